"""What a joint velocity must keep: the limits of the joints, distance from singularities, clearance to obstacles."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]
_SIGN = np.array([[1.0], [-1.0]])

ELBOW_MARGIN = 0.15  # [rad] the hard bound's distance from the stretched elbow
WRIST_MARGIN = 0.1  # [rad] the soft bound's distance from the singular wrist
_RETURN = 5.0  # [1/s] share of what is missing of it that is made up in a second


class VelocityBox:
    r"""The joint velocities from which the limits of position can still be kept; never empty (METHODS A.9).

    With D the way left to the upper limit, a joint that is to stop in time may have at most
    :math:`v_b(D)=-a\,dt+\sqrt{a^2 dt^2+2aD}`, the solution of :math:`v^2/(2a)+v\,dt=D`. The upper bound is
    :math:`\min(v_{max},\; v_p+a\,dt,\; \max(v_b(D),\, v_p-a\,dt))`, the lower one its mirror image: when the velocity
    before, :math:`v_p`, kept this bound, then braking with a keeps it now.

    Args:
        arm: the arm.
        dt: length of the control step [s].
        singularity_bounds: stay 0.15 rad off the stretched elbow too (METHODS A.8), on the side of it where the arm
            is. This is one more limit of position; an arm that begins nearer can only leave.

    Raises:
        InputError: when the arm does not say where its elbow is.
    """

    def __init__(self, arm: ArmModel, dt: float, *, singularity_bounds: bool = False) -> None:
        self._most, self._least = arm.max_velocity, -arm.max_velocity
        self._least.setflags(write=False)
        self._step = arm.max_acceleration * dt
        self._squared, self._double = self._step * self._step, 2.0 * arm.max_acceleration
        room = self._most * self._most / self._double + self._most * dt  # beyond it v_b is more than v_max
        self._elbow, self._straight = -1, 0.0
        limits = [(arm.lower, arm.upper)]
        if singularity_bounds:
            marked = arm.marked()
            self._elbow, self._straight = marked.elbow, marked.elbow_straight
            limits = [_narrowed(arm, self._elbow, self._straight, side) for side in (1.0, -1.0)]
        # both directions at once: row 0 upwards, row 1 downwards, where up is what is down in row 0
        self._ends = [np.stack((upper, -lower)) for lower, upper in limits]
        self._inner = [((lower + room).tolist(), (upper - room).tolist()) for lower, upper in limits]

    def at(self, q: Array, velocity: Array | None = None) -> tuple[Array, Array]:
        """Return the bounds at a posture.

        Args:
            q: joint positions, shape (n_joints,) [rad]; outside the limits a joint can only move back.
            velocity: of the step before, shape (n_joints,) [rad/s]; None: from any velocity, at any acceleration.

        Returns:
            lower and upper, each of shape (n_joints,) [rad/s]; not to be written to.
        """
        values = q.tolist()
        side = 1 if self._elbow >= 0 and values[self._elbow] < self._straight else 0
        for value, low, high in zip(values, *self._inner[side], strict=True):
            if not low <= value <= high:
                return self._near_a_limit(q, velocity, self._ends[side])
        if velocity is None:
            return self._least, self._most
        lower = np.minimum(velocity, self._most)
        lower -= self._step
        upper = np.maximum(velocity, self._least)
        upper += self._step
        return np.maximum(lower, self._least, out=lower), np.minimum(upper, self._most, out=upper)

    def _near_a_limit(self, q: Array, velocity: Array | None, ends: Array) -> tuple[Array, Array]:
        bound = np.maximum(ends - _SIGN * q, 0.0)
        bound *= self._double
        bound += self._squared
        np.sqrt(bound, out=bound)
        bound -= self._step
        if velocity is not None:
            before = _SIGN * np.minimum(np.maximum(velocity, self._least), self._most)
            np.maximum(bound, before - self._step, out=bound)
            np.minimum(bound, before + self._step, out=bound)
        np.minimum(bound, self._most, out=bound)
        return -bound[1], bound[0]


def _narrowed(arm: ArmModel, elbow: int, straight: float, side: float) -> tuple[Array, Array]:
    """Return the limits of position on one side of the stretched elbow; the file's own where they leave no room."""
    lower, upper = np.array(arm.lower), np.array(arm.upper)
    end = straight + side * ELBOW_MARGIN
    if lower[elbow] < end < upper[elbow]:
        (lower if side > 0.0 else upper)[elbow] = end
    return lower, upper


