"""RCAMO's choice among its candidates: compiled code and NumPy choose alike."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compiled_code import by_numpy
from imitarm.demonstrations import align
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.perception import CoverageMargin
from imitarm.policies import RCAMO, Observation
from imitarm.policies.least_cost import STAY
from imitarm.scene import HalfSpace, Scene
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach
from scene_shapes import KINDS, random_obstacle

pytestmark = pytest.mark.usefixtures("compiled")
REST = np.zeros(7)


@pytest.fixture(scope="module")
def skill():
    return Skill(6).fit(align(demonstrations_by(s_shaped_reach(planar=False), 3)))


def scene_on_the_path(rng, skill, kinds, spin, covariance):
    """Obstacles that move and meet the path, at a time before now."""
    path, obstacles = skill.nominal(np.linspace(0.0, skill.duration_, 50)).positions, []
    for kind in kinds:
        motion = {"velocity": rng.uniform(-0.3, 0.3, 3), "angular_velocity": spin * rng.normal(size=3)}
        place = path[rng.integers(50)] + rng.uniform(-0.2, 0.2, 3)
        if kind == "half_space":
            obstacles.append(HalfSpace(place - [0.0, 0.0, 0.3], rng.normal(size=3) * [0.3, 0.3, 1.0], **motion))
            continue
        root = 0.02 * rng.normal(size=(3, 3))
        one = random_obstacle(kind, rng, covariance=root @ root.T if covariance else None)
        obstacles.append(one.placed(place, one.solid().quaternion, *motion.values()))
    return Scene(None, obstacles, 0.0).at(0.02)


SPHERES = {
    "tip": [[0.0, 0.0, 0.0, 0.03]],
    "three": [[0.0, 0.0, 0.0, 0.02], [0.0, 0.03, -0.06, 0.04], [0.02, 0.0, -0.12, 0.05]],
}
SIDES = {"space": (), "floor": ([0.0, 0.0, -1.0],), "plane": ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0])}


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.sampled_from([*KINDS, "sphere", "half_space"]), min_size=1, max_size=6),
    spheres=st.sampled_from(sorted(SPHERES)),
    sides=st.sampled_from(sorted(SIDES)),
    spin=st.sampled_from([0.0, 1.0]),
    margin=st.sampled_from(["none", "covariance", "coverage"]),
)
def test_both_ways_choose_alike(skill, seed, kinds, spheres, sides, spin, margin):
    rng = np.random.default_rng(seed)
    scene = scene_on_the_path(rng, skill, kinds, spin, margin == "covariance")
    coverage = CoverageMargin(0.01, 0.02) if margin == "coverage" else None
    policy = RCAMO(skill, tool_spheres=SPHERES[spheres], forbidden=SIDES[sides], margin=coverage)
    start = Pose(skill.start_.position, skill.start_.quaternion)
    policy.reset(Observation(0.0, ArmState(REST, REST, REST, 0.0), start, scene))
    policy._phase, policy._rate = rng.choice([rng.uniform(0.0, 1.0), 0.98, 1.0]), rng.uniform(0.0, 1.0)
    policy._deviation = rng.normal(size=(2, 3)) * [[0.03], [0.1]]
    policy._scaled = rng.uniform(-0.5, 0.5, 3)
    path, lag = policy._path, 0.01 * rng.normal(size=3)
    tool = Pose(path.position(policy._phase) + policy._deviation[0] + lag, start.quaternion)
    given_ = Observation(0.1, ArmState(REST, REST, REST, 0.1), tool, scene), path, lag
    one, other = by_numpy(policy._choose, *given_), policy._choose(*given_)
    if one is STAY or other is STAY:
        assert one is other
        return
    np.testing.assert_allclose(other.cost, one.cost, rtol=1e-9, atol=1e-9)
    if one.cost > 1e6:  # deep inside an obstacle, rounding decides between candidates of nearly the same cost
        return
    assert other.rate == one.rate
    np.testing.assert_allclose(other.scaled, one.scaled, rtol=0.0, atol=1e-9)
    assert other.nearest == one.nearest
    assert other.gap == pytest.approx(one.gap, abs=1e-9)


def test_both_ways_move_alike(skill):
    """A whole motion past obstacles ends at the same place, on the same path."""
    scene = scene_on_the_path(np.random.default_rng(3), skill, ["sphere", "box", "capsule"], 0.0, False)

    def path():
        policy, x, q, points = (
            RCAMO(skill, tool_spheres=SPHERES["tip"]),
            skill.start_.position,
            skill.start_.quaternion,
            [],
        )
        for k in range(300):
            now = Observation(0.02 * k, ArmState(REST, REST, REST, 0.02 * k), Pose(x, q), scene)
            if k == 0:
                policy.reset(now)
            x = x + 0.02 * policy.step(now, 0.02).twist[:3]
            points.append(x)
        return np.array(points)

    np.testing.assert_allclose(path(), by_numpy(path), rtol=0.0, atol=1e-9)


def test_a_copy_of_the_policy_chooses_alike(skill):
    scene = scene_on_the_path(np.random.default_rng(4), skill, ["convex_hull", "sphere"], 0.0, True)
    policy = RCAMO(skill, tool_spheres=SPHERES["three"])
    now = Observation(0.0, ArmState(REST, REST, REST, 0.0), skill.start_, scene)
    policy.reset(now)
    policy.step(now, 0.01)
    again = pickle.loads(pickle.dumps(copy.deepcopy(policy)))
    later = Observation(0.01, ArmState(REST, REST, REST, 0.01), skill.start_, scene)
    np.testing.assert_array_equal(again.step(later, 0.01).twist, policy.step(later, 0.01).twist)
