from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cholesky_banded

from imitarm.benchmark import train_irl
from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.benchmark.train_irl import expectation, first_weights, inverse_hessian, learn_weights
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.expert import PathProblem
from imitarm.policies.baselines.gmm_irl import WEIGHTS, GmmIrl, learned_weights, path_cost
from imitarm.policies.baselines.path_cost import FEATURES, N_FREE, PathCost
from imitarm.scene import Scene, Sphere

TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
LEARNED = {planar: learn(planar=planar) for planar in (True, False)}
KNOWN = np.array([5.0, 0.1, 300.0, 100.0, 30.0, 3000.0])  # weights
seeds = st.integers(0, 500)


def cost_in(seed, *, planar=False, forbidden=None) -> PathCost:
    skill, path = LEARNED[planar]
    case = sparse_clutter(seed, path, n_obstacles=2, planar=planar)
    directions = np.array(case.forbidden if forbidden is None else forbidden, dtype=float).reshape(-1, 3)
    problem = PathProblem.of(skill.gmr_.trajectory(200), ToolGaps(case.scene, TOOL), CLEARANCE, directions)
    return path_cost(problem, skill)


def smooth_random(cost, rng):
    """A smooth deviation of some centimetres that touches nothing exactly."""
    u = np.linspace(0.0, 1.0, N_FREE)
    waves = np.stack([np.sin((k + 1) * np.pi * u) for k in range(4)], axis=1)
    return 0.02 * waves @ rng.normal(size=(4, cost.axes.shape[1]))


@settings(max_examples=15, deadline=None)
@given(seeds, st.booleans(), st.sampled_from([(), NOT_DOWN]))
def test_gradients_of_the_features_equal_finite_differences(seed, planar, forbidden):
    cost = cost_in(seed, planar=planar, forbidden=(*(HORIZONTAL_ONLY if planar else ()), *forbidden))
    rng = np.random.default_rng(seed)
    d = smooth_random(cost, rng)
    direction = smooth_random(cost, rng)
    step = 1e-5
    expected = (cost.features(d + step * direction) - cost.features(d - step * direction)) / (2.0 * step)
    found = np.einsum("fik,ik->f", cost.gradients(d), direction)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(seeds, st.booleans())
def test_the_hessian_equals_finite_differences_of_the_gradient(seed, planar):
    cost = cost_in(seed, planar=planar)
    rng = np.random.default_rng(seed)
    d, direction = smooth_random(cost, rng), smooth_random(cost, rng)
    gap = cost._gaps(d)[0]
    if np.abs(gap).min() < 1e-4:  # second derivatives jump where a gap is 0
        return
    step = 1e-5
    up, down = (np.tensordot(KNOWN, cost.gradients(d + sign * step * direction), axes=1) for sign in (1.0, -1.0))
    band = cost.hessian(KNOWN, cost.blocks(d))
    full = np.zeros((band.shape[1], band.shape[1]))
    for offset in range(len(band)):
        entries = band[len(band) - 1 - offset, offset:]
        full += np.diag(entries, offset) + (np.diag(entries, -offset) if offset else 0.0)
    found = (full @ direction.ravel()).reshape(d.shape)
    scale = np.abs(found).max()
    agree = np.abs(found - (up - down) / (2.0 * step)).max(axis=1) < 2e-3 * scale
    assert np.mean(agree) > 0.97  # but at samples whose closest point jumps between faces and edges


@settings(max_examples=8, deadline=None)
@given(seeds, st.booleans())
def test_l_bfgs_ends_where_the_gradient_vanishes(seed, planar):
    cost = cost_in(seed, planar=planar)
    start = np.zeros((N_FREE, cost.axes.shape[1]))
    minimum = cost.minimised(KNOWN, start)
    slope = np.tensordot(KNOWN, cost.gradients(minimum), axes=1)
    first = np.tensordot(KNOWN, cost.gradients(start), axes=1)
    # measured in the metric of the quadratic features, in which the solver works
    only = np.where(np.arange(len(KNOWN)) < 2, KNOWN, 0.0)
    blocks = np.zeros((len(KNOWN), *cost.precisions.shape))
    blocks[0] = 2.0 * cost.precisions / N_FREE
    inverse = inverse_hessian(cost, only, blocks)
    norms = [float(np.sqrt(g.ravel() @ inverse @ g.ravel())) for g in (slope, first)]
    assert norms[0] < 1e-3 * norms[1] + 1e-3
    assert KNOWN @ cost.features(minimum) <= KNOWN @ cost.features(start)


def test_without_obstacles_the_learned_path_is_the_best_and_the_model_is_gaussian():
    """Closed forms: E phi_1 w_1 + E phi_2 w_2 is half the number of coordinates, and the covariance is exact."""
    skill, _ = LEARNED[False]
    gaps = ToolGaps(Scene(None, ()), TOOL)
    cost = path_cost(PathProblem.of(skill.gmr_.trajectory(200), gaps, CLEARANCE, np.zeros((0, 3))), skill)
    found = expectation(cost, KNOWN, np.full((N_FREE, 3), 0.01))
    np.testing.assert_allclose(found.minimum, 0.0, atol=1e-6)
    assert KNOWN[:2] @ found.mean[:2] == pytest.approx(0.5 * 3 * N_FREE, rel=1e-6)
    blocks = cost.blocks(found.minimum)
    draws = np.linalg.cholesky(inverse_hessian(cost, KNOWN, blocks)) @ np.random.default_rng(0).normal(size=(282, 4000))
    sampled = np.stack([cost.features(d.reshape(N_FREE, 3)) for d in draws.T])
    np.testing.assert_allclose(found.mean[:2], sampled.mean(axis=0)[:2], rtol=0.02)
    np.testing.assert_allclose(found.covariance[:2, :2], np.cov(sampled.T)[:2, :2], rtol=0.15)


