from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from imitarm.errors import InputError
from imitarm.skills import DegenerateAxisWarning, GaussianMixture, ellipsoid_scale

Array = NDArray[np.float64]


def over_time(seed: int = 0, noise: float = 0.002) -> Array:
    rng = np.random.default_rng(seed)
    t = np.tile(np.linspace(0.0, 2.0, 100), 5)
    x = np.column_stack([0.3 * np.sin(1.5 * t), 0.2 * np.cos(2.5 * t), 0.1 * np.sin(4.0 * t)])
    return np.column_stack([t, x + noise * rng.standard_normal(x.shape)])


def test_one_component_is_mean_and_covariance() -> None:
    X = over_time()
    mixture = GaussianMixture(1).fit(X)
    np.testing.assert_allclose(mixture.means_[0], X.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(mixture.covariances_[0], np.cov(X.T, bias=True), rtol=1e-5, atol=1e-9)
    assert mixture.weights_ == pytest.approx([1.0])


def test_density_is_the_sum_of_gaussians() -> None:
    X = over_time()
    mixture = GaussianMixture(4).fit(X)
    density = sum(
        w * multivariate_normal(m, c).pdf(X)
        for w, m, c in zip(mixture.weights_, mixture.means_, mixture.covariances_, strict=True)
    )
    np.testing.assert_allclose(mixture.score_samples(X), np.log(density), atol=1e-8)
    assert mixture.lower_bound_ == pytest.approx(mixture.score(X), abs=1e-9)


def test_responsibilities_are_bayes_rule() -> None:
    X = over_time()
    mixture = GaussianMixture(3).fit(X)
    joint = np.stack(
        [
            w * multivariate_normal(m, c).pdf(X)
            for w, m, c in zip(mixture.weights_, mixture.means_, mixture.covariances_, strict=True)
        ],
        axis=1,
    )
    np.testing.assert_allclose(mixture.predict_proba(X), joint / joint.sum(axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_array_equal(mixture.predict(X), np.argmax(joint, axis=1))


def test_information_criteria_count_parameters() -> None:
    X = over_time()
    mixture = GaussianMixture(3).fit(X)
    p = 2 + 3 * 4 + 3 * 10
    assert mixture.n_parameters == p
    likelihood = mixture.score_samples(X).sum()
    assert mixture.bic(X) == pytest.approx(-2.0 * likelihood + p * np.log(len(X)))
    assert mixture.aic(X) == pytest.approx(-2.0 * likelihood + 2.0 * p)


def test_it_is_deterministic() -> None:
    X = over_time()
    a, b = GaussianMixture(6, n_init=3).fit(X), GaussianMixture(6, n_init=3).fit(X)
    np.testing.assert_array_equal(a.covariances_, b.covariances_)


def test_more_starts_are_never_worse() -> None:
    X = over_time(3)
    assert GaussianMixture(6, n_init=4).fit(X).lower_bound_ >= GaussianMixture(6).fit(X).lower_bound_ - 1e-3


def test_kmeans_start_serves_data_without_time() -> None:
    rng = np.random.default_rng(0)
    centers = np.array([[0.0, 5.0], [0.0, -5.0], [0.1, 0.0]])  # column 0 says nothing
    X = np.concatenate([c + 0.3 * rng.standard_normal((80, 2)) for c in centers])
    mixture = GaussianMixture(3, init="kmeans++", n_init=3).fit(X)
    np.testing.assert_allclose(np.sort(mixture.means_[:, 1]), [-5.0, 0.0, 5.0], atol=0.2)


@settings(max_examples=25, deadline=None)
@given(
    scale=st.lists(st.floats(1e-3, 1e3), min_size=4, max_size=4),
    offset=st.lists(st.floats(-10.0, 10.0), min_size=4, max_size=4),
)
def test_units_do_not_decide_the_result(scale: list[float], offset: list[float]) -> None:
    X = over_time(noise=0.01)
    s, o = np.array(scale), np.array(offset)
    plain = GaussianMixture(3, max_iter=20, tol=0.0).fit(X)
    other = GaussianMixture(3, max_iter=20, tol=0.0).fit(X * s + o * s)
    np.testing.assert_allclose(other.means_, plain.means_ * s + o * s, rtol=1e-4, atol=1e-4 * s.max())
    np.testing.assert_allclose(other.weights_, plain.weights_, atol=1e-4)


def test_a_still_axis_does_not_disturb_the_others() -> None:
    X = over_time()
    plain = GaussianMixture(5).fit(X)
    with pytest.warns(DegenerateAxisWarning, match=r"columns \[2\]"):
        mixture = GaussianMixture(5).fit(np.insert(X, 2, 0.23, axis=1))
    assert mixture.degenerate_axes_ == (2,)
    rest = [0, 1, 3, 4]
    np.testing.assert_allclose(mixture.means_[:, rest], plain.means_, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(mixture.covariances_[:, rest][:, :, rest], plain.covariances_, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(mixture.means_[:, 2], 0.23)
    assert np.linalg.eigvalsh(mixture.covariances_).min() > 0.0
    assert mixture.lower_bound_ == pytest.approx(mixture.score(np.insert(X, 2, 0.23, axis=1)))


def test_min_std_says_what_is_still() -> None:
    X = over_time()
    X[:, 3] = 0.5 + 1e-5 * np.random.default_rng(0).standard_normal(len(X))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert GaussianMixture(3).fit(X).degenerate_axes_ == ()
    with pytest.warns(DegenerateAxisWarning):
        mixture = GaussianMixture(3, min_std=[0.0, 1e-4, 1e-4, 1e-4]).fit(X)
    assert mixture.degenerate_axes_ == (3,)
    np.testing.assert_allclose(np.sqrt(mixture.covariances_[:, 3, 3]), 1e-4)


def test_an_epoch_stamp_is_no_still_axis() -> None:
    X = over_time()
    X[:, 0] += 1.7e9
    assert GaussianMixture(3).fit(X).degenerate_axes_ == ()


def test_samples_come_from_the_mixture() -> None:
    mixture = GaussianMixture(3).fit(over_time())
    drawn, component = mixture.sample(20_000, random_state=1)
    np.testing.assert_allclose(np.bincount(component) / 20_000, mixture.weights_, atol=0.02)
    np.testing.assert_allclose(drawn.mean(axis=0), mixture.weights_ @ mixture.means_, atol=0.02)


@pytest.mark.parametrize(
    "X",
    [
        np.zeros((0, 3)),
        np.zeros(5),
        np.zeros((5, 2, 2)),
        np.ones((9, 3)),
        [[1.0, np.nan]],
        [["a", "b"]],
        [[1.0], [2.0, 3.0]],
    ],
)
def test_bad_samples_are_named(X: object) -> None:
    with pytest.raises(InputError, match=r"GaussianMixture\.fit"):
        GaussianMixture(1).fit(X)  # type: ignore[arg-type]


def test_too_few_samples_for_the_components() -> None:
    with pytest.raises(InputError, match="3 samples are too few for 4 components"):
        GaussianMixture(4).fit(np.random.default_rng(0).random((3, 2)))


@pytest.mark.parametrize(
    "options",
    [
        {"n_components": 0},
        {"n_components": 2.5},
        {"n_components": 2, "reg_covar": 0.0},
        {"n_components": 2, "n_init": 0},
        {"n_components": 2, "max_iter": 0},
        {"n_components": 2, "tol": -1.0},
        {"n_components": 2, "init": "random"},
    ],
)
def test_bad_options_are_refused_when_given(options: dict[str, object]) -> None:
    with pytest.raises(InputError):
        GaussianMixture(**options)  # type: ignore[arg-type]


def test_use_before_fit_and_wrong_columns() -> None:
    with pytest.raises(InputError, match="not fitted"):
        GaussianMixture(2).score(np.zeros((3, 2)))
    with pytest.raises(InputError, match="fitted to 4 columns, got 2"):
        GaussianMixture(2).fit(over_time()).score(np.zeros((3, 2)))


@pytest.mark.parametrize("n_dims", [1, 2, 3])
def test_a_95_percent_ellipse_covers_95_percent(n_dims: int) -> None:
    rng = np.random.default_rng(n_dims)
    A = rng.standard_normal((n_dims, n_dims))
    X = rng.standard_normal((100_000, n_dims)) @ A.T
    squared = np.sum(X @ np.linalg.inv(A @ A.T) * X, axis=1)
    inside = squared <= ellipsoid_scale(0.95, n_dims) ** 2
    assert inside.mean() == pytest.approx(0.95, abs=0.003)


def test_ellipsoid_scale_is_chi_square() -> None:
    assert ellipsoid_scale(0.95, 1) == pytest.approx(1.95996, abs=1e-5)
    assert ellipsoid_scale(0.95, 2) == pytest.approx(2.44775, abs=1e-5)
    assert ellipsoid_scale(0.95, 3) == pytest.approx(2.79548, abs=1e-5)
    assert ellipsoid_scale(0.0, 2) == 0.0
    for bad in ((1.0, 2), (-0.1, 2), (0.5, 0), (float("nan"), 2)):
        with pytest.raises(InputError):
            ellipsoid_scale(*bad)
