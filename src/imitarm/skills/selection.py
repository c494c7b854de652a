"""How many components: BIC, AIC, and the error on a demonstration that was not learnt from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills.em import Fit, expectation_maximisation, quadratic_features
from imitarm.skills.starts import responsibilities_by_segments

Array = NDArray[np.float64]

_SAMPLES = 100  # a demonstration: neighbouring samples of a fast recorder tell nothing new about K
_HELD_OUT = 1.02  # times the best held-out error
_BIAS = 0.1  # of the best held-out error
_SLACK_MM = 0.1  # below the repeatability of industrial arms
_PATIENCE = 4  # stop after so many numbers in a row without a better held-out error
_BETTER = 0.995  # times the best so far


@dataclass(frozen=True)
class Candidate:
    """One number of components, judged.

    Attributes:
        n_components: the number K.
        bic: Bayes' information criterion, lower is better.
        aic: Akaike's information criterion, lower is better.
        held_out_rmse_mm: distance between a demonstration and the mean learnt from all the others, root mean square
            over samples and over all choices of that demonstration [mm]; nan with one demonstration only.
        bias_rmse_mm: distance between the learnt mean and the plain mean of the demonstrations at the same instants,
            root mean square [mm].
    """

    n_components: int
    bic: float
    aic: float
    held_out_rmse_mm: float
    bias_rmse_mm: float


def choose(candidates: Sequence[Candidate]) -> int:
    """Return the number of components to use.

    The smallest K

    * whose held-out error is within 2 % of the best (or 0.1 mm): it generalises as well as any, and
    * whose bias is at most a tenth of the best held-out error (or 0.1 mm): what the regression rounds off is small
      beside what demonstrations differ by anyway. The held-out error alone hardly sees such a bias, because squares
      add.

    If no K does both, the bias has stopped falling above that: the smallest K that generalises with a bias within a
    tenth of the least bias that was reached. BIC alone keeps growing with K on data over time,
    because neighbouring samples are not independent (METHODS C); it decides only when there is one demonstration, so
    that nothing can be held out.
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
    tables: Sequence[Array], numbers: Sequence[int], min_std: Array, reg_covar: float
) -> tuple[Candidate, ...]:
    """Judge several numbers of components.

    For each, the fit to all demonstrations and the fits that hold one out run side by side, as rows of the same
    matrix products. At most 100 samples a demonstration are used. Larger numbers are not tried any more when four in
    a row brought no better held-out error (by 0.5 %) and a good one (:func:`choose`) was found.

    Args:
        tables: samples [t, x, y, z, ...] of each demonstration, over the same span of time.
        numbers: numbers K to try.
        min_std: smallest deviations that count as motion, one a column.
        reg_covar: smallest eigenvalue of a covariance relative to the variances of the columns.

    Raises:
        InputError: when there are fewer samples than the smallest number.
    """
    tables = [_thinned(table) for table in tables]
    samples = np.concatenate(tables)
    fewest = len(samples) - (max(len(table) for table in tables) if len(tables) > 1 else 0)
    numbers = sorted({int(k) for k in numbers})
    possible = [k for k in numbers if 2 * k <= fewest] or numbers[:1]
    if possible[0] > fewest:
        raise InputError(
            f"GMR: {fewest} samples are too few for {possible[0]} components; record more, or ask for less"
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
    places = np.flatnonzero(np.flatnonzero(moves) <= 3)[1:]  # columns of Z that hold positions
    grid = np.linspace(Z[:, 0].min(), Z[:, 0].max(), _SAMPLES)
    plain_mean = np.mean([_resampled(Z[owner == i], places, grid) for i in range(len(tables))], axis=0)
    still = float(np.sum(samples[:, 1:4][:, ~moves[1:4]].var(axis=0)))
    size = 1e3 * scale[places]  # back to mm
    judged: list[Candidate] = []
    for k, cut in zip(possible, responsibilities_by_segments(features, samples[:, 0], possible), strict=True):
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
        judged.append(
            Candidate(
                k,
                bic=-2.0 * likelihood + parameters * float(np.log(len(samples))),
                aic=-2.0 * likelihood + 2.0 * parameters,
                held_out_rmse_mm=float(error),
                bias_rmse_mm=float(np.sqrt(np.mean(np.sum(bias**2, axis=1)))),
            )
        )
        if len(tables) > 1 and _enough(judged):
            break
    return tuple(judged)


def _enough(judged: Sequence[Candidate]) -> bool:
    errors = [c.held_out_rmse_mm for c in judged]
    if len(errors) <= _PATIENCE or min(errors[-_PATIENCE:]) < _BETTER * min(errors[:-_PATIENCE]):
        return False
    return any(_good(c, min(errors)) for c in judged)


def _thinned(table: Array) -> Array:
    if len(table) <= _SAMPLES:
        return table
    return table[np.round(np.linspace(0, len(table) - 1, _SAMPLES)).astype(int)]


def _resampled(Z: Array, places: NDArray[np.intp], grid: Array) -> Array:
    return np.stack([np.interp(grid, Z[:, 0], Z[:, c]) for c in places], axis=1)


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
