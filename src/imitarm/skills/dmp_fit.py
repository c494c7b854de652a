"""Learning the weights of a movement primitive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from imitarm.skills.phase_basis import on_grid, phase_basis
from imitarm.skills.spring import Gains, propagator, roll_out

Array = NDArray[np.float64]

_FINE = 512  # steps of the grid on which responses are computed


class Imitation(NamedTuple):
    """What was learnt from one path.

    Attributes:
        weights: w, shape (N, 3) [m].
        progress_weights: w_p, shape (N,).
        start_rate: T x'(0), shape (3,) [m].
        path_length: of the fitted motion [m].
    """

    weights: Array
    progress_weights: Array
    start_rate: Array
    path_length: float


@dataclass(frozen=True, eq=False)
class _Responses:
    """What the spring answers on the fine grid to a start of 1, a goal of 1, a rate of 1, and each basis function."""

    values: Array  # (_FINE + 1, 3 + N)
    rates: Array
    spline: CubicHermiteSpline


@lru_cache(maxsize=8)
def _responses(gains: Gains, n_basis: int) -> _Responses:
    s, basis = on_grid(n_basis, _FINE)
    # the base target is x_0 s + g (1 - s): a start of 1 gives s, a change of goal by 1 gives 1 - s
    inputs = np.column_stack([np.ones_like(s), 1.0 - s, np.zeros_like(s), basis])
    start = np.zeros((2, inputs.shape[1]))
    start[0, 0] = start[1, 2] = 1.0
    z = roll_out(propagator(gains, 1.0 / _FINE), start, inputs)
    spline = CubicHermiteSpline(np.linspace(0.0, 1.0, _FINE + 1), z[0], z[1])
    return _Responses(z[0], z[1], spline)


def imitate(share: Array, x: Array, gains: Gains, n_basis: int, regularisation: float) -> Imitation:
    r"""Learn a path.

    The motion is linear in the weights: ``x(t) = x_base(t) + sum_i w_i R_i(t)``, R_i the spring's response to basis
    function i. This is METHODS C's ridge regression on the force, ``tau v' + D v`` and so on, with both sides filtered
    by the spring itself, which turns accelerations that nobody measured into positions that were. So no noise is
    differentiated, time stamps may lie anywhere, and what is minimised is the error of the reproduction in metres. The
    last sample is met exactly.

    Args:
        share: of the duration, 0 to 1, shape (n,).
        x: positions, shape (n, 3) [m].
        gains: of the spring.
        n_basis: number of basis functions.
        regularisation: ridge, relative to the mean square response.
    """
    responses = _responses(gains, n_basis)
    at_samples = responses.spline(share)
    rate = start_rate(share, x)
    ends = np.stack([x[0], x[-1] - x[0], rate])
    base = at_samples[:, :3] @ ends
    weights = _ridge(at_samples[:, 3:], x - base, x[-1] - base[-1], regularisation)
    fitted_rate = responses.rates @ np.concatenate([ends, weights])
    progress, path_length = _progress(fitted_rate)
    base_progress = responses.values[:, 1]
    progress_weights = _ridge(
        responses.values[:, 3:], (progress - base_progress)[:, None], 1.0 - base_progress[-1:], regularisation
    )
    return Imitation(weights, progress_weights[:, 0], rate, path_length)


def _ridge(R: Array, y: Array, end: Array, regularisation: float) -> Array:
    """Return weights with ``R w = y`` in the sense of ridge regression, and exactly ``R[-1] w = end``.

    Late basis functions carry the factor s = 0.01, so each weight is punished by the force it makes.
    """
    n = R.shape[1]
    force = phase_basis(n).centers
    S = R / force
    kkt = np.zeros((n + 1, n + 1))
    kkt[:n, :n] = S.T @ S / len(S)
    kkt[np.arange(n), np.arange(n)] += regularisation * np.trace(kkt) / n
    kkt[n, :n] = kkt[:n, n] = S[-1]
    right = np.concatenate([S.T @ y / len(S), end[None]])
    return np.asarray(np.linalg.solve(kkt, right)[:n] / force[:, None])


def _progress(rate: Array) -> tuple[Array, float]:
    """Return the share of the path that is done on the fine grid, and its length; minimum jerk if it has none."""
    speed = np.linalg.norm(rate, axis=1)
    done = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / _FINE
    length = float(done[-1])
    if length > 1e-9:
        return done / length, length
    u = np.linspace(0.0, 1.0, _FINE + 1)
    return u**3 * (10.0 + u * (6.0 * u - 15.0)), length


def start_rate(share: Array, x: Array) -> Array:
    """Return how fast the motion is under way at its first sample, shape (3,), in m a duration.

    The slope of a parabola through the first twentieth. It counts only when it stands out of the noise and is more than
    a tenth of the mean speed: a motion that begins at rest begins exactly at rest.
    """
    n = max(6, int(np.searchsorted(share, 0.05, side="right")))
    if len(share) < n:
        return np.zeros(3)
    table = share[:n, None] ** np.arange(3)
    solution, *_ = np.linalg.lstsq(table, x[:n], rcond=None)
    variance = np.sum((x[:n] - table @ solution) ** 2, axis=0) / (n - 3)
    error = np.sqrt(variance.sum() * np.linalg.inv(table.T @ table)[1, 1])
    mean_speed = np.linalg.norm(np.diff(x, axis=0), axis=1).sum()
    slope = np.linalg.norm(solution[1])
    return solution[1] if slope > max(3.0 * error, 0.1 * mean_speed) else np.zeros(3)
