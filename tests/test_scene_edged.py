"""Box, Cylinder and Cone against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.scene import Box, Cone, ConvexHull, Cylinder

HERE = Pose.identity()
UPSIDE_DOWN = Pose([0, 0, 0], quaternion_exp([np.pi, 0, 0]))


def test_box_by_hand():
    box = Box(HERE, [2.0, 4.0, 6.0])
    points = [[2, 0, 0], [4, 6, 0], [2, 3, 4], [0.5, 0, 0], [0, 0, 0], [1, 2, 3], [-1, -2, -3]]
    distance, gradient = box.distance_and_gradient(points)
    np.testing.assert_allclose(distance, [1, 5, np.sqrt(3), -0.5, -1, 0, 0])
    third = 1 / np.sqrt(3)
    np.testing.assert_allclose(
        gradient,
        [[1, 0, 0], [0.6, 0.8, 0], [third] * 3, [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]],
        atol=1e-12,
    )


def test_box_is_turned_by_its_pose():
    box = Box(Pose([0, 0, 1], quaternion_exp([0, 0, np.pi / 4])), [2.0, 2.0, 2.0])
    assert float(box.signed_distance([np.sqrt(2), 0, 1])) == pytest.approx(0.0, abs=1e-12)  # an edge is there now
    assert float(box.signed_distance([0, 0, 2.5])) == pytest.approx(0.5)
    np.testing.assert_allclose(box.bounds(), [[-np.sqrt(2), -np.sqrt(2), 0], [np.sqrt(2), np.sqrt(2), 2]], atol=1e-12)


def test_cylinder_by_hand():
    can = Cylinder(HERE, 1.0, 4.0)
    points = [[3, 0, 0], [0, 0, 3], [4, 0, 6], [0.5, 0, 0], [0, 0, 1.5], [0, 0, 0]]
    distance, gradient = can.distance_and_gradient(points)
    np.testing.assert_allclose(distance, [2, 1, 5, -0.5, -0.5, -1])
    np.testing.assert_allclose(
        gradient, [[1, 0, 0], [0, 0, 1], [0.6, 0, 0.8], [1, 0, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12
    )


def test_cone_by_hand():
    # base of radius 3 at z = -2, tip at z = 2: the side's normal is (4, 3) / 5 in (rho, z)
    cone = Cone(HERE, 3.0, 4.0)
    points = [[0, 0, 5], [0, 0, -3], [5, 0, -2], [7, 0, -5], [1.5 + 0.8, 0, 0.6], [0, 0, -1.9], [1.5 - 0.08, 0, -0.06]]
    distance, gradient = cone.distance_and_gradient(points)
    np.testing.assert_allclose(distance, [3, 1, 2, 5, 1, -0.1, -0.1], atol=1e-12)
    side = [0.8, 0, 0.6]
    np.testing.assert_allclose(
        gradient, [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.8, 0, -0.6], side, [0, 0, -1], side], atol=1e-12
    )
    np.testing.assert_allclose(cone.bounds(), [[-3, -3, -2], [3, 3, 2]], atol=1e-12)
    assert float(Cone(UPSIDE_DOWN, 3.0, 4.0).signed_distance([0, 0, -5])) == pytest.approx(3.0)


def test_cone_and_its_hull_agree_within_what_is_documented():
    cone = Cone(Pose([0.4, 0.1, 0.2], quaternion_exp([0.3, -0.4, 0.5])), 0.08, 0.2, velocity=[0.1, 0, 0], name="c")
    points = np.random.default_rng(2).normal(size=(500, 3)) * 0.2 + cone.pose.position
    for sides in (3, 12, 48):
        hull = cone.hull(sides)
        assert isinstance(hull, ConvexHull)
        assert hull.name == "c"
        np.testing.assert_array_equal(hull.velocity, cone.velocity)
        excess = hull.signed_distance(points) - cone.signed_distance(points)
        assert excess.min() >= -1e-12
        assert excess.max() <= cone.radius * (1 - np.cos(np.pi / sides)) + 1e-12
    with pytest.raises(InputError, match="at least 3 sides, got 2"):
        cone.hull(2)
