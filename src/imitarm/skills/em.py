"""Expectation maximisation of Gaussian mixtures, many fits side by side, without a loop over components or samples.

The logarithm of a weighted Gaussian is linear in the quadratic features ``phi(z) = [1, z_i, z_i z_j (i <= j)]``::

    log pi_k N(z; mu_k, Sigma_k) = theta_k . phi(z)

so that all log-densities are one matrix product ``theta @ phi``, and all sufficient statistics are another one,
``responsibilities @ phi^T``. Put into a symmetric matrix, the statistics of one component are the second moments of
``[1; z]``, and one inverse gives everything that ``theta_k`` needs (``P = Sigma^-1``)::

    M = [1     mu^T             ]     M^-1 = [1 + mu^T P mu   -mu^T P]     det M = det Sigma
        [mu    Sigma + mu mu^T  ]            [-P mu            P     ]

Fits that differ only in where they start or in which samples they may see (restarts, held-out folds) are further rows
of the same two products. Data are meant to be standardised (mean 0, deviation 1 of each column), which keeps the sums
of squares well conditioned.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LOG_2PI = float(np.log(2.0 * np.pi))
_NOTHING = -45.0  # exp(-45) is lost beside 1 in double precision; numbers far below make np.exp slow


class Fit(NamedTuple):
    """What :func:`expectation_maximisation` found, for each of ``B`` fits.

    Attributes:
        weights: priors pi, shape (B, K).
        moments: second moments of [1; z], the matrix M of the module's docstring, shape (B, K, d + 1, d + 1).
        theta: weights of the quadratic features, shape (B, K, F), F = (d + 1) (d + 2) / 2.
        log_likelihood: mean log-likelihood per sample at exactly these parameters, shape (B,).
        converged: whether its last change was below the tolerance, shape (B,).
        n_iter: number of iterations done (the fits run side by side).
    """

    weights: Array
    moments: Array
    theta: Array
    log_likelihood: Array
    converged: NDArray[np.bool_]
    n_iter: int

    @property
    def means(self) -> Array:
        """Means mu, shape (B, K, d)."""
        return self.moments[..., 0, 1:]

    @property
    def covariances(self) -> Array:
        """Covariances Sigma, shape (B, K, d, d)."""
        return self.moments[..., 1:, 1:] - self.means[..., :, None] * self.means[..., None, :]


@cache
def packing(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return how a symmetric (size, size) matrix and its packed upper triangle map to each other.

    Returns:
        Places of the packed numbers in the flat matrix, the (size, size) table of the way back, and the factors that
        ``-[1; z]^T M^-1 [1; z] / 2`` gives to the packed numbers.
    """
    i, j = np.triu_indices(size)
    unpack = np.empty((size, size), dtype=np.intp)
    unpack[i, j] = unpack[j, i] = np.arange(len(i))
    return i * size + j, unpack, np.where(i == j, -0.5, -1.0)


def quadratic_features(Z: Array) -> Array:
    """Return ``[1, z_i, z_i z_j]`` of standardised samples ``Z`` (n, d) as rows, shape (F, n)."""
    columns = np.concatenate([np.ones((1, len(Z))), Z.T])
    i, j = np.triu_indices(len(columns))
    return columns[i] * columns[j]


def _theta(weights: Array, moments: Array, floor: float) -> Array | None:
    """Return theta (B, K, F), or None when an eigenvalue of a covariance may be below ``floor``."""
    size = moments.shape[-1]
    pack, _, factors = packing(size)
    try:
        inverse = np.linalg.inv(moments)
    except np.linalg.LinAlgError:
        return None
    # The smallest eigenvalue is at least 1 / trace(P), so most iterations need no eigenvalues at all. A negative one,
    # which only rounding can make, shows on the diagonal of P as a negative number.
    diagonal = np.einsum("bkii->bki", inverse)[..., 1:]
    if not (diagonal.min() > 0.0 and diagonal.sum(axis=-1).max() < 1.0 / floor):
        return None
    theta = inverse.reshape(*inverse.shape[:2], size * size).take(pack, axis=-1) * factors
    log_det = np.linalg.slogdet(moments)[1]
    theta[..., 0] += np.log(weights) - 0.5 * log_det + (0.5 - 0.5 * (size - 1) * LOG_2PI)
    return np.asarray(theta)


