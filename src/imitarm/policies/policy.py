"""The interface of every policy, and ACFRA, the built-in one.

A policy observes an arm and its scene, and returns a command. ACFRA (adaptive collision-free reaching, thesis Chapter
4) adapts the whole learned path, then follows it.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies.adaptation import adapt, adapter_named
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.component_path import ComponentPath
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number, instance

Array = NDArray[np.float64]

_OF_THE_ARM = ("arm", "max_tilt", "goal_tilt")  # options that a policy need not have
_LEAST_PATIENCE = 5e-3  # [m] no robot follows more closely than this at all times
_ALLOWANCE, _ALLOWANCE_OF_ARM = 2e-3, 5e-3  # [m] usual margin of a plan for the tool, for the whole arm
_SAME_START = 1e-4  # [m, rad] the joints are planned from exactly where the arm is
_SAME_PLACE = 5e-3  # [m, rad] a start nearer than this to the learned one is the learned one
_STANDS = 0.05  # speed of the phase below which the motion is said to wait
_DISPLACED = 1e-3  # [m] from the learned path: less is not called avoiding


@dataclass(frozen=True, eq=False)
class Observation:
    """The input of a policy at one control step.

    Attributes:
        time: time since the reproduction began [s].
        state: measured state of the arm.
        tool_to_base: measured pose of the tool in the base frame.
        scene: goal and obstacles as last seen, at the time ``scene.stamp``; ``scene.at(time)`` predicts the
            obstacles at the current time.
    """

    time: float
    state: ArmState
    tool_to_base: Pose
    scene: Scene

    def __post_init__(self) -> None:
        finite_number(self.time, "Observation: time", "s")
        instance(self.state, ArmState, "Observation: state")
        instance(self.tool_to_base, Pose, "Observation: tool_to_base")
        instance(self.scene, Scene, "Observation: scene")


class Policy(ABC):
    """Decides the next command from the current observation.

    To write your own policy, implement the three methods below in one subclass. Register the policy under the entry
    point group ``imitarm.policies``, or by ``POLICIES.register(name, policy)``. The policy then appears in ``imitarm
    reproduce --policy``, in ``imitarm benchmark placements`` and in their reports. These commands construct the policy
    with the arguments below. The state of a policy lasts from :meth:`reset` to the end of one reproduction; the same
    observations give the same commands.

    Args:
        skill: the skill to reproduce.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m]; None: its tip.
        clearance: required distance of the tool to every obstacle [m].
        forbidden: directions in which the motion must not leave the learned path, shape (m, 3).
        arm: the arm that will move, for policies that plan its joints; None: not known.

    Attributes:
        plan: plan to draw in a report, an :class:`~imitarm.policies.Adaptation`; None if the policy has no plan.
    """

    plan: Any = None

    def __init__(
        self,
        skill: Skill,
        *,
        tool_spheres: ArrayLike | None = None,
        clearance: float = 0.02,
        forbidden: ArrayLike = (),
        arm: ArmModel | None = None,
    ) -> None:
        self.arm = None if arm is None else instance(arm, ArmModel, "Policy: arm")
        self.skill = instance(skill, Skill, "Policy: skill")
        self.tool_spheres = (
            None if tool_spheres is None else finite_array(tool_spheres, (None, 4), "Policy: tool_spheres", "m")
        )
        self.clearance = finite_number(clearance, "Policy: clearance", "m", at_least=0.0)
        self.forbidden = forbidden

    @classmethod
    def build(cls, skill: Skill, **options: Any) -> Self:
        """Return a policy, built from the arguments that the command line and the benchmark give to every policy.

        Options about the arm are left out if the constructor does not take them.

        Raises:
            InputError: when the constructor does not take the other arguments.
        """
        parameters = inspect.signature(cls).parameters.values()
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            known = {parameter.name for parameter in parameters}
            options = {name: value for name, value in options.items() if name in known or name not in _OF_THE_ARM}
        try:
            return cls(skill, **options)
        except TypeError as error:
            raise InputError(
                f"{cls.__name__}: can't be built with the arguments {', '.join(options)}: {error}; let its "
                f"constructor take the arguments of Policy's constructor"
            ) from error

    @abstractmethod
    def reset(self, observation: Observation) -> None:
        """Start a reproduction in the observed scene.

        Raises:
            InfeasibleError: when the policy knows in advance that the reproduction is impossible; the message says why.
        """

    @abstractmethod
    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command for the next ``dt`` seconds."""

    @abstractmethod
    def finished(self, observation: Observation) -> bool:
        """Return whether the motion has arrived."""


