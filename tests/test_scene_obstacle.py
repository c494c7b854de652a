"""What every obstacle promises: an exact signed distance and its gradient, whatever the shape."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene import OBSTACLES, Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, Sphere
from scene_shapes import KINDS, coal_distances, contains, moved_by, points_around, random_obstacle, random_pose

seeds = st.integers(0, 2**32 - 1)
quick = settings(deadline=None, max_examples=25)
every_kind = pytest.mark.parametrize("kind", KINDS)


def unit_directions(rng, n):
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@every_kind
@quick
@given(seed=seeds)
def test_gradient_is_the_finite_difference(kind, seed):
    rng = np.random.default_rng(seed)
    obstacle = random_obstacle(kind, rng)
    points = points_around(obstacle, rng, 60)
    gradient = obstacle.gradient(points)
    h = 1e-6
    ahead = [obstacle.gradient(points + s * h * axis) for axis in np.eye(3) for s in (-1.0, 1.0)]
    smooth = np.max([np.abs(g - gradient).max(axis=1) for g in ahead], axis=0) < 1e-3  # no medial axis in between
    difference = np.stack(
        [
            (obstacle.signed_distance(points + h * axis) - obstacle.signed_distance(points - h * axis)) / (2 * h)
            for axis in np.eye(3)
        ],
        axis=1,
    )
    assert smooth.sum() >= 50
    np.testing.assert_allclose(gradient[smooth], difference[smooth], atol=1e-3)
    assert np.median(np.abs(gradient - difference)[smooth]) < 1e-8


@every_kind
@quick
@given(seed=seeds)
def test_changes_at_most_one_metre_a_metre_and_is_convex(kind, seed):
    rng = np.random.default_rng(seed)
    obstacle = random_obstacle(kind, rng)
    a, b = points_around(obstacle, rng, 100), rng.permutation(points_around(obstacle, rng, 100))
    share = rng.uniform(size=(100, 1))
    at_a, at_b = obstacle.signed_distance(a), obstacle.signed_distance(b)
    between = obstacle.signed_distance(share * a + (1 - share) * b)
    assert np.all(np.abs(at_a - at_b) <= np.linalg.norm(a - b, axis=1) + 1e-12)
    assert np.all(between <= share[:, 0] * at_a + (1 - share[:, 0]) * at_b + 1e-12)


@every_kind
@quick
@given(seed=seeds)
def test_rigid_motion_changes_nothing(kind, seed):
    rng = np.random.default_rng(seed)
    obstacle, pose = random_obstacle(kind, rng), random_pose(rng)
    points = points_around(obstacle, rng, 60)
    distance, gradient = obstacle.distance_and_gradient(points)
    moved_distance, moved_gradient = moved_by(obstacle, pose).distance_and_gradient(pose.apply(points))
    np.testing.assert_allclose(moved_distance, distance, atol=1e-12)
    same_side = np.abs(moved_gradient - gradient @ pose.rotation.T).max(axis=1) < 1e-6
    assert same_side.sum() >= 58  # rounding may choose another of two nearest faces


@every_kind
@quick
@given(seed=seeds)
def test_distance_is_that_of_the_best_separating_plane(kind, seed):
    # For a convex solid sd(x) = max over unit n of n·x - max over s of n·s. Here the gradient is that n.
    rng = np.random.default_rng(seed)
    obstacle = random_obstacle(kind, rng)
    points = points_around(obstacle, rng, 60)
    distance, gradient = obstacle.distance_and_gradient(points)
    np.testing.assert_allclose(np.sum(gradient * (points - obstacle.support(gradient)), axis=1), distance, atol=1e-10)
    n = unit_directions(rng, 200)
    planes = points @ n.T - np.sum(n * obstacle.support(n), axis=1)
    assert np.all(planes <= distance[:, None] + 1e-12)


@every_kind
@quick
@given(seed=seeds)
def test_surface_is_where_the_distance_is_zero(kind, seed):
    rng = np.random.default_rng(seed)
    obstacle = random_obstacle(kind, rng)
    points = points_around(obstacle, rng, 60)
    distance, gradient = obstacle.distance_and_gradient(points)
    nearest = points - distance[:, None] * gradient
    np.testing.assert_allclose(obstacle.signed_distance(nearest), 0.0, atol=1e-10)
    candidates = points_around(obstacle, rng, 10000)
    inside = contains(obstacle, candidates)
    assume(inside.any())  # a thin one may be missed
    core = candidates[inside].mean(axis=0)
    inwards = nearest + 1e-6 * (core - nearest)
    assert contains(obstacle, inwards).all()
    assert not contains(obstacle, nearest + 1e-8 * gradient).any()
    np.testing.assert_allclose(obstacle.signed_distance(obstacle.support(unit_directions(rng, 60))), 0.0, atol=1e-12)


@every_kind
@quick
@given(seed=seeds)
def test_sign_tells_inside_from_outside(kind, seed):
    rng = np.random.default_rng(seed)
    obstacle = random_obstacle(kind, rng)
    points = points_around(obstacle, rng, 300)
    distance = obstacle.signed_distance(points)
    clear = np.abs(distance) > 1e-9
    np.testing.assert_array_equal((distance < 0.0)[clear], contains(obstacle, points)[clear])


@every_kind
def test_inside_the_distance_is_that_of_the_nearest_exit(kind):
    rng = np.random.default_rng(3)
    rays = unit_directions(rng, 4000)
    for _ in range(3):
        obstacle = random_obstacle(kind, rng)
        candidates = points_around(obstacle, rng, 600)
        for point in candidates[obstacle.signed_distance(candidates) < -1e-3][:4]:
            near, far = np.zeros(len(rays)), np.full(len(rays), 5.0)
            for _ in range(40):  # bisection of where each ray leaves the solid
                middle = 0.5 * (near + far)
                inside = contains(obstacle, point + middle[:, None] * rays)
                near, far = np.where(inside, middle, near), np.where(inside, far, middle)
            depth = -float(obstacle.signed_distance(point))
            assert depth <= near.min() + 1e-9  # no ray leaves sooner
            assert depth >= near.min() * np.cos(0.1)  # and the nearest of 4000 rays is within 0.1 rad of the best


@every_kind
def test_outside_it_agrees_with_coal(kind):
    rng = np.random.default_rng(5)
    for _ in range(10):
        obstacle = random_obstacle(kind, rng)
        points = points_around(obstacle, rng, 60, spread=0.3)
        distance = obstacle.signed_distance(points)
        outside = distance > 2e-3
        assert outside.sum() > 20
        np.testing.assert_allclose(distance[outside], coal_distances(obstacle, points[outside]), atol=1e-8)


@every_kind
def test_gradient_is_a_unit_vector_everywhere(kind):
    rng = np.random.default_rng(7)
    for _ in range(10):
        obstacle = random_obstacle(kind, rng)
        center = obstacle.bounds().mean(axis=0)
        surface = obstacle.support(np.vstack([np.eye(3), -np.eye(3), unit_directions(rng, 20)]))
        special = [center[None], surface, 0.5 * (center + surface), 2.0 * surface - center]
        if hasattr(obstacle, "pose"):  # its own axes: medial axes, tips and middles of faces
            along = np.linspace(-0.4, 0.4, 41)[:, None, None] * np.eye(3)
            special.append(obstacle.pose.apply(along.reshape(-1, 3)))
        points = np.vstack(special)
        points = np.vstack([points, *(points + 10.0**-k * unit_directions(rng, len(points)) for k in range(6, 18, 2))])
        distance, gradient = obstacle.distance_and_gradient(points)
        np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)
        assert np.isfinite(distance).all()
        again = obstacle.distance_and_gradient(points.copy())
        np.testing.assert_array_equal(again[0], distance)
        np.testing.assert_array_equal(again[1], gradient)
        on_planes = np.sum(gradient * (points - obstacle.support(gradient)), axis=1)
        np.testing.assert_allclose(distance, on_planes, atol=1e-7)  # so each is one of the nearest sides


@every_kind
def test_any_leading_shape(kind):
    rng = np.random.default_rng(11)
    obstacle = random_obstacle(kind, rng)
    points = points_around(obstacle, rng, 24)
    distance, gradient = obstacle.distance_and_gradient(points)
    for shape in ((24,), (2, 12), (2, 3, 4), (24, 1)):
        d, g = obstacle.distance_and_gradient(points.reshape(*shape, 3))
        assert d.shape == shape
        assert g.shape == (*shape, 3)
        np.testing.assert_allclose(d.ravel(), distance, atol=1e-14)
        np.testing.assert_allclose(g.reshape(-1, 3), gradient, atol=1e-12)
        np.testing.assert_array_equal(obstacle.signed_distance(points.reshape(*shape, 3)), d)
        np.testing.assert_array_equal(obstacle.gradient(points.reshape(*shape, 3)), g)
        assert obstacle.support(gradient.reshape(*shape, 3)).shape == (*shape, 3)
    single, normal = obstacle.distance_and_gradient(list(points[3]))
    assert single.shape == ()
    assert normal.shape == (3,)
    assert float(single) == pytest.approx(distance[3], abs=1e-14)
    empty, none = obstacle.distance_and_gradient(np.empty((0, 3)))
    assert empty.shape == (0,)
    assert none.shape == (0, 3)
    for layout in (np.asfortranarray(points), np.repeat(points, 2, axis=0)[::2]):
        np.testing.assert_allclose(obstacle.signed_distance(layout), distance, atol=1e-14)
    kept = points.copy()
    obstacle.distance_and_gradient(points)
    np.testing.assert_array_equal(points, kept)


@every_kind
@pytest.mark.parametrize("shape", [(4,), (5, 2), (), (3, 1)])
def test_points_of_another_shape_are_refused(kind, shape):
    obstacle = random_obstacle(kind, np.random.default_rng(0))
    for ask in (obstacle.signed_distance, obstacle.gradient, obstacle.distance_and_gradient, obstacle.support):
        with pytest.raises(InputError, match=r"shape \(\.\.\., 3\)"):
            ask(np.zeros(shape))


@every_kind
def test_moves_at_its_velocity(kind):
    rng = np.random.default_rng(13)
    velocity = np.array([0.1, -0.2, 0.3])
    obstacle = random_obstacle(kind, rng, velocity=velocity, name="cart")
    points = points_around(obstacle, rng, 50)
    before = obstacle.distance_and_gradient(points)
    moved = obstacle.after(0.5)
    assert type(moved) is type(obstacle)
    assert moved.name == "cart"
    np.testing.assert_array_equal(moved.velocity, velocity)
    for now, then in zip(moved.distance_and_gradient(points + 0.5 * velocity), before, strict=True):
        np.testing.assert_allclose(now, then, atol=1e-9)
    np.testing.assert_allclose(moved.bounds(), obstacle.bounds() + 0.5 * velocity, atol=1e-12)
    # what is shown is where it is: the same shape built anew from its fields
    own = {f.name: getattr(moved, f.name) for f in dataclasses.fields(moved) if f.init}
    np.testing.assert_allclose(type(moved)(**own).signed_distance(points), moved.signed_distance(points), atol=1e-12)
    np.testing.assert_array_equal(obstacle.distance_and_gradient(points)[0], before[0])  # the first one stayed
    back = moved.after(0.25).after(-0.75)
    np.testing.assert_allclose(back.signed_distance(points), before[0], atol=1e-12)
    still = random_obstacle(kind, rng)
    assert still.after(10.0) is still


@every_kind
def test_bounds_are_tight(kind):
    rng = np.random.default_rng(17)
    obstacle = random_obstacle(kind, rng)
    low, high = obstacle.bounds()
    surface = obstacle.support(unit_directions(rng, 20000))
    assert np.all(surface >= low - 1e-12)
    assert np.all(surface <= high + 1e-12)
    np.testing.assert_allclose(surface.min(axis=0), low, atol=2e-3)
    np.testing.assert_allclose(surface.max(axis=0), high, atol=2e-3)


@every_kind
def test_is_frozen(kind):
    obstacle = random_obstacle(kind, np.random.default_rng(0))
    with pytest.raises(dataclasses.FrozenInstanceError):
        obstacle.name = "other"
    with pytest.raises(ValueError, match="read-only"):
        obstacle.velocity[0] = 1.0
    assert OBSTACLES[obstacle.kind] is type(obstacle)


HERE = Pose.identity()
TETRAHEDRON = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
BAD = [
    (lambda: Sphere([0, 0, 0], 0.0), "Sphere: radius must be a finite number above 0 [m], got 0.0"),
    (lambda: Sphere([0, 0, 0], -0.1, name="ball"), 'Sphere "ball": radius must be a finite number'),
    (lambda: Sphere([0, 0, 0], float("nan")), "radius must be a finite number"),
    (lambda: Sphere([0, 0, 0], "big"), "radius must be a finite number [m], got 'big'"),
    (lambda: Sphere([0, 0, 0], [0.1, 0.2]), "radius must be a finite number"),
    (lambda: Sphere([0, 0, 0], 50.0), "radius 50 is beyond 10 m; give it in metres"),
    (lambda: Sphere([0, 0], 0.1), "center must be 3 numbers [m], got shape (2,)"),
    (lambda: Sphere([0, 0, np.inf], 0.1), "center must be finite [m], but center[2] is inf"),
    (lambda: Sphere(["a", 0, 0], 0.1), "center must be 3 finite numbers"),
    (lambda: Sphere([450, 0, 0], 0.1), "center [450.0, 0.0, 0.0] is beyond 100 m; give it in m"),
    (lambda: Sphere([0, 0, 0], 0.1, velocity=[1, 2]), "velocity must be 3 numbers [m/s]"),
    (lambda: Sphere([0, 0, 0], 0.1, velocity=[200, 0, 0]), "beyond 100 m/s"),
    (lambda: Sphere([0, 0, 0], 0.1, name=3), "name must be one line of text, got 3"),
    (lambda: Sphere([0, 0, 0], 0.1, name="a\nb"), "Sphere: name must be one line of text, got 'a\\nb'"),
    (lambda: Box(HERE, [0.1, 0.1]), "Box: size must be 3 numbers [m], got shape (2,)"),
    (lambda: Box(HERE, [0.1, 0.0, 0.1]), "Box: size must be 3 positive numbers [m], got [0.1, 0.0, 0.1]"),
    (lambda: Box(HERE, [120, 80, 200], name="tin"), 'Box "tin": size [120.0, 80.0, 200.0] is beyond 10 m'),
    (lambda: Box([0, 0, 0], [0.1, 0.1, 0.1]), "Box: pose must be a Pose(position, quaternion), got [0, 0, 0]"),
    (lambda: Box(Pose([500, 0, 0], [1, 0, 0, 0]), [1, 1, 1]), "Box: position [500.0, 0.0, 0.0] is beyond 100 m"),
    (lambda: Capsule([0, 0, 0], [0, 0, 30], 0.1), "Capsule: length 30.1 is beyond 10 m"),
    (lambda: Capsule([0, 0, 0], [0, np.nan, 0], 0.1), "Capsule: end must be finite"),
    (lambda: Capsule([0, 0, 0], [0, 0, 1], 0), "Capsule: radius must be a finite number"),
    (lambda: Cylinder(HERE, 0.1, -1), "Cylinder: length must be a finite number"),
    (lambda: Cylinder(HERE, 0.0, 1), "Cylinder: radius must be a finite number"),
    (lambda: Cone(HERE, 0.1, 0), "Cone: height must be a finite number"),
    (lambda: Cone(HERE, None, 1), "Cone: radius must be a finite number"),
    (lambda: Ellipsoid(HERE, [0.1, 0.2, -0.1]), "Ellipsoid: semi_axes must be 3 positive"),
    (lambda: Ellipsoid(HERE, 0.1), "Ellipsoid: semi_axes must be 3 numbers"),
    (lambda: ConvexHull(TETRAHEDRON[:3]), "ConvexHull: points must be at least 4 to span a volume, got 3"),
    (lambda: ConvexHull([[0, 0], [1, 1]]), "ConvexHull: points must be an array of shape (n, 3) [m], got shape (2, 2)"),
    (lambda: ConvexHull([[0, 0, 0], [1, 1]]), "points must be numbers [m]"),
    (lambda: ConvexHull([*TETRAHEDRON, [0, np.nan, 0]]), "points must be finite [m], but points[4, 1]"),
    (lambda: ConvexHull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), "the 4 points lie in one plane"),
    (lambda: ConvexHull([[1, 2, 3]] * 5), "the 5 points lie in one plane"),
    (
        lambda: ConvexHull(np.multiply(TETRAHEDRON, 200)),
        "must span at most 10 m and lie within 100 m of the base; give them in metres",
    ),
]


@pytest.mark.parametrize(("build", "message"), BAD)
def test_bad_values_are_refused_when_built(build, message):
    with pytest.raises(InputError) as caught:
        build()
    assert message in str(caught.value)


def test_velocity_zero_is_an_obstacle_that_stands():
    for obstacle in (Sphere([0, 0, 0], 0.1, velocity=0), Box(Pose.identity(), [0.1, 0.1, 0.1], velocity=0.0)):
        np.testing.assert_array_equal(obstacle.velocity, np.zeros(3))
    with pytest.raises(InputError, match="velocity"):
        Sphere([0, 0, 0], 0.1, velocity=1)
