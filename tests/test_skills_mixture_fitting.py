from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from imitarm.errors import InputError
from imitarm.skills import GMR, GaussianMixture, gmm
from imitarm.skills import mixture_fitting as em
from imitarm.skills.mixture_fitting import Candidate, choose, try_numbers_of_components
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]


def two_blobs(seed: int, n: int = 300) -> Array:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3)) * 0.3
    first = rng.standard_normal((n, 3)) @ A + [1.0, 0.0, -1.0]
    X = np.concatenate([first, 0.5 * rng.standard_normal((n // 2, 3)) - [1.0, 0.5, 0.0]])
    return (X - X.mean(axis=0)) / X.std(axis=0)


def start(n: int, k: int, seed: int = 0) -> Array:
    r = np.random.default_rng(seed).random((1, k, n))
    return r / r.sum(axis=1, keepdims=True)


def run(Z: Array, r: Array, **options: float) -> em.Fit:
    return em.expectation_maximisation(
        em.quadratic_features(Z), r, floor=1e-6, tol=options.get("tol", 0.0), max_iter=int(options.get("max_iter", 50))
    )


def test_log_densities_are_those_of_gaussians() -> None:
    Z = two_blobs(0)
    fit = run(Z, start(len(Z), 3), max_iter=3)
    expected = [
        np.log(fit.weights[0, k]) + multivariate_normal(fit.means[0, k], fit.covariances[0, k]).logpdf(Z)
        for k in range(3)
    ]
    np.testing.assert_allclose(em.log_densities(fit.theta, em.quadratic_features(Z))[0], expected, atol=1e-9)


def test_one_component_is_mean_and_covariance() -> None:
    Z = two_blobs(1)
    fit = run(Z, np.ones((1, 1, len(Z))), max_iter=2)
    np.testing.assert_allclose(fit.means[0, 0], Z.mean(axis=0), atol=1e-8)
    np.testing.assert_allclose(fit.covariances[0, 0], np.cov(Z.T, bias=True), atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_likelihood_never_falls(seed: int) -> None:
    Z = two_blobs(seed)
    likelihood = [run(Z, start(len(Z), 3, seed), max_iter=n).log_likelihood[0] for n in range(1, 30)]
    assert np.diff(likelihood).min() > -1e-6


def test_side_by_side_is_the_same_as_one_after_another() -> None:
    Z = two_blobs(2)
    a, b = start(len(Z), 3, 1), start(len(Z), 3, 2)
    both = run(Z, np.concatenate([a, b]), max_iter=20)
    for i, alone in enumerate((run(Z, a, max_iter=20), run(Z, b, max_iter=20))):
        np.testing.assert_allclose(both.means[i], alone.means[0], atol=1e-6)
        np.testing.assert_allclose(both.log_likelihood[i], alone.log_likelihood[0], atol=1e-8)


def test_a_weight_of_zero_holds_a_sample_out() -> None:
    Z = two_blobs(3)
    seen = np.ones((1, len(Z)))
    seen[0, ::3] = 0.0
    r = start(len(Z), 2)
    weighted = em.expectation_maximisation(em.quadratic_features(Z), r, seen, floor=1e-6, tol=0.0, max_iter=15)
    kept = seen[0] > 0.0
    alone = run(Z[kept], r[:, :, kept], max_iter=15)
    np.testing.assert_allclose(weighted.means, alone.means, atol=1e-6)
    np.testing.assert_allclose(weighted.log_likelihood, alone.log_likelihood, atol=1e-6)


def test_eigenvalues_do_not_fall_below_the_floor() -> None:
    rng = np.random.default_rng(4)
    line = np.linspace(-1.7, 1.7, 200)
    Z = np.column_stack([line, line, rng.standard_normal(200)])  # two columns say the same
    fit = em.expectation_maximisation(em.quadratic_features(Z), start(200, 2), floor=1e-4, tol=0.0, max_iter=20)
    assert np.linalg.eigvalsh(fit.covariances).min() > 0.99e-4
    assert np.isfinite(fit.log_likelihood).all()


def test_a_component_without_samples_stays_finite() -> None:
    Z = two_blobs(5)
    r = np.zeros((1, 3, len(Z)))
    r[0, 0] = 1.0
    fit = run(Z, r, max_iter=10)
    assert np.isfinite(fit.log_likelihood).all()
    assert np.isfinite(fit.means).all()


def test_segments_are_hard_and_in_order() -> None:
    t = np.linspace(0.0, 1.0, 400)
    Z = np.column_stack([t, np.sin(6.0 * t)])
    (cut,) = em.responsibilities_by_segments(em.quadratic_features(Z), t, [5])
    assert set(np.unique(cut)) == {0.0, 1.0}
    np.testing.assert_array_equal(cut.sum(axis=0), 1.0)
    assert np.all(np.diff(np.argmax(cut, axis=0)) >= 0)


def test_segments_find_the_corners_of_a_polyline() -> None:
    rng = np.random.default_rng(0)
    t = np.tile(np.linspace(0.0, 1.0, 401), 3)
    x = np.interp(t, [0.0, 0.2, 0.75, 1.0], [0.0, 1.0, -1.0, 0.5]) + 0.01 * rng.standard_normal(len(t))
    Z = np.column_stack([t - 0.5, x])
    (cut,) = em.responsibilities_by_segments(em.quadratic_features(Z), t, [3])
    labels = np.argmax(cut, axis=0)
    corners = [t[labels == k].min() for k in (1, 2)]
    np.testing.assert_allclose(corners, [0.2, 0.75], atol=1.1 / 40)  # one slot


def test_dynamic_programming_equals_trying_all_cuts() -> None:
    rng = np.random.default_rng(1)
    t = np.repeat(np.arange(40), 10) + 0.5
    Z = np.column_stack([(t - 20.0) / 11.5, rng.standard_normal(len(t)).cumsum() / 10.0])
    features = em.quadratic_features(Z)
    (cut,) = em.responsibilities_by_segments(features, t, [3])

    def cost(labels: np.ndarray) -> float:
        sums = np.stack([features[:, labels == k].sum(axis=1) for k in range(3)])
        return float(em._segment_costs(sums, len(t)).sum())

    slot = np.repeat(np.arange(40), 10)
    least = min(cost(np.searchsorted([a, b], slot, side="right")) for a, b in itertools.combinations(range(1, 40), 2))
    assert cost(np.argmax(cut, axis=0)) == pytest.approx(least, rel=1e-9)


def test_several_numbers_at_once_equal_each_alone() -> None:
    t = np.linspace(0.0, 1.0, 500)
    features = em.quadratic_features(np.column_stack([t, np.cos(9.0 * t)]))
    together = em.responsibilities_by_segments(features, t, [1, 4, 10])
    for k, cut in zip((1, 4, 10), together, strict=True):
        np.testing.assert_array_equal(cut, em.responsibilities_by_segments(features, t, [k])[0])
        assert cut.shape == (k, 500)


def test_few_samples_fall_back_to_bins_of_equal_number() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 5.0, 9.0])
    features = em.quadratic_features(np.column_stack([t, t**2]))
    (cut,) = em.responsibilities_by_segments(features, t, [3])
    np.testing.assert_array_equal(cut.sum(axis=1), 2.0)


def test_seeds_reach_every_far_cluster() -> None:
    rng = np.random.default_rng(2)
    centers = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0], [20.0, 20.0]])
    Z = np.concatenate([c + 0.1 * rng.standard_normal((30, 2)) for c in centers])
    labels = np.argmax(gmm._responsibilities_by_seeds(Z, 4, rng), axis=0).reshape(4, 30)
    assert np.all(labels == labels[:, :1])
    assert len(set(labels[:, 0])) == 4


