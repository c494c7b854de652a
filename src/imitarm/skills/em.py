"""Expectation maximisation (EM) of Gaussian mixtures: many fits side by side, and the responsibilities to start from.

The logarithm of a weighted Gaussian is linear in the quadratic features ``phi(z) = [1, z_i, z_i z_j (i <= j)]``::

    log pi_k N(z; mu_k, Sigma_k) = theta_k . phi(z)

so all log-densities are one matrix product ``theta @ phi``, and all sufficient statistics are another one,
``responsibilities @ phi^T``. There is no loop over components or samples. Written as a symmetric matrix, the
statistics of one component are the second moments of ``[1; z]``, and its inverse holds all parts of ``theta_k``
(``P = Sigma^-1``)::

    M = [1     mu^T             ]     M^-1 = [1 + mu^T P mu   -mu^T P]     det M = det Sigma
        [mu    Sigma + mu mu^T  ]            [-P mu            P     ]

Fits that differ only in their start or in their samples (restarts, folds of a cross-validation) are further rows of
the same two products. The samples must be standardised (each column with mean 0 and standard deviation 1), so that the
sums of squares are well conditioned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LOG_2PI = float(np.log(2.0 * np.pi))
_SLOTS = 40  # least number of equal time slots that segments are made of; 4 per component if that is more
_EDGE = 1e-4  # of a slot: rounding must not move a time that lies on an edge into the other slot
_SOFT = 1e-6  # variance added to a segment, relative to the columns', so that a straight one costs a finite amount
_EVEN = 0.05  # weight of the squared lengths; a sample costs about 10. It makes lengths equal where the data allow it
_NOTHING = -45.0  # exp(-45) vanishes beside 1 in double precision; np.exp is slow for much smaller numbers


class Fit(NamedTuple):
    """The result of :func:`expectation_maximisation`, for each of ``B`` fits.

    Attributes:
        weights: priors pi, shape (B, K).
        moments: second moments of [1; z], the matrix M in the docstring of this module, shape (B, K, d + 1, d + 1).
        theta: weights of the quadratic features, shape (B, K, F), F = (d + 1) (d + 2) / 2.
        log_likelihood: mean log-likelihood per sample at exactly these parameters, shape (B,).
        converged: whether its last change was below the tolerance, shape (B,).
        n_iter: number of iterations, the same for all fits.
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
    """Return the maps between a symmetric (size, size) matrix and its packed upper triangle.

    Returns:
        The indices of the packed numbers in the flat matrix, the (size, size) indices of each entry in the packed
        numbers, and the factors of the packed numbers in ``-[1; z]^T M^-1 [1; z] / 2``.
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
    # The smallest eigenvalue is at least 1 / trace(P), so most iterations need no eigenvalues at all. A negative
    # eigenvalue, which only rounding can cause, makes a number on the diagonal of P negative.
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
        Responsibilities (B, K, n), in the memory of ``log_density``, and log-likelihoods of the samples (B, n).
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
        responsibilities: of the start, shape (B, K, n).
        sample_weights: weight of each sample in each fit, shape (B, n); 0 leaves it out. None: 1 for all.
        floor: smallest eigenvalue of a covariance, in squared standard deviations of the columns.
        tol: stop when the mean log-likelihood per sample changes by less, in every fit.
        max_iter: most iterations.
    """
    fraction = None if sample_weights is None else sample_weights / sample_weights.sum(axis=1, keepdims=True)
    last = np.full(len(responsibilities), -np.inf)
    n_iter = 0
    while True:
        n_iter += 1
        if sample_weights is not None:
            responsibilities = responsibilities * sample_weights[:, None]
        weights, moments, theta = _maximise(features, responsibilities, floor)
        responsibilities, by_sample = normalise(log_densities(theta, features))
        likelihood = by_sample.mean(axis=1) if fraction is None else (by_sample * fraction).sum(axis=1)
        converged = np.abs(likelihood - last) < tol
        if converged.all() or n_iter >= max_iter:
            return Fit(weights, moments, theta, likelihood, converged, n_iter)
        last = likelihood


