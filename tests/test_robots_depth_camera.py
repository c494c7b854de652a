"""The simulated depth camera sees the surfaces of the world where they are."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.perception import DepthNoise, Intrinsics
from imitarm.robots import SimulatedRobot
from imitarm.robots.depth_camera import DepthCamera
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Scene, Sphere

CAMERA = Intrinsics.from_field_of_view(80, 60, 0.9)
LOOKS_ALONG_X = np.array([0.5, -0.5, 0.5, -0.5])  # camera z along the base's x, camera y down


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("sawyer", tool="brush")


def one_of_each():
    turned = quaternion_exp([0.3, -0.5, 0.8])
    corners = np.random.default_rng(0).normal(size=(12, 3)) * 0.1
    return (
        Sphere([3.0, -0.8, 0.6], 0.15),
        Box(Pose([3.0, -0.3, 0.6], turned), [0.2, 0.3, 0.1]),
        Capsule([3.0, 0.2, 0.4], [3.0, 0.1, 0.7], 0.08),
        Cylinder(Pose([3.0, 0.6, 0.5], turned), 0.1, 0.3),
        Ellipsoid(Pose([3.0, -0.5, 0.1], turned), [0.2, 0.1, 0.15]),
        ConvexHull(corners + [3.0, 0.3, 0.05]),
    )


def test_the_camera_frame_is_right_handed_and_looks_where_it_says():
    pose = Pose([0, 0, 0], LOOKS_ALONG_X)
    np.testing.assert_allclose(pose.apply([0, 0, 1]), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pose.apply([0, 1, 0]), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(pose.apply([1, 0, 0]), [0, -1, 0], atol=1e-12)


def test_every_point_is_on_a_surface(arm):
    scene = Scene(None, one_of_each(), stamp=7.0)
    robot = SimulatedRobot(arm, scene=scene)
    pose = Pose([1.5, 0.0, 0.4], LOOKS_ALONG_X)
    frame = DepthCamera(robot, CAMERA, pose, farthest=4.0).frame()
    assert frame.stamp == 7.0
    assert frame.depth.shape == (60, 80)
    points = frame.points()
    world = Scene(None, [*scene.obstacles, *robot.scene.fixtures])
    distances = world.distances(points)
    np.testing.assert_allclose(np.abs(distances).min(axis=0), 0.0, atol=1e-5)
    assert distances.min() > -1e-5
    seen = np.bincount(np.abs(distances).argmin(axis=0), minlength=len(world.obstacles))
    assert (seen[: len(scene.obstacles)] > 20).all()
    assert seen[len(scene.obstacles)] > 0  # the floor
    # and no surface hides: the centre of each obstacle in sight is seen at most at its own depth
    for obstacle in scene.obstacles:
        u, v = np.round(CAMERA.project(pose.inverse().apply(obstacle.solid().position))).astype(int)
        assert frame.depth[v, u] < pose.inverse().apply(obstacle.solid().position)[2]


def test_it_sees_moving_obstacles_and_the_arm(arm):
    ball = Sphere([3.0, -0.5, 0.4], 0.2, velocity=[0.0, 1.0, 0.0])
    robot = SimulatedRobot(arm, scene=Scene(None, [ball]))
    camera = DepthCamera(robot, CAMERA, Pose([1.5, 0.0, 0.4], LOOKS_ALONG_X))
    for _ in range(30):
        robot.move(np.zeros(7), 0.01)
    frame = camera.frame()
    assert frame.stamp == pytest.approx(0.3)
    on_ball = np.abs(robot.scene.distances(frame.points())[0]) < 5e-3  # the body lags by one physics step
    assert on_ball.sum() > 100
    back = Pose([2.0, 0.0, 0.6], quaternion_multiply(quaternion_exp([0, 0, np.pi]), LOOKS_ALONG_X))
    at_arm = DepthCamera(robot, CAMERA, back).frame()
    centers, radii = arm.collision_spheres(robot.state().q)
    points = at_arm.points()
    gaps = (np.linalg.norm(points[:, None] - centers, axis=2) - radii).min(axis=1)
    assert (gaps < 0.03).sum() > 100


def test_a_camera_on_the_tool_moves_with_it(arm):
    robot = SimulatedRobot(arm, scene=Scene(None, [Sphere([0.5, 0.2, -0.5], 0.1)]))
    mount = Pose([0.0, 0.0, 0.02], [1.0, 0.0, 0.0, 0.0])
    camera = DepthCamera(robot, CAMERA, mount, on_tool=True)
    before = camera.camera_to_base
    for _ in range(30):
        robot.move([0.3, 0.2, 0.0, 0.2, 0.0, 0.0, 0.0], 0.01)
    after = camera.frame().camera_to_base
    assert np.linalg.norm(after.position - before.position) > 0.02
    expected = robot.tool_to_base @ mount
    np.testing.assert_allclose(after.position, expected.position)
    world = Scene(None, [*robot.scene.obstacles, *robot.scene.fixtures])
    points = camera.frame().points()
    assert (np.abs(world.clearance(points)) < 1e-5).mean() > 0.5


def test_bad_arguments_are_refused(arm):
    robot = SimulatedRobot(arm)
    for change in ({"robot": arm}, {"intrinsics": 60}, {"pose": np.eye(4)}, {"on_tool": "yes"}, {"farthest": np.nan}):
        good = {"robot": robot, "intrinsics": CAMERA, "pose": Pose.identity()}
        with pytest.raises(InputError, match=next(iter(change))):
            DepthCamera(**{**good, **change})


def test_range_noise_and_colour(arm):
    scene = Scene(None, [Sphere([2.0, 0.0, 0.4], 0.1), Sphere([3.0, 0.4, 0.4], 0.1)])
    robot = SimulatedRobot(arm, scene=scene)
    pose = Pose([1.0, 0.0, 0.4], LOOKS_ALONG_X)
    exact = DepthCamera(robot, CAMERA, pose, color=True).frame()
    near = DepthCamera(robot, CAMERA, pose, nearest=0.5, farthest=1.5).frame()
    assert np.nanmax(near.depth) <= 1.5
    both = ~np.isnan(near.depth)
    np.testing.assert_array_equal(near.depth[both], exact.depth[both])
    assert np.isnan(DepthCamera(robot, CAMERA, pose, nearest=1.2, farthest=1.5).frame().depth).all()
    noisy = [DepthCamera(robot, CAMERA, pose, noise=DepthNoise(), seed=seed).frame().depth for seed in (1, 1, 2)]
    np.testing.assert_array_equal(noisy[0], noisy[1])
    assert not np.array_equal(noisy[0], noisy[2], equal_nan=True)
    assert 0.0 < np.nanmax(np.abs(noisy[0] - exact.depth)[exact.depth < 2.0]) < 0.1
    colours = [exact.color[exact.depth < limit] for limit in (1.2, 2.2)]
    assert len(np.unique(colours[0], axis=0)) == 1  # the near ball alone
    assert len(np.unique(colours[1], axis=0)) >= 2
    assert near.color is None