class ACFRA(Policy):
    r"""Adapt the whole path once, then follow it (thesis Chapter 4).

    The constructor decomposes the learned path. The method ``reset`` adapts this path to the observed scene, and raises
    an error when the clearance can't be kept. The method ``step`` follows the adapted path with the path's velocity
    plus feedback::

        twist = r v_d(s) + K [p_d(s) - p; log(R_d(s) R^T)],     ds/dt = r = max(0, 1 - (|p_d - p| / e_0)^2)

    The phase ``s`` therefore waits for a robot that lags, for example at its speed limits or when a hand holds it. A
    robot that has left the path returns to it along the straight line from the tool to its target. The tool and its
    target are both clear of obstacles, and each point of the line is within ``e_0 / 2`` of the tool or of the target.
    If ``e_0`` is the required clearance, the line therefore cuts a corner by at most half of the clearance.

    Among moving obstacles the plan is valid only at the planned times, so the phase follows the clock and does not
    wait. When the tool is farther than ``e_0 / 2`` from its planned position, the plan is no longer valid: the arm
    brakes and stays at rest.

    Only the method ``"certified"`` raises an error in advance when it can't keep the clearance. The thesis's potential
    fields (``"mapf"``, ``"literal"``) serve for comparison, so the robot follows their paths even if these paths do not
    keep the clearance.

    Args:
        skill: skill to reproduce.
        method: name in :data:`~imitarm.policies.ADAPTERS`.
        tool_radius: radius of one sphere about the tool's tip [m]; use it instead of ``tool_spheres``.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m].
        clearance: required distance of the tool to every obstacle [m].
        forbidden: directions in which the motion must not leave the learned path, shape (m, 3).
        pinned: times at which the path must not move [s].
        arm: the arm with its tool. The policy then plans the joints of the whole arm and follows them, and
            ``tool_radius`` and ``tool_spheres`` are not used. None: only the path of the tool is planned.
        max_tilt: largest rotation of the tool of ``arm`` away from the learned rotation [rad]; see
            :func:`~imitarm.policies.adapt`.
        goal_tilt: largest rotation of the tool of ``arm`` at the goal [rad]; see :func:`~imitarm.policies.adapt`.
        gain: K [1/s].
        patience: e_0, the position error at which the phase stops [m]; None: the clearance, at least 5 mm.
        arrival: the motion has arrived when the tool is nearer than this to the end of the path [m].
        allowance: additional clearance for the robot's tracking errors, used if a path with this larger clearance is
            found [m]. The default is 2 mm for a plan of the tool, and 5 mm for a plan of the whole arm.

    Attributes:
        adaptation: result of the last ``reset``.
    """

    def __init__(
        self,
        skill: Skill,
        *,
        method: str = "certified",
        tool_radius: float | None = None,
        tool_spheres: ArrayLike | None = None,
        clearance: float = 0.02,
        forbidden: ArrayLike = (),
        pinned: Sequence[float] = (),
        arm: ArmModel | None = None,
        max_tilt: float | None = None,
        goal_tilt: float = 0.0,
        gain: float = 8.0,
        patience: float | None = None,
        arrival: float = 0.003,
        allowance: float | None = None,
    ) -> None:
        super().__init__(skill, tool_spheres=tool_spheres, clearance=clearance, forbidden=forbidden, arm=arm)
        self._refuses = adapter_named(method).refuses
        self._whole_arm = arm is not None and self._refuses
        self._options: dict[str, Any] = {"method": method, "forbidden": forbidden}
        if self._whole_arm:
            self._options |= {"arm": arm, "max_tilt": max_tilt, "goal_tilt": goal_tilt}
        else:
            self._options |= {"tool_radius": tool_radius, "tool_spheres": tool_spheres}
        self._path = ComponentPath.of_skill(skill, pinned=pinned)
        self._gain = finite_number(gain, "ACFRA: gain", "1/s", above=0.0)
        self._arrival = finite_number(arrival, "ACFRA: arrival", "m", above=0.0)
        usual = _ALLOWANCE_OF_ARM if self._whole_arm else _ALLOWANCE
        self._allowance = finite_number(
            usual if allowance is None else allowance, "ACFRA: allowance", "m", at_least=0.0
        )
        self._patience = max(self.clearance, _LEAST_PATIENCE)
        if patience is not None:
            self._patience = finite_number(patience, "ACFRA: patience", "m", above=0.0)
        self.adaptation: Adaptation | None = None
        self._phase, self._void = 0.0, ""

    def reset(self, observation: Observation) -> None:
        """Adapt the path to the scene, starting at the measured pose of the tool.

        Raises:
            InfeasibleError: when the clearance can't be kept; the message names the obstacle and the reason.
        """
        away = observation.tool_to_base.error_to(self.skill.start_)
        if not self.skill.gmr_.has_orientation_:
            away = away[:3]
        same = np.linalg.norm(away) <= (_SAME_START if self._whole_arm else _SAME_PLACE)
        start = None if same else observation.tool_to_base
        self.adaptation = self._adapted(observation.scene.now(observation.time), start, observation.state)
        if not self.adaptation.feasible and self._refuses:
            raise InfeasibleError(self.adaptation.reason)
        self._path_to_follow, self._joints = path, joints = _with_approach(self.adaptation, self.arm)
        velocity = np.gradient(path.positions, path.times, axis=0)
        rotation = np.zeros((len(path), 3))
        if path.quaternions is not None:
            step = quaternion_multiply(path.quaternions[1:], quaternion_conjugate(path.quaternions[:-1]))
            rotation[:-1] = quaternion_log(step) / np.diff(path.times)[:, None]
        self._twists = np.concatenate([velocity, rotation], axis=1)
        self._joint_velocities = None if joints is None else np.gradient(joints, path.times, axis=0)
        planned = self.adaptation.trajectory.positions
        displaced = np.linalg.norm(planned - self.adaptation.nominal.positions, axis=1)
        self._displaced = np.concatenate([np.zeros(len(path) - len(displaced)), displaced])
        self._hold = observation.tool_to_base
        self._began = observation.time
        self._phase, self._void = 0.0, ""

    def _adapted(self, scene: Scene, start: Pose | None, state: ArmState) -> Adaptation:
        """Return the adapted path that begins at ``start``, or at the learned start if ``start`` is None."""
        path = self._path.between(self.skill, start, scene.goal)
        allowance = self._allowance if self._refuses else 0.0
        return adapt(
            path,
            scene,
            clearance=self.clearance,
            allowance=allowance,
            state=state if self._whole_arm else None,
            **self._options,
        )

    @property
    def plan(self) -> Adaptation | None:
        """The result of the last adaptation, for drawing in a report."""
        return self.adaptation

    @property
    def phase(self) -> float:
        """The phase of the motion, as a time in the demonstrated motion [s]."""
        return self._phase

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command that follows the adapted path.

        Raises:
            InputError: when ``reset`` was not called.
        """
        if self.adaptation is None:
            raise InputError("ACFRA.step: call reset(observation) first")
        path = self._path_to_follow
        end = float(path.times[-1])
        on_schedule = self.adaptation.only_on_schedule
        if on_schedule:
            self._phase = min(observation.time - self._began, end)
        target = self._target(path)
        error = observation.tool_to_base.error_to(target)
        lag = float(np.linalg.norm(error[:3]))
        if on_schedule and lag > 0.5 * self._patience:
            self._void = self._void or (
                f"the plan is valid only at the planned times, but the tool is {1e3 * lag:.0f} mm from its planned "
                f"position at {observation.time:.2f} s: the arm brakes; plan again from here"
            )
        if self._void:
            return Command(np.zeros(6), progress=self._phase / end, status=Status.BRAKING, reason=self._void)
        speed = 1.0 if on_schedule else max(0.0, 1.0 - (lag / self._patience) ** 2)
        phase = self._phase
        forward = _at(phase, path.times, self._twists)
        if self._phase >= end:
            speed = 0.0
        elif not on_schedule:
            self._phase = min(self._phase + speed * dt, end)
        joints = self._joint_command(observation.state.q, phase, speed)
        return self._command(speed * forward + self._gain * error, joints, speed, lag, end)

    def _joint_command(self, q: Array, phase: float, speed: float) -> Array | None:
        """Return the joint velocity that follows the planned joints; None when only the tool was planned."""
        joints, times = self._joints, self._path_to_follow.times
        if joints is None or self._joint_velocities is None:
            return None
        forward = _at(phase, times, self._joint_velocities)
        return np.asarray(speed * forward + self._gain * (_at(phase, times, joints) - q))

    def _command(self, twist: Array, joints: Array | None, speed: float, lag: float, end: float) -> Command:
        assert self.adaptation is not None
        progress = self._phase / end
        if (speed < _STANDS and self._phase < end) or (self._phase >= end and lag > self._arrival):
            what = "behind its path" if self._phase < end else "from the end of its path"
            reason = f"the tool is {1e3 * lag:.0f} mm {what}"
            return Command(twist, joints, progress=progress, status=Status.WAITING, reason=reason)
        displaced = float(np.interp(self._phase, self._path_to_follow.times, self._displaced))
        if displaced > _DISPLACED:
            reason = f"the path is displaced by {1e3 * displaced:.0f} mm here because of an obstacle"
            return Command(twist, joints, progress=progress, status=Status.AVOIDING, reason=reason)
        return Command(twist, joints, progress=progress)

    def _target(self, path: Trajectory) -> Pose:
        """Return the desired pose at the current phase; without a learned orientation, the tool's rotation is kept."""
        if self._joints is not None and self.arm is not None:  # between samples the joints move linearly
            return self.arm.tool_pose(_at(self._phase, path.times, self._joints))
        positions, quaternions = path.at([self._phase])
        return Pose(positions[0], self._hold.quaternion if quaternions is None else quaternions[0])

    def finished(self, observation: Observation) -> bool:
        """Return whether the phase is at its end, and the tool is nearer than ``arrival`` to the end of the path."""
        if self.adaptation is None or self._void:
            return False
        path = self._path_to_follow
        away = np.linalg.norm(observation.tool_to_base.position - path.positions[-1])
        return self._phase >= path.times[-1] and bool(away < self._arrival)


def _at(time: float, times: Array, values: Array) -> Array:
    """Return the row at ``time``, shape (m,), interpolated linearly between the rows of ``values`` (n, m)."""
    return np.array([np.interp(time, times, column) for column in values.T])


def _with_approach(plan: Adaptation, arm: ArmModel | None) -> tuple[Trajectory, Array | None]:
    """Return the tool's path and the joints (n, n_joints) of the whole motion, which begins with the approach."""
    path, joints, approach = plan.trajectory, plan.joints, plan.approach
    if approach is None or joints is None or arm is None:
        return path, joints
    positions, quaternions = arm.tool_path(approach.joints[:-1])  # its last posture is the first one of the plan
    whole = Trajectory(
        np.concatenate([approach.times[:-1], approach.times[-1] + path.times]),
        np.concatenate([positions, path.positions]),
        None if path.quaternions is None else np.concatenate([quaternions, path.quaternions]),
    )
    return whole, np.concatenate([approach.joints[:-1], joints])
