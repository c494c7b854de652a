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
from imitarm.scene.clearance import ClearanceLimit
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


def all_rows(arm, q, scene, clearance, rate, influence):
    """The rows by their definition: one obstacle after the other, one sphere after the other."""
    centers, radii = arm.collision_spheres(q)
    jacobians = arm.sphere_jacobians(q)
    matrix, lower = [], []
    for obstacle in scene.obstacles:
        middle = obstacle.solid().position
        for center, radius, jacobian in zip(centers, radii, jacobians, strict=True):
            distance, n = obstacle.distance_and_gradient(center)
            room = float(distance) - radius - clearance
            if room < influence:
                surface = center - distance * n
                moves = obstacle.velocity + np.cross(obstacle.angular_velocity, surface - middle)
                least = n @ moves - rate * room
                if least > 0.0 and np.abs(n @ jacobian).max() < 1e-6:
                    continue  # too near, and no joint moves it away
                matrix.append(n @ jacobian)
                lower.append(least)
    return np.array(matrix).reshape(-1, arm.n_joints), np.array(lower)


@pytest.mark.parametrize("spin", [[0, 0, 0], [0.5, -0.8, 1.0]])
@pytest.mark.parametrize("seed", range(6))
def test_every_near_pair_has_its_row(arm, seed, spin):
    rng = np.random.default_rng(seed)
    q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
    scene = near_scene(arm, q, rng, angular_velocity=spin)
    rows = ClearanceLimit(arm, 0.02, rate=5.0, retreat_rate=5.0, influence=0.1).rows(q, scene)
    expected = all_rows(arm, q, scene, 0.02, 5.0, 0.1)
    assert len(expected[1]) > 10
    np.testing.assert_allclose(sorted_rows(rows.matrix, rows.lower), sorted_rows(*expected), atol=1e-8)


@pytest.mark.parametrize("spin", [[0, 0, 0], [0.5, -0.8, 1.0]])
def test_rows_equal_the_finite_difference_of_the_clearance(arm, spin):
    rng = np.random.default_rng(0)
    step, compared = 1e-6, 0
    for kind in KINDS:
        for _ in range(5):
            q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
            scene = Scene(None, near_scene(arm, q, rng, [kind], angular_velocity=spin).obstacles[:1])
            rows = ClearanceLimit(arm, 0.02, rate=0.0, retreat_rate=0.0).rows(q, scene)
            if rows is None:
                continue
            qd = rng.normal(size=arm.n_joints)
            before = rooms(arm, q - step * qd, scene.at(-step))[0]
            after = rooms(arm, q + step * qd, scene.at(step))[0]
            normal = scene.obstacles[0].distance_and_gradient(arm.collision_spheres(q)[0])[1]
            speeds = np.einsum("md,mdj->mj", normal, arm.sphere_jacobians(q))
            helpless = (np.abs(speeds).max(axis=1) < 1e-6) & (after < before)  # approached, and no joint moves it away
            near = np.flatnonzero((rooms(arm, q, scene)[0] - 0.02 < 0.15) & ~helpless)
            rate_of_change = ((after - before) / (2 * step))[near]
            error = np.abs(np.sort(rows.matrix @ qd - rows.lower) - np.sort(rate_of_change))
            assert np.median(error) < 1e-6
            compared += np.count_nonzero(error < 1e-5)
            assert np.count_nonzero(error >= 1e-5) <= 0.1 * len(error) + 1  # a medial axis in between
    assert compared > 200


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
