"""The clearance limit: its rows are the derivative of the clearance, and keeping them keeps the clearance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.tasks import TwistTask
from imitarm.scene import HalfSpace, Scene, Sphere
from imitarm.scene.clearance_limit import ClearanceLimit
from scene_shapes import KINDS, random_obstacle


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("panda", tool="gripper")


def rooms(arm, q, scene):
    centers, radii = arm.collision_spheres(q)
    return np.array([o.signed_distance(centers) - radii for o in scene.obstacles])


def test_no_obstacle_or_only_far_ones_give_no_rows(arm):
    assert ClearanceLimit(arm, 0.02).rows(arm.home, Scene()) is None
    assert ClearanceLimit(arm, 0.02).rows(arm.home, Scene(None, [Sphere([50.0, 0, 0], 0.1)])) is None


def sorted_rows(matrix, lower):
    table = np.round(np.column_stack([matrix, lower]), 6)
    return np.column_stack([matrix, lower])[np.lexsort(table.T)]


def near_scene(arm, q, rng, kinds=KINDS, **more):
    """One obstacle of each kind near the hand, and a floor below it."""
    obstacles = []
    for kind in kinds:
        obstacle = random_obstacle(kind, rng)
        way = arm.tool_pose(q).position + 0.25 * rng.normal(size=3) - obstacle.solid().position
        there = dataclasses.replace(obstacle, velocity=way).after(1.0)
        velocity = 0.2 * rng.normal(size=3)
        obstacles.append(type(there)(**{**fields_of(there), "velocity": velocity, **more}))
    return Scene(None, [*obstacles, HalfSpace([0, 0, 0.1], velocity=[0, 0, 0.1])])


def fields_of(obstacle):
    return {f.name: getattr(obstacle, f.name) for f in dataclasses.fields(obstacle) if f.init}


def all_rows(arm, q, scene, limit, qd):
    """The rows by their definition: one obstacle after the other, one sphere after the other."""
    centers, radii = arm.collision_spheres(q)
    jacobians = arm.sphere_jacobians(q)
    matrix, lower = [], []
    braking = np.max(np.abs(qd) / arm.max_acceleration)
    for obstacle in scene.obstacles:
        middle = obstacle.solid().position
        for center, radius, jacobian in zip(centers, radii, jacobians, strict=True):
            distance, n = obstacle.distance_and_gradient(center)
            room, gradient = float(distance) - radius - limit.clearance, n @ jacobian
            surface = center - distance * n
            approach = n @ (obstacle.velocity + np.cross(obstacle.angular_velocity, surface - middle))
            fastest = np.abs(gradient) @ arm.max_velocity
            yielding = 0.0
            if 0.0 < approach <= fastest:
                yielding = min(approach / (0.1 * np.abs(gradient) @ arm.max_acceleration), 1.5)
            rate = min(limit.rate, 1.0 / (limit.delay + 0.5 * max(braking, yielding)))
            least = approach - (rate if room > 0.0 else limit.retreat_rate) * room
            if least <= -fastest or (least > 0.0 and np.linalg.norm(gradient) < 1e-6):
                continue  # no velocity violates it, or it is too near and no joint moves it away
            matrix.append(gradient)
            lower.append(least)
    return np.array(matrix).reshape(-1, arm.n_joints), np.array(lower)


@pytest.mark.parametrize("spin", [[0, 0, 0], [0.5, -0.8, 1.0]])
@pytest.mark.parametrize("seed", range(6))
def test_every_near_pair_has_its_row(arm, seed, spin):
    """No row is left out that a velocity within the limits could violate, however far the pair is apart."""
    rng = np.random.default_rng(seed)
    q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
    scene, qd = near_scene(arm, q, rng, angular_velocity=spin), rng.normal(size=arm.n_joints)
    limit = ClearanceLimit(arm, 0.02, influence=3.0)
    rows, expected = limit.rows(q, scene, qd), all_rows(arm, q, scene, limit, qd)
    assert len(expected[1]) > 10
    # the normals of ellipsoids have errors of 1e-6
    np.testing.assert_allclose(sorted_rows(rows.matrix, rows.lower), sorted_rows(*expected), atol=1e-6)


def test_rows_beyond_the_influence_do_not_matter_at_the_speeds_of_people_and_carts(arm):
    """With the usual influence, no velocity of an arm with a tool at up to 0.8 m/s violates a row that is left out."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
        scene = near_scene(arm, q, rng)
        some, every = ClearanceLimit(arm, 0.02).rows(q, scene), ClearanceLimit(arm, 0.02, influence=3.0).rows(q, scene)
        qd = rng.normal(size=arm.n_joints)
        fastest = np.linalg.norm(arm.sphere_jacobians(q) @ qd, axis=1).max()
        qd *= 0.8 / fastest
        missed = np.sum(every.matrix @ qd < every.lower) - np.sum(some.matrix @ qd < some.lower)
        assert missed == 0


