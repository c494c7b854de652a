from __future__ import annotations

import numpy as np
import pytest

from imitarm.skills.dmp_fit import fit_weights, start_rate
from imitarm.skills.dynamical_systems import GAINS

SHARE = np.linspace(0.0, 1.0, 201)


def minimum_jerk(u: np.ndarray) -> np.ndarray:
    return (u**3 * (10.0 + u * (6.0 * u - 15.0)))[:, None] * np.array([0.3, -0.2, 0.1])


def test_a_motion_from_rest_begins_exactly_at_rest() -> None:
    rng = np.random.default_rng(0)
    x = minimum_jerk(SHARE)
    np.testing.assert_array_equal(start_rate(SHARE, x), 0.0)
    np.testing.assert_array_equal(start_rate(SHARE, x + 1e-3 * rng.standard_normal(x.shape)), 0.0)


def test_a_motion_under_way_is_seen() -> None:
    x = np.column_stack([np.sin(3.0 * SHARE), 0.0 * SHARE, SHARE])
    np.testing.assert_allclose(start_rate(SHARE, x), [3.0, 0.0, 1.0], atol=0.03)


def test_few_samples_give_no_rate() -> None:
    np.testing.assert_array_equal(start_rate(SHARE[:4], minimum_jerk(SHARE)[:4]), 0.0)


def test_noise_does_not_blow_up_the_weights() -> None:
    """1 mm of noise at 100 Hz multiplied the largest weight by 180 where differences were used."""
    x = minimum_jerk(SHARE)
    noisy = x + 1e-3 * np.random.default_rng(1).standard_normal(x.shape)
    clean, other = (fit_weights(SHARE, k, GAINS["critical"], 40, 1e-7) for k in (x, noisy))
    force = np.exp(-np.log(100.0) * np.linspace(0.0, 1.0, 40))[:, None]  # what a weight does: w_i s at its centre
    assert np.abs(other.weights * force).max() < 3.0 * np.abs(clean.weights * force).max()


def test_progress_is_the_share_of_the_path() -> None:
    learnt = fit_weights(SHARE, minimum_jerk(SHARE), GAINS["critical"], 40, 1e-7)
    assert learnt.path_length == pytest.approx(np.linalg.norm([0.3, -0.2, 0.1]), rel=1e-3)
    ratio = learnt.weights @ np.array([0.3, -0.2, 0.1]) / np.sum(np.square([0.3, -0.2, 0.1]))
    force = np.exp(-np.log(100.0) * np.linspace(0.0, 1.0, 40))
    np.testing.assert_allclose(learnt.progress_weights * force, ratio * force, atol=0.02)


def test_a_motion_of_no_length_has_a_progress_too() -> None:
    learnt = fit_weights(SHARE, np.ones((201, 3)), GAINS["critical"], 20, 1e-7)
    assert learnt.path_length == pytest.approx(0.0, abs=1e-9)
    assert np.isfinite(learnt.progress_weights).all()


def test_a_noisy_end_is_no_reason_to_jerk() -> None:
    x = minimum_jerk(SHARE)
    exact = fit_weights(SHARE, x, GAINS["critical"], 40, 1e-7)
    np.testing.assert_array_equal(exact.start, x[0])
    np.testing.assert_array_equal(exact.goal, x[-1])
    x[-1] += [0.0, 0.0, 2e-3]
    beside = fit_weights(SHARE, x, GAINS["critical"], 40, 1e-7)
    assert abs(beside.goal[2] - 0.1) < 1.5e-3


@pytest.mark.parametrize("moving", [False, True])
def test_the_target_is_the_goal_when_the_duration_is_over(moving: bool) -> None:
    x = np.column_stack([SHARE, SHARE**2, np.sin(4.0 * SHARE)]) if moving else minimum_jerk(SHARE)
    learnt = fit_weights(SHARE, x, GAINS["critical"], 40, 1e-7)
    np.testing.assert_allclose(learnt.weights[-1], learnt.goal - learnt.start, atol=1e-12)
    assert learnt.progress_weights[-1] == 1.0
