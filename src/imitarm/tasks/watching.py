"""Cameras that watch a task: a depth camera in front of the table, and one second of watching before the arm moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.perception import DepthNoise, Intrinsics
from imitarm.robots.depth_camera import DepthCamera
from imitarm.robots.simulated import SimulatedRobot
from imitarm.scene import Scene

Array = NDArray[np.float64]

WATCHES = 1.0
"""Time for which the camera watches before the arm moves [s]."""
PERIOD = 0.01
"""Control period of the tasks [s]."""
_PIXELS, _FIELD_OF_VIEW = (200, 150), 0.9  # columns and rows, vertical [rad]
_RANGE = (0.5, 5.0)  # [m] depths that a Kinect v2 measures


def camera_in_front(robot: SimulatedRobot, eye: Array, middle: Array, *, seed: int, color: bool = False) -> DepthCamera:
    """Return a fixed depth camera with the noise of a Kinect v2.

    Args:
        robot: the simulated robot.
        eye: position of the camera in the base frame (3,) [m].
        middle: point at which the camera looks, in the base frame (3,) [m].
        seed: seed of the noise.
        color: whether the images have colours.
    """
    return DepthCamera(
        robot,
        Intrinsics.from_field_of_view(*_PIXELS, _FIELD_OF_VIEW),
        looking_at(eye, middle),
        nearest=_RANGE[0],
        farthest=_RANGE[1],
        noise=DepthNoise(),
        seed=seed,
        color=color,
    )


def looking_at(eye: Array, target: Array) -> Pose:
    """Return the pose of a camera whose z axis points from ``eye`` to ``target`` and whose y axis points down."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Pose(eye, matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def watch(robot: SimulatedRobot, observe: Callable[[float], Scene]) -> None:
    """Let the robot stand for one second while ``observe`` is called with times from -1 s to 0 s."""
    start = robot.time + WATCHES
    while robot.time < start - 0.5 * PERIOD:
        observe(robot.time - start)
        robot.move(np.zeros(robot.arm.n_joints), PERIOD)