def test_seeds_of_equal_samples_do_not_divide_by_zero() -> None:
    cut = gmm._responsibilities_by_seeds(np.zeros((5, 2)), 3, np.random.default_rng(0))
    assert np.isfinite(cut).all()


MIN_STD = np.array([0.0, 1e-4, 1e-4, 1e-4])


def tables(seed: int = 0, n: int = 6, spread: float = 0.01) -> list[Array]:
    """A polyline of four straight pieces, shown n times."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 4.0, 100)
    corners = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.1], [0.3, 0.3, 0.0], [0.0, 0.3, 0.1], [-0.2, 0.0, 0.3]])
    x = np.column_stack([np.interp(t, np.arange(5.0), c) for c in corners.T])
    return [
        np.column_stack([t, x + spread * rng.standard_normal(3) + 1e-3 * rng.standard_normal(x.shape)])
        for _ in range(n)
    ]


def row(k: int, held_out: float, bias: float, bic: float = 0.0) -> Candidate:
    return Candidate(k, bic, bic, held_out, bias)


def test_the_smallest_number_that_generalises_and_rounds_off_little() -> None:
    rows = [row(2, 40.0, 20.0), row(3, 30.4, 5.0), row(4, 30.3, 2.9), row(5, 30.0, 2.0), row(6, 33.0, 1.0)]
    assert choose(rows) == 4
    assert choose(rows[::-1]) == 4


def test_without_a_good_one_the_least_held_out_error() -> None:
    assert choose([row(2, 40.0, 20.0), row(3, 30.0, 9.0), row(4, 31.0, 1.0)]) == 3


def test_below_the_repeatability_of_arms_errors_do_not_count() -> None:
    assert choose([row(2, 0.09, 0.05), row(3, 0.02, 0.01)]) == 2


def test_bic_decides_for_one_demonstration() -> None:
    assert choose([row(2, np.nan, 3.0, -10.0), row(3, np.nan, 2.0, -30.0), row(4, np.nan, 1.0, -20.0)]) == 3


def test_four_pieces_need_four_components() -> None:
    assert choose(try_numbers_of_components(tables(spread=0.03), range(1, 11), MIN_STD, 1e-6)) == 4


def test_held_out_error_is_that_of_learning_without_each() -> None:
    demonstrations = tables()
    (evaluated,) = try_numbers_of_components(demonstrations, [4], MIN_STD, 1e-6)
    squares = []
    for i, left_out in enumerate(demonstrations):
        rest = [Trajectory(d[:, 0], d[:, 1:]) for j, d in enumerate(demonstrations) if j != i]
        squares.append(np.sum((GMR(4).fit(rest).predict(left_out[:, 0])[0] - left_out[:, 1:]) ** 2, axis=1))
    assert evaluated.held_out_rmse_mm == pytest.approx(1e3 * np.sqrt(np.mean(squares)), rel=0.02)


def test_criteria_are_those_of_the_mixture() -> None:
    demonstrations = tables()
    (evaluated,) = try_numbers_of_components(demonstrations, [4], MIN_STD, 1e-6)
    X = np.concatenate(demonstrations)
    mixture = GaussianMixture(4, tol=1e-3).fit(X)
    assert evaluated.bic == pytest.approx(mixture.bic(X), rel=2e-3)
    assert evaluated.aic - evaluated.bic == pytest.approx(mixture.aic(X) - mixture.bic(X), rel=1e-9)


def test_a_still_axis_is_left_out_but_counts_in_the_error() -> None:
    flat = tables()
    for i, table in enumerate(flat):
        table[:, 3] = 0.2 + 1e-5 * i
    (evaluated,) = try_numbers_of_components(flat, [4], MIN_STD, 1e-6)
    assert np.isfinite([evaluated.bic, evaluated.held_out_rmse_mm]).all()


def test_large_numbers_are_not_tried_in_vain() -> None:
    evaluated = try_numbers_of_components(tables(spread=0.03), range(1, 41), MIN_STD, 1e-6)
    assert len(evaluated) == 8  # 4, and four more that are no better


def test_numbers_beyond_the_samples_are_skipped_or_refused() -> None:
    few = [table[::20] for table in tables(n=3)]  # 5 samples each
    evaluated = try_numbers_of_components(few, [2, 4, 90], MIN_STD, 1e-6)
    assert [c.n_components for c in evaluated] == [2, 4]
    with pytest.raises(InputError, match="too few"):
        try_numbers_of_components(few, [90], MIN_STD, 1e-6)
