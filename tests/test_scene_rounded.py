"""Sphere, Capsule and Ellipsoid against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose
from imitarm.scene import Capsule, Ellipsoid, Sphere

HERE = Pose.identity()
COORDINATE = st.one_of(st.floats(-9.0, 9.0), st.sampled_from([0.0, 1e-300, -1e-17, 1e-9]))


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