def velocity_box(
    arm: ArmModel, q: ArrayLike, dt: float, velocity: ArrayLike | None = None, *, singularity_bounds: bool = False
) -> tuple[Array, Array]:
    """Return the bounds of :class:`VelocityBox` at one posture.

    Args:
        arm: the arm.
        q: joint positions, shape (n_joints,) [rad]; outside the limits a joint can only move back.
        dt: length of the control step [s].
        velocity: of the step before, shape (n_joints,) [rad/s]; None: from any velocity, at any acceleration.
        singularity_bounds: stay off the stretched elbow too.

    Returns:
        lower and upper, each of shape (n_joints,) [rad/s].

    Raises:
        InputError: with ``singularity_bounds``, when the arm does not say where its elbow is.
    """
    before = None if velocity is None else np.asarray(velocity, dtype=float)
    lower, upper = _box(arm, dt, singularity_bounds).at(np.asarray(q, dtype=float), before)
    return lower.copy(), upper.copy()


@lru_cache(maxsize=32)
def _box(arm: ArmModel, dt: float, singularity_bounds: bool) -> VelocityBox:
    return VelocityBox(arm, dt, singularity_bounds=singularity_bounds)


class WristBound:
    r"""A soft bound that keeps the wrist's joint at least 0.1 rad off where it is singular (METHODS A.8).

    The wrist is singular where the axes before and after its joint are parallel, at every multiple of pi. The bound
    asks of the joint's velocity, away from the nearest of them, at least :math:`-v_b(D)` with D the way left to
    0.1 rad (see :class:`VelocityBox`), or, nearer than that, 5/s times what is missing. It gives way at a price, so
    that a hand which has to turn through can.

    Args:
        arm: the arm.
        dt: length of the control step [s].

    Raises:
        InputError: when the arm does not say where its wrist is.
    """

    def __init__(self, arm: ArmModel, dt: float) -> None:
        self.joint = arm.marked().wrist
        self._acceleration = float(arm.max_acceleration[self.joint])
        self._step = self._acceleration * dt
        self._most = float(arm.max_velocity[self.joint])

    def at(self, q: Array) -> tuple[int, float, float] | None:
        """Return the joint, the side on which it is, and its least velocity to that side [rad/s]; None: any will do."""
        position = float(q[self.joint])
        away = position - math.pi * round(position / math.pi)
        side = 1.0 if away >= 0.0 else -1.0
        way = abs(away) - WRIST_MARGIN
        if way <= 0.0:
            return self.joint, side, -_RETURN * way
        least = self._step - math.sqrt(self._step * self._step + 2.0 * self._acceleration * way)
        return (self.joint, side, least) if least > -self._most else None


def clearance_rows(
    jacobians: Array,
    normals: Array,
    distances: Array,
    *,
    clearance: float,
    gain: float = 5.0,
    obstacle_velocity: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    r"""Return rows for :func:`solve_ik` that keep points of the arm off obstacles (METHODS A.9, D.3.4).

    A point at distance d may come nearer only as fast as :math:`n^T J v \ge n^T v_o - \xi (d - d_{safe})`.

    Args:
        jacobians: of the points, shape (m, 3, n_joints), as from ``ArmModel.sphere_jacobians``.
        normals: unit outward normals of the nearest obstacle, shape (m, 3).
        distances: from the point (the sphere's surface) to the obstacle, shape (m,) [m].
        clearance: distance to keep [m].
        gain: xi [1/s].
        obstacle_velocity: of the nearest obstacle, shape (m, 3) or (3,) [m/s].

    Returns:
        ``(A, lower)`` of shapes (m, n_joints) and (m,).
    """
    approach = np.sum(normals * np.broadcast_to(np.asarray(obstacle_velocity, dtype=float), normals.shape), axis=1)
    rows = np.einsum("mi,mij->mj", normals, jacobians)
    return rows, approach - gain * (np.asarray(distances, dtype=float) - clearance)
