"""The detector finds the objects in an image, covers what is visible, and leaves out table and robot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import DepthFrame, DepthNoise, ObstacleDetector, PointCloud
from imitarm.scene import Box, Capsule, Cylinder, HalfSpace, Sphere
from seen_scenes import CAMERA, image, looking

TABLE = HalfSpace([0.0, 0.0, 0.0], name="table")
EYE = looking([1.6, 0.2, 0.9], [0.4, 0.0, 0.1])
EXACT = DepthNoise.none()


def detector(**options):
    return ObstacleDetector(surfaces=[TABLE], **{"noise": EXACT, **options})


def upright(x, y, z, yaw=0.0):
    return Pose([x, y, z], quaternion_exp([0.0, 0.0, yaw]))


@settings(deadline=None, max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_sphere_is_found_where_it_is(seed):
    rng = np.random.default_rng(seed)
    truth = Sphere([*rng.uniform([0.2, -0.3, 0.2], [0.6, 0.3, 0.4])], rng.uniform(0.05, 0.12))
    (found,) = detector().detect(image([truth, TABLE], EYE))
    assert isinstance(found.obstacle, Sphere)
    np.testing.assert_allclose(found.position, truth.center, atol=1e-3)
    assert found.obstacle.radius == pytest.approx(truth.radius, abs=1e-3)


@pytest.mark.parametrize(
    "truth",
    [
        Cylinder(upright(0.4, 0.1, 0.12), 0.05, 0.24),
        Box(upright(0.4, -0.1, 0.1, 0.5), [0.12, 0.2, 0.2]),
        Capsule([0.3, -0.2, 0.3], [0.4, 0.2, 0.4], 0.05),
    ],
    ids=lambda shape: shape.kind,
)
def test_the_shape_is_recognised(truth):
    (found,) = detector().detect(image([truth, TABLE], EYE))
    assert found.obstacle.kind == truth.kind
    assert np.linalg.norm(found.position - truth.solid().position) < 0.02
    np.testing.assert_allclose(np.sort(found.obstacle.solid().size), np.sort(truth.solid().size), atol=0.05)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["sphere", "box", "capsule", "cylinder", "convex_hull"]))
def test_the_visible_points_are_in_the_shapes(seed, kind):
    from scene_shapes import random_obstacle  # noqa: PLC0415  it needs coal

    rng = np.random.default_rng(seed)
    shape = random_obstacle(kind, rng)
    frame = image([shape], looking(shape.solid().position + [1.5, 0.3, 0.8], shape.solid().position))
    finder = ObstacleDetector(noise=EXACT, workspace=((-9, -9, -9), (9, 9, 9)), min_points=1)
    found = finder.detect(frame)
    points = finder.obstacle_points(frame)
    if len(points):
        inside = np.min([one.obstacle.signed_distance(points) for one in found], axis=0)
        assert inside.max() < 1e-6


def test_with_noise_few_points_are_outside():
    noise = DepthNoise()
    truth = Sphere([0.4, 0.0, 0.3], 0.1)
    frame = noise.apply(image([truth, TABLE], EYE), np.random.default_rng(3))
    finder = detector(noise=noise)
    (found,) = finder.detect(frame)
    outside = found.obstacle.signed_distance(finder.obstacle_points(frame))
    sigma = float(noise.sigma(1.4))
    assert outside.max() < 2.5 * sigma
    assert np.linalg.norm(found.position - truth.center) < 3.0 * np.sqrt(np.linalg.eigvalsh(found.covariance)[-1])


def test_objects_are_separate_and_sorted_by_their_depth():
    shapes = [Sphere([0.2, 0.3, 0.1], 0.08), Cylinder(upright(0.6, -0.2, 0.1), 0.05, 0.2)]
    found = detector().detect(image([*shapes, TABLE], EYE))
    assert [one.obstacle.kind for one in found] == ["cylinder", "sphere"]


def test_a_table_of_unknown_height_is_found():
    table = HalfSpace([0.0, 0.0, 0.03])
    frame = image([Sphere([0.4, 0.0, 0.3], 0.1), table], EYE)
    (found,) = ObstacleDetector(find_table=True, noise=EXACT).detect(frame)
    assert found.obstacle.kind == "sphere"


def test_the_robot_is_not_an_obstacle_but_a_ball_beside_it_is():
    arm = ArmModel.load("sawyer", tool="gripper")
    centers, radii = arm.collision_spheres(arm.home)
    parts = [Sphere(center, radius) for center, radius in zip(centers, radii, strict=True)]
    parts += [Sphere(*one) for one in zip(arm.cover.base_centers, arm.cover.base_radii, strict=True)]
    eye = looking([2.2, 0.6, 0.9], [0.3, 0.1, 0.3])
    finder = ObstacleDetector(arm, noise=EXACT)
    with pytest.raises(InputError, match="joint positions of the arm are unknown"):
        finder.detect(image(parts, eye))
    assert finder.detect(image(parts, eye), arm.home) == []
    ball = Sphere([0.8, -0.5, 0.3], 0.1)
    (found,) = finder.detect(image([*parts, ball], eye))
    assert np.linalg.norm(found.position - ball.center) < 0.02


def test_two_objects_in_contact_are_told_apart():
    hand = Capsule([0.4, -0.25, 0.15], [0.4, -0.08, 0.15], 0.04)
    bottle = Cylinder(upright(0.4, 0.0, 0.12), 0.04, 0.24)
    found = detector().detect(image([hand, bottle, TABLE], EYE))
    assert len(found) == 2
    assert min(np.linalg.norm(one.position - bottle.pose.position) for one in found) < 0.03


def test_a_point_cloud_is_as_good_as_an_image():
    frame = image([Sphere([0.4, 0.0, 0.3], 0.1), TABLE], EYE)
    measured = np.vstack([EYE.inverse().apply(frame.points()), [np.nan] * 3])
    cloud = PointCloud(frame.stamp, measured, EYE, spacing=frame.spacing)
    assert repr(cloud) == f"PointCloud({len(measured) - 1} points, stamp 0 s)"
    (a,), (b,) = detector().detect(frame), detector().detect(cloud)
    np.testing.assert_allclose(a.position, b.position, atol=1e-6)


def test_an_empty_image_has_no_obstacles():
    frame = DepthFrame(0.0, np.full((72, 96), np.nan), CAMERA, EYE)
    assert detector().detect(frame) == []
    assert detector().detect(image([TABLE], EYE)) == []
    far = image([Sphere([0.4, 0.0, 0.3], 0.1)], EYE)
    assert detector(depth_range=(0.2, 0.5)).detect(far) == []
    assert detector(workspace=((-1, -1, 1), (1, 1, 2))).detect(far) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arm": "sawyer"}, "arm must be a ArmModel"),
        ({"surfaces": [1]}, "surfaces"),
        ({"workspace": ((1, 1, 1), (0, 0, 0))}, "lowest and the highest corner"),
        ({"depth_range": (5.0, 0.5)}, "depth_range must be two increasing"),
        ({"noise": 0.01}, "noise"),
        ({"voxel": 0.0}, "voxel"),
        ({"min_points": 0}, "min_points"),
        ({"shapes": ["torus"]}, "unknown shape to fit"),
        ({"shapes": []}, "at least one shape"),
        ({"split": 1}, "split"),
    ],
)
def test_bad_arguments_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        ObstacleDetector(**changes)


def test_what_is_no_image_is_refused():
    with pytest.raises(InputError, match="DepthFrame or a PointCloud"):
        detector().detect(np.ones((3, 3)))
