"""A velocity barrier for the whole arm: no link may approach an obstacle faster than it could still stay clear."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.scene.scene import Scene

Array = NDArray[np.float64]

_RATE = 6.0  # [1/s] share of the remaining clearance that may be used up in a second
_INFLUENCE = 0.15  # [m] beyond the asked clearance a sphere farther than this gets no row


def clearance_rows(
    arm: ArmModel, q: ArrayLike, scene: Scene, clearance: float, *, rate: float = _RATE
) -> tuple[Array, Array] | None:
    r"""Return inequalities on the joint velocity that keep every link clear of every obstacle (METHODS D.3.4).

    The arm and its tool are covered by spheres. For sphere i near obstacle o, with ``h = sd_o(c_i) - r_i - clearance``,
    outward normal ``n`` and obstacle velocity ``v_o``, the clearance may shrink at most exponentially::

        n^T J_i(q) qd  >=  n^T v_o - rate h

    so it never gets below what was asked, and where it already is, it must grow. They fit ``solve_ik(..., rows=...)``.

    Args:
        arm: the arm with its tool.
        q: joint angles, shape (n_joints,) [rad].
        scene: obstacles, with their velocities.
        clearance: asked of every link [m].
        rate: how quickly the rest of the clearance may be used up [1/s].

    Returns:
        ``A`` (m, n_joints) and ``lower`` (m,) with ``A qd >= lower``; None when nothing is near.
    """
    if not scene.obstacles:
        return None
    centers, radii = arm.collision_spheres(q)
    rows: list[Array] = []
    lower: list[Array] = []
    jacobians: Array | None = None
    for obstacle in scene.obstacles:
        distance, normal = obstacle.distance_and_gradient(centers)
        room = distance - radii - clearance
        near = np.flatnonzero(room < _INFLUENCE)
        if not len(near):
            continue
        if jacobians is None:
            jacobians = arm.sphere_jacobians(q)
        rows.append((normal[near, None, :] @ jacobians[near])[:, 0])
        lower.append(normal[near] @ obstacle.velocity - rate * room[near])
    return (np.concatenate(rows), np.concatenate(lower)) if rows else None
