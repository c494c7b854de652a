"""The rows of the safety filter: compiled code and NumPy find the same pairs, distances and gradients."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compiled_code import by_numpy, compiled  # noqa: F401  a fixture
from imitarm import ArmModel
from imitarm.kinematics.limits import JointLimits
from imitarm.scene import OBSTACLES, HalfSpace, Scene
from imitarm.scene.arm_rows import obstacle_rows
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit
from scene_shapes import KINDS, random_obstacle

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
SEEDS = st.integers(0, 2**32 - 1)

pytestmark = pytest.mark.usefixtures("compiled")


def scene_around(rng, kinds, spin=0.0):
    """Obstacles of these kinds in the reach of an arm, moving and uncertain, as predicted from a little earlier."""
    obstacles = []
    for kind in kinds:
        root = 0.01 * rng.normal(size=(3, 3))
        motion = {"velocity": 0.3 * rng.normal(size=3), "angular_velocity": spin * rng.normal(size=3)}
        if kind == "half_space":
            obstacles.append(HalfSpace([0.0, 0.0, -0.2], rng.normal(size=3), **motion))
        else:
            obstacles.append(random_obstacle(kind, rng, covariance=root @ root.T, **motion))
    return Scene(None, obstacles).at(0.1).at(0.3)


def posture(rng, arm):
    return rng.uniform(np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0))


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, name=st.sampled_from(sorted(ARMS)), spin=st.sampled_from([0.0, 1.0]), data=st.data())
def test_both_ways_find_the_same_obstacles(seed, name, spin, data):
    rng, arm = np.random.default_rng(seed), ARMS[name]
    kinds = data.draw(st.lists(st.sampled_from([*KINDS, "half_space"]), min_size=1, max_size=6))
    packed, q = scene_around(rng, kinds, spin).packed, posture(rng, arm)
    given_ = arm.cover, arm.at(q), packed, arm.sphere_centers(q), rng.uniform(0.0, 0.5, len(arm.cover.radii))
    one, other = by_numpy(obstacle_rows, *given_), obstacle_rows(*given_)
    first, second = (np.lexsort((rows.sphere, rows.obstacle)) for rows in (one, other))
    np.testing.assert_array_equal(one.obstacle[first], other.obstacle[second])
    np.testing.assert_array_equal(one.sphere[first], other.sphere[second])
    np.testing.assert_allclose(other.distance[second], one.distance[first], rtol=0.0, atol=1e-9)
    # NumPy stops the search for the normal of an ellipsoid at an error of 1e-6
    round_ = np.isin(packed.kinds[one.obstacle[first]], [list(OBSTACLES).index("ellipsoid")])
    for mine, theirs in (
        (other.approach, one.approach),
        (other.variance, one.variance),
        (other.gradient, one.gradient),
    ):
        np.testing.assert_allclose(mine[second][~round_], theirs[first][~round_], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(mine[second], theirs[first], rtol=0.0, atol=1e-5)


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, name=st.sampled_from(sorted(ARMS)))
def test_both_ways_find_the_same_links(seed, name):
    arm = ARMS[name]
    own, q = SelfClearance(arm, 0.02), posture(np.random.default_rng(seed), arm)
    one, other = by_numpy(own._found, q), own._found(q)
    np.testing.assert_array_equal(one.pair, other.pair)
    np.testing.assert_allclose(other.distance, one.distance, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(other.gradient, one.gradient, rtol=0.0, atol=1e-9)


def test_gradients_are_derivatives_of_the_distances():
    arm, rng = ARMS["sawyer"], np.random.default_rng(0)
    packed, q, own = scene_around(rng, [*KINDS, "half_space"]).packed, arm.home + 0.1, SelfClearance(arm)
    reach = np.full(len(arm.cover.radii), 0.4)

    def everything(posture):
        found = obstacle_rows(arm.cover, arm.at(posture), packed, arm.sphere_centers(posture), reach)
        return found, own.pairs.distances(own._centers(posture))

    rows, _ = everything(q)
    pairs = own._found(q)
    for joint in range(arm.n_joints):
        step = 1e-6 * np.eye(arm.n_joints)[joint]
        (after, apart), (before, apart_before) = everything(q + step), everything(q - step)
        assert len(after.distance) == len(before.distance) == len(rows.distance) > 50
        np.testing.assert_allclose((after.distance - before.distance) / 2e-6, rows.gradient[:, joint], atol=1e-4)
        slope = (apart - apart_before)[pairs.pair] / 2e-6
        np.testing.assert_allclose(slope, pairs.gradient[:, joint], atol=1e-7)


def test_the_limit_is_the_same_in_both_ways():
    arm, rng = ARMS["panda"], np.random.default_rng(1)
    limit = ClearanceLimit(arm, 0.02, deviations=1.0)
    for _ in range(20):
        scene, q = scene_around(rng, rng.choice([k for k in KINDS if k != "ellipsoid"], 5)), posture(rng, arm)
        velocity, margins = rng.uniform(-0.5, 0.5, arm.n_joints), rng.uniform(0.0, 0.05, 5)
        box = JointLimits(arm).box(q, 0.01, velocity)
        one, other = (
            by_numpy(limit.near, q, scene, velocity, margins, box),
            limit.near(q, scene, velocity, margins, box),
        )
        assert (one is None) == (other is None)
        if one is None:
            continue
        first, second = (np.lexsort((rows.sphere, rows.obstacle)) for rows in (one, other))
        np.testing.assert_allclose(other.rows.lower[second], one.rows.lower[first], atol=1e-8)
        np.testing.assert_allclose(other.rows.matrix[second], one.rows.matrix[first], atol=1e-9)


def test_a_scene_can_be_sent_to_another_process_after_use():
    arm, rng = ARMS["sawyer"], np.random.default_rng(2)
    scene = scene_around(rng, ["convex_hull", "box", "convex_hull"])
    limit = ClearanceLimit(arm, 0.02, influence=0.5)
    before = limit.rows(arm.home, scene)
    again = pickle.loads(pickle.dumps(scene))
    del scene
    np.testing.assert_array_equal(limit.rows(arm.home, again).matrix, before.matrix)
