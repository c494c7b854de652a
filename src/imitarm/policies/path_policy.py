"""PathPolicy: the base class of policies that plan the whole path of the tool once, then follow it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from imitarm.command import Command, Status
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.policy import Observation, Policy
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_LEAST_PATIENCE = 5e-3  # [m] no robot follows more closely than this at all times
_SAME_PLACE = 5e-3  # [m, rad] a start nearer than this to the learned one is the learned one
_STANDS = 0.05  # speed of the phase below which the motion is said to wait
_DISPLACED = 1e-3  # [m] from the learned path: less is not called avoiding
_EVEN = 200  # evenly spaced samples at which speed and acceleration are computed
_ROUNDS = 40  # of slowing down
_SPARE = 0.97  # fraction of the limits that is used
_WIDTH = 4  # samples: slowing down begins so much before the place where it is needed


@dataclass(frozen=True, eq=False)
class PathPlan:
    """The motion that a :class:`PathPolicy` follows.

    Attributes:
        trajectory: path of the tool with times, n samples. If it has no quaternions, the tool keeps its rotation.
        displaced: distance of each sample from the learned path at the same fraction of the duration, shape (n,) [m].
        joints: joint positions of the arm at the samples, shape (n, n_joints) [rad]; the joints move linearly between
            the samples. None if only the tool was planned.
        only_on_schedule: whether the plan keeps its clearance only at the planned times, because an obstacle moves.
        adaptation: the result of :func:`~imitarm.policies.adapt`, for reports; None if the method computes no
            adaptation.
    """

    trajectory: Trajectory
    displaced: Array
    joints: Array | None = None
    only_on_schedule: bool = False
    adaptation: Adaptation | None = None

    @classmethod
    def beside(cls, nominal: Trajectory, trajectory: Trajectory) -> Self:
        """Return a plan that follows ``trajectory``; ``nominal`` is the learned path between the same ends."""
        phase = (trajectory.times - trajectory.times[0]) / trajectory.duration
        learned, _ = nominal.at(nominal.times[0] + phase * nominal.duration)
        return cls(trajectory, np.linalg.norm(trajectory.positions - learned, axis=1))

    def within(self, max_speed: float, max_acceleration: float) -> PathPlan:
        """Return a plan with the same path, slowed down where the tool would exceed a limit.

        A plan that is valid only at its planned times or that has ``joints`` is returned unchanged.

        Args:
            max_speed: largest speed of the tool [m/s].
            max_acceleration: largest acceleration of the tool [m/s^2].
        """
        if self.only_on_schedule or self.joints is not None:
            return self
        times = _slowed(self.trajectory, max_speed, max_acceleration)
        if times is self.trajectory.times:
            return self
        path = self.trajectory
        return replace(self, trajectory=Trajectory(times, path.positions, path.quaternions))


class PathPolicy(Policy):
    r"""Plan the whole path of the tool once, then follow it.

    A subclass implements :meth:`plan_motion`, which ``reset`` calls for the observed scene. The method ``step``
    commands the velocity ``v_d`` of the planned path plus feedback::

        twist = r v_d(s) + K [p_d(s) - p; log(R_d(s) R^T)],     ds/dt = r = max(0, 1 - (|p_d - p| / e_0)^2)

    Here, ``p`` and ``R`` are the measured position and rotation of the tool, and ``p_d`` and ``R_d`` are their desired
    values at the phase ``s`` [s]. The rate ``r`` of the phase decreases if the tool lags behind, for example because of
    its speed limits or because a hand holds it. The feedback moves the tool along the straight line to the desired
    position. While the phase moves, this line is shorter than ``e_0``. Let ``e_0`` be the required clearance. If the
    tool and its desired position keep this clearance, every point of the line keeps at least half of it.

    If obstacles move, a plan may be valid only at the planned times. The phase is then the time since the start, and
    does not wait. As soon as the tool is farther than ``e_0 / 2`` from its planned position, the plan becomes invalid,
    and the arm brakes and stays at rest.

    Args:
        skill: skill to reproduce.
        gain: K, the feedback gain of position and rotation [1/s].
        patience: e_0, the position error at which the phase stops [m]; None: the clearance, but at least 5 mm.
        arrival: distance from the end of the path below which the tool has arrived [m].
        options: arguments of :class:`~imitarm.policies.Policy`.

    Attributes:
        search_space: arguments of the constructor that a benchmark may tune, each with its lowest and highest value.
            The benchmark chooses values on a logarithmic scale.
        motion: the plan that the last ``reset`` computed.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def __init__(
        self,
        skill: Skill,
        *,
        gain: float = 8.0,
        patience: float | None = None,
        arrival: float = 0.003,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        name = type(self).__name__
        self._gain = finite_number(gain, f"{name}: gain", "1/s", above=0.0)
        self._arrival = finite_number(arrival, f"{name}: arrival", "m", above=0.0)
        self._patience = max(self.clearance, _LEAST_PATIENCE)
        if patience is not None:
            self._patience = finite_number(patience, f"{name}: patience", "m", above=0.0)
        self._same_start = _SAME_PLACE
        self.motion: PathPlan | None = None
        self._phase, self._void = 0.0, ""

    @abstractmethod
    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Plan the whole motion in a scene.

        Args:
            scene: goal and obstacles at the start of the motion; if the goal is None, the motion ends at the learned
                goal.
            start: pose of the tool at the start; None: the learned start.
            state: measured state of the arm, for methods that plan its joints.

        Raises:
            InfeasibleError: when the method finds that no solution exists; the message gives the reason.
        """

    def reset(self, observation: Observation) -> None:
        """Plan the path in the observed scene, starting at the measured pose of the tool.

        Raises:
            InfeasibleError: when the method finds that no solution exists; the message gives the reason.
        """
        start = self.start_of(observation)
        self.motion = None
        self.motion = self.plan_motion(observation.scene.now(observation.time), start, observation.state)
        path, joints = self.motion.trajectory, self.motion.joints
        velocity = np.gradient(path.positions, path.times, axis=0)
        rotation = np.zeros((len(path), 3))
        if path.quaternions is not None:
            step = quaternion_multiply(path.quaternions[1:], quaternion_conjugate(path.quaternions[:-1]))
            rotation[:-1] = quaternion_log(step) / np.diff(path.times)[:, None]
        self._twists = np.concatenate([velocity, rotation], axis=1)
        self._joint_velocities = None if joints is None else np.gradient(joints, path.times, axis=0)
        self._hold = observation.tool_to_base
        self._began = observation.time
        self._phase, self._void = 0.0, ""

    def start_of(self, observation: Observation) -> Pose | None:
        """Return the measured pose of the tool, or None if this pose is the learned start."""
        away = observation.tool_to_base.error_to(self.skill.start_)
        if not self.skill.gmr_.has_orientation_:
            away = away[:3]
        return None if np.linalg.norm(away) <= self._same_start else observation.tool_to_base

    @property
    def plan(self) -> Adaptation | None:
        """The result of the last adaptation, for drawing it in reports; None if the method computes no adaptation."""
        return None if self.motion is None else self.motion.adaptation

    @property
    def phase(self) -> float:
        """Phase of the motion: the time in the planned motion that the tool has reached [s]."""
        return self._phase

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command that follows the planned path.

        Raises:
            InputError: when ``reset`` was not called.
        """
        if self.motion is None:
            raise InputError(f"{type(self).__name__}.step: call reset(observation) first")
        path = self.motion.trajectory
        end = float(path.times[-1])
        on_schedule = self.motion.only_on_schedule
        if on_schedule:
            self._phase = min(observation.time - self._began, end)
        error = observation.tool_to_base.error_to(self._target(path))
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
        joints = self._joint_command(self.motion, observation.state.q, phase, speed)
        return self._command(self.motion, speed * forward + self._gain * error, joints, speed, lag)

    def _joint_command(self, motion: PathPlan, q: Array, phase: float, speed: float) -> Array | None:
        """Return the joint velocity that follows the planned joints; None when only the tool was planned."""
        if motion.joints is None or self._joint_velocities is None:
            return None
        times = motion.trajectory.times
        forward = _at(phase, times, self._joint_velocities)
        return np.asarray(speed * forward + self._gain * (_at(phase, times, motion.joints) - q))

    def _command(self, motion: PathPlan, twist: Array, joints: Array | None, speed: float, lag: float) -> Command:
        times = motion.trajectory.times
        end = float(times[-1])
        progress = self._phase / end
        if (speed < _STANDS and self._phase < end) or (self._phase >= end and lag > self._arrival):
            what = "behind its path" if self._phase < end else "from the end of its path"
            reason = f"the tool is {1e3 * lag:.0f} mm {what}"
            return Command(twist, joints, progress=progress, status=Status.WAITING, reason=reason)
        displaced = float(np.interp(self._phase, times, motion.displaced))
        if displaced > _DISPLACED:
            reason = f"the path is displaced by {1e3 * displaced:.0f} mm here because of an obstacle"
            return Command(twist, joints, progress=progress, status=Status.AVOIDING, reason=reason)
        return Command(twist, joints, progress=progress)

    def _target(self, path: Trajectory) -> Pose:
        """Return the desired pose at the current phase; without a learned orientation, the tool's rotation is kept."""
        joints = None if self.motion is None else self.motion.joints
        if joints is not None and self.arm is not None:  # between samples the joints move linearly
            return self.arm.tool_pose(_at(self._phase, path.times, joints))
        positions, quaternions = path.at([self._phase])
        return Pose(positions[0], self._hold.quaternion if quaternions is None else quaternions[0])

    def finished(self, observation: Observation) -> bool:
        """Return whether the planned motion is over and the tool is nearer than ``arrival`` to the end of the path."""
        if self.motion is None or self._void:
            return False
        path = self.motion.trajectory
        away = np.linalg.norm(observation.tool_to_base.position - path.positions[-1])
        return self._phase >= path.times[-1] and bool(away < self._arrival)


def _at(time: float, times: Array, values: Array) -> Array:
    """Return the row at ``time``, shape (m,), interpolated linearly between the rows of ``values`` (n, m)."""
    return np.array([np.interp(time, times, column) for column in values.T])


def _slowed(path: Trajectory, max_speed: float, max_acceleration: float) -> Array:
    """Return times of the samples at which speed and acceleration are within their limits.

    Each round stretches the time around those samples that exceed a limit: by the ratio for a speed, by the square root
    of the ratio for an acceleration. The stretching is smoothed, so that the change of speed adds little acceleration.
    """
    times = path.times
    for _ in range(_ROUNDS):
        even = np.linspace(times[0], times[-1], _EVEN)
        dt = even[1] - even[0]
        positions = CubicSpline(times, path.positions)(even)
        speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / dt
        acceleration = np.linalg.norm(np.diff(positions, 2, axis=0), axis=1) / dt**2
        if speed.max() <= max_speed and acceleration.max() <= max_acceleration:
            break
        needed = np.ones(_EVEN)
        needed[:-1] = np.maximum(needed[:-1], speed / (_SPARE * max_speed))
        needed[1:-1] = np.maximum(needed[1:-1], np.sqrt(acceleration / (_SPARE * max_acceleration)))
        stretch = gaussian_filter1d(maximum_filter1d(needed, 2 * _WIDTH + 1), 0.5 * _WIDTH, mode="nearest")
        clock = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]) * dt)])
        times = times[0] + np.interp(times, even, clock)
    return times
