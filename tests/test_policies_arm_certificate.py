"""The certificate of a whole arm on a joint path: nothing on the path is nearer than it says."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel, Box, HalfSpace, InputError, Pose, Sphere
from imitarm.benchmark.families import random_obstacle
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.arm_certificate import ArmAmongObstacles, bows
from imitarm.policies.arm_pairs import SELF
from imitarm.scene.clearance import SelfClearance

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
OWN = {name: SelfClearance(arm, 0.01) for name, arm in ARMS.items()}
UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def random_scene(arm, seed):
    """A joint path with 8 samples, its times, and three obstacles near it; every second scene moves."""
    rng = np.random.default_rng(seed)
    start = arm.home + 0.5 * rng.normal(size=7)
    end = start + rng.choice([0.1, 0.4, 1.0]) * rng.normal(size=7)
    path = ArmPath.of(arm, np.linspace(start, end, 8))
    obstacles = []
    for _ in range(3):
        centre = path.centers[rng.integers(8), rng.integers(path.centers.shape[1])] + 0.3 * rng.normal(size=3)
        velocity = 0.2 * rng.normal(size=3) if seed % 2 else np.zeros(3)
        obstacles.append(replace(random_obstacle(rng, centre, planar=False), velocity=velocity))
    return path, np.linspace(0.0, 1.0, 8), obstacles


def densely(arm, own, path, times, obstacles):
    """The smallest distance of all spheres at 25 instants of each segment, by the obstacles' own distances."""
    steps = np.concatenate([np.linspace(a, b, 25) for a, b in zip(path.joints[:-1], path.joints[1:], strict=True)])
    when = np.concatenate([np.linspace(a, b, 25) for a, b in itertools.pairwise(times)])
    lowest = min(own.distance(q) - own.clearance for q in steps[::2])
    for q, t in zip(steps, when, strict=True):
        centers, radii = arm.collision_spheres(q)
        lowest = min(lowest, *(float((o.after(t).signed_distance(centers) - radii).min()) for o in obstacles))
    return lowest


@pytest.mark.parametrize("name", ARMS)
def test_nothing_on_the_path_is_nearer_than_the_bound(name):
    arm, own, accepted, free = ARMS[name], OWN[name], 0, 0
    for seed in range(60):
        path, times, obstacles = random_scene(arm, seed)
        bound = ArmAmongObstacles(arm, obstacles, 0.0, own=own).clearance_of(path, times)
        true = densely(arm, own, path, times, obstacles)
        if bound.room >= 0.0:
            assert bound.room <= true + 1e-9, seed
            accepted += 1
        free += true > 1e-3
    assert accepted >= free - 1 > 15  # what is free by a millimetre is proven


@given(st.integers(0, 10_000))
def test_an_arc_of_a_chain_stays_within_its_bow(seed):
    rng = np.random.default_rng(seed)
    arm = ARMS["sawyer"]
    start = rng.uniform(np.maximum(arm.lower, -2.5), np.minimum(arm.upper, 2.5))
    step = rng.uniform(0.0, 0.3) * rng.normal(size=7) * rng.integers(0, 2, 7)
    path = ArmPath.of(arm, start + np.linspace(0.0, 1.0, 21)[:, None] * step)
    m = path.centers.shape[1]
    ends = [path.sphere_radii(np.full(m, i), np.arange(m)) for i in (0, 20)]
    allowed = bows(np.tile(np.abs(step), (m, 1)), np.maximum(*ends))
    chord = path.centers[0] + np.linspace(0.0, 1.0, 21)[:, None, None] * (path.centers[-1] - path.centers[0])
    assert (np.linalg.norm(path.centers - chord, axis=2) <= allowed + 1e-12).all()


def test_the_bow_of_one_joint_is_that_of_a_parabola():
    assert bows(np.array([[0.1, 0.0]]), np.array([[0.5, 0.0]]))[0] == pytest.approx(0.1**2 * 0.5 / 8.0)


@pytest.mark.parametrize("name", ARMS)
def test_rates_and_drift_equal_finite_differences(name):
    arm, own, step = ARMS[name], OWN[name], 1e-6
    path, times, obstacles = random_scene(arm, 5)
    around = ArmAmongObstacles(arm, obstacles, 0.0, own=own)
    q, t = path.joints[3:4], times[3:4]
    gaps = around.gaps(ArmPath.of(arm, q), t, 0.3)
    rates, drift = gaps.rates(np.arange(len(gaps)))
    assert {SELF, 0, 1} <= set(gaps.obstacle.tolist())

    def rooms(joints, time):
        near = around.gaps(ArmPath.of(arm, joints), time, 0.4)
        keys = zip(near.obstacle.tolist(), near.sphere.tolist(), near.other.tolist(), strict=True)
        found = dict(zip(keys, near.room.tolist(), strict=True))
        return np.array(
            [found[key] for key in zip(*(x.tolist() for x in (gaps.obstacle, gaps.sphere, gaps.other)), strict=True)]
        )

    for j in range(7):
        change = step * np.eye(7)[j]
        differences = (rooms(q + change, t) - rooms(q - change, t)) / (2.0 * step)
        wrong = np.abs(rates[:, j] - differences) > 1e-5
        assert wrong.mean() < 0.01  # distances have kinks at edges
    differences = (rooms(q, t + step) - rooms(q, t - step)) / (2.0 * step)
    assert (np.abs(drift - differences) > 1e-5).mean() < 0.01


