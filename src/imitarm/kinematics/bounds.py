"""What a joint velocity must keep: the limits of the joints, and clearance to obstacles."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]
_SIGN = np.array([[1.0], [-1.0]])


def velocity_box(arm: ArmModel, q: ArrayLike, dt: float, velocity: ArrayLike | None = None) -> tuple[Array, Array]:
    r"""Return the joint velocities from which the limits of position can still be kept; never empty (METHODS A.9).

    With D the way left to the upper limit, a joint that is to stop in time may have at most
    :math:`v_b(D)=-a\,dt+\sqrt{a^2 dt^2+2aD}`, the solution of :math:`v^2/(2a)+v\,dt=D`. The upper bound is
    :math:`\min(v_{max},\; v_p+a\,dt,\; \max(v_b(D),\, v_p-a\,dt))`, the lower one its mirror image: when the velocity
    before, :math:`v_p`, kept this bound, then braking with a keeps it now.

    Args:
        arm: the arm.
        q: joint positions, shape (n_joints,) [rad]; outside the limits a joint can only move back.
        dt: length of the control step [s].
        velocity: of the step before, shape (n_joints,) [rad/s]; None: from any velocity, at any acceleration.

    Returns:
        lower and upper, each of shape (n_joints,) [rad/s].
    """
    step, squared, double, ends = _constants(arm, dt)
    # both directions at once: row 0 upwards, row 1 downwards, where up is what is down in row 0
    way = np.maximum(ends - _SIGN * np.asarray(q, dtype=float), 0.0)
    bound = np.sqrt(squared + double * way) - step
    most = arm.max_velocity
    if velocity is not None:
        before = _SIGN * np.minimum(np.maximum(velocity, -most), most)
        bound = np.minimum(np.maximum(bound, before - step), before + step)
    bound = np.minimum(bound, most)
    return -bound[1], bound[0]


@lru_cache(maxsize=32)
def _constants(arm: ArmModel, dt: float) -> tuple[Array, Array, Array, Array]:
    """Return what is the same in every step: a dt, its square, 2 a, and the ends of the way in both directions."""
    step = arm.max_acceleration * dt
    return step, step * step, 2.0 * arm.max_acceleration, np.stack((arm.upper, -arm.lower))


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
