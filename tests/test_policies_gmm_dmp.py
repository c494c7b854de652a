from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import sparse_clutter
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, POLICIES
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.gmm_dmp import GMMDMP, attractor_of, reconstructed_demonstrations
from imitarm.scene import Scene, Sphere
from imitarm.trajectory import Trajectory

SKILL, PATH = learn(planar=False)
PLANAR, PLANAR_PATH = learn(planar=True)
TOOL = [[0.0, 0.0, 0.0, 0.03]]


def test_reconstructed_demonstrations_have_the_mean_and_the_covariance_of_the_skill():
    paths = reconstructed_demonstrations(SKILL, 50)
    positions = np.stack([path.positions for path in paths])
    times = paths[0].times
    np.testing.assert_allclose(positions.mean(axis=0), SKILL.gmr_.nominal(times)[0], atol=1e-12)
    offset = positions - positions.mean(axis=0)
    covariance = np.einsum("pnd,pne->nde", offset, offset) / len(paths)
    np.testing.assert_allclose(covariance, SKILL.gmr_.predict(times)[1] + 1e-8 * np.eye(3), atol=1e-12)


def test_the_attractor_has_the_published_closed_form():
    """Calinon et al. 2012: y = x + (D/K) x' + x''/K, here for a path of minimum jerk."""
    T, (K, D) = SKILL.duration_, SKILL.dmp_.gains_
    u = np.linspace(0.0, 1.0, 400)
    direction = np.array([0.4, -0.2, 0.1])
    shape = [10 * u**3 - 15 * u**4 + 6 * u**5, 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u)]
    expected = (shape[0] + D / K * shape[1] + shape[2] / K)[:, None] * direction
    found = attractor_of(Trajectory(T * u, shape[0][:, None] * direction), SKILL).positions
    np.testing.assert_allclose(found[8:-8], expected[8:-8], atol=2e-3)


@pytest.mark.parametrize("skill", [SKILL, PLANAR])
@pytest.mark.parametrize("variable", [False, True])
def test_without_the_force_it_reproduces_the_learned_path_and_avoids_nothing(skill, variable):
    """The control: the published method, which has no avoidance, follows the mean of the demonstrations."""
    control = GMMDMP(skill, force=0.0, variable_stiffness=variable)
    middle = skill.gmr_.trajectory(401).positions[200]
    plan = control.plan_motion(Scene(None, [Sphere(middle, 0.03)]))
    assert plan.trajectory.duration == pytest.approx(skill.duration_)
    assert np.sqrt(np.mean(plan.displaced**2)) < 0.01 * SKILL.gmr_.trajectory(400).path_length
    np.testing.assert_allclose(plan.trajectory.positions[-1], skill.goal_.position, atol=2e-3)


def test_another_start_and_goal_move_the_path_as_they_move_the_nominal_path():
    start = Pose(SKILL.start_.position + [0.02, 0.0, 0.03], SKILL.start_.quaternion)
    goal = Pose(SKILL.goal_.position + [0.0, -0.05, 0.04], SKILL.goal_.quaternion)
    policy = GMMDMP(SKILL, force=0.0)
    displaced = policy.plan_motion(Scene(goal), start).displaced
    learned = policy.plan_motion(Scene()).displaced
    np.testing.assert_allclose(displaced, learned, atol=2e-3)


def test_a_variable_stiffness_holds_the_path_more_firmly_where_the_demonstrations_agree():
    policy = GMMDMP(SKILL, variable_stiffness=True)
    variance = np.trace(policy.regression_.predict(np.linspace(0.0, SKILL.duration_, 200))[1], axis1=1, axis2=2)
    order = np.argsort(variance)
    assert np.all(np.diff(policy._ratios[order]) <= 1e-12)
    assert policy._ratios.min() >= 0.3 and policy._ratios.max() <= 3.0


def test_the_repulsion_keeps_the_tool_away():
    policy = GMMDMP(SKILL, tool_spheres=TOOL)
    flat = GMMDMP(PLANAR, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY)
    for seed in range(8):
        scene = sparse_clutter(seed, PATH, n_obstacles=1, planar=False).scene
        plan = policy.plan_motion(scene).trajectory
        assert ToolGaps(scene, TOOL).gaps(plan.positions).min() > 0.02
        np.testing.assert_allclose(plan.positions[[0, -1]], PATH[[0, -1]], atol=5e-3)
        scene = sparse_clutter(seed, PLANAR_PATH, n_obstacles=1, planar=True).scene
        plan = flat.plan_motion(scene).trajectory
        np.testing.assert_allclose(plan.positions[:, 2], PLANAR_PATH[0, 2], atol=1e-4)


def test_it_is_registered_with_options_to_search_and_checks_its_options():
    assert POLICIES["gmm-dmp"] is GMMDMP
    for option, (low, high) in GMMDMP.search_space.items():
        assert 0.0 < low < high and getattr(GMMDMP(SKILL, **{option: high}), option) == high
    with pytest.raises(InputError, match="GMMDMP: n_components"):
        GMMDMP(SKILL, n_components=0)
    with pytest.raises(InputError, match="GMMDMP: variable_stiffness"):
        GMMDMP(SKILL, variable_stiffness="yes")
