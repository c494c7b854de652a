"""Fitting Gaussian mixtures: initialisation, expectation maximisation (EM), and the number of components.

The logarithm of a weighted Gaussian is linear in the quadratic features ``phi(z) = [1, z_i, z_i z_j (i <= j)]``::

    log pi_k N(z; mu_k, Sigma_k) = theta_k . phi(z)

Therefore, one matrix product, ``theta @ phi``, computes all log-densities. A second matrix product, ``responsibilities
@ phi^T``, computes all sufficient statistics. The statistics of one component form a symmetric matrix M, the second
moments of ``[1; z]``. With ``P = Sigma^-1``, the inverse of M contains all parts of ``theta_k``::

    M = [1     mu^T             ]     M^-1 = [1 + mu^T P mu   -mu^T P]     det M = det Sigma
        [mu    Sigma + mu mu^T  ]            [-P mu            P     ]

Some fits differ only in their start (restarts) or in their samples (folds of a cross-validation). The two matrix
products compute all of these fits together. The samples must be standardised (each column with mean 0 and standard
deviation 1), so that the sums of squares are well conditioned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills.path_length import relative_length, turning

Array = NDArray[np.float64]
LOG_2PI = float(np.log(2.0 * np.pi))
_SLOTS = 40  # least number of equal time slots that segments are made of; 4 per component if that is more
_EDGE = 1e-4  # of a slot: rounding must not move a time that lies on an edge into the other slot
_SOFT = 1e-6  # variance added to a segment, relative to the columns', so that a straight one costs a finite amount
_EVEN = 0.05  # weight of the squared lengths; a sample costs about 10. It makes lengths equal where the data allow it
_NOTHING = -45.0  # exp(-45) vanishes beside 1 in double precision; np.exp is slow for much smaller numbers
NUMBERS = tuple(range(2, 17))
MORE_NUMBERS = (20, 25, 32, 40, 50, 64, 80, 100, 128)  # tried while the bias is large: long motions with many bends
_SAMPLES = 100  # per demonstration, for a path up to 3 times as long as its extent that turns by up to 3 circles
_TURNING = 6.0 * np.pi  # [rad]
_MOST_SAMPLES = 1000
_HELD_OUT = 1.02  # times the smallest held-out error
_BIAS = 0.1  # of the smallest held-out error
_NO_MOTION = 1e-6  # [m]
_LEVER = 0.1  # [m] where only the rotation moves, errors are those of a point at this distance
_SLACK_MM = 0.1  # below the repeatability of industrial arms
_PATIENCE = 4  # stop after so many numbers in a row without a smaller held-out error
_BETTER = 0.995  # times the smallest so far
_LENGTH = 0.95  # of the motion's length: below it, more numbers are tried
_LARGE_BIAS = 0.01  # of the motion's extent: above it, more numbers are tried


class Fit(NamedTuple):
    """The result of :func:`expectation_maximisation`, for each of ``B`` fits.

    Attributes:
        weights: priors pi, shape (B, K).
        moments: the matrix M of the module's docstring, which holds the second moments of [1; z], shape (B, K, d + 1, d
            + 1).
        theta: weights of the quadratic features, shape (B, K, F), F = (d + 1) (d + 2) / 2.
        log_likelihood: mean log-likelihood per sample at exactly these parameters, shape (B,).
        converged: whether the last change of ``log_likelihood`` was below the tolerance, shape (B,).
        n_iter: number of iterations, which is the same for all fits.
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
    """Return index arrays that convert between a symmetric (size, size) matrix and its packed upper triangle.

    Returns:
        Three arrays. The first array gives the index of each packed number in the flat matrix. The second array, of
        shape (size, size), gives the index of each matrix entry among the packed numbers. The third array gives the
        factor of each packed number in ``-[1; z]^T M^-1 [1; z] / 2``.
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
    """Return responsibilities (B, K, n), which overwrite ``log_density``, and the samples' log-likelihoods (B, n)."""
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
    """Fit ``B`` mixtures at the same time.

    Args:
        features: :func:`quadratic_features` of the standardised samples, shape (F, n).
        responsibilities: initial responsibilities, shape (B, K, n).
        sample_weights: weight of each sample in each fit, shape (B, n); 0 excludes the sample. None: all 1.
        floor: smallest permitted eigenvalue of a covariance, in squared standard deviations of the columns.
        tol: the iterations stop when the mean log-likelihood per sample changes by less than this in every fit.
        max_iter: largest number of iterations.
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
    """Divide time into K segments so that one Gaussian describes each segment well, for several K at once.

    The range of ``column`` is divided into equal slots. The cost of a segment is its negative log-likelihood under a
    separate Gaussian, ``n (log det Sigma / 2 - log(n / N))``. The segment has n of the N samples and the covariance
    Sigma. A small additional cost for the squared length of each segment makes the lengths equal if the samples do not
    determine them. Dynamic programming over the slots finds the cheapest division for every K up to the largest. The
    result is deterministic. EM that starts from this result needs fewer iterations than EM that starts from equal bins.

    Args:
        features: :func:`quadratic_features` of the standardised samples, shape (F, n).
        column: times of the samples, shape (n,).
        numbers: values of K; for each of them, the function returns one division.

    Returns:
        One array for each K: responsibilities of 0 or 1, shape (K, n), with the segments in the order of time. If there
        are too few samples or gaps in time, the segments are equal bins.
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
    """Return the costs of segments, given their sums of features; inf for segments with too few samples."""
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
    """Return the responsibilities (K, n) of the cheapest division into K segments, traced back from the last slot."""
    borders = [n_slots]
    for back in reversed(came_from):
        borders.append(int(back[borders[-1]]))
    labels = np.searchsorted(borders[::-1], np.arange(n_slots), side="right")
    return np.asarray(labels[slot] == np.arange(len(came_from) + 1)[:, None], dtype=float)


