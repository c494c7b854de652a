"""The rows of the safety filter: compiled code and NumPy find the same pairs, distances and gradients."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compiled_code import by_numpy
from imitarm import ArmModel
from imitarm.command import Command
from imitarm.compiled import library
from imitarm.errors import InputError
from imitarm.kinematics.ik_problem import Box
from imitarm.kinematics.limits import JointLimits
from imitarm.safety import SafetyFilter
from imitarm.scene import HalfSpace, Scene, Sphere
from imitarm.scene.arm_rows import _room
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.scene.distances import KINDS as PACKED_KINDS
from scene_shapes import KINDS, random_obstacle

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
SEEDS = st.integers(0, 2**32 - 1)

pytestmark = pytest.mark.usefixtures("compiled")


def scene_around(rng, kinds, spin=0.0, speed=0.3):
    """Obstacles of these kinds in the reach of an arm, moving and uncertain, as predicted from a little earlier."""
    obstacles = []
    for kind in kinds:
        root = 0.01 * rng.normal(size=(3, 3))
        motion = {"velocity": speed * rng.normal(size=3), "angular_velocity": spin * rng.normal(size=3)}
        if kind == "half_space":
            obstacles.append(HalfSpace([0.0, 0.0, -0.2], rng.normal(size=3), **motion))
        else:
            obstacles.append(random_obstacle(kind, rng, covariance=root @ root.T, **motion))
    return Scene(None, obstacles).at(0.1).at(0.3)


def posture(rng, arm):
    return rng.uniform(np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0))


@settings(deadline=None, max_examples=60)
@given(
    seed=SEEDS,
    name=st.sampled_from(sorted(ARMS)),
    spin=st.sampled_from([0.0, 1.0]),
    still=st.booleans(),
    bounded=st.booleans(),
    deviations=st.sampled_from([0.0, 2.0]),
    kinds=st.lists(st.sampled_from([*KINDS, "half_space"]), min_size=1, max_size=6),
)
def test_both_ways_find_the_same_obstacles(seed, name, spin, still, bounded, deviations, kinds):
    rng, arm = np.random.default_rng(seed), ARMS[name]
    scene, q = scene_around(rng, kinds, 0.0 if still else spin, 0.0 if still else 0.3), posture(rng, arm)
    limit = ClearanceLimit(arm, 0.02, influence=rng.uniform(0.1, 1.0), deviations=deviations)
    velocity, margins = rng.uniform(-0.5, 0.5, arm.n_joints), rng.uniform(0.0, 0.05, len(kinds))
    box = JointLimits(arm).box(q, 0.01, velocity) if bounded else None
    given_ = q, scene, velocity if bounded else None, margins if bounded else None, box
    one, other = by_numpy(limit.near, *given_), limit.near(*given_)
    assert (one is None) == (other is None)
    if one is None:
        return
    first, second = (np.lexsort((rows.sphere, rows.obstacle)) for rows in (one, other))
    np.testing.assert_array_equal(one.obstacle[first], other.obstacle[second])
    np.testing.assert_array_equal(one.sphere[first], other.sphere[second])
    # NumPy stops the search for the normal of an ellipsoid at an error of 1e-6
    exact = ~np.isin(scene.packed.kinds[one.obstacle[first]], [PACKED_KINDS.index("ellipsoid")])
    pairs = (other.room, one.room), (other.rows.lower, one.rows.lower), (other.rows.matrix, one.rows.matrix)
    for mine, theirs in pairs:
        np.testing.assert_allclose(mine[second][exact], theirs[first][exact], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mine[second], theirs[first], rtol=1e-4, atol=1e-5)


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, name=st.sampled_from(sorted(ARMS)))
def test_both_ways_find_the_same_links(seed, name):
    arm, rng = ARMS[name], np.random.default_rng(seed)
    own, q = SelfClearance(arm, 0.02), posture(rng, arm)
    box = JointLimits(arm).box(q, 0.01, rng.uniform(-0.5, 0.5, arm.n_joints))
    assert (by_numpy(own.rows, q, box) is None) == (own.rows(q, box) is None)
    one, other = by_numpy(own._found, q), own._found(q)
    assert (one is None) == (other is None)
    if one is None:
        return
    np.testing.assert_allclose(other.distance, one.distance, rtol=0.0, atol=1e-12)
    same = one.pair == other.pair  # of several pairs with the same distance, rounding chooses
    np.testing.assert_allclose(other.gradient[same], one.gradient[same], rtol=0.0, atol=1e-9)


def test_gradients_are_derivatives_of_the_distances():
    arm, rng = ARMS["sawyer"], np.random.default_rng(0)
    scene, q, own = scene_around(rng, [*KINDS, "half_space"]), arm.home + 0.1, SelfClearance(arm)
    limit = ClearanceLimit(arm, 0.02, influence=0.4)

    def everything(posture):
        rows = limit.near(posture, scene, box=Box(*(side * np.full(arm.n_joints, 100.0) for side in (-1.0, 1.0))))
        return rows, own.pairs.distances(arm.sphere_centers(posture))

    (rows, _), pairs = everything(q), own._found(q)
    for joint in range(arm.n_joints):
        step = 1e-6 * np.eye(arm.n_joints)[joint]
        (after, apart), (before, apart_before) = everything(q + step), everything(q - step)
        assert len(after.room) == len(before.room) == len(rows.room) > 50
        np.testing.assert_allclose((after.room - before.room) / 2e-6, rows.rows.matrix[:, joint], atol=1e-4)
        slope = (apart - apart_before)[pairs.pair] / 2e-6
        np.testing.assert_allclose(slope, pairs.gradient[:, joint], atol=1e-7)


def test_a_scene_can_be_sent_to_another_process_after_use():
    arm, rng = ARMS["sawyer"], np.random.default_rng(2)
    scene = scene_around(rng, ["convex_hull", "box", "convex_hull"])
    limit = ClearanceLimit(arm, 0.02, influence=0.5)
    before = limit.rows(arm.home, scene)
    again = pickle.loads(pickle.dumps(scene))
    del scene
    np.testing.assert_array_equal(limit.rows(arm.home, again).matrix, before.matrix)


@pytest.mark.parametrize("way", [by_numpy, lambda call, *arguments: call(*arguments)], ids=["numpy", "compiled"])
def test_the_layout_of_an_array_in_memory_changes_nothing_and_a_wrong_length_is_refused(way):
    arm = ArmModel.load("sawyer", tool="gripper")
    rng = np.random.default_rng(3)
    scene = scene_around(rng, KINDS)
    limit, own = ClearanceLimit(arm, 0.02), SelfClearance(arm)
    q, log = posture(rng, arm), rng.normal(size=(arm.n_joints, 3))
    margins, bounds = rng.uniform(0.0, 0.05, (len(scene.obstacles), 2)), np.full((arm.n_joints, 2), [-0.5, 0.5])
    strided = Box(bounds[:, 0], bounds[:, 1])
    same = Box(bounds[:, 0].copy(), bounds[:, 1].copy())
    one = way(limit.near, q, scene, log[:, 1], margins[:, 0], strided)
    other = way(limit.near, q, scene, log[:, 1].copy(), margins[:, 0].copy(), same)
    assert len(one.room)
    for found, expected in zip(one.rows, other.rows, strict=True):
        np.testing.assert_array_equal(found, expected)
    near = way(own.rows, q, strided)
    expected = way(own.rows, q, same)
    assert (near is None) == (expected is None)
    if near is not None:
        np.testing.assert_array_equal(near[0], expected[0])
    for wrong, what in (((log[:2, 0],), "velocity"), ((None, margins[:1, 0].tolist() * 99), "margins")):
        with pytest.raises(InputError, match=what):
            way(limit.near, q, scene, *wrong)
    with pytest.raises(InputError, match="box"):
        way(limit.near, q, scene, None, None, Box(bounds[:3, 0], bounds[:3, 1]))


def test_the_filter_takes_a_velocity_from_a_column_of_a_log():
    arm = ArmModel.load("sawyer", tool="gripper")
    log = np.random.default_rng(1).normal(0.0, 0.2, (arm.n_joints, 4))
    safety = SafetyFilter(arm, clearance=0.02)
    scene = Scene(None, [Sphere(arm.tool_pose(arm.home).position + [0.0, 0.08, 0.0], 0.03, velocity=[0.0, -0.3, 0.0])])
    command = Command(np.array([0.1, 0.2, 0.0, 0.0, 0.0, 0.0]))
    found = safety.step(command, arm.home, log[:, 2], scene).velocity
    np.testing.assert_array_equal(found, safety.step(command, arm.home, log[:, 2].copy(), scene).velocity)


def test_both_ways_are_really_different_ways(monkeypatch):
    calls = []
    kernels = library()

    class Counted:
        def __getattr__(self, name):
            calls.append(name)
            return getattr(kernels, name)

    monkeypatch.setattr("imitarm.scene.arm_rows.library", Counted)
    arm = ArmModel.load("sawyer", tool="gripper")
    rng = np.random.default_rng(0)
    ClearanceLimit(arm, 0.02).near(posture(rng, arm), scene_around(rng, KINDS))
    SelfClearance(arm).rows(arm.home)
    assert {"obstacle_rows", "self_rows"} <= set(calls)


def test_users_that_alternate_share_memory():
    """One needs more rows, the other more scratch memory; both then use one room that is large enough."""
    memory = ARMS["sawyer"].at(ARMS["sawyer"].home)
    memory.kept.pop("room", None)
    rooms = [_room(memory, size, scratch) for size, scratch in ((5, 900), (80, 10), (5, 900), (80, 10))]
    assert rooms[1] is rooms[2] is rooms[3]
    assert rooms[3].rows.shape == (80, 7) and rooms[3].scratch.shape == (900,)