def test_the_slope_of_the_log_determinant_is_half_a_trace():
    cost = cost_in(3)
    found = expectation(cost, KNOWN, np.zeros((N_FREE, 3)))
    blocks = cost.blocks(found.minimum)

    def half_log_determinant(weights):
        return float(np.log(cholesky_banded(cost.hessian(weights, blocks))[-1]).sum())

    mean = found.mean - cost.features(found.minimum)
    for k in range(len(FEATURES)):
        step = 1e-3 * KNOWN[k] * np.eye(len(FEATURES))[k]
        slope = (half_log_determinant(KNOWN + step) - half_log_determinant(KNOWN - step)) / (2.0 * step[k])
        assert mean[k] == pytest.approx(slope, rel=2e-3, abs=1e-6)


def test_known_weights_are_recovered_from_paths_drawn_from_their_model():
    rng = np.random.default_rng(0)
    costs, shown = [], []
    for seed in range(4):
        cost = cost_in(seed, planar=True)
        minimum = cost.minimised(KNOWN, 1e-3 * rng.normal(size=(N_FREE, 2)))
        spread = np.linalg.cholesky(inverse_hessian(cost, KNOWN, cost.blocks(minimum)))
        for _ in range(4):
            costs.append(cost)
            shown.append(minimum + (spread @ rng.normal(size=minimum.size)).reshape(minimum.shape))
    learned = learn_weights(costs, shown, iterations=25)
    np.testing.assert_allclose(learned.weights[:2], KNOWN[:2], rtol=0.15)
    np.testing.assert_allclose(learned.expected, learned.demonstrated, rtol=0.05, atol=1e-4)
    for cost, deviation in zip(costs[::4], shown[::4], strict=True):  # and so is the best path
        found, true = cost.minimised(learned.weights, deviation), cost.minimised(KNOWN, deviation)
        assert np.abs(found - true).max() < 5e-3


def test_first_weights_give_each_feature_the_same_part():
    cost = cost_in(0)
    shown = cost.features(smooth_random(cost, np.random.default_rng(0)))
    parts = first_weights([cost], shown) * shown
    np.testing.assert_allclose(parts[shown > 1e-6], 0.5 * 3 * N_FREE / len(FEATURES))


def test_the_training_command_writes_weights_with_their_origin(tmp_path, capsys):
    train_irl.main(["--scenes", "2", "--iterations", "2", "--output", str(tmp_path / "weights.json")])
    written = json.loads((tmp_path / "weights.json").read_text())
    shipped = json.loads(WEIGHTS.read_text())
    assert written.keys() == shipped.keys() and written["demonstrations"] == 2
    assert list(shipped["weights"]) == list(FEATURES) == list(learned_weights())
    assert shipped["demonstrations"] >= 190 and "uncommitted" not in shipped["code"]
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_the_policy_goes_around_obstacles_and_returns_the_learned_path_without_any():
    skill, path = LEARNED[False]
    clear = GmmIrl(skill, tool_spheres=TOOL).plan_motion(Scene(None, ()))
    assert clear.displaced.max() < 1e-3
    for seed in range(3):
        case = sparse_clutter(seed, path, n_obstacles=2, planar=False)
        plan = GmmIrl(skill, tool_spheres=TOOL, avoidance=10.0).plan_motion(case.scene)
        assert ToolGaps(case.scene, TOOL).gaps(plan.trajectory.positions).min() > CLEARANCE
        np.testing.assert_allclose(plan.trajectory.positions[[0, -1]], path[[0, -1]], atol=1e-9)


def test_forbidden_directions_and_moving_obstacles():
    skill, path = LEARNED[False]
    scene = Scene(None, (Sphere(path[200], 0.03),))
    learned = skill.gmr_.trajectory(200).at(np.linspace(0.0, skill.duration_, 100))[0]
    plan = GmmIrl(skill, tool_spheres=TOOL, avoidance=10.0, forbidden=HORIZONTAL_ONLY).plan_motion(scene)
    np.testing.assert_allclose(plan.trajectory.positions[:, 2], learned[:, 2], atol=1e-9)
    plan = GmmIrl(skill, tool_spheres=TOOL, avoidance=10.0, forbidden=NOT_DOWN).plan_motion(scene)
    assert (plan.trajectory.positions - learned)[:, 2].min() > -2e-3
    crossing = Scene(None, (Sphere(path[200] - [0.0, 0.6, 0.0], 0.03, velocity=[0.0, 0.3, 0.0]),))
    plan = GmmIrl(skill, tool_spheres=TOOL, avoidance=10.0).plan_motion(crossing)
    gaps = ToolGaps(crossing, TOOL).gaps(plan.trajectory.positions[:, None], plan.trajectory.times)
    assert plan.only_on_schedule and gaps.min() > CLEARANCE


def test_options_are_checked():
    skill, _ = LEARNED[True]
    for name, (lowest, highest) in GmmIrl.search_space.items():
        assert 0.0 < lowest < highest
        with pytest.raises(ValueError, match=name):
            GmmIrl(skill, **{name: -1.0})
