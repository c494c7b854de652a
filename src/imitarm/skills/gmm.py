"""Gaussian mixture with full covariances."""

from __future__ import annotations

import warnings
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from imitarm.errors import InputError
from imitarm.skills.em import (
    LOG_2PI,
    expectation_maximisation,
    log_densities,
    normalise,
    quadratic_features,
)
from imitarm.skills.starts import responsibilities_by_seeds, responsibilities_by_segments

Array = NDArray[np.float64]

_CONSTANT = 1e-6  # a column whose deviation is below this share of its largest value holds rounding, not motion


class DegenerateAxisWarning(UserWarning):
    """A column does not move, so nothing can be learnt from it; it is kept apart from the others."""


def ellipsoid_scale(probability: float, n_dims: int) -> float:
    """Return how many standard deviations wide an ellipsoid is that holds ``probability`` of a Gaussian.

    The squared Mahalanobis distance of a Gaussian in ``n_dims`` dimensions is chi-square distributed with ``n_dims``
    degrees of freedom, so the semi-axes are ``scale * sqrt(eigenvalue)``: 1.960, 2.448, 2.796 for 95 % in 1, 2, 3
    dimensions (METHODS D.2). The one-dimensional 1.960 covers only 85 % in the plane and 72 % in space.

    Raises:
        InputError: when ``probability`` is not in [0, 1) or ``n_dims`` is below 1.
    """
    if not 0.0 <= probability < 1.0:
        raise InputError(f"ellipsoid_scale: probability must be at least 0 and below 1, got {probability!r}")
    if n_dims < 1:
        raise InputError(f"ellipsoid_scale: n_dims must be at least 1, got {n_dims!r}")
    return float(np.sqrt(2.0 * gammaincinv(0.5 * n_dims, probability)))


