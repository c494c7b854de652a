from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from imitarm.benchmark.avoidance import learn
from imitarm.errors import InfeasibleError
from imitarm.kinematics.pose import Pose
from imitarm.policies import ACFRA, HORIZONTAL_ONLY, PathPlan
from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.scene import Box, Scene, Sphere
from imitarm.trajectory import Trajectory

SKILL, PATH = learn(planar=False)
SPHERES = [[0.0, 0.0, 0.01, 0.02]]


class Follow(BaselinePolicy):
    """Follows the learned path, slower."""

    def tool_path(self, nominal, gaps, scene):
        return 1.5 * nominal.times, nominal.positions


@given(st.integers(0, 10_000))
def test_gaps_have_the_normals_of_finite_differences_and_contain_the_tool(seed):
    rng = np.random.default_rng(seed)
    scene = Scene(
        None, [Sphere(rng.normal(size=3), 0.3), Box(Pose(rng.normal(size=3), [1, 0, 0, 0]), rng.uniform(0.1, 0.5, 3))]
    )
    gaps = ToolGaps(scene, SPHERES)
    assert gaps.radius == pytest.approx(0.03) and gaps.n_obstacles == 2
    points = 2.0 * rng.normal(size=(5, 3))
    gap, normal = gaps.gaps_and_normals(points)
    np.testing.assert_allclose(gap, gaps.gaps(points), atol=1e-12)
    np.testing.assert_allclose(gap[0], np.linalg.norm(points - scene.obstacles[0].center, axis=1) - 0.33, atol=1e-12)
    step = 1e-6 * rng.normal(size=3)
    outside = gap > 1e-3
    change = gaps.gaps(points + step) - gaps.gaps(points - step)
    np.testing.assert_allclose(change[outside], (2.0 * normal @ step)[outside], atol=1e-10)


def test_a_plan_knows_its_displacement_from_the_learned_path_at_equal_phases():
    nominal = SKILL.gmr_.trajectory(100)
    moved = Trajectory(2.0 * nominal.times, nominal.positions + [0.0, 0.03, 0.04])
    np.testing.assert_allclose(PathPlan.beside(nominal, moved).displaced, 0.05, atol=1e-12)


def test_a_baseline_takes_the_options_of_every_policy_and_leaves_out_those_of_the_arm():
    policy = Follow.build(SKILL, tool_spheres=SPHERES, forbidden=HORIZONTAL_ONLY, max_tilt=0.3, pinned=(1.0,), gain=4.0)
    plan = policy.plan_motion(Scene(None, []))
    assert plan.adaptation is None and plan.joints is None
    assert plan.trajectory.duration == pytest.approx(1.5 * SKILL.duration_)
    np.testing.assert_allclose(plan.displaced, 0.0, atol=1e-3)


def test_forbidden_directions_are_taken_out_of_forces():
    policy = Follow(SKILL, forbidden=HORIZONTAL_ONLY)
    np.testing.assert_allclose(policy.allowed(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, -3.0]])), [[1, 2, 0], [1, 2, 0]])


def test_acfra_plans_the_motion_without_an_arm_and_refuses_what_it_can_not_solve():
    spheres = [[0.0, 0.0, 0.0, 0.03]]
    policy = ACFRA(SKILL, tool_spheres=spheres)
    middle = PATH[len(PATH) // 2]
    plan = policy.plan_motion(Scene(None, [Sphere(middle, 0.03)]))
    assert plan.adaptation is not None and plan.displaced.max() > 0.05
    assert ToolGaps(Scene(None, [Sphere(middle, 0.03)]), spheres).gaps(plan.trajectory.positions).min() >= 0.02
    with pytest.raises(InfeasibleError, match="goal"):
        policy.plan_motion(Scene(None, [Sphere(PATH[-1], 0.03)]))


@given(st.integers(0, 10_000))
def test_a_plan_is_slowed_down_until_the_tool_is_within_its_limits(seed):
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 2.0, 150)
    corners = np.cumsum(0.1 * rng.normal(size=(6, 3)), axis=0)
    u = 10 * (times / 2) ** 3 - 15 * (times / 2) ** 4 + 6 * (times / 2) ** 5
    positions = np.stack([np.interp(5 * u, range(6), column) for column in corners.T], axis=1)
    plan = PathPlan(Trajectory(times, positions), np.zeros(150)).within(0.3, 2.0)
    path = plan.trajectory
    np.testing.assert_array_equal(path.positions, positions)
    even = np.linspace(path.times[0], path.times[-1], 200)
    smooth = CubicSpline(path.times, path.positions)(even)
    assert np.linalg.norm(np.diff(smooth, axis=0), axis=1).max() / (even[1] - even[0]) <= 0.3 + 1e-9
    assert np.linalg.norm(np.diff(smooth, 2, axis=0), axis=1).max() / (even[1] - even[0]) ** 2 <= 2.0 + 1e-9
    assert plan.within(0.3, 2.0) is plan


def test_a_slow_plan_is_not_changed():
    nominal = SKILL.gmr_.trajectory(100)
    plan = PathPlan.beside(nominal, nominal)
    assert plan.within(5.0, 50.0) is plan
