"""A depth camera in the control loop; the camera starts one second before the arm moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.control_loop.camera_observer import CameraObserver
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.perception import DepthNoise, Intrinsics, ObstacleDetector, ObstacleTracker
from imitarm.robots.depth_camera import DepthCamera
from imitarm.robots.simulated import SimulatedRobot
from imitarm.scene import MovingScene, Obstacle, Scene

Array = NDArray[np.float64]

WATCHES = 1.0
"""Time for which the camera watches before the arm moves [s]."""
PERIOD = 0.01
"""Control period of the tasks [s]."""
_PIXELS, _FIELD_OF_VIEW = (200, 150), 0.9  # columns and rows, vertical [rad]
_RANGE = (0.5, 5.0)  # [m] depths that a Kinect v2 measures


def camera_in_front(
    robot: SimulatedRobot, eye: ArrayLike, middle: ArrayLike, *, seed: int, color: bool = False
) -> DepthCamera:
    """Return a fixed depth camera with the noise of a Kinect v2.

    Args:
        robot: the simulated robot.
        eye: position of the camera in the base frame, shape (3,) [m].
        middle: point at which the camera looks, in the base frame, shape (3,) [m].
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


def looking_at(eye: ArrayLike, target: ArrayLike) -> Pose:
    """Return the pose of a camera whose z axis points from ``eye`` to ``target`` and whose y axis points down."""
    eye, target = np.asarray(eye, dtype=float), np.asarray(target, dtype=float)
    z = (target - eye) / np.linalg.norm(target - eye)
    upright = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([1.0, 0.0, 0.0])  # not along z
    x = np.cross(z, upright)
    x /= np.linalg.norm(x)
    return Pose(eye, matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def watch(robot: SimulatedRobot, observe: Callable[[float], Scene]) -> None:
    """Let the robot stand still for one second.

    Call ``observe`` in each control period, with times from -1 s to 0 s.
    """
    start = robot.time + WATCHES
    while robot.time < start - 0.5 * PERIOD:
        observe(robot.time - start)
        robot.move(np.zeros(robot.arm.n_joints), PERIOD)


def delayed(truth: MovingScene) -> MovingScene:
    """Return the scene with all motions delayed by the second in which the camera watches and the arm rests."""
    motions = {key: lambda time, motion=motion: motion(time - WATCHES) for key, motion in truth.motions.items()}
    return MovingScene(replace(truth.scene.at(truth.scene.stamp - WATCHES), stamp=truth.scene.stamp), motions)


def watched(
    robot: SimulatedRobot,
    eye: ArrayLike,
    middle: ArrayLike,
    workspace: ArrayLike,
    *,
    surfaces: Sequence[Obstacle],
    goal: Pose | None = None,
    fixtures: Sequence[Obstacle] = (),
    tracker: ObstacleTracker | None = None,
    seed: int = 0,
) -> CameraObserver:
    """Observe the scene for one second with a depth camera, and return the function ``observe`` of a control loop.

    A detector finds the obstacles in the images of the camera, and a tracker follows them. Delay the motions of the
    robot's scene with :func:`delayed` first.

    Args:
        robot: the simulated robot, at rest.
        eye: position of the camera in the base frame, shape (3,) [m]; several cameras have one row each, shape (n, 3).
        middle: point at which the camera looks, in the base frame, shape (3,) [m]; one row for each of several cameras.
        workspace: lowest and highest corner of the box in which obstacles are searched, shape (2, 3) [m].
        surfaces: known surfaces, such as the table top, which the detector must not report as obstacles. They must not
            be larger than in the simulated world.
        goal: goal that the observed scenes contain.
        fixtures: fixtures that the observed scenes contain.
        tracker: tracker that follows the detected obstacles; None: a new one with the default options.
        seed: seed of the camera's noise.
    """
    observe = CameraObserver(
        [
            camera_in_front(robot, one, at, seed=seed + 1_000_000 * number).frame
            for number, (one, at) in enumerate(zip(np.atleast_2d(eye), np.atleast_2d(middle), strict=True))
        ],
        ObstacleDetector(robot.arm, surfaces=surfaces, workspace=workspace),
        ObstacleTracker() if tracker is None else tracker,
        joints=lambda: robot.state().q,
        clock=robot.time + WATCHES,
        goal=goal,
        fixtures=fixtures,
    )
    watch(robot, observe)
    return observe
