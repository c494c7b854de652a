"""Points on the surface of a geom and distances to it, written out for the tests."""

from __future__ import annotations

import mujoco
import numpy as np

KIND = mujoco.mjtGeom


def rotation(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def surface_points(model, geom, n, seed, *, in_body=True):
    """Return n points on the surface, in the frame of the body or of the geom."""
    rng = np.random.default_rng(seed)
    kind, size = model.geom_type[geom], model.geom_size[geom]
    unit = rng.normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    if kind == KIND.mjGEOM_SPHERE:
        points = unit * size[0]
    elif kind == KIND.mjGEOM_ELLIPSOID:
        points = unit * size
    elif kind == KIND.mjGEOM_CAPSULE:
        points = unit * size[0] + np.sign(unit[:, 2:]) * [0, 0, size[1]]
    elif kind == KIND.mjGEOM_CYLINDER:  # its rims stick out farthest
        angle = rng.uniform(0, 2 * np.pi, n)
        points = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), rng.choice([-1, 1], n) * size[1]], axis=1)
    elif kind == KIND.mjGEOM_BOX:
        points = rng.uniform(-1, 1, (n, 3))
        face = rng.integers(0, 3, n)
        points[np.arange(n), face] = np.sign(points[np.arange(n), face])
        points[:8] = np.array(np.meshgrid(*3 * [[-1, 1]])).reshape(3, 8).T[: min(n, 8)]
        points = points * size
    else:
        raise ValueError(f"no such shape here: {kind}")
    return points @ rotation(model.geom_quat[geom]).T + model.geom_pos[geom] if in_body else points


def signed_distance(model, geom, points):
    """Return distances of points in the frame of the geom's body; negative inside."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    p = (points - model.geom_pos[geom]) @ rotation(model.geom_quat[geom])
    if kind == KIND.mjGEOM_SPHERE:
        return np.linalg.norm(p, axis=1) - size[0]
    if kind == KIND.mjGEOM_CAPSULE:
        p = p - np.clip(p[:, 2:], -size[1], size[1]) * [0, 0, 1]
        return np.linalg.norm(p, axis=1) - size[0]
    if kind == KIND.mjGEOM_CYLINDER:
        over = np.stack([np.hypot(p[:, 0], p[:, 1]) - size[0], np.abs(p[:, 2]) - size[1]], axis=1)
    elif kind == KIND.mjGEOM_BOX:
        over = np.abs(p) - size
    else:
        raise ValueError(f"no such shape here: {kind}")
    return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)