def responsibilities_by_segments(features: Array, column: Array, numbers: Sequence[int]) -> list[Array]:
    """Divide time into the K segments that Gaussians describe best, for several K at once.

    The span of ``column`` is divided into slots of equal length. A segment with n of the N samples and covariance Sigma
    costs ``n (log det Sigma / 2 - log(n / N))``, the negative log-likelihood under a Gaussian of its own, plus a small
    amount for its squared length, so that lengths are equal where the data allow it. Dynamic programming over the slots
    finds the cheapest division for every K up to the largest. It is deterministic, and EM needs fewer iterations from
    there than from equal bins.

    Args:
        features: of the standardised samples, shape (F, n).
        column: times of the samples, shape (n,).
        numbers: the numbers K of segments.

    Returns:
        Responsibilities of 0 or 1, shape (K, n), in the order of time, for each K. Equal bins where a division into
        slots is impossible (few samples, or gaps in time).
    """
    most = max(numbers)
    n_slots = max(_SLOTS, 4 * most)
    low, high = column.min(), column.max()
    slots = (column - low) * (n_slots / max(high - low, 1e-300)) + _EDGE
    slot = np.minimum(slots.astype(np.intp), n_slots - 1)
    sums = np.asarray(slot == np.arange(n_slots)[:, None], dtype=float) @ features.T
    cumulative = np.concatenate([np.zeros((1, len(features))), np.cumsum(sums, axis=0)])
    first, last = np.triu_indices(n_slots + 1, 1)
    cost = np.full((n_slots + 1, n_slots + 1), np.inf)
    evenly = _EVEN * len(column) * ((last - first) / n_slots) ** 2
    cost[first, last] = _segment_costs(cumulative[last] - cumulative[first], len(column)) + evenly
    cheapest = cost[0]
    came_from: list[NDArray[np.intp]] = []
    answers: dict[int, Array | None] = {}
    for k in range(1, most + 1):
        if k in numbers:
            answers[k] = _cut(slot, came_from, n_slots) if np.isfinite(cheapest[-1]) else None
        totals = cheapest[:, None] + cost
        came_from.append(np.argmin(totals, axis=0))
        cheapest = totals.min(axis=0)
    return [responsibilities_by_bins(column, k) if (cut := answers[k]) is None else cut for k in numbers]


def _segment_costs(statistics: Array, n_samples: int) -> Array:
    """Return the costs of segments with these sums of features, inf for those of too few samples."""
    number = statistics[:, 0]
    size = round(float(np.sqrt(8 * statistics.shape[1] + 1) - 1) / 2)
    moments = (statistics / np.maximum(number, 1.0)[:, None]).take(packing(size)[1], axis=-1)
    diagonal = np.arange(1, size)
    moments[:, diagonal, diagonal] += _SOFT
    moments[:, 0, 0] = 1.0
    log_det = np.linalg.slogdet(moments)[1]
    costs = number * (0.5 * log_det - np.log(np.maximum(number, 1.0) / n_samples))
    return np.where(number >= 2 * size, costs, np.inf)


def _cut(slot: NDArray[np.intp], came_from: list[NDArray[np.intp]], n_slots: int) -> Array:
    """Follow the cheapest division back from the last slot and return its responsibilities (K, n)."""
    borders = [n_slots]
    for back in reversed(came_from):
        borders.append(int(back[borders[-1]]))
    labels = np.searchsorted(borders[::-1], np.arange(n_slots), side="right")
    return np.asarray(labels[slot] == np.arange(len(came_from) + 1)[:, None], dtype=float)


def responsibilities_by_bins(column: Array, n_bins: int) -> Array:
    """Return responsibilities of 0 or 1, shape (K, n), of bins of one column, in order.

    The bins have equal widths, or equal numbers of samples when a bin would hold fewer than two.
    """
    low, high = column.min(), column.max()
    labels = np.minimum(((column - low) * (n_bins / max(high - low, 1e-300)) + _EDGE).astype(np.intp), n_bins - 1)
    if np.bincount(labels, minlength=n_bins).min() < 2:
        order = np.argsort(column, kind="stable")
        labels = np.empty(len(column), dtype=np.intp)
        labels[order] = np.arange(len(column)) * n_bins // len(column)
    return np.asarray(labels == np.arange(n_bins)[:, None], dtype=float)


def responsibilities_by_seeds(Z: Array, n_components: int, rng: np.random.Generator, n_lloyd: int = 5) -> Array:
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