def responsibilities_by_bins(column: Array, n_bins: int) -> Array:
    """Return responsibilities of 0 or 1, shape (K, n), for bins of equal width.

    If a bin would have fewer than two samples, all bins get nearly the same number of samples instead.
    """
    low, high = column.min(), column.max()
    labels = np.minimum(((column - low) * (n_bins / max(high - low, 1e-300)) + _EDGE).astype(np.intp), n_bins - 1)
    if np.bincount(labels, minlength=n_bins).min() < 2:
        order = np.argsort(column, kind="stable")
        labels = np.empty(len(column), dtype=np.intp)
        labels[order] = np.arange(len(column)) * n_bins // len(column)
    return np.asarray(labels == np.arange(n_bins)[:, None], dtype=float)


@dataclass(frozen=True)
class Candidate:
    """Errors and information criteria of the fit with one number of components.

    Attributes:
        n_components: the number K.
        bic: Bayes' information criterion; lower is better.
        aic: Akaike's information criterion; lower is better.
        held_out_rmse_mm: root mean square distance between each demonstration and the mean learned from all other
            demonstrations [mm]; NaN with one demonstration.
        bias_rmse_mm: root mean square distance between the learned mean and the average of the demonstrations at equal
            times [mm].
    """

    n_components: int
    bic: float
    aic: float
    held_out_rmse_mm: float
    bias_rmse_mm: float


def choose(candidates: Sequence[Candidate]) -> int:
    """Return the number of components to use.

    The function returns the smallest K that meets two conditions:

    * The held-out error of K is within 2 % (or 0.1 mm) of the smallest held-out error, so K generalises as well as any
      other number.
    * The bias of K is at most a tenth of the smallest held-out error (or 0.1 mm), so the bias is small. The second
      condition is necessary because the held-out error hardly shows a bias. The squared held-out error is the sum of
      the squared bias and the squared differences between demonstrations, which are much larger.

    If no K meets both conditions, only the K that meet the first condition are compared. The result is the smallest of
    these K whose bias exceeds their lowest bias by at most 10 %.

    A held-out error needs at least two demonstrations. With a single demonstration, the K with the lowest BIC is
    returned. Otherwise, BIC is not used: it prefers too large K for time series, whose neighbouring samples are not
    independent.
    """
    ordered = sorted(candidates, key=lambda c: c.n_components)
    if any(np.isnan(c.held_out_rmse_mm) for c in ordered):
        return min(ordered, key=lambda c: c.bic).n_components
    least = min(c.held_out_rmse_mm for c in ordered)
    general = [c for c in ordered if _generalises(c, least)]
    floor = (1.0 + _BIAS) * min(c.bias_rmse_mm for c in general)
    settled = next(c for c in general if c.bias_rmse_mm <= floor)
    return next((c for c in general if _good(c, least)), settled).n_components


