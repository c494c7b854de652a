"""The number of components: BIC, AIC, the error on left-out demonstrations, and the bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills.em import Fit, expectation_maximisation, quadratic_features, responsibilities_by_segments

Array = NDArray[np.float64]

NUMBERS = tuple(range(2, 17))
MORE_NUMBERS = (20, 25, 32, 40, 50, 64, 80, 100, 128)  # tried while the bias is large: long motions with many bends
_SAMPLES = 100  # per demonstration, for a motion whose path is up to 3 times its extent; in proportion for longer paths
_MOST_SAMPLES = 1000
_HELD_OUT = 1.02  # times the smallest held-out error
_BIAS = 0.1  # of the smallest held-out error
_NO_MOTION = 1e-6  # [m]
_LEVER = 0.1  # [m] where only the rotation moves, errors are those of a point at this distance
_SLACK_MM = 0.1  # below the repeatability of industrial arms
_PATIENCE = 4  # stop after so many numbers in a row without a smaller held-out error
_BETTER = 0.995  # times the smallest so far
_LARGE_BIAS = 0.01  # of the motion's extent: above it, more numbers are tried


@dataclass(frozen=True)
class Candidate:
    """One number of components, evaluated.

    Attributes:
        n_components: the number K.
        bic: Bayes' information criterion; lower is better.
        aic: Akaike's information criterion; lower is better.
        held_out_rmse_mm: distance between a demonstration and the mean learned from all the others, root mean square
            over the samples and over all choices of that demonstration [mm]; NaN with one demonstration.
        bias_rmse_mm: distance between the learned mean and the average of the demonstrations at the same times, root
            mean square [mm].
    """

    n_components: int
    bic: float
    aic: float
    held_out_rmse_mm: float
    bias_rmse_mm: float


def choose(candidates: Sequence[Candidate]) -> int:
    """Return the number of components to use.

    It is the smallest K

    * whose held-out error is within 2 % (or 0.1 mm) of the smallest, so it generalises as well as any, and
    * whose bias is at most a tenth of the smallest held-out error (or 0.1 mm), so the bias is small beside the
      differences between demonstrations. The held-out error alone hardly shows such a bias, because squares add.

    If no K meets both, it is the smallest K that generalises and whose bias is within a tenth of the smallest bias
    among those. BIC alone keeps growing with K on data over time, because neighbouring samples are not independent. It
    decides only when there is one demonstration, because then none can be left out.
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

    For each, the fit to all demonstrations and the fits that leave one out run side by side, as rows of the same
    matrix products. A part of the samples is used, more of them the longer the path is. Where only the rotation moves,
    errors are those of a point 100 mm away. Larger numbers are not tried
    when four in a row brought no smaller held-out error (by 0.5 %) and a good one (:func:`choose`) was found.

    Args:
        tables: samples [t, x, y, z, ...] of each demonstration, over the same span of time.
        numbers: numbers K to try.
        min_std: smallest standard deviations that count as motion, one per column.
        reg_covar: smallest eigenvalue of a covariance relative to the variances of the columns.
        more: numbers to try, in this order, while every bias so far is above 1 % of the motion's extent.

    Raises:
        InputError: when there are fewer samples than the smallest number.
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
        bias = (_regression(fit, np.zeros(len(grid), dtype=np.intp), grid, places) - plain_mean) * size
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
        if min(c.bias_rmse_mm for c in evaluated) <= max(_SLACK_MM, _LARGE_BIAS * extent):
            break
        evaluated.append(evaluate(k, responsibilities_by_segments(features, samples[:, 0], [k])[0]))
    return tuple(evaluated)


def _enough(evaluated: Sequence[Candidate]) -> bool:
    errors = [c.held_out_rmse_mm for c in evaluated]
    if len(errors) <= _PATIENCE or min(errors[-_PATIENCE:]) < _BETTER * min(errors[:-_PATIENCE]):
        return False
    return any(_good(c, min(errors)) for c in evaluated)


def _samples_needed(tables: Sequence[Array]) -> int:
    """Return how many samples per demonstration show the motion."""
    grid = np.linspace(tables[0][0, 0], tables[0][-1, 0], 4 * _SAMPLES)
    mean = np.mean([_resampled(table, np.arange(1, table.shape[1]), grid) for table in tables], axis=0)
    only_rotates = mean.shape[1] > 3 and np.ptp(mean[:, :3], axis=0).max() < _NO_MOTION
    mean = _LEVER * mean[:, 3:] if only_rotates else mean[:, :3]
    extent = float(np.linalg.norm(np.ptp(mean, axis=0)))
    path = float(np.linalg.norm(np.diff(mean, axis=0), axis=1).sum())
    needed = _SAMPLES * path / (3.0 * extent) if extent > 0.0 else 0.0
    return int(np.clip(needed, _SAMPLES, _MOST_SAMPLES))


def _thinned(table: Array, n: int) -> Array:
    if len(table) <= n:
        return table
    return table[np.round(np.linspace(0, len(table) - 1, n)).astype(int)]


def _resampled(Z: Array, places: NDArray[np.intp], grid: Array) -> Array:
    return np.array([np.interp(grid, Z[:, 0], Z[:, c]) for c in places]).reshape(len(places), -1).T


def _regression(fit: Fit, which: NDArray[np.intp], t: Array, places: NDArray[np.intp]) -> Array:
    """Return the mean of some columns at standardised times (n,), each from the fit numbered ``which`` (n,)."""
    means, covariances = fit.means, fit.covariances
    variance = covariances[:, :, 0, 0]
    slopes = covariances[:, :, 0, :] / variance[..., None]
    offset = t[:, None] - means[which, :, 0]
    log_h = np.log(fit.weights[which]) - 0.5 * (np.log(variance[which]) + offset**2 / variance[which])
    h = np.exp(log_h - log_h.max(axis=1, keepdims=True))
    h /= h.sum(axis=1, keepdims=True)
    pieces = means[which][..., places] + offset[..., None] * slopes[which][..., places]
    return np.asarray((h[:, None, :] @ pieces)[:, 0])
