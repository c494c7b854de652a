"""Retargeter: converts a person's arm motion into a robot's joint motion, one control period at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.retarget.arm_estimator import ArmEstimate, ArmEstimator
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.engagement import Engagement, EngagementRule, EngagementState, engaged_samples
from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import finite_number, finite_vector, instance

Array = NDArray[np.float64]

PUSHED = 0.05  # [rad] a joint at rest that is found farther than this from its command was moved by hand


@dataclass(frozen=True, eq=False)
class RetargetStep:
    """Result of one control step of a retargeter.

    Attributes:
        time: time since :meth:`Retargeter.start` [s].
        q: commanded joint positions at the end of the step, shape (n_joints,) [rad].
        velocity: joint velocities at the end of the step, shape (n_joints,) [rad/s].
        closed: whether the gripper should be closed; None: leave it as it is.
        state: whether the robot waits, follows, coasts, holds its target or is stopped.
        target: desired pose of the tool in the base frame, before limits are applied; None while the robot follows
            nobody.
        elbow: unit vector from the person's shoulder to the elbow in the base frame, shape (3,); None when unknown.
    """

    time: float
    q: Array
    velocity: Array
    closed: bool | None = None
    state: EngagementState = EngagementState.WAITING
    target: Pose | None = None
    elbow: Array | None = None


class Goal(NamedTuple):
    """The input of a method in one control step while the robot follows the person.

    Attributes:
        target: current desired pose of the tool in the base frame.
        estimate: estimate of the person's arm, from the last camera frame that shows the arm.
        fresh: whether this camera frame arrived in the current control step.
        age: time since this camera frame arrived [s].
        state: FOLLOWING, COASTING or HOLDING; in the other states, the robot follows nobody.
        clutch: the poses of hand and tool when the robot began to follow the person.
    """

    target: Pose
    estimate: ArmEstimate
    fresh: bool
    age: float
    state: EngagementState
    clutch: Clutch


class Retargeter(ABC):
    """Converts a person's arm motion, given as skeletons, to joint positions of a robot arm.

    Call :meth:`start` with the posture in which the robot is at rest. Then call :meth:`step` once per control period
    ``dt`` with the skeleton that arrived since the last call, or None. A camera delivers about 30 frames per second,
    but a robot takes 100 commands per second. Most calls therefore receive None instead of a skeleton.

    Every control step has four parts, which are the same for all methods:

    1. ``_see`` computes an estimate of the person's arm from a new skeleton;
    2. the :class:`~imitarm.retarget.engagement.Engagement` decides whether the robot follows the person;
    3. if the robot follows the person, ``_hand`` and ``_target`` compute the desired pose of the tool;
    4. ``_advance`` returns the joint positions of the next period. Each method has its own ``_advance``.

    A method is a subclass that implements ``_advance``. The subclass may also override other functions, such as
    ``_see`` or ``_target``, which have default implementations. The ``title`` and the ``caption`` of the subclass
    appear in tables and reports::

        class Damped(Retargeter):
            name, title = "damped", "Damped least squares"

            def _advance(self, goal, measured):
                q = self.latest.q
                if goal is None:
                    return q
                J = self.arm.tool_jacobian(q)
                error = self.arm.tool_pose(q).error_to(goal.target)
                return q + 0.1 * J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(6), error)

    Attributes:
        name: name of the method, as in :data:`imitarm.retarget.RETARGETERS`; default: the class's name.
        title: title of the method in tables and reports; default: ``name``.
        caption: one sentence about the method for reports.
        rule: how long the person must be seen before the robot follows, and how long the person may be lost until the
            robot stops.
        arm: the robot's arm with its tool.
        n_joints: number of joints of the arm.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: obstacles; only some methods avoid them.
        latest: result of the last step.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation. With None,
            default values are used.
        dt: control period [s].
        scene: obstacles; None: no obstacles.

    Raises:
        InputError: when an argument has the wrong type, or ``dt`` is out of range.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    caption: ClassVar[str] = ""
    rule: ClassVar[EngagementRule] = EngagementRule()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = cls.__dict__  # a subclass of a method is another method: it does not inherit these
        cls.name = own.get("name", cls.__name__)
        cls.title = own.get("title", cls.name)
        cls.caption = own.get("caption", "")

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
    ) -> None:
        me = type(self).__name__
        self.arm = instance(arm, ArmModel, f"{me}: arm")
        chosen = Correspondence() if correspondence is None else correspondence
        self.correspondence = instance(chosen, Correspondence, f"{me}: correspondence")
        self.dt = finite_number(dt, f"{me}: dt", "s", at_least=0.0005, at_most=0.05)
        self.scene = instance(Scene() if scene is None else scene, Scene, f"{me}: scene")
        self.n_joints = arm.n_joints
        self.latest = RetargetStep(0.0, np.array(arm.home), np.zeros(arm.n_joints))
        self._engagement = Engagement(self.correspondence, self.rule)
        self._estimator: ArmEstimator  # made by start
        self._estimate: ArmEstimate | None = None
        self._started = False

    def start(self, q: ArrayLike) -> None:
        """Reset the state, with the robot at rest at ``q``, shape (n_joints,) [rad].

        Raises:
            InputError: when ``q`` has the wrong shape or is beyond the joint limits.
        """
        posture = finite_vector(q, self.arm.n_joints, "q", "rad").copy()
        self.arm.check_limits(posture)
        self.latest = RetargetStep(0.0, posture, np.zeros(self.arm.n_joints))
        self._engagement.reset()
        self._estimator = self._new_estimator()
        self._estimate = None
        self._started = True
        self._begin()
        self._rest_at(posture)

    def step(self, skeleton: Skeleton | None, q: ArrayLike) -> Array:
        """Process one control period; the class describes its parts.

        If :meth:`start` was not called before, the first call starts at ``arm.home``.

        Args:
            skeleton: newest skeleton since the last step; None if no skeleton has arrived.
            q: measured joint positions, shape (n_joints,) [rad].

        Returns:
            The joint positions to reach by the end of the period, shape (n_joints,) [rad]; also in :attr:`latest`.

        Raises:
            InputError: when ``q`` is not ``n_joints`` finite numbers, or ``skeleton`` is not a skeleton.
        """
        if not self._started:
            self.start(self.arm.home)
        measured = finite_vector(q, self.n_joints, "q", "rad")
        if skeleton is not None:
            instance(skeleton, Skeleton, "skeleton")
        engagement, dt = self._engagement, self.dt
        fresh = self._see(skeleton)
        if fresh is not None:
            self._estimate = fresh
        at_rest = engagement.clutch is None and self._at_rest()
        if at_rest:
            self._start_where_pushed(measured)
        engagement.update(fresh, dt, at_rest=at_rest)
        if engagement.ready:
            engagement.engage(*self._hand(), self.arm.tool_pose(self.latest.q))
        goal = self._goal(fresh is not None)
        before = self.latest
        reached = self._advance(goal, measured)
        velocity, time = self._velocity_at(before.q, reached), before.time + dt
        if goal is None:
            self.latest = RetargetStep(time, reached, velocity, None, engagement.state)
        else:
            arm = goal.estimate
            self.latest = RetargetStep(time, reached, velocity, arm.closed, goal.state, goal.target, arm.upper_arm)
        return reached

    def run(self, skeletons: Iterable[Skeleton], q: ArrayLike | None = None) -> Retargeting:
        """Retarget a whole recording with a robot that reaches every commanded position.

        Args:
            skeletons: skeletons in order of time.
            q: start posture, shape (n_joints,) [rad]; None: ``arm.home``.

        Raises:
            InputError: when there are fewer than two skeletons, or times do not increase.
        """
        frames = in_order(skeletons)
        self.start(self.arm.home if q is None else q)
        steps = [self.latest]
        for skeleton in ticks(frames, self.dt):
            self.step(skeleton, steps[-1].q)
            steps.append(self.latest)
        return Retargeting.of(self, steps, self.notes)

    @property
    def notes(self) -> dict[str, float]:
        """Counts and other figures that the method reports, by name; empty by default."""
        return {}

    # --- the method

    @abstractmethod
    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        """Return the joint positions to reach by the end of this period, shape (n_joints,) [rad].

        The last commanded positions are ``self.latest.q``.

        Args:
            goal: desired pose of the tool, with the data that it is computed from; None while the robot follows nobody
                and must therefore stop and stay at rest.
            measured: measured joint positions, shape (n_joints,) [rad].
        """

    # --- what a method may replace

    def _begin(self) -> None:  # noqa: B027 (optional)
        """Reset the method's state; :meth:`start` calls this before ``_rest_at``."""

    def _rest_at(self, q: Array) -> None:  # noqa: B027 (optional)
        """Store that the robot is at rest at ``q`` (n_joints,) [rad], at the start or after it was moved by hand."""

    def _new_estimator(self) -> ArmEstimator:
        """Return the estimator of the person's arm."""
        return ArmEstimator(self.correspondence)

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        """Return the estimate of the person's arm from a new skeleton; None without a skeleton that shows the arm."""
        return None if skeleton is None else self._estimator.update(skeleton)

    def _hand(self) -> tuple[Array, Array]:
        """Return the current wrist (3,) [m] and hand quaternion (4,) wxyz to follow, in the base frame."""
        assert self._estimate is not None
        return self._estimate.wrist, self._estimate.hand

    def _target(self, clutch: Clutch, wrist: Array, hand: Array) -> Pose:
        """Return the desired pose of the tool in the base frame for a wrist (3,) [m] and a hand (4,) wxyz."""
        return clutch.target(wrist, hand)

    def _at_rest(self) -> bool:
        """Return whether the robot is at rest; only then may it begin to follow a person."""
        return True

    def _velocity_at(self, before: Array, after: Array) -> Array:
        """Return the joint velocities at the end of this period, shape (n_joints,) [rad/s].

        The default implementation returns the mean velocity over the period.
        """
        return (after - before) / self.dt

    # --- the same for all

    def _start_where_pushed(self, measured: Array) -> None:
        """Rest at the measured posture if the arm was moved by hand while the robot followed nobody."""
        if float(np.abs(measured - self.latest.q).max()) > PUSHED:
            q = np.clip(measured, self.arm.lower, self.arm.upper)
            self.latest = RetargetStep(self.latest.time, q, np.zeros(self.arm.n_joints), state=self.latest.state)
            self._rest_at(q)

    def _goal(self, fresh: bool) -> Goal | None:
        clutch, estimate = self._engagement.clutch, self._estimate
        if clutch is None or estimate is None:
            return None
        target = self._target(clutch, *self._hand())
        return Goal(target, estimate, fresh, self._engagement.time_since_seen, self._engagement.state, clutch)


