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

    and :math:`2 D'/dt` where D' is negative.

    A joint that keeps this bound once can always keep it by braking with a_max. Near a limit the last clipping may
    exceed the jerk limit; position, velocity and acceleration are always kept.

    A blocked arm falls behind its commands, and its drives press harder the further it falls behind. So a command that
    is ahead of the measured joint by more than half of ``max_lead`` brakes: ``max_lead`` acts as one more position
    limit. The command may exceed it by the braking distance.

    Args:
        arm: whose limits.
        dt: control period [s].
        frequency: omega [rad/s]; must be well below 1/dt.
        rise_time: time to full acceleration [s]: j = a_max / rise_time.
        max_lead: of a command over the measured position [rad]; half of it must exceed the distance that the joints
            move at full speed within the robot's delay, or the limit slows the joints down.

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
        self.max_jerk = arm.max_acceleration / rise_time
        # farther than this from a position limit, that limit never restricts the velocity
        room = arm.max_velocity * (arm.max_velocity / (2.0 * arm.max_acceleration) + 2.0 * dt)
        columns = (
            arm.max_velocity,
            arm.max_acceleration,
            arm.max_acceleration * dt,
            arm.max_acceleration * (dt / rise_time),
            arm.lower,
            arm.upper,
            arm.lower + room,
            arm.upper - room,
        )
        self._joints = list(zip(*(column.tolist() for column in columns), strict=True))
        self._lead = max_lead
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Reset to rest at ``q``, shape (n_joints,) [rad]."""
        self.q: Array = np.array(q, dtype=float)
        self.velocity: Array = np.zeros_like(self.q)
        self._acceleration = [0.0] * len(self.q)

    @property
    def acceleration(self) -> Array:
        """Joint accelerations of the last period, shape (n_joints,) [rad/s^2]."""
        return np.array(self._acceleration)

    def follow(self, q: Array, velocity: Array, measured: Array | None = None) -> Array:
        """Advance by one period towards a reference and return the joint positions reached, (n_joints,) [rad].

        Args:
            q: of the reference, shape (n_joints,) [rad].
            velocity: of the reference, shape (n_joints,) [rad/s].
            measured: measured joint positions, shape (n_joints,) [rad]; None: as commanded.
        """
        # plain floats without min and max: for so few numbers twice as fast as NumPy
        dt, half, stiffness, damping = self._dt, 0.5 * self._dt, self._stiffness, self._damping
        half_lead = 0.5 * self._lead
        at = self.q.tolist()
        columns = (at, self.velocity.tolist(), self._acceleration, q.tolist(), velocity.tolist())
        positions, velocities, accelerations = [], [], []
        for x, v, a, x_r, v_r, m, joint in zip(
            *columns, at if measured is None else measured.tolist(), self._joints, strict=True
        ):
            v_max, a_max, step, jerk_step, _, _, inner_lower, inner_upper = joint
            wanted = stiffness * (x_r - x - dt * v) + damping * (v_r - v)
            low, high = a - jerk_step, a + jerk_step
            low = -a_max if low < -a_max else low
            high = a_max if high > a_max else high
            wanted = low if wanted < low else wanted
            after = v + dt * (high if wanted > high else wanted)
            low, high = v - step, v + step
            low = -v_max if low < -v_max else low
            high = v_max if high > v_max else high
            if not (inner_lower < x < inner_upper and -half_lead < x - m < half_lead):
                low, high = self._stoppable(x, v, m, low, high, joint)
            after = low if after < low else after
            after = high if after > high else after
            positions.append(x + half * (v + after))
            velocities.append(after)
            accelerations.append((after - v) / dt)
        self.q, self.velocity, self._acceleration = np.array(positions), np.array(velocities), accelerations
        return self.q

    def _stoppable(
        self, x: float, v: float, measured: float, low: float, high: float, joint: tuple[float, ...]
    ) -> tuple[float, float]:
        """Return the lowest and highest velocity of a joint from which it can still stop before its limits.

        Args:
            x: its position [rad].
            v: its velocity [rad/s].
            measured: its measured position [rad].
            low: lowest velocity that the other limits allow [rad/s].
            high: highest velocity that the other limits allow [rad/s].
            joint: its limits.
        """
        _, a_max, step, _, bottom, top, _, _ = joint
        if abs(x - measured) > 0.5 * self._lead:  # a joint that keeps up is not slowed
            top, bottom = min(top, measured + self._lead), max(bottom, measured - self._lead)
        ahead = x + 0.5 * self._dt * v
        return (
            min(max(-self._braking(ahead - bottom, a_max, step), low), high),
            max(min(self._braking(top - ahead, a_max, step), high), low),
        )

    def _braking(self, distance: float, a_max: float, step: float) -> float:
        """Return the highest velocity from which a joint can stop within ``distance``; negative beyond the limit."""
        bound = math.sqrt(0.25 * step * step + 2.0 * a_max * max(distance, 0.0)) - 0.5 * step
        return bound + min(distance, 0.0) * (2.0 / self._dt)
