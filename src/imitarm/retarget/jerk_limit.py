"""JerkLimiter: the last stage before the robot; its output keeps every joint limit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]


class JerkLimiter:
    r"""Follows a reference of the joints with limited position, velocity, acceleration and jerk.

    A critically damped follower with feed-forward, :math:`a_d = \omega^2 (q_r - q) + 2\omega (v_r - v)`. Its
    acceleration is clipped to :math:`|a| \le a_{max}` and to :math:`|a - a_p| \le j\,dt`, where :math:`a_p` is the
    previous one. The resulting velocity :math:`v + a\,dt` is then clipped so that the joint can still stop before its
    limit. With D the distance to the limit, and the position changing by the mean of two velocities, the highest such
    velocity is

    .. math:: v_b = -\tfrac12 a\,dt + \sqrt{\tfrac14 a^2 dt^2 + 2 a D'}, \qquad D' = D - \tfrac12 v\,dt,

    and :math:`2 D'/dt` where that is negative.

    A joint that keeps this bound once can always keep it by braking with a. Near a limit the last clipping may exceed
    the jerk limit; position, velocity and acceleration are always kept.

    A blocked arm falls behind its commands, and its drives press harder the further it falls behind. So a command that
    is ahead of the measured joint by more than half of ``max_lead`` brakes: ``max_lead`` acts as one more position
    limit. The command may exceed it by the braking distance.

    Args:
        arm: whose limits.
        dt: control period [s].
        frequency: omega [rad/s]; must be well below 1/dt.
        rise_time: time to full acceleration [s]: j = a_max / rise_time.
        max_lead: of a command over the measured position [rad]; half of it must exceed the distance that the joints
            move at full speed within the robot's delay, or it slows them down.

    Raises:
        InputError: when a number is out of range.
    """

    def __init__(
        self, arm: ArmModel, dt: float, *, frequency: float = 30.0, rise_time: float = 0.02, max_lead: float = math.inf
    ) -> None:
        if not 0.0 < frequency * dt < 1.0:
            raise InputError(f"JerkLimiter: frequency must be positive and below 1/dt = {1 / dt:g} rad/s")
        if not rise_time >= dt:
            raise InputError(f"JerkLimiter: rise_time must be at least dt = {dt:g} s, got {rise_time:g}")
        if not max_lead > 0.0:
            raise InputError(f"JerkLimiter: max_lead must be positive [rad], got {max_lead:g}")
        self._dt = dt
        # semi-implicit: uses the error at the end of the period, which keeps the follower stable at a large omega dt
        calm = 1.0 + 2.0 * frequency * dt + frequency * frequency * dt * dt
        self._stiffness, self._damping = frequency * frequency / calm, 2.0 * frequency / calm
        self._v_max, self._a_max = arm.max_velocity, arm.max_acceleration
        self._v_min, self._a_min = -arm.max_velocity, -arm.max_acceleration
        self._step = arm.max_acceleration * dt
        self._jerk_step = arm.max_acceleration * (dt / rise_time)
        self.max_jerk = arm.max_acceleration / rise_time
        self._upper, self._lower, self._lead = arm.upper, arm.lower, max_lead
        # farther than this from a position limit, that limit never restricts the velocity
        room = arm.max_velocity * (arm.max_velocity / (2.0 * arm.max_acceleration) + 2.0 * dt)
        self._inner = list(zip((arm.lower + room).tolist(), (arm.upper - room).tolist(), strict=True))
        self._half_squared, self._double = 0.25 * np.square(self._step), 2.0 * arm.max_acceleration
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Be at rest at ``q``, shape (n_joints,) [rad]."""
        self.q: Array = np.array(q, dtype=float)
        self.velocity: Array = np.zeros_like(self.q)
        self.acceleration: Array = np.zeros_like(self.q)

    def follow(self, q: Array, velocity: Array, measured: Array | None = None) -> Array:
        """Advance by one period towards a reference and return the joint positions reached, (n_joints,) [rad].

        Args:
            q: of the reference, shape (n_joints,) [rad].
            velocity: of the reference, shape (n_joints,) [rad/s].
            measured: measured joint positions, shape (n_joints,) [rad]; None: as commanded.
        """
        dt, before = self._dt, self.velocity
        wanted = self._stiffness * (q - self.q - dt * before) + self._damping * (velocity - before)
        most = np.minimum(self.acceleration + self._jerk_step, self._a_max)
        least = np.maximum(self.acceleration - self._jerk_step, self._a_min)
        after = before + dt * np.minimum(np.maximum(wanted, least), most)
        lower, upper = self._box(measured)
        after = np.minimum(np.maximum(after, lower), upper)
        self.q = self.q + 0.5 * dt * (before + after)
        self.velocity, self.acceleration = after, (after - before) / dt
        return self.q

    def _box(self, measured: Array | None) -> tuple[Array, Array]:
        """Return the lowest and highest velocity from which each joint can still stop before its limits."""
        q, velocity, step = self.q, self.velocity, self._step
        upper, lower = np.minimum(velocity + step, self._v_max), np.maximum(velocity - step, self._v_min)
        if self._free(q, measured):
            return lower, upper
        top, bottom = self._upper, self._lower
        if measured is not None:
            held = np.abs(q - measured) > 0.5 * self._lead  # joints that keep up are not slowed
            top = np.where(held, np.minimum(top, measured + self._lead), top)
            bottom = np.where(held, np.maximum(bottom, measured - self._lead), bottom)
        ahead = q + (0.5 * self._dt) * velocity
        return (
            np.minimum(np.maximum(-self._braking(ahead - bottom), lower), upper),
            np.maximum(np.minimum(self._braking(top - ahead), upper), lower),
        )

    def _free(self, q: Array, measured: Array | None) -> bool:
        """Return whether every position limit is far away; plain floats are faster than NumPy for so few numbers."""
        half = 0.5 * self._lead
        where = q if measured is None else measured
        for value, at, (low, high) in zip(q.tolist(), where.tolist(), self._inner, strict=True):
            if not (low < value < high and -half < value - at < half):
                return False
        return True

    def _braking(self, distance: Array) -> Array:
        """Return the highest velocity from which a joint can stop within ``distance``; negative beyond the limit."""
        bound = np.sqrt(self._half_squared + self._double * np.maximum(distance, 0.0)) - 0.5 * self._step
        return np.asarray(bound + np.minimum(distance, 0.0) * (2.0 / self._dt))
