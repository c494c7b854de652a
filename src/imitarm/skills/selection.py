"""How many components: BIC, AIC, and the error on a demonstration that was not learnt from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills.em import Fit, expectation_maximisation, quadratic_features, responsibilities_by_bins

Array = NDArray[np.float64]

_SAMPLES = 100  # a demonstration: neighbouring samples of a fast recorder tell nothing new about K
_BIAS = 0.1  # of the best held-out error: what the mean may be off beyond what demonstrations differ anyway
_SLACK_MM = 0.1  # below the repeatability of industrial arms
_PATIENCE = 4  # stop after so many numbers in a row without a better one


@dataclass(frozen=True)
class Candidate:
    """One number of components, judged.

    Attributes:
        n_components: the number K.
        bic: Bayes' information criterion, lower is better.
        aic: Akaike's information criterion, lower is better.
        held_out_rmse_mm: distance between a demonstration and the mean learnt from all the others, root mean square
            over samples and over all choices of that demonstration [mm]; nan with one demonstration only.
    """

    n_components: int
    bic: float
    aic: float
    held_out_rmse_mm: float


def choose(candidates: Sequence[Candidate]) -> int:
    """Return the number of components to use.

    Held-out errors ``e_K`` hold how much demonstrations differ, which no K can mend, and the bias of a mean that is
    too simple; squares add. Chosen is the smallest K whose bias ``sqrt(e_K^2 - e_best^2)`` is at most a tenth of
    ``e_best``, that is, ``e_K`` within 0.5 % of the best, or within 0.1 mm of it. BIC alone keeps growing with K on
    data over time, because neighbouring samples are not independent (METHODS C); it decides only when there is one
    demonstration, so that nothing can be held out.
    """
    errors = np.array([c.held_out_rmse_mm for c in candidates])
    if np.isnan(errors).any():
        return min(candidates, key=lambda c: (c.bic, c.n_components)).n_components
    good = errors <= max(errors.min() * np.sqrt(1.0 + _BIAS**2), errors.min() + _SLACK_MM)
    return min(c.n_components for c, ok in zip(candidates, good, strict=True) if ok)


def try_numbers_of_components(
    tables: Sequence[Array], numbers: Sequence[int], min_std: Array, reg_covar: float
) -> tuple[Candidate, ...]:
    """Judge several numbers of components.

    For each, the fit to all demonstrations and the fits that hold one out run side by side, as rows of the same
    matrix products. At most 100 samples a demonstration are used. Larger numbers are not tried any more when four in
    a row brought no smaller error.

    Args:
        tables: samples [t, x, y, z, ...] of each demonstration.
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
        raise InputError(f"GMR: {fewest} samples are too few for {possible[0]} components")
    moves = samples.std(axis=0) > min_std
    moves[0] = True
    center, scale = samples[:, moves].mean(axis=0), samples[:, moves].std(axis=0)
    features = quadratic_features((samples[:, moves] - center) / scale)
    owner = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    seen = np.ones((1, len(samples)))
    if len(tables) > 1:
        seen = np.concatenate([seen, owner != np.arange(len(tables))[:, None]])
    d = int(moves.sum())
    judged: list[Candidate] = []
    for k in possible:
        start = np.repeat(responsibilities_by_bins(samples[:, 0], k)[None], len(seen), axis=0)
        fit = expectation_maximisation(features, start, seen, floor=reg_covar, tol=1e-3, max_iter=100)
        likelihood = len(samples) * float(fit.log_likelihood[0] - np.log(scale).sum())
        parameters = k - 1 + k * d + k * d * (d + 1) // 2
        error = np.nan
        if len(tables) > 1:
            error = 1e3 * _held_out_error(fit, samples, moves, center, scale, owner)
        bic = -2.0 * likelihood + parameters * np.log(len(samples))
        judged.append(Candidate(k, float(bic), float(-2.0 * likelihood + 2.0 * parameters), float(error)))
        if len(tables) > 1 and len(judged) - int(np.argmin([c.held_out_rmse_mm for c in judged])) > _PATIENCE:
            break
    return tuple(judged)


def _thinned(table: Array) -> Array:
    if len(table) <= _SAMPLES:
        return table
    return table[np.round(np.linspace(0, len(table) - 1, _SAMPLES)).astype(int)]


def _held_out_error(
    fit: Fit, samples: Array, moves: NDArray[np.bool_], center: Array, scale: Array, owner: NDArray[np.intp]
) -> float:
    """Return the root mean square distance [m] of each demonstration from the regression that did not see it."""
    t = (samples[:, 0] - center[0]) / scale[0]
    fold = owner + 1  # fold 0 sees everything
    means, covariances = fit.means, fit.covariances
    position = np.flatnonzero(moves[1:4]) + 1
    column = np.flatnonzero(np.isin(np.flatnonzero(moves), position))
    variance = covariances[:, :, 0, 0]
    slopes = covariances[:, :, 0, :] / variance[..., None]
    offset = t[:, None] - means[fold, :, 0]
    log_h = np.log(fit.weights[fold]) - 0.5 * (np.log(variance[fold]) + offset**2 / variance[fold])
    h = np.exp(log_h - log_h.max(axis=1, keepdims=True))
    h /= h.sum(axis=1, keepdims=True)
    predicted = np.einsum("nk,nkd->nd", h, means[fold][..., column] + offset[..., None] * slopes[fold][..., column])
    still = ~moves[1:4]
    errors = np.zeros((len(samples), 3))
    errors[:, position - 1] = predicted * scale[column] + center[column] - samples[:, position]
    errors[:, still] = samples[:, 1:4][:, still] - samples[:, 1:4][:, still].mean(axis=0)
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
