"""Depth images of obstacles without a robot: rays against the exact distances of the scene."""

from __future__ import annotations

import numpy as np

from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.perception import DepthFrame, Intrinsics
from imitarm.scene import Scene

CAMERA = Intrinsics.from_field_of_view(96, 72, 0.9)


def looking(eye, at):
    """Pose of a camera at ``eye`` that looks at the point ``at``, with the image upright."""
    z = np.asarray(at, dtype=float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([0.0, -1.0, 0.0])
    x /= np.linalg.norm(x)
    return Pose(np.asarray(eye, dtype=float), matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def image(obstacles, camera_to_base, camera=CAMERA, stamp=0.0, farthest=6.0):
    """Depth image by sphere tracing: along each ray, step by the distance to the nearest obstacle."""
    scene = Scene(None, tuple(obstacles))
    rays = camera.rays().reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    directions = (rays / lengths[:, None]) @ camera_to_base.rotation.T
    along = np.zeros(len(rays))
    for _ in range(200):
        gap = scene.clearance(camera_to_base.position + along[:, None] * directions)
        along += np.where(along < farthest * 2.0, np.maximum(gap, 0.0), 0.0)
        if (gap[along < farthest * 2.0] < 1e-7).all():
            break
    depth = np.where(gap < 1e-4, along / lengths, np.nan)
    depth[~(depth <= farthest)] = np.nan
    return DepthFrame(stamp, depth.reshape(camera.height, camera.width), camera, camera_to_base)