@pytest.mark.parametrize("spin", [[0, 0, 0], [0.5, -0.8, 1.0]])
def test_rows_equal_the_finite_difference_of_the_clearance(arm, spin):
    rng = np.random.default_rng(0)
    step, errors = 1e-6, []
    for kind in KINDS:
        for _ in range(5):
            q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
            scene = Scene(None, near_scene(arm, q, rng, [kind], angular_velocity=spin).obstacles[:1])
            near = ClearanceLimit(arm, 0.02, rate=0.0, retreat_rate=0.0).near(q, scene)
            if near is None:
                continue
            qd = rng.normal(size=arm.n_joints)
            before = rooms(arm, q - step * qd, scene.at(-step))[0]
            after = rooms(arm, q + step * qd, scene.at(step))[0]
            rate_of_change = ((after - before) / (2 * step))[near.sphere]
            errors.append(np.abs(near.rows.matrix @ qd - near.rows.lower - rate_of_change))
            np.testing.assert_allclose(near.room, rooms(arm, q, scene)[0][near.sphere] - 0.02, atol=1e-9)
            assert np.median(errors[-1]) < 1e-6
            assert np.count_nonzero(errors[-1] >= 1e-5) <= 0.1 * len(errors[-1]) + 1  # a medial axis in between
    assert np.count_nonzero(np.concatenate(errors) < 1e-5) > 200


def test_margin_and_covariance_are_distances_that_are_missing(arm):
    rng = np.random.default_rng(2)
    spread = np.diag([0.01, 0.02, 0.03]) ** 2
    plain = near_scene(arm, arm.home, rng, ["sphere", "box"])
    scene = Scene(None, [dataclasses.replace(o, covariance=spread) for o in plain.obstacles])
    limit = ClearanceLimit(arm, 0.02, influence=3.0)
    margins = np.array([0.01, 0.02, 0.0])
    bare, enlarged = limit.near(arm.home, scene), limit.near(arm.home, scene, None, margins)
    doubtful = ClearanceLimit(arm, 0.02, influence=3.0, deviations=2.0).near(arm.home, scene)
    rooms_of = [
        dict(zip(zip(f.obstacle, f.sphere, strict=True), f.room, strict=True)) for f in (bare, enlarged, doubtful)
    ]
    centers = arm.collision_spheres(arm.home)[0]
    for (obstacle, sphere), room in rooms_of[0].items():
        assert rooms_of[1][obstacle, sphere] == pytest.approx(room - margins[obstacle])
        n = scene.obstacles[obstacle].distance_and_gradient(centers[sphere])[1]
        assert rooms_of[2][obstacle, sphere] == pytest.approx(room - 2.0 * np.sqrt(n @ spread @ n))


@pytest.mark.parametrize("bad", [np.nan, -0.01, np.inf, "2 cm", None])
def test_bad_options_are_refused(arm, bad):
    with pytest.raises(InputError, match="clearance must be a finite number"):
        ClearanceLimit(arm, bad)
    for option in ("rate", "influence"):
        with pytest.raises(InputError, match=f"{option} must be a finite number"):
            ClearanceLimit(arm, 0.02, **{option: bad})
    with pytest.raises(InputError, match="arm must be a ArmModel"):
        ClearanceLimit("panda", 0.02)
    with pytest.raises(InputError, match="finite"):
        ClearanceLimit(arm, 0.02).rows(np.full(7, np.nan), Scene(None, [Sphere([0, 0, 0], 0.1)]))


def test_an_arm_that_is_pulled_into_an_obstacle_stays_clear(arm):
    """The tool is drawn straight at a sphere; without the rows it goes in, with them no link does."""
    ahead = arm.tool_pose(arm.home).position + [0.25, 0.0, 0.0]
    scene = Scene(None, [Sphere(ahead, 0.06)])
    least = {}
    for guarded in (False, True):
        q = arm.home.copy()
        least[guarded] = np.inf
        for _ in range(300):
            rows = ClearanceLimit(arm, 0.02).rows(q, scene) if guarded else None
            q = q + 0.01 * solve_ik(arm, q, TwistTask([0.2, 0, 0, 0, 0, 0]), dt=0.01, rows=rows)
            least[guarded] = min(least[guarded], float(rooms(arm, q, scene).min()))
    assert least[False] < 0.0
    assert least[True] > 0.018


def test_an_arm_gives_way_to_what_comes_at_it(arm):
    """A sphere moves at the hand while the tool has nothing to do."""
    hand = arm.tool_pose(arm.home).apply([0.0, 0.0, -0.1])
    start = Scene(None, [Sphere(hand + [0.0, 0.28, 0.0], 0.06, velocity=[0.0, -0.1, 0.0])])
    q, least = arm.home.copy(), np.inf
    for k in range(250):
        scene = start.at(0.01 * k)
        rows = ClearanceLimit(arm, 0.02).rows(q, scene)
        q = q + 0.01 * solve_ik(arm, q, TwistTask(np.zeros(6)), dt=0.01, rows=rows)
        least = min(least, float(rooms(arm, q, start.at(0.01 * (k + 1))).min()))
    assert rooms(arm, arm.home, start.at(2.5)).min() < 0.0  # it would have been hit
    assert least > 0.015
