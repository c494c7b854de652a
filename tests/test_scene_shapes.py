"""Each shape against numbers worked out by hand, closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.scene import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

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


def test_sphere_by_hand():
    ball = Sphere([1.0, 0.0, 0.0], 0.25)
    distance, gradient = ball.distance_and_gradient([[2.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(distance, [0.75, -0.15, -0.25])
    np.testing.assert_allclose(gradient, [[1, 0, 0], [0, 1, 0], [1, 0, 0]])
    np.testing.assert_allclose(ball.bounds(), [[0.75, -0.25, -0.25], [1.25, 0.25, 0.25]])


def test_capsule_by_hand():
    rod = Capsule([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.1)
    points = [[0.5, 0, 0.5], [0, 0.05, 0.2], [0, 0, 1.4], [0, 0, -0.3], [0.3, 0, 1.4]]
    np.testing.assert_allclose(rod.signed_distance(points), [0.4, -0.05, 0.3, 0.2, 0.4])
    on_axis = rod.gradient([0, 0, 0.5])
    assert abs(on_axis[2]) < 1e-12  # the nearest side is across
    assert np.linalg.norm(on_axis) == pytest.approx(1.0)


def test_capsule_of_no_length_is_a_sphere():
    points = np.random.default_rng(0).normal(size=(50, 3))
    dot = Capsule([0.1, 0.2, 0.3], [0.1, 0.2, 0.3], 0.4)
    ball = Sphere([0.1, 0.2, 0.3], 0.4)
    for a, b in zip(dot.distance_and_gradient(points), ball.distance_and_gradient(points), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_ellipsoid_by_hand():
    egg = Ellipsoid(HERE, [0.3, 0.2, 0.1])
    points = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0.05], [0.3, 0, 0]]
    distance, gradient = egg.distance_and_gradient(points)
    np.testing.assert_allclose(distance, [0.7, 0.8, 0.9, -0.1, -0.05, 0.0], atol=1e-12)
    np.testing.assert_allclose(gradient, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0]], atol=1e-6)


def test_ellipsoid_inside_near_its_long_axis():
    # On the long axis within x < a - b²/a the nearest points lie off the axis, at x_e = x a² / (a² - b²).
    a, b = 0.4, 0.1
    egg = Ellipsoid(HERE, [a, b, b])
    for x in (0.0, 0.1, 0.3, 0.37):
        on_surface = x * a**2 / (a**2 - b**2)
        height = b * np.sqrt(1.0 - (on_surface / a) ** 2)
        assert float(egg.signed_distance([x, 0, 0])) == pytest.approx(-np.hypot(on_surface - x, height), abs=1e-10)
    assert float(egg.signed_distance([0.39, 0, 0])) == pytest.approx(-0.01, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(
    semi_axes=st.lists(st.floats(1e-3, 5.0), min_size=3, max_size=3),
    point=st.lists(
        st.one_of(st.floats(-9.0, 9.0), st.sampled_from([0.0, 1e-300, -1e-17, 1e-9])), min_size=3, max_size=3
    ),
)
def test_ellipsoid_of_any_proportions(semi_axes, point):
    egg = Ellipsoid(HERE, semi_axes)
    distance, gradient = egg.distance_and_gradient(point)
    g = np.array(semi_axes)
    normal = gradient / np.linalg.norm(gradient)
    foot = g**2 * normal / np.linalg.norm(g * normal)  # where the surface has this normal
    assert np.linalg.norm(gradient) == pytest.approx(1.0, abs=1e-12)
    # the foot of the distance is that surface point: so both bounds meet, from the plane and from the point
    assert abs(abs(distance) - np.linalg.norm(np.array(point) - foot)) <= 1e-6 * max(1.0, g.max())
    angles = np.linspace(0, 2 * np.pi, 61)
    u, v = np.meshgrid(angles, angles[:31])
    surface = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1) * g
    assert abs(distance) <= np.linalg.norm(surface - point, axis=-1).min() + 1e-12
    assert (distance < 0) == (np.sum((np.array(point) / g) ** 2) < 1.0) or abs(distance) < 1e-12


def test_ellipsoid_with_equal_axes_is_a_sphere():
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.3
    egg, ball = Ellipsoid(HERE, [0.2, 0.2, 0.2]), Sphere([0, 0, 0], 0.2)
    for a, b in zip(egg.distance_and_gradient(points), ball.distance_and_gradient(points), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)
