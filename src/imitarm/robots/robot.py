"""What every body has in common: it tells its state and moves at joint velocities, within its limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel, ArmState

Array = NDArray[np.float64]

_TOUCHED = 1e-9  # relative change of a velocity above which a limit is said to have changed it


def limit_velocity(
    arm: ArmModel, q: ArrayLike, previous: ArrayLike, velocity: ArrayLike, dt: float
) -> tuple[Array, tuple[str, ...]]:
    """Return the velocity nearest to the asked one that the joints can follow and still brake from.

    1. *velocity*: all joints are slowed by one factor, so that the direction of the tool stays.
    2. *acceleration* and *position*, joint by joint, the box of METHODS A.9::

           upper = min(v_max, v_p + a dt, max(v_b(q_max - q - v_p dt / 2), v_p - a dt)),   lower mirrored
           v_b(D) = -a dt + sqrt(a^2 dt^2 + 2 a max(D, 0))

       ``v_b`` satisfies ``v^2 / 2a + v dt <= D``. The term ``v_p dt / 2`` is there because the speed changes evenly
       during ``dt``: with it whoever obeys the box can always brake before the limit, so the box is never empty,
       also beyond a limit.

    Args:
        arm: whose limits.
        q: commanded joint angles now, shape (n,) [rad].
        previous: velocity ``v_p`` commanded last, shape (n,) [rad/s].
        velocity: asked, shape (n,) [rad/s].
        dt: how long the velocity will be held [s].

    Returns:
        The velocity (n,) [rad/s], and which of ``"velocity"``, ``"acceleration"``, ``"position"`` changed it.
    """
    q, v_p, asked = (np.asarray(x, dtype=float) for x in (q, previous, velocity))
    a = arm.max_acceleration
    scaled = asked / max(1.0, float(np.max(np.abs(asked) / arm.max_velocity)))
    reached = np.clip(scaled, v_p - a * dt, v_p + a * dt)
    ahead = q + 0.5 * dt * v_p
    upper = np.maximum(_braking_velocity(arm.upper - ahead, a, dt), v_p - a * dt)
    lower = np.minimum(-_braking_velocity(ahead - arm.lower, a, dt), v_p + a * dt)
    braked = np.clip(reached, lower, upper)
    stages = (("velocity", asked, scaled), ("acceleration", scaled, reached), ("position", reached, braked))
    tolerance = _TOUCHED * arm.max_velocity
    return braked, tuple(name for name, before, after in stages if np.any(np.abs(after - before) > tolerance))


def _braking_velocity(distance: Array, a: Array, dt: float) -> Array:
    root = np.sqrt(np.square(a * dt) + 2.0 * a * np.maximum(distance, 0.0))
    return np.maximum(root - a * dt, 0.0)  # rounding must not ask for a motion at the limit


class Robot(ABC):
    """A body with an arm: simulated or real, driven by joint velocities.

    :meth:`move` checks the velocity against the arm's limits and then sends it. What was sent is integrated to
    ``set_point``, the joint angles where the drives should be, so the limits hold for the commands and do not
    depend on the noise of a measurement. Between two calls the drives change speed evenly: the set-point moves by
    ``(previous + velocity) / 2 * dt``.

    Attributes:
        arm: the model of the arm, with its limits.
        set_point: commanded joint angles, shape (n_joints,) [rad].
        velocity: commanded joint velocity, shape (n_joints,) [rad/s].
        clamped: which limits changed the last command: any of ``"velocity"``, ``"acceleration"``, ``"position"``.
        fault: why the robot has stopped to protect itself and what is near it, in words; empty when all is well.
    """

    following_error: ClassVar[float] = 0.1  # [rad] a joint so far from its set-point is held by something

    def __init__(self, arm: ArmModel, q: ArrayLike) -> None:
        self.arm = arm
        self.clamped: tuple[str, ...] = ()
        self.fault = ""
        self._begin(q)

    def _begin(self, q: ArrayLike) -> None:
        """Set point and command of an arm at rest at ``q``."""
        self.set_point: Array = np.array(q, dtype=float)
        self.velocity: Array = np.zeros(self.arm.n_joints)
        self.clamped = ()

    @abstractmethod
    def state(self) -> ArmState:
        """Return the measured joint angles, velocities and torques, and the robot's time."""

    @abstractmethod
    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        """Drive from ``set_point`` for ``dt`` while the speed goes evenly from ``previous`` to ``velocity``."""

    def move(self, velocity: ArrayLike, dt: float) -> ArmState:
        """Move for ``dt`` seconds so that the joints have ``velocity`` at the end of it.

        A velocity that the limits forbid is replaced by the nearest one they allow, see :func:`limit_velocity`;
        ``clamped`` says so. A velocity that is no velocity stops the robot before the error is raised.
        A joint that is more than 0.1 rad from its set-point is held by something: the robot stops where it is and
        sets ``fault``; from then on it does not move.

        Args:
            velocity: of the joints, shape (n_joints,) [rad/s].
            dt: [s].

        Returns:
            The measured state after the motion.

        Raises:
            InputError: when the shape is wrong, a number is not finite or ``dt`` is not positive.
        """
        asked = np.asarray(velocity, dtype=float)
        if asked.shape != (self.arm.n_joints,) or not np.isfinite(asked).all():
            self.stop()
            raise InputError(
                f"move: velocity must be {self.arm.n_joints} finite numbers [rad/s], got {velocity!r}; robot stopped"
            )
        if not 0.0 < dt < np.inf:
            raise InputError(f"move: dt must be a positive time [s], got {dt!r}")
        if self.fault:
            return self.state()
        allowed, self.clamped = limit_velocity(self.arm, self.set_point, self.velocity, asked, dt)
        self._send(self.velocity, allowed, dt)
        self.set_point = self.set_point + 0.5 * dt * (self.velocity + allowed)
        self.velocity = allowed
        state = self.state()
        behind = np.abs(self.set_point - state.q)
        if behind.max() > self.following_error:
            i = int(behind.argmax())
            self._begin(state.q)
            self.fault = f"protective stop: {self.arm.joint_names[i]} was held {behind[i]:.2f} rad from its set-point"
        return state

    def grasp(self, opening: float) -> None:
        """Begin to move the gripper's fingers to an opening; they go on by themselves while the arm moves.

        Fingers that meet something press on it with their limited force: ``grasp(0.0)`` takes hold of what is
        between them.

        Args:
            opening: between the fingers [m].

        Raises:
            InputError: when this robot has no gripper, or its fingers do not open so far.
        """
        raise InputError(f"grasp: {type(self).__name__} with {self.arm!r} has no gripper; mount one with a tool")

    @property
    def opening(self) -> float:
        """Measured opening between the gripper's fingers [m]; nan without a gripper."""
        return float("nan")

    @property
    def widest_opening(self) -> float:
        """Opening of the gripper when it is wide open [m]; nan without a gripper."""
        return float("nan")

    def clearance(self) -> float:
        """Return the measured distance from arm and tool to the nearest obstacle [m]; nan for a body that can't."""
        return float("nan")

    def nearest_pair(self) -> tuple[str, str] | None:
        """Return the names of the arm's part and the obstacle that are nearest; None when there is none, or unknown."""
        return None

    def report(self) -> Mapping[str, Any]:
        """Return what else this body has measured since it was started, by name; empty by default."""
        return {}

    def stop(self, dt: float = 0.01) -> ArmState:
        """Brake as hard as the accelerations allow, until the command is at rest.

        Args:
            dt: time between two commands [s].

        Returns:
            The measured state at the end.
        """
        while self.velocity.any():
            self.move(np.zeros(self.arm.n_joints), dt)
        return self.state()