def _generalises(candidate: Candidate, least: float) -> bool:
    return candidate.held_out_rmse_mm <= max(_HELD_OUT * least, least + _SLACK_MM)


def _good(candidate: Candidate, least: float) -> bool:
    return _generalises(candidate, least) and candidate.bias_rmse_mm <= max(_BIAS * least, _SLACK_MM)


def try_numbers_of_components(
    tables: Sequence[Array], numbers: Sequence[int], min_std: Array, reg_covar: float, more: Sequence[int] = ()
) -> tuple[Candidate, ...]:
    """Evaluate several numbers of components.

    For each number, one fit uses all demonstrations, and each further fit leaves out one demonstration. These fits are
    computed together. They use a subset of the samples; a longer path needs more samples. If the tool only rotates,
    errors are computed for a point 100 mm from the axis of rotation. The search stops when two conditions are met. Four
    consecutive numbers of components have not reduced the held-out error by 0.5 %. One of the tried numbers meets both
    conditions of :func:`choose`.

    Args:
        tables: samples [t, x, y, z, ...] of each demonstration, over the same span of time.
        numbers: numbers K of components to try.
        min_std: one value for each column, in the column's unit. A column with at most this standard deviation counts
            as constant.
        reg_covar: lower bound of the eigenvalues of a covariance, relative to the variances of the columns.
        more: further numbers to try in this order. The search ends when a fit has a bias of at most 1 % of the motion's
            extent and a learned path has at least 95 % of the motion's length.

    Raises:
        InputError: when there are fewer samples than the smallest number of components.
    """
    n_samples = _samples_needed(tables)
    tables = [_thinned(table, n_samples) for table in tables]
    samples = np.concatenate(tables)
    fewest = len(samples) - (max(len(table) for table in tables) if len(tables) > 1 else 0)
    numbers = sorted({int(k) for k in numbers})
    possible = [k for k in numbers if 2 * k <= fewest] or numbers[:1]
    if possible[0] > fewest:
        raise InputError(
            f"GMR: {fewest} samples are too few for {possible[0]} components; record more, or use fewer components"
        )
    moves = samples.std(axis=0) > min_std
    moves[0] = True
    center, scale = samples[:, moves].mean(axis=0), samples[:, moves].std(axis=0)
    Z = (samples[:, moves] - center) / scale
    features = quadratic_features(Z)
    owner = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    seen = np.ones((1, len(samples)))
    if len(tables) > 1:
        seen = np.concatenate([seen, owner != np.arange(len(tables))[:, None]])
    columns = np.flatnonzero(moves)
    lever = 1.0
    places = np.flatnonzero((columns >= 1) & (columns <= 3))  # columns of Z that hold positions
    if not len(places):  # only the rotation moves: a point at a distance moves with it
        lever, places = _LEVER, np.flatnonzero(columns >= 4)
    grid = np.linspace(Z[:, 0].min(), Z[:, 0].max(), n_samples)
    plain_mean = np.mean([_resampled(Z[owner == i], places, grid) for i in range(len(tables))], axis=0)
    still = float(np.sum(samples[:, 1:4][:, ~moves[1:4]].var(axis=0)))
    size = 1e3 * lever * scale[places]  # back to mm
    extent = float(np.linalg.norm(np.ptp(plain_mean * size, axis=0)))

    lengths: list[float] = []

    def evaluate(k: int, cut: Array) -> Candidate:
        start = np.repeat(cut[None], len(seen), axis=0)
        fit = expectation_maximisation(features, start, seen, floor=reg_covar, tol=1e-3, max_iter=50)
        likelihood = len(samples) * float(fit.log_likelihood[0] - np.log(scale).sum())
        d = Z.shape[1]
        parameters = k - 1 + k * d + k * d * (d + 1) // 2
        error = np.nan
        if len(tables) > 1:
            held_out = (_regression(fit, owner + 1, Z[:, 0], places) - Z[:, places]) * size
            error = np.sqrt(np.mean(np.sum(held_out**2, axis=1)) + 1e6 * still)
        mean = _regression(fit, np.zeros(len(grid), dtype=np.intp), grid, places)
        lengths.append(relative_length(mean * size, plain_mean * size))
        bias = (mean - plain_mean) * size
        return Candidate(
            k,
            bic=-2.0 * likelihood + parameters * float(np.log(len(samples))),
            aic=-2.0 * likelihood + 2.0 * parameters,
            held_out_rmse_mm=float(error),
            bias_rmse_mm=float(np.sqrt(np.mean(np.sum(bias**2, axis=1)))),
        )

    evaluated: list[Candidate] = []
    for k, cut in zip(possible, responsibilities_by_segments(features, samples[:, 0], possible), strict=True):
        evaluated.append(evaluate(k, cut))
        if len(tables) > 1 and _enough(evaluated):
            break
    for k in (k for k in more if 2 * k <= fewest):
        near = min(c.bias_rmse_mm for c in evaluated) <= max(_SLACK_MM, _LARGE_BIAS * extent)
        if near and max(lengths) >= _LENGTH:
            break
        evaluated.append(evaluate(k, responsibilities_by_segments(features, samples[:, 0], [k])[0]))
    return tuple(evaluated)