@dataclass(frozen=True, eq=False)
class Retargeting:
    """The robot motion that a method has computed from a recording, sampled at the control period.

    Attributes:
        method: name of the method.
        arm: the robot's arm.
        times: time stamps, shape (n,) [s], from 0.
        joints: joint positions, shape (n, n_joints) [rad].
        velocities: commanded joint velocities, shape (n, n_joints) [rad/s].
        targets: target positions (n, 3) [m] and quaternions wxyz (n, 4) of the tool; nan while the robot follows
            nobody.
        elbows: unit vectors from the person's shoulder to the elbow in the base frame, shape (n, 3); nan where unknown.
        closed: whether the gripper should be closed at each sample, shape (n,) bool.
        states: state at each sample, shape (n,), values of :class:`~imitarm.retarget.engagement.EngagementState`.
        notes: counts and other figures that the method reports, by name.
        title: title of the method for tables and reports; if empty, ``method`` is used.
        caption: one sentence about the method for reports.
        shown_times: time in the person's recording that corresponds to each sample, counted from the first skeleton,
            shape (n,) [s]. Only methods that slow the motion down need it. None: equal to ``times``.
    """

    method: str
    arm: ArmModel
    times: Array
    joints: Array
    velocities: Array
    targets: tuple[Array, Array]
    elbows: Array
    closed: NDArray[np.bool_]
    states: NDArray[np.str_]
    notes: dict[str, float] = field(default_factory=dict)
    title: str = ""
    caption: str = ""
    shown_times: Array | None = None

    @classmethod
    def of(
        cls,
        retargeter: Retargeter,
        steps: Sequence[RetargetStep],
        notes: dict[str, float] | None = None,
        shown_times: Array | None = None,
    ) -> Retargeting:
        """Combine the steps of a run into arrays."""
        nowhere, unknown = np.full(3, np.nan), np.full(4, np.nan)
        closed, now = np.zeros(len(steps), dtype=bool), False
        for i, step in enumerate(steps):
            now = now if step.closed is None else step.closed
            closed[i] = now
        return cls(
            retargeter.name,
            retargeter.arm,
            np.array([step.time for step in steps]),
            np.array([step.q for step in steps]),
            np.array([step.velocity for step in steps]),
            (
                np.array([nowhere if step.target is None else step.target.position for step in steps]),
                np.array([unknown if step.target is None else step.target.quaternion for step in steps]),
            ),
            np.array([nowhere if step.elbow is None else step.elbow for step in steps]),
            closed,
            np.array([step.state.value for step in steps]),
            {} if notes is None else notes,
            retargeter.title,
            retargeter.caption,
            shown_times,
        )

    @property
    def engaged(self) -> NDArray[np.bool_]:
        """Whether the robot followed the person at each sample, shape (n,) bool."""
        return engaged_samples(self.states)

    def demonstration(self, task: str = "", source: str = "") -> Demonstration:
        """Return the motion of the robot's tool and joints as a demonstration to learn from."""
        trajectory = Trajectory(self.times, *self.arm.tool_path(self.joints))
        return Demonstration(trajectory, self.joints, task=task, source=source)


