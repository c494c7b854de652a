"""Retargeter: what turns a person's arm into a robot's, one control step at a time; and runs of whole recordings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.retarget.correspondence import Correspondence
from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

STATES = ("waiting", "following", "coasting", "holding", "stopped")
"""What a retargeter may be doing: waiting for a person to take hold; following; bridging a short gap by coasting, a
longer one by holding; stopped until the person takes hold anew."""


@dataclass(frozen=True, eq=False)
class Command:
    """What one control step of a retargeter came to.

    Attributes:
        time: since :meth:`Retargeter.start` [s].
        q: joint positions to be at when the step is over, shape (n_joints,) [rad].
        velocity: joint velocity at that moment, shape (n_joints,) [rad/s].
        closed: whether the gripper is to be closed; None: as it is.
        state: one of :data:`STATES`.
        target: where the tool should be, ``tool_to_base``, before any limit; None while nothing is followed.
        elbow: direction from the shoulder to the elbow of the person in the base frame, shape (3,); None when unknown.
    """

    time: float
    q: Array
    velocity: Array
    closed: bool | None = None
    state: str = "waiting"
    target: Pose | None = None
    elbow: Array | None = None


class Retargeter(ABC):
    """Turns a person's arm, seen as skeletons, into joint positions of a robot arm, at a fixed control period.

    A method is one subclass. :meth:`start` puts it at rest at a posture; then :meth:`step` is called once every
    ``dt``, with the skeleton that came in since the last call, or None. Cameras give 30 frames a second and a robot
    wants 100 commands: most steps get None.

    Attributes:
        name: of the method, as in :data:`imitarm.retarget.RETARGETERS`.
        arm: the robot's arm with its tool.
        correspondence: what of the person's arm stands for what of the robot's.
        dt: control period [s].
        scene: obstacles that a method which heeds them keeps clear of.
        command: what the last step came to.
    """

    name: ClassVar[str]

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
    ) -> None:
        if not 0.0005 <= dt <= 0.05:
            raise InputError(f"{type(self).__name__}: dt must be between 0.0005 and 0.05 s, got {dt!r}")
        self.arm = arm
        self.correspondence = Correspondence() if correspondence is None else correspondence
        self.dt = dt
        self.scene = Scene() if scene is None else scene
        self.command: Command
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Forget the past and be at rest at ``q``, shape (n_joints,) [rad].

        Raises:
            InputError: when ``q`` has a wrong shape or is beyond the joints' limits.
        """
        posture = np.array(q, dtype=float)
        self.arm.check_limits(posture)
        self.command = Command(0.0, posture, np.zeros(self.arm.n_joints))
        self._begin(posture)

    @abstractmethod
    def _begin(self, q: Array) -> None:
        """Forget the past; ``command`` has been set to rest at ``q``."""

    @abstractmethod
    def step(self, skeleton: Skeleton | None, q: ArrayLike) -> Array:
        """Return the joint positions to be at after ``dt``, and set ``command``.

        Args:
            skeleton: the newest one since the last step, or None.
            q: measured joint positions, shape (n_joints,) [rad].

        Returns:
            shape (n_joints,) [rad].
        """

    def run(self, skeletons: Iterable[Skeleton], q: ArrayLike | None = None) -> Retargeting:
        """Retarget a whole recording with a robot that does what it is told.

        Args:
            skeletons: in the order of their times.
            q: where the arm is at first, shape (n_joints,) [rad]; None: ``arm.home``.

        Raises:
            InputError: when there are fewer than two skeletons, or times do not increase.
        """
        frames = in_order(skeletons)
        self.start(self.arm.home if q is None else q)
        commands = [self.command]
        for skeleton in ticks(frames, self.dt):
            self.step(skeleton, commands[-1].q)
            commands.append(self.command)
        return Retargeting.of(self, commands, self.notes)

    @property
    def notes(self) -> dict[str, float]:
        """What there is to count so far, by name; a method without anything to count has none."""
        return {}


@dataclass(frozen=True, eq=False)
class Retargeting:
    """What a method made of a recording, sampled at its control period.

    Attributes:
        method: its name.
        arm: the robot's arm.
        times: shape (n,) [s], from 0.
        joints: shape (n, n_joints) [rad].
        velocities: as commanded, shape (n, n_joints) [rad/s].
        targets: of the tool, positions (n, 3) [m] and quaternions (n, 4); nan while nothing was followed.
        elbows: directions from the person's shoulder to the elbow in the base frame, (n, 3); nan where unknown.
        closed: whether the gripper was to be closed, shape (n,) bool.
        states: shape (n,), each one of :data:`STATES`.
        notes: what else the method has to say, for example corrections made and failures left, by name.
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
    notes: dict[str, float]

    @classmethod
    def of(
        cls, retargeter: Retargeter, commands: Sequence[Command], notes: dict[str, float] | None = None
    ) -> Retargeting:
        """Stack the commands of a run."""
        nowhere, unknown = np.full(3, np.nan), np.full(4, np.nan)
        closed, now = np.zeros(len(commands), dtype=bool), False
        for i, command in enumerate(commands):
            now = now if command.closed is None else command.closed
            closed[i] = now
        return cls(
            retargeter.name,
            retargeter.arm,
            np.array([c.time for c in commands]),
            np.array([c.q for c in commands]),
            np.array([c.velocity for c in commands]),
            (
                np.array([nowhere if c.target is None else c.target.position for c in commands]),
                np.array([unknown if c.target is None else c.target.quaternion for c in commands]),
            ),
            np.array([nowhere if c.elbow is None else c.elbow for c in commands]),
            closed,
            np.array([c.state for c in commands]),
            {} if notes is None else notes,
        )

    def demonstration(self, task: str = "", source: str = "") -> Demonstration:
        """Return the motion of the robot's tool and joints as a demonstration to learn from."""
        trajectory = Trajectory(self.times, *self.arm.tool_path(self.joints))
        return Demonstration(trajectory, self.joints, task=task, source=source)


def in_order(skeletons: Iterable[Skeleton]) -> list[Skeleton]:
    """Return a recording as a list, or say where it is not one.

    Raises:
        InputError: when there are fewer than two skeletons, or a time is not later than the one before.
    """
    frames = list(skeletons)
    if len(frames) < 2:
        raise InputError(f"retarget: needs at least 2 skeletons, got {len(frames)}; is the person in the picture?")
    for i, (before, after) in enumerate(pairwise(frames)):
        if after.time <= before.time:
            raise InputError(
                f"retarget: skeleton {i + 1} has time {after.time:g} s, which is not later than the one before; "
                "sort the recording, or keep one person of it"
            )
    return frames


def ticks(frames: Sequence[Skeleton], dt: float) -> Iterable[Skeleton | None]:
    """Give for each control period of a recording the newest skeleton that came in during it, or None.

    Args:
        frames: in order, at least one.
        dt: control period [s].
    """
    start, k = frames[0].time, 0
    for step in range(int(np.floor((frames[-1].time - start) / dt)) + 1):
        newest = None
        while k < len(frames) and frames[k].time - start <= step * dt + 1e-9:
            newest = frames[k]
            k += 1
        yield newest
