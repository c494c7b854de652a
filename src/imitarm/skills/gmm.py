"""Gaussian mixture with full covariances."""

from __future__ import annotations

import warnings
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from imitarm.errors import InputError
from imitarm.skills.mixture_fitting import (
    LOG_2PI,
    expectation_maximisation,
    log_densities,
    normalise,
    quadratic_features,
    responsibilities_by_segments,
)
from imitarm.validation import choice, finite_array, finite_number, real_array, whole_number

Array = NDArray[np.float64]

_CONSTANT = 1e-6  # of a column's largest value: a smaller standard deviation is rounding, not motion
_MOST_COMPONENTS = 10_000


class DegenerateAxisWarning(UserWarning):
    """A column is constant, so nothing can be learned from it; it does not influence the other columns."""


def ellipsoid_scale(probability: float, n_dims: int) -> float:
    """Return the semi-axis of the ellipsoid that contains ``probability`` of a Gaussian, in standard deviations.

    The squared Mahalanobis distance of a Gaussian in ``n_dims`` dimensions has a chi-square distribution with
    ``n_dims`` degrees of freedom. The semi-axes are therefore ``scale * sqrt(eigenvalue)``. For 95 %, the scale is
    1.960, 2.448 or 2.796 in 1, 2 or 3 dimensions. With the one-dimensional scale 1.960, an ellipse in the plane would
    contain only 85 % of the Gaussian, and an ellipsoid in space only 72 %.

    Raises:
        InputError: when ``probability`` is not in [0, 1) or ``n_dims`` is below 1.
    """
    probability = finite_number(probability, "ellipsoid_scale: probability", at_least=0.0)
    if not probability < 1.0:
        raise InputError(f"ellipsoid_scale: probability must be at least 0 and below 1, got {probability!r}")
    n_dims = whole_number(n_dims, "ellipsoid_scale: n_dims", at_least=1, at_most=1_000_000)
    return float(np.sqrt(2.0 * gammaincinv(0.5 * n_dims, probability)))


