"""Robot: the interface of every robot. A robot reports its state and moves at joint velocities within its limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.limits import JointLimits
from imitarm.validation import finite_number, finite_vector

Array = NDArray[np.float64]

_CHANGED = 1e-9  # relative change of a velocity above which a limit counts as having changed it


def limit_velocity(
    limits: JointLimits, q: ArrayLike, previous: ArrayLike, velocity: ArrayLike, dt: float
) -> tuple[Array, tuple[str, ...]]:
    """Limit a joint velocity so that the joints can reach it and can still brake before their position limits.

    First, all joints are slowed by one factor until none exceeds its maximum velocity, so that the tool keeps its
    direction. Then the velocity of each joint is clipped to the interval that
    :class:`~imitarm.kinematics.limits.JointLimits` permits. :class:`~imitarm.kinematics.limits.JointLimits` assumes
    that the set-point moves by ``velocity * dt``. With constant acceleration, however, the set-point moves by
    ``(previous + velocity) / 2 * dt``. The interval is therefore computed for the position ``q + previous * dt / 2``
    instead of ``q``.

    Args:
        limits: limits of the arm.
        q: current commanded joint positions, shape (n_joints,) [rad].
        previous: joint velocity commanded last, shape (n_joints,) [rad/s].
        velocity: requested joint velocity, shape (n_joints,) [rad/s].
        dt: time until the joints reach the velocity [s].

    Returns:
        The permitted velocity, shape (n_joints,) [rad/s], and the names of the limits that changed it: any of
        ``"velocity"``, ``"acceleration"`` and ``"position"``.
    """
    q, previous, requested = (np.asarray(x, dtype=float) for x in (q, previous, velocity))
    arm = limits.arm
    scaled = requested / max(1.0, float(np.max(np.abs(requested) / arm.max_velocity)))
    reached = np.clip(scaled, previous - arm.max_acceleration * dt, previous + arm.max_acceleration * dt)
    box = limits.box(q + 0.5 * dt * previous, dt, previous)
    allowed = np.clip(scaled, box.lower, box.upper)
    stages = (("velocity", requested, scaled), ("acceleration", scaled, reached), ("position", reached, allowed))
    tolerance = _CHANGED * arm.max_velocity
    return allowed, tuple(name for name, before, after in stages if np.any(np.abs(after - before) > tolerance))


class Robot(ABC):
    """A robot with an arm, simulated or real, that is commanded by joint velocities.

    :meth:`move` limits a velocity and sends it to the robot. The drives track the joint positions ``set_point``, the
    integral of the sent velocities. The limits are computed from ``set_point``, so measurement noise has no effect on
    them. Between two calls the acceleration is constant: the set-point moves by ``(previous + velocity) / 2 * dt``.

    Attributes:
        arm: the model of the arm, with its limits.
        set_point: commanded joint positions, shape (n_joints,) [rad].
        velocity: commanded joint velocities, shape (n_joints,) [rad/s].
        clamped: limits that changed the last command: any of ``"velocity"``, ``"acceleration"``, ``"position"``.
        fault: reason for the protective stop; empty if there was none.
    """

    following_error: ClassVar[float] = 0.1  # [rad] distance from its set-point at which a joint counts as blocked

    def __init__(self, arm: ArmModel, q: ArrayLike) -> None:
        self.arm = arm
        self.clamped: tuple[str, ...] = ()
        self.fault = ""
        self._limits = JointLimits(arm)
        self._begin(q)

    def _begin(self, q: ArrayLike) -> None:
        """Reset set-point and velocity to an arm at rest at ``q``."""
        self.set_point: Array = np.array(q, dtype=float)
        self.velocity: Array = np.zeros(self.arm.n_joints)
        self.clamped = ()

    @abstractmethod
    def state(self) -> ArmState:
        """Return the measured joint positions, velocities and torques, and the time on the robot's clock."""

    @abstractmethod
    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        """Drive from ``set_point`` for ``dt`` with constant acceleration from ``previous`` to ``velocity`` [rad/s]."""

    def move(self, velocity: ArrayLike, dt: float) -> ArmState:
        """Move for ``dt`` seconds; the joints reach ``velocity`` at the end.

        A velocity beyond the limits is replaced by a permitted velocity (:func:`limit_velocity`). Then ``clamped``
        names the exceeded limits. If an argument is invalid (wrong shape, NaN), the robot stops before InputError is
        raised. If a joint is more than 0.1 rad away from its set-point, the joint counts as blocked. The robot then
        makes a protective stop, sets ``fault``, and no longer moves.

        Args:
            velocity: joint velocities, shape (n_joints,) [rad/s].
            dt: duration of the motion [s].

        Returns:
            The measured state after the motion.

        Raises:
            InputError: when ``velocity`` is not ``n_joints`` finite numbers, or ``dt`` is not a positive time.
        """
        try:
            requested = finite_vector(velocity, self.arm.n_joints, "move: velocity", "rad/s")
            dt = finite_number(dt, "move: dt", "s", above=0.0)
        except InputError as invalid:
            self.stop()
            raise InputError(f"{invalid}; robot stopped") from invalid
        if self.fault:
            return self.state()
        allowed, self.clamped = limit_velocity(self._limits, self.set_point, self.velocity, requested, dt)
        self._send(self.velocity, allowed, dt)
        self.set_point = self.set_point + 0.5 * dt * (self.velocity + allowed)
        self.velocity = allowed
        state = self.state()
        error = np.abs(self.set_point - state.q)
        if error.max() > self.following_error:
            i = int(error.argmax())
            self._begin(state.q)
            self.fault = f"protective stop: {self.arm.joint_names[i]} is {error[i]:.2f} rad away from its set-point"
        return state

    def grasp(self, opening: float) -> None:
        """Start to move the gripper's fingers to an opening; the fingers continue to move while the arm moves.

        Fingers in contact with an object press with limited force, so ``grasp(0.0)`` grasps an object between them.

        Args:
            opening: distance between the fingers [m].

        Raises:
            InputError: when this robot has no gripper, or its fingers do not open so far.
        """
        raise InputError(
            f"grasp: {type(self).__name__} with {self.arm!r} has no gripper; load an arm with a gripper as its tool"
        )

    @property
    def opening(self) -> float:
        """Measured opening between the gripper's fingers [m]; nan without a gripper."""
        return float("nan")

    @property
    def widest_opening(self) -> float:
        """Largest opening of the gripper [m]; nan without a gripper."""
        return float("nan")

    def clearance(self) -> float:
        """Return the distance from arm and tool to the nearest obstacle [m]; nan if the robot can't measure it."""
        return float("nan")

    def nearest_pair(self) -> tuple[str, str] | None:
        """Return the names of the nearest arm part and obstacle; None if they are unknown or there is no obstacle."""
        return None

    def report(self) -> Mapping[str, Any]:
        """Return further measurements by name, for example the contacts in a simulation; empty by default."""
        return {}

    def stop(self, dt: float = 0.01) -> ArmState:
        """Brake at the maximum acceleration until the commanded velocity is zero.

        Args:
            dt: time between two commands [s].

        Returns:
            The measured state at the end.

        Raises:
            InputError: when ``dt`` is not a positive time.
        """
        dt = finite_number(dt, "stop: dt", "s", above=0.0)
        while self.velocity.any():
            self.move(np.zeros(self.arm.n_joints), dt)
        return self.state()