def test_a_segment_that_passes_through_an_obstacle_between_two_far_samples_is_found():
    arm = ARMS["sawyer"]
    joints = np.stack([arm.home, arm.home])
    joints[0, 0], joints[1, 0] = -1.2, 1.2
    path = ArmPath.of(arm, joints)
    middle = arm.tool_pose(joints.mean(axis=0)).position
    found = ArmAmongObstacles(arm, [Sphere(middle, 0.03)], 0.02).clearance_of(path, np.array([0.0, 1.0]))
    assert found.room < 0.0
    assert found.sample == 0
    assert (
        ArmAmongObstacles(arm, [Sphere([0.0, 0.0, 2.0], 0.03)], 0.02).clearance_of(path, np.array([0.0, 1.0])).room
        > 0.0
    )


def test_parts_may_be_as_near_to_a_fixture_as_where_contact_is_meant():
    arm = ARMS["panda"]
    tool = arm.tool_pose(arm.home).position
    table = HalfSpace([0.0, 0.0, tool[2] - 0.002])
    path, times = ArmPath.of(arm, np.tile(arm.home, (3, 1))), np.linspace(0.0, 1.0, 3)
    assert ArmAmongObstacles(arm, [table], 0.02).clearance_of(path, times).room < 0.0
    assert ArmAmongObstacles(arm, [], 0.02, fixtures=[table]).clearance_of(path, times).room >= 0.0
    lower = arm.home.copy()
    lower[3] -= 0.3
    lowered = ArmPath.of(arm, np.linspace(arm.home, lower, 20))
    if lowered.positions[-1, 2] > tool[2]:
        lowered = ArmPath.of(arm, np.linspace(arm.home, 2.0 * arm.home - lower, 20))
    assert lowered.positions[-1, 2] < tool[2] - 0.02
    assert ArmAmongObstacles(arm, [], 0.02, fixtures=[table]).clearance_of(lowered, np.linspace(0, 1, 20)).room < 0.0


def test_a_rotating_obstacle_is_replaced_by_what_contains_it():
    arm = ARMS["sawyer"]
    tool = arm.tool_pose(arm.home).position
    thin = Box(Pose(tool + [0.25, 0.0, 0.0], UPRIGHT), [0.02, 0.5, 0.02])
    path, times = ArmPath.of(arm, np.tile(arm.home, (2, 1))), np.array([0.0, 1.0])
    assert ArmAmongObstacles(arm, [thin], 0.02).clearance_of(path, times).room > 0.0
    turning = replace(thin, angular_velocity=np.array([0.0, 0.0, 1.0]))
    assert ArmAmongObstacles(arm, [turning], 0.02).clearance_of(path, times).room < 0.0
    with pytest.raises(InputError, match="rotates"):
        ArmAmongObstacles(arm, [HalfSpace([0, 0, -1], angular_velocity=[1, 0, 0])], 0.02)


@pytest.mark.parametrize("name", ARMS)
def test_near_pairs_are_all_pairs_that_are_near_however_fast_the_arm_moves(name):
    arm, own = ARMS[name], OWN[name]
    for seed in range(6):
        path, _, obstacles = random_scene(arm, seed)
        path = ArmPath.of(arm, np.linspace(path.joints[0], path.joints[-1], (8, 30, 200)[seed % 3]))
        times, around = np.linspace(0.0, 1.0, len(path)), ArmAmongObstacles(arm, obstacles, 0.02, own=own)
        together, alone = around.gaps(path, times, 0.05), around.gaps(path, times, 0.05, connected=False)
        keys = [
            sorted(zip(*(getattr(gaps, key).tolist() for key in ("source", "sample", "pair", "room")), strict=True))
            for gaps in (together, alone)
        ]
        assert keys[0] == keys[1]
        assert len(keys[0]) > 0
        for i, obstacle in enumerate(obstacles):
            centers = path.centers - times[:, None, None] * obstacle.velocity
            room = obstacle.signed_distance(centers) - arm.cover.radii - 0.02
            assert (room < 0.05).sum() == (together.obstacle == i).sum()


@pytest.mark.parametrize("name", ARMS)
def test_the_same_postures_at_several_times_have_the_clearances_of_each_time(name):
    arm, own = ARMS[name], OWN[name]
    for seed in range(8):
        path, times, obstacles = random_scene(arm, seed)
        around = ArmAmongObstacles(arm, obstacles, 0.02, own=own)
        clocks = times + np.array([0.0, 0.3, 2.0])[:, None]
        expected = [around.clearance_at(path, clock, 0.0).room for clock in clocks]
        np.testing.assert_allclose(around.rooms_at(path.joints, clocks), expected, atol=1e-6)