def _enough(evaluated: Sequence[Candidate]) -> bool:
    errors = [c.held_out_rmse_mm for c in evaluated]
    if len(errors) <= _PATIENCE or min(errors[-_PATIENCE:]) < _BETTER * min(errors[:-_PATIENCE]):
        return False
    return any(_good(c, min(errors)) for c in evaluated)


def _samples_needed(tables: Sequence[Array]) -> int:
    """Return how many samples per demonstration are enough to represent the motion."""
    grid = np.linspace(tables[0][0, 0], tables[0][-1, 0], 4 * _SAMPLES)
    mean = np.mean([_resampled(table, np.arange(1, table.shape[1]), grid) for table in tables], axis=0)
    only_rotates = mean.shape[1] > 3 and np.ptp(mean[:, :3], axis=0).max() < _NO_MOTION
    mean = _LEVER * mean[:, 3:] if only_rotates else mean[:, :3]
    extent = float(np.linalg.norm(np.ptp(mean, axis=0)))
    path = float(np.linalg.norm(np.diff(mean, axis=0), axis=1).sum())
    needed = _SAMPLES * max(path / (3.0 * extent), turning(mean) / _TURNING) if extent > 0.0 else 0.0
    return int(np.clip(needed, _SAMPLES, _MOST_SAMPLES))


def _thinned(table: Array, n: int) -> Array:
    if len(table) <= n:
        return table
    return table[np.round(np.linspace(0, len(table) - 1, n)).astype(int)]


def _resampled(Z: Array, places: NDArray[np.intp], grid: Array) -> Array:
    return np.array([np.interp(grid, Z[:, 0], Z[:, c]) for c in places]).reshape(len(places), -1).T


def _regression(fit: Fit, which: NDArray[np.intp], t: Array, places: NDArray[np.intp]) -> Array:
    """Return the means of some columns at standardised times (n,); ``which`` (n,) is the fit to use at each time."""
    means, covariances = fit.means, fit.covariances
    variance = covariances[:, :, 0, 0]
    slopes = covariances[:, :, 0, :] / variance[..., None]
    offset = t[:, None] - means[which, :, 0]
    log_h = np.log(fit.weights[which]) - 0.5 * (np.log(variance[which]) + offset**2 / variance[which])
    h = np.exp(log_h - log_h.max(axis=1, keepdims=True))
    h /= h.sum(axis=1, keepdims=True)
    pieces = means[which][..., places] + offset[..., None] * slopes[which][..., places]
    return np.asarray((h[:, None, :] @ pieces)[:, 0])