class GaussianMixture:
    r"""Mixture of Gaussians with full covariances, fitted by expectation maximisation.

    .. math::
        p(z) = \sum_k \pi_k N(z; \mu_k, \Sigma_k), \qquad
        h_k(z) = \frac{\pi_k N(z; \mu_k, \Sigma_k)}{\sum_j \pi_j N(z; \mu_j, \Sigma_j)}

        N_k = \sum_n h_k(z_n), \quad \pi_k = N_k / N, \quad \mu_k = \frac{1}{N_k} \sum_n h_k z_n, \quad
        \Sigma_k = \frac{1}{N_k} \sum_n h_k z_n z_n^T - \mu_k \mu_k^T

    (thesis 2.2.1). The names of arguments, attributes and methods follow scikit-learn. The differences from
    scikit-learn are:

    * Columns are standardised internally, so the result does not depend on the units.
    * ``init="time"`` divides column 0 into K segments such that one Gaussian describes each segment well
      (:func:`~imitarm.skills.mixture_fitting.responsibilities_by_segments`). This start is deterministic and is meant
      for samples [t; x] with the time t in column 0.
    * A constant column (such as z in a planar task) does not influence the other columns. ``degenerate_axes_`` lists
      such columns, and a :class:`DegenerateAxisWarning` reports them.

    Args:
        n_components: number K of Gaussians.
        reg_covar: smallest eigenvalue of a covariance, relative to the variances of the columns.
        n_init: number of starts; the best fit is kept. All starts except the first use k-means++ seeds.
        init: method for the first start: ``"time"`` (segments of column 0) or ``"kmeans++"``.
        min_std: a column whose standard deviation is at most this value counts as constant and gets this standard
            deviation. Pass one number for all columns or one for each, in the column's unit.
        random_state: seed of the k-means++ starts.
        tol: the iterations stop when the mean log-likelihood per sample changes by less than this value.
        max_iter: largest number of iterations of one start.

    Attributes:
        weights_: priors, shape (K,).
        means_: means of the components, shape (K, d).
        covariances_: covariances of the components, shape (K, d, d).
        lower_bound_: mean log-likelihood per sample of the fitted data.
        converged_: whether the last change of ``lower_bound_`` was below ``tol``.
        n_iter_: number of iterations.
        degenerate_axes_: indices of the constant columns.

    Raises:
        InputError: when an option is out of range.
    """

    weights_: Array
    means_: Array
    covariances_: Array
    lower_bound_: float
    converged_: bool
    n_iter_: int
    degenerate_axes_: tuple[int, ...]

    def __init__(
        self,
        n_components: int,
        *,
        reg_covar: float = 1e-6,
        n_init: int = 1,
        init: Literal["time", "kmeans++"] = "time",
        min_std: ArrayLike = 0.0,
        random_state: int = 0,
        tol: float = 1e-4,
        max_iter: int = 500,
    ) -> None:
        what = "GaussianMixture:"
        self.n_components = whole_number(n_components, f"{what} n_components", at_least=1, at_most=_MOST_COMPONENTS)
        self.n_init = whole_number(n_init, f"{what} n_init", at_least=1, at_most=1000)
        self.max_iter = whole_number(max_iter, f"{what} max_iter", at_least=1)
        self.random_state = whole_number(random_state, f"{what} random_state", at_least=0)
        self.reg_covar = finite_number(reg_covar, f"{what} reg_covar", above=0.0)
        self.tol = finite_number(tol, f"{what} tol", at_least=0.0)
        self.init = choice(init, ("time", "kmeans++"), "init of GaussianMixture")
        self.min_std = finite_array(min_std, (...,), f"{what} min_std")
        if self.min_std.ndim > 1 or np.any(self.min_std < 0.0):
            raise InputError(f"{what} min_std must be one number or one per column, each at least 0")

    def fit(self, X: ArrayLike) -> Self:
        """Fit to samples ``X`` (n, d).

        Raises:
            InputError: when ``X`` is not a table of finite numbers, has fewer than 2 samples or fewer samples than
                components, or all columns are constant.
        """
        X = _table(X, "GaussianMixture.fit")
        if self.min_std.ndim and len(self.min_std) != X.shape[1]:
            raise InputError(
                f"GaussianMixture.fit: min_std has {len(self.min_std)} numbers, but X has "
                f"{X.shape[1]} columns; give one number or one per column"
            )
        if len(X) < max(2, self.n_components):
            raise InputError(
                f"GaussianMixture.fit: {len(X)} samples are too few for {self.n_components} components; "
                f"give at least {max(2, self.n_components)}"
            )
        center, scale, moves, fixed_std = self._standardisation(X)
        Z = (X[:, moves] - center[moves]) / scale[moves]
        features = quadratic_features(Z)
        fit = expectation_maximisation(
            features, self._starts(features, X[:, 0], Z), floor=self.reg_covar, tol=self.tol, max_iter=self.max_iter
        )
        best = int(np.argmax(fit.log_likelihood))
        self._center, self._scale, self._moves = center, scale, moves
        self._theta = fit.theta[best : best + 1]
        self.weights_ = fit.weights[best]
        self.means_, self.covariances_ = _in_units(
            fit.means[best], fit.covariances[best], center, scale, moves, fixed_std
        )
        self._fixed_variance = fixed_std[~moves] ** 2
        self.lower_bound_ = float(fit.log_likelihood[best] - np.log(scale[moves]).sum() + self._fixed_score(X).mean())
        self.converged_ = bool(fit.converged[best])
        self.n_iter_ = fit.n_iter
        self.degenerate_axes_ = tuple(int(i) for i in np.flatnonzero(~moves))
        if self.degenerate_axes_:
            warnings.warn(
                f"columns {list(self.degenerate_axes_)} do not move (deviation at most {fixed_std[~moves].max():.2g}); "
                "they are kept constant and do not influence the other columns",
                DegenerateAxisWarning,
                stacklevel=2,
            )
        return self

    def _standardisation(self, X: Array) -> tuple[Array, Array, NDArray[np.bool_], Array]:
        """Return mean and deviation of the columns, whether each varies, and the deviation of the constant columns."""
        center = X.mean(axis=0)
        scale = X.std(axis=0)
        largest = np.abs(X).max(axis=0)
        least = np.maximum(self.min_std, _CONSTANT * np.where(largest > 0.0, largest, 1.0))
        # compared with the rounding of the largest value: times with a large offset (epoch stamps) still move
        moves = scale > np.maximum(self.min_std, 1e-12 * np.maximum(largest, 1e-300))
        if not moves.any():
            raise InputError("GaussianMixture.fit: no column moves; there is nothing to learn from constant data")
        return center, scale, moves, least

    def _starts(self, features: Array, column: Array, Z: Array) -> Array:
        """Return the initial responsibilities (n_init, K, n)."""
        rng = np.random.default_rng(self.random_state)
        starts = responsibilities_by_segments(features, column, [self.n_components]) if self.init == "time" else []
        while len(starts) < self.n_init:
            starts.append(_responsibilities_by_seeds(Z, self.n_components, rng))
        return np.stack(starts)

    def _fixed_score(self, X: Array) -> Array:
        """Return the log-density (n,) of the constant columns."""
        offset = X[:, ~self._moves] - self._center[~self._moves]
        return -0.5 * np.sum(offset**2 / self._fixed_variance + np.log(self._fixed_variance) + LOG_2PI, axis=1)

    def _normalised(self, X: Array) -> tuple[Array, Array]:
        """Return responsibilities (K, n) and log-likelihoods (n,)."""
        moves = self._moves
        Z = (X[:, moves] - self._center[moves]) / self._scale[moves]
        responsibilities, by_sample = normalise(log_densities(self._theta, quadratic_features(Z)))
        return responsibilities[0], by_sample[0] - np.log(self._scale[moves]).sum() + self._fixed_score(X)

    def _checked(self, X: ArrayLike, what: str) -> Array:
        if not hasattr(self, "means_"):
            raise InputError(f"GaussianMixture.{what}: not fitted yet; call fit first")
        X = _table(X, f"GaussianMixture.{what}")
        if not len(X):
            raise InputError(f"GaussianMixture.{what}: X has no samples")
        if X.shape[1] != self.means_.shape[1]:
            raise InputError(f"GaussianMixture.{what}: fitted to {self.means_.shape[1]} columns, got {X.shape[1]}")
        return X

    def score_samples(self, X: ArrayLike) -> Array:
        """Return the log-density of each sample of ``X`` (n, d), shape (n,)."""
        return self._normalised(self._checked(X, "score_samples"))[1]

    def score(self, X: ArrayLike) -> float:
        """Return the mean log-likelihood per sample of ``X`` (n, d)."""
        return float(self._normalised(self._checked(X, "score"))[1].mean())

    def predict_proba(self, X: ArrayLike) -> Array:
        """Return the responsibilities h_k of each sample of ``X`` (n, d), shape (n, K)."""
        return self._normalised(self._checked(X, "predict_proba"))[0].T

    def predict(self, X: ArrayLike) -> NDArray[np.intp]:
        """Return, for each sample of ``X`` (n, d), the index of the component with the largest responsibility, (n,)."""
        return np.argmax(self.predict_proba(X), axis=1)

    @property
    def n_parameters(self) -> int:
        """Number of free parameters: K - 1 priors, K means and K symmetric covariances, without constant columns."""
        K, d = self.n_components, self.means_.shape[1] - len(self.degenerate_axes_)
        return K - 1 + K * d + K * d * (d + 1) // 2

    def bic(self, X: ArrayLike) -> float:
        """Return Bayes' information criterion ``-2 log L + p log n`` of ``X`` (n, d); lower is better."""
        X = self._checked(X, "bic")
        return float(-2.0 * len(X) * self.score(X) + self.n_parameters * np.log(len(X)))

    def aic(self, X: ArrayLike) -> float:
        """Return Akaike's information criterion ``-2 log L + 2 p`` of ``X`` (n, d); lower is better."""
        X = self._checked(X, "aic")
        return float(-2.0 * len(X) * self.score(X) + 2.0 * self.n_parameters)

    def sample(self, n_samples: int = 1, random_state: int = 0) -> tuple[Array, NDArray[np.intp]]:
        """Draw samples.

        Args:
            n_samples: how many.
            random_state: seed.

        Returns:
            Samples (n_samples, d), and the index of each sample's component (n_samples,).

        Raises:
            InputError: when not fitted, or an argument is not a whole number in range.
        """
        n_samples = whole_number(n_samples, "GaussianMixture.sample: n_samples", at_least=0, at_most=100_000_000)
        random_state = whole_number(random_state, "GaussianMixture.sample: random_state", at_least=0)
        if not hasattr(self, "means_"):
            raise InputError("GaussianMixture.sample: not fitted yet; call fit first")
        rng = np.random.default_rng(random_state)
        components = rng.choice(self.n_components, size=n_samples, p=self.weights_)
        noise = rng.standard_normal((n_samples, self.means_.shape[1], 1))
        factors = np.linalg.cholesky(self.covariances_)
        return self.means_[components] + (factors[components] @ noise)[..., 0], components