class GaussianMixture:
    r"""Mixture of Gaussians with full covariances, fitted by expectation maximisation.

    .. math::
        p(z) = \sum_k \pi_k N(z; \mu_k, \Sigma_k), \qquad
        h_k(z) = \frac{\pi_k N(z; \mu_k, \Sigma_k)}{\sum_j \pi_j N(z; \mu_j, \Sigma_j)}

        N_k = \sum_n h_k(z_n), \quad \pi_k = N_k / N, \quad \mu_k = \frac{1}{N_k} \sum_n h_k z_n, \quad
        \Sigma_k = \frac{1}{N_k} \sum_n h_k z_n z_n^T - \mu_k \mu_k^T

    (thesis 2.2.1, METHODS C). The names are those of scikit-learn. What differs:

    * Columns are standardised inside, so that the choice of units does not decide the result.
    * ``init="time"`` starts from the best cut of column 0 into K segments
      (:func:`~imitarm.skills.starts.responsibilities_by_segments`), deterministic and right for data [t; x].
    * A column that does not move (a planar task has a constant z) is kept apart: the other columns come out as
      though it were not there. It is named in ``degenerate_axes_`` and in a :class:`DegenerateAxisWarning`.

    Args:
        n_components: number K of Gaussians.
        reg_covar: smallest eigenvalue of a covariance, relative to the variances of the columns.
        n_init: number of starts; the best fit is kept. All but the first start from k-means++ seeds.
        init: how the first start is made: ``"time"`` (segments of column 0) or ``"kmeans++"``.
        min_std: smallest standard deviation of a column [the column's unit] that counts as motion, one number or one
            a column; it is also the deviation that a degenerate column is given.
        random_state: seed of the k-means++ starts and of nothing else.
        tol: stop when the mean log-likelihood per sample changes by less.
        max_iter: most iterations of one start.

    Attributes:
        weights_: priors, shape (K,).
        means_: shape (K, d).
        covariances_: shape (K, d, d).
        lower_bound_: mean log-likelihood per sample of the data fitted.
        converged_: whether the last change of ``lower_bound_`` was below ``tol``.
        n_iter_: number of iterations done.
        degenerate_axes_: indices of the columns that do not move.

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
        for name, value in {"n_components": n_components, "n_init": n_init, "max_iter": max_iter}.items():
            if not isinstance(value, int | np.integer) or value < 1:
                raise InputError(f"GaussianMixture: {name} must be a whole number of at least 1, got {value!r}")
        if not (np.isfinite(reg_covar) and reg_covar > 0.0):
            raise InputError(f"GaussianMixture: reg_covar must be above 0, got {reg_covar!r}")
        if not tol >= 0.0:
            raise InputError(f"GaussianMixture: tol must be at least 0, got {tol!r}")
        if init not in {"time", "kmeans++"}:
            raise InputError(f"GaussianMixture: init must be 'time' or 'kmeans++', got {init!r}")
        self.n_components = int(n_components)
        self.reg_covar = reg_covar
        self.n_init = n_init
        self.init = init
        self.min_std = np.asarray(min_std, dtype=float)
        self.random_state = random_state
        self.tol = tol
        self.max_iter = max_iter

    def fit(self, X: ArrayLike) -> Self:
        """Fit to samples ``X`` (n, d).

        Raises:
            InputError: when ``X`` is not a finite table, has fewer samples than components or less than 2, or no
                column of it moves.
        """
        X = _table(X, "GaussianMixture.fit")
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
                "they are kept constant and do not influence the others",
                DegenerateAxisWarning,
                stacklevel=2,
            )
        return self

    def _standardisation(self, X: Array) -> tuple[Array, Array, NDArray[np.bool_], Array]:
        """Return mean and deviation of the columns, which of them move, and the deviation given to those that don't."""
        center = X.mean(axis=0)
        scale = X.std(axis=0)
        largest = np.abs(X).max(axis=0)
        least = np.maximum(self.min_std, _CONSTANT * np.where(largest > 0.0, largest, 1.0))
        # deviation of the deviations from the mean: a large offset (an epoch stamp) is no reason to call time constant
        moves = scale > np.maximum(self.min_std, 1e-12 * np.maximum(largest, 1e-300))
        if not moves.any():
            raise InputError("GaussianMixture.fit: no column moves; there is nothing to learn from constant data")
        return center, scale, moves, least

    def _starts(self, features: Array, column: Array, Z: Array) -> Array:
        """Return the responsibilities (n_init, K, n) to start from."""
        rng = np.random.default_rng(self.random_state)
        starts = responsibilities_by_segments(features, column, [self.n_components]) if self.init == "time" else []
        while len(starts) < self.n_init:
            starts.append(responsibilities_by_seeds(Z, self.n_components, rng))
        return np.stack(starts)

    def _fixed_score(self, X: Array) -> Array:
        """Return the log-density (n,) of the columns that do not move."""
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
        """Return the most responsible component of each sample of ``X`` (n, d), shape (n,)."""
        return np.argmax(self.predict_proba(X), axis=1)

    @property
    def n_parameters(self) -> int:
        """Number of free parameters: K - 1 priors, K means, K symmetric covariances of the columns that move."""
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

        Returns:
            Samples (n_samples, d), and the component each was drawn from (n_samples,).
        """
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
    """Undo the standardisation, and put the columns that do not move back in."""
    K = len(means)
    all_means = np.repeat(center[None], K, axis=0)
    all_means[:, moves] += means * scale[moves]
    all_covariances = np.repeat(np.diag(fixed_std**2)[None], K, axis=0)
    active = np.flatnonzero(moves)
    all_covariances[np.ix_(np.arange(K), active, active)] = covariances * scale[moves][:, None] * scale[moves]
    return all_means, all_covariances


def _table(X: ArrayLike, what: str) -> Array:
    """Return ``X`` as a finite table of floats (n, d), or say what is wrong with it."""
    try:
        table = np.asarray(X, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: X is not a table of numbers ({error})") from error
    if table.ndim != 2 or table.shape[1] < 1:
        raise InputError(f"{what}: X must have shape (n, d), got {table.shape}")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise InputError(f"{what}: row {int(np.flatnonzero(bad)[0])} of X is not finite; remove or repair it")
    return table
