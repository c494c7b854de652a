"""The one entry point for distances: packed obstacles give what each obstacle gives, at one time and at several."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.scene import OBSTACLES, ConvexHull, HalfSpace, Scene, Sphere
from imitarm.scene.distances import KINDS as PACKED_KINDS
from imitarm.scene.distances import distances, distances_and_gradients, near_pairs
from scene_shapes import KINDS, random_obstacle


def scene_of(kinds, seed=0, spin=0.0, n=1):
    rng = np.random.default_rng(seed)
    obstacles = [
        random_obstacle(kind, rng, velocity=rng.normal(size=3) * 0.2, angular_velocity=spin * rng.normal(size=3))
        for kind in kinds
        for _ in range(n)
    ]
    rng.shuffle(obstacles)
    return Scene(None, obstacles, stamp=3.0)


def test_every_registered_shape_can_be_packed():
    assert set(OBSTACLES) == set(PACKED_KINDS)


@pytest.mark.parametrize("kinds", [KINDS, ["sphere", "capsule"], ["box", "sphere", "cylinder"], ["convex_hull"], []])
@pytest.mark.parametrize("shape", [(), (30,), (2, 5, 3), (0,)])
def test_packed_obstacles_give_what_each_one_gives(kinds, shape):
    scene = scene_of(kinds, n=2)
    points = np.random.default_rng(1).normal(size=(*shape, 3)) * 0.5
    distance, gradient = scene.distances_and_gradients(points)
    assert distance.shape == (len(scene.obstacles), *shape)
    assert gradient.shape == (len(scene.obstacles), *shape, 3)
    np.testing.assert_array_equal(scene.distances(points), distance)
    for obstacle, d, g in zip(scene.obstacles, distance, gradient, strict=True):
        own_distance, own_gradient = obstacle.distance_and_gradient(points)
        np.testing.assert_allclose(d, own_distance, atol=1e-12)
        np.testing.assert_allclose(g, own_gradient, atol=1e-6)


@pytest.mark.parametrize("spin", [0.0, 1.0])
def test_many_times_at_once_equal_one_after_the_other(spin):
    scene = scene_of(KINDS, spin=spin)
    rng = np.random.default_rng(2)
    times = np.array([-0.5, 0.0, 0.3, 2.0])
    for points in (rng.normal(size=(4, 7, 3)), rng.normal(size=(4, 3)), rng.normal(size=(1, 7, 3))):
        distance, gradient = distances_and_gradients(scene.packed, points, times)
        np.testing.assert_array_equal(distances(scene.packed, points, times), distance)
        for k, dt in enumerate(times):
            then = scene.at(3.0 + dt)
            expected = then.distances_and_gradients(points[min(k, len(points) - 1)])
            np.testing.assert_allclose(distance[:, k], expected[0], atol=1e-12)
            np.testing.assert_allclose(gradient[:, k], expected[1], atol=1e-6)


@pytest.mark.parametrize("spin", [0.0, 1.0])
def test_near_pairs_misses_none(spin):
    scene = scene_of([*KINDS, "sphere"], spin=spin).at(3.5)
    scene = Scene(None, [HalfSpace([0, 0, -0.3]), *scene.obstacles])
    points = np.random.default_rng(3).normal(size=(80, 3)) * 0.6
    reach = np.random.default_rng(4).uniform(0.0, 0.3, 80)
    distance, gradient = scene.distances_and_gradients(points)
    pairs = near_pairs(scene.packed, points, reach)
    expected = {(int(i), int(j)) for i, j in np.argwhere(distance <= reach)}
    found = list(zip(pairs.obstacle.tolist(), pairs.point.tolist(), strict=True))
    assert len(found) == len(expected)
    assert set(found) == expected
    np.testing.assert_allclose(pairs.distance, distance[pairs.obstacle, pairs.point], atol=1e-12)
    np.testing.assert_allclose(pairs.normal.T, gradient[pairs.obstacle, pairs.point], atol=1e-6)
    assert near_pairs(scene.packed, points[:3] + 50.0, reach[:3]) is None


def test_a_rotating_obstacle_turns_about_its_centre():
    """A point that rides on the obstacle keeps its distance."""
    rng = np.random.default_rng(5)
    for kind in KINDS:
        spin, velocity = rng.normal(size=3), rng.normal(size=3)
        obstacle = random_obstacle(kind, rng, velocity=velocity, angular_velocity=spin)
        middle = obstacle.solid().position
        points = middle + rng.normal(size=(20, 3)) * 0.3
        dt = 1e-5
        riding = points + dt * (velocity + np.cross(spin, points - middle))
        drift = obstacle.after(dt).signed_distance(riding) - obstacle.signed_distance(points)
        assert np.abs(drift).max() < 20.0 * dt**2
        for seconds in (0.7, -2.0):
            moved = obstacle.after(seconds)
            own, packed = moved.signed_distance(points), Scene(None, [obstacle]).at(seconds).distances(points)[0]
            np.testing.assert_allclose(packed, own, atol=1e-12)
            np.testing.assert_allclose(moved.after(-seconds).bounds(), obstacle.bounds(), atol=1e-12)
            np.testing.assert_allclose(moved.signed_distance(moved.support(points)), 0.0, atol=1e-9)


def test_half_space_by_hand():
    floor = HalfSpace([5.0, 0.0, -0.5])
    distance, gradient = floor.distance_and_gradient([[0.3, 40.0, 1.0], [0, 0, -0.5], [1, 2, -3.0]])
    np.testing.assert_allclose(distance, [1.5, 0.0, -2.5], atol=1e-12)
    np.testing.assert_array_equal(gradient, np.tile([0.0, 0.0, 1.0], (3, 1)))
    np.testing.assert_array_equal(floor.bounds(), [[-np.inf] * 3, [np.inf, np.inf, -0.5]])
    wall = HalfSpace([1.0, 0.0, 0.0], [-3.0, 0.0, 0.0], velocity=[-0.1, 0.0, 0.0])
    np.testing.assert_allclose(wall.signed_distance([[0.0, 7.0, 7.0], [2.0, 0.0, 0.0]]), [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(wall.after(2.0).signed_distance([0.0, 0.0, 0.0]), 0.8, atol=1e-12)
    rng = np.random.default_rng(6)
    for _ in range(20):
        n, p = rng.normal(size=3), rng.normal(size=3)
        points = rng.normal(size=(30, 3)) * 3.0
        expected = (points - p) @ n / np.linalg.norm(n)
        np.testing.assert_allclose(HalfSpace(p, n).signed_distance(points), expected, atol=1e-12)
    with pytest.raises(InputError, match="normal must have a direction"):
        HalfSpace([0, 0, 0], [0, 0, 0])
    with pytest.raises(InputError, match="no farthest point"):
        floor.support([1.0, 0.0, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    scene = scene_of(KINDS)
    points = np.zeros((4, 3))
    points[2, 1] = bad
    for ask in (scene.distances, scene.clearance, scene.nearest, scene.distances_and_gradients):
        with pytest.raises(InputError, match=r"points\[2, 1\]"):
            ask(points)
    for obstacle in scene.obstacles:
        for ask in (obstacle.signed_distance, obstacle.gradient, obstacle.distance_and_gradient, obstacle.support):
            with pytest.raises(InputError, match=r"points\[2, 1\]"):
                ask(points)
    for ask in (scene.at, scene.obstacles[0].after):
        with pytest.raises(InputError, match="must be a finite number"):
            ask(bad)
    with pytest.raises(InputError, match="times must be finite"):
        distances(scene.packed, np.zeros((1, 3)), [0.0, bad])


@pytest.mark.parametrize("bad", ["abc", None, [[1, 2, "x"]], {}, np.ma.masked_equal([1.0, 2.0, 3.0], 2.0)])
def test_points_that_are_no_numbers_are_refused(bad):
    for thing in (scene_of(["box"]).distances, Sphere([0, 0, 0], 0.1).signed_distance):
        with pytest.raises(InputError, match="points"):
            thing(bad)


def test_moving_hulls_keep_their_faces():
    hull = ConvexHull(np.random.default_rng(0).normal(size=(20, 3)), angular_velocity=[0, 0, 1.0])
    moved = hull.after(0.4)
    assert moved._polytope is hull._polytope
    again = ConvexHull(moved.points)
    points = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(moved.signed_distance(points), again.signed_distance(points), atol=1e-12)
    np.testing.assert_allclose(np.sort(moved.vertices, axis=0), np.sort(again.vertices, axis=0), atol=1e-12)