def _in_units(
    means: Array, covariances: Array, center: Array, scale: Array, moves: NDArray[np.bool_], fixed_std: Array
) -> tuple[Array, Array]:
    """Return means and covariances in the units of the samples, including the constant columns."""
    K = len(means)
    all_means = np.repeat(center[None], K, axis=0)
    all_means[:, moves] += means * scale[moves]
    all_covariances = np.repeat(np.diag(fixed_std**2)[None], K, axis=0)
    active = np.flatnonzero(moves)
    all_covariances[np.ix_(np.arange(K), active, active)] = covariances * scale[moves][:, None] * scale[moves]
    return all_means, all_covariances


def _table(X: ArrayLike, what: str) -> Array:
    """Return ``X`` as a table of finite numbers (n, d)."""
    table = real_array(X, (None, None), f"{what}: X")
    if table.shape[1] < 1:
        raise InputError(f"{what}: X must have at least one column, got shape {table.shape}")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise InputError(f"{what}: row {int(np.flatnonzero(bad)[0])} of X is not finite; remove or repair it")
    return table


def _responsibilities_by_seeds(Z: Array, n_components: int, rng: np.random.Generator, n_lloyd: int = 5) -> Array:
    """Return the responsibilities (K, n) of k-means++ (Arthur and Vassilvitskii 2007) and a few Lloyd iterations."""
    seeds = Z[rng.integers(len(Z), size=1)]
    nearest = np.sum((Z - seeds[0]) ** 2, axis=1)
    while len(seeds) < n_components:
        total = nearest.sum()
        pick = rng.choice(len(Z), size=1, p=nearest / total if total > 0.0 else None)
        seeds = np.concatenate([seeds, Z[pick]])
        nearest = np.minimum(nearest, np.sum((Z - Z[pick]) ** 2, axis=1))
    for _ in range(n_lloyd):
        labels = np.argmin(np.sum(seeds**2, axis=1)[:, None] - 2.0 * seeds @ Z.T, axis=0)
        members = np.asarray(labels == np.arange(n_components)[:, None], dtype=float)
        number = members.sum(axis=1, keepdims=True)
        seeds = np.where(number > 0.0, members @ Z / np.maximum(number, 1.0), seeds)
    return members