def in_order(skeletons: Iterable[Skeleton]) -> list[Skeleton]:
    """Return the skeletons of a recording as a list, after checking them.

    Raises:
        InputError: when there are fewer than two skeletons, when an item is not a skeleton, or when times do not
            increase.
    """
    if not isinstance(skeletons, Iterable):
        raise InputError(f"retarget: needs a sequence of skeletons, got {type(skeletons).__name__}")
    frames = [instance(frame, Skeleton, "retarget: each frame") for frame in skeletons]
    if len(frames) < 2:
        raise InputError(f"retarget: needs at least 2 skeletons, got {len(frames)}; is the person in the picture?")
    for i, (before, after) in enumerate(pairwise(frames)):
        if after.time <= before.time:
            raise InputError(
                f"retarget: skeleton {i + 1} has time {after.time:g} s, not later than the previous skeleton; "
                "sort the recording by time, or keep only one person"
            )
    return frames


def ticks(frames: Sequence[Skeleton], dt: float) -> Iterable[Skeleton | None]:
    """For each control period of a recording, yield the newest skeleton of the period, or None.

    Args:
        frames: frames in order of time, at least one.
        dt: control period [s].
    """
    start, k = frames[0].time, 0
    for step in range(int(np.floor((frames[-1].time - start) / dt)) + 1):
        newest = None
        while k < len(frames) and frames[k].time - start <= step * dt + 1e-9:
            newest = frames[k]
            k += 1
        yield newest