def _floored(moments: Array, floor: float) -> Array:
    """Raise the eigenvalues of the covariances inside ``moments`` (B, K, d + 1, d + 1) to at least ``floor``."""
    means = moments[..., 0, 1:]
    outer = means[..., :, None] * means[..., None, :]
    values, vectors = np.linalg.eigh(moments[..., 1:, 1:] - outer)
    covariances = (vectors * np.maximum(values, floor)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    lifted = moments.copy()
    lifted[..., 1:, 1:] = 0.5 * (covariances + np.swapaxes(covariances, -1, -2)) + outer
    return lifted


def _maximise(features: Array, responsibilities: Array, floor: float) -> tuple[Array, Array, Array]:
    """M-step: weights, moments and theta from responsibilities (B, K, n)."""
    B, K, n = responsibilities.shape
    statistics = (responsibilities.reshape(B * K, n) @ features.T).reshape(B, K, -1)
    number = statistics[..., :1] + 1e-10  # a component that lost all its samples stays finite
    size = round(float(np.sqrt(8 * len(features) + 1) - 1) / 2)
    moments = (statistics / number).take(packing(size)[1], axis=-1)
    moments[..., 0, 0] = 1.0
    weights = number[..., 0] / number.sum(axis=1)
    theta = _theta(weights, moments, floor)
    if theta is None:
        moments = _floored(moments, floor)
        theta = _theta(weights, moments, 0.5 * floor / size)
        if theta is None:  # pragma: no cover - the floor makes every covariance positive definite
            raise FloatingPointError("a covariance is not positive definite although its eigenvalues were raised")
    return weights, moments, theta


def log_densities(theta: Array, features: Array) -> Array:
    """Return ``log pi_k N(z)``, shape (B, K, n), for feature weights (B, K, F) and features (F, n)."""
    B, K, F = theta.shape
    return (theta.reshape(B * K, F) @ features).reshape(B, K, -1)


def normalise(log_density: Array) -> tuple[Array, Array]:
    """Turn log-densities (B, K, n) into responsibilities, in place, by log-sum-exp over the components.

    Returns:
        Responsibilities (B, K, n), in the memory given, and log-likelihoods of the samples (B, n).
    """
    top = log_density.max(axis=1)
    ratio = np.subtract(log_density, top[:, None], out=log_density)
    np.maximum(ratio, _NOTHING, out=ratio)
    np.exp(ratio, out=ratio)
    total = ratio.sum(axis=1)
    ratio *= (1.0 / total)[:, None]
    return ratio, np.log(total) + top


def expectation_maximisation(
    features: Array,
    responsibilities: Array,
    sample_weights: Array | None = None,
    *,
    floor: float,
    tol: float,
    max_iter: int,
) -> Fit:
    """Fit ``B`` mixtures side by side.

    Args:
        features: :func:`quadratic_features` of the standardised samples, shape (F, n).
        responsibilities: where to start, shape (B, K, n).
        sample_weights: how often each sample counts in each fit, shape (B, n); 0 holds it out. None: once each.
        floor: smallest eigenvalue of a covariance, in squared standard deviations of the columns.
        tol: stop when the mean log-likelihood per sample changes by less, in every fit.
        max_iter: most iterations.
    """
    share = None if sample_weights is None else sample_weights / sample_weights.sum(axis=1, keepdims=True)
    last = np.full(len(responsibilities), -np.inf)
    n_iter = 0
    while True:
        n_iter += 1
        if sample_weights is not None:
            responsibilities = responsibilities * sample_weights[:, None]
        weights, moments, theta = _maximise(features, responsibilities, floor)
        responsibilities, by_sample = normalise(log_densities(theta, features))
        likelihood = by_sample.mean(axis=1) if share is None else (by_sample * share).sum(axis=1)
        converged = np.abs(likelihood - last) < tol
        if converged.all() or n_iter >= max_iter:
            return Fit(weights, moments, theta, likelihood, converged, n_iter)
        last = likelihood
