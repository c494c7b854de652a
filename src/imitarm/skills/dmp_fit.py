"""The weights of a movement primitive, from one path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from imitarm.skills.dynamical_systems import Gains, basis_on_grid, phase_basis, propagator, roll_out

Array = NDArray[np.float64]

_FINE, _FINE_PER_BASIS = 512, 12  # steps of the grid on which responses are computed, at least
_START = 0.05  # of the duration: the part of a noisy motion that shows its velocity at the start
_NOISE = 1e-4  # [m] the repeatability of industrial arms


class FittedWeights(NamedTuple):
    """A primitive's parameters, fitted to one path.

    Attributes:
        start: x_0, shape (3,) [m].
        goal: g, shape (3,) [m].
        weights: w, shape (N, 3) [m].
        progress_weights: w_p, shape (N,).
        start_rate: T x'(0), shape (3,) [m].
        path_length: of the fitted motion [m].
    """

    start: Array
    goal: Array
    weights: Array
    progress_weights: Array
    start_rate: Array
    path_length: float


@dataclass(frozen=True, eq=False)
class _Responses:
    """Responses of the spring on the fine grid: to a start of 1, a rate of 1, a goal of 1, and each basis function."""

    values: Array  # (n_steps + 1, 3 + N)
    rates: Array
    spline: CubicHermiteSpline


@lru_cache(maxsize=8)
def _responses(gains: Gains, n_basis: int) -> _Responses:
    fine = max(_FINE, _FINE_PER_BASIS * n_basis)
    basis = basis_on_grid(n_basis, fine)[1]
    nothing = np.zeros(len(basis))
    inputs = np.column_stack([nothing, nothing, np.ones_like(nothing), basis])
    start = np.zeros((2, inputs.shape[1]))
    start[0, 0] = start[1, 1] = 1.0
    z = roll_out(propagator(gains, 1.0 / fine, n_basis), start, inputs)
    return _Responses(z[0], z[1], CubicHermiteSpline(np.linspace(0.0, 1.0, fine + 1), z[0], z[1]))


def fit_weights(
    fraction: Array, x: Array, gains: Gains, n_basis: int, regularisation: float, *, exact_ends: bool = False
) -> FittedWeights:
    r"""Return the weights with which the primitive reproduces a path.

    The motion is linear in the drives ``d_i = w_i - (g - x_0)``: with R the spring's responses to a start, a rate, a
    goal and each basis function, ``x(t) = R_start x_0 + R_rate v_0 + R_goal g + sum_i d_i R_i``. The usual regression
    compares forces, ``tau v' + D v`` and so on, and needs measured accelerations. Here both sides are filtered by the
    spring itself, which turns forces into positions. So noise is not differentiated, samples may lie at any times, and
    the regression minimises the error of the reproduction in metres.

    The motion passes exactly through its start and its goal. These are the first and the last sample. Where noise has
    put one of them more than 0.1 mm beside the path that fits all samples, it is that path's end instead, unless
    ``exact_ends``: forced through a noisy sample, the motion would jerk there. The last drive is 0, so that the target
    is the goal when the duration is over. (The regression hardly determines it; left free, it can pull the tool
    decimetres off the goal after the end.)

    Args:
        fraction: of the duration, from 0 to 1, shape (n,).
        x: positions, shape (n, 3) [m].
        gains: of the spring.
        n_basis: number N of basis functions.
        regularisation: of the ridge regression, relative to the mean square response.
        exact_ends: take the first and the last sample as they are, without smoothing.
    """
    responses = _responses(gains, n_basis)
    R = responses.spline(fraction)
    rate = start_rate(fraction, x, 0.0 if exact_ends else _START)
    ends = np.stack([x[0], rate, x[-1]])
    if not exact_ends:
        beside = _beside(R, x - R[:, :3] @ ends, n_basis, regularisation)
        if start_rate(1.0 - fraction[::-1], x[::-1]).any():  # it ends in motion: the last sample is as good as any
            beside[2] = 0.0
        ends += np.where(np.linalg.norm(beside, axis=1, keepdims=True) > _NOISE, beside, 0.0)
    base = R[:, :3] @ ends
    force = phase_basis(n_basis).centers  # of a drive of 1: late ones carry the factor s = 0.01
    drives = _without_last(R[:, 3:], x - base, force, regularisation, ends[2] - base[-1])
    progress, path_length = _progress(responses.rates @ np.concatenate([ends, drives]))
    base_progress = responses.values[:, 2]
    progress_drives = _without_last(
        responses.values[:, 3:], (progress - base_progress)[:, None], force, regularisation, 1.0 - base_progress[-1:]
    )
    weights = drives + (ends[2] - ends[0])
    return FittedWeights(ends[0], ends[2], weights, progress_drives[:, 0] + 1.0, rate, path_length)


def progress_at(fraction: Array, progress_weights: Array, gains: Gains) -> Array:
    """Return the fraction of the path, from 0 to 1, that is done at ``fraction`` (n,) of the duration."""
    R = _responses(gains, len(progress_weights)).spline(np.clip(fraction, 0.0, 1.0))
    return np.asarray(R[:, 2] + R[:, 3:] @ (progress_weights - 1.0))


def _without_last(R: Array, y: Array, force: Array, regularisation: float, end: Array) -> Array:
    """Return the solution of :func:`_ridge` whose last drive is 0."""
    drives = _ridge(R[:, :-1], y, force[:-1], regularisation, end)
    return np.concatenate([drives, np.zeros((1, y.shape[1]))])


def _beside(R: Array, y: Array, n_basis: int, regularisation: float) -> Array:
    """Return how far the best path passes from the first and from the last sample, rows (start, 0, goal) [m]."""
    columns = np.concatenate([R[:, :1], R[:, 3:-1]], axis=1)
    solution = _ridge(columns, y, np.append(1.0, phase_basis(n_basis).centers[:-1]), regularisation)
    start, goal = columns[[0, -1]] @ solution - y[[0, -1]]
    return np.stack([start, np.zeros(3), goal])


def _ridge(R: Array, y: Array, force: Array, regularisation: float, end: Array | None = None) -> Array:
    """Return the ridge regression of ``R d = y``, penalising ``force d``; with ``end``, ``R[-1] d = end`` exactly."""
    n = R.shape[1]
    S = R / force
    kkt = np.zeros((n + 1, n + 1))
    kkt[:n, :n] = S.T @ S / len(S)
    kkt[np.arange(n), np.arange(n)] += regularisation * np.trace(kkt) / n
    right = np.concatenate([S.T @ y / len(S), np.zeros((1, y.shape[1])) if end is None else end[None]])
    if end is None:
        kkt[n, n] = 1.0
    else:
        kkt[n, :n] = kkt[:n, n] = S[-1]
    return np.asarray(np.linalg.solve(kkt, right)[:n] / force[:, None])


def _progress(rate: Array) -> tuple[Array, float]:
    """Return the fraction of the path that is done, on the fine grid, and its length [m].

    A motion without length gets a minimum-jerk profile.
    """
    speed = np.linalg.norm(rate, axis=1)
    done = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / (len(rate) - 1)
    length = float(done[-1])
    if length > 1e-9:
        return done / length, length
    u = np.linspace(0.0, 1.0, len(rate))
    return u**3 * (10.0 + u * (6.0 * u - 15.0)), length


def start_rate(fraction: Array, x: Array, part: float = _START) -> Array:
    """Return the velocity at the first sample, in m per duration, shape (3,).

    It is the slope of a parabola through the first samples. It is 0 unless it exceeds three standard errors and a tenth
    of the mean speed: a motion that begins at rest begins exactly at rest.

    Args:
        fraction: of the duration, from 0 to 1, shape (n,).
        x: positions, shape (n, 3) [m].
        part: fraction of the duration that the parabola covers; at least 6 samples are used.
    """
    n = max(6, int(np.searchsorted(fraction, part, side="right")))
    if len(fraction) < n:
        return np.zeros(3)
    table = fraction[:n, None] ** np.arange(3)
    solution, *_ = np.linalg.lstsq(table, x[:n], rcond=None)
    variance = np.sum((x[:n] - table @ solution) ** 2, axis=0) / (n - 3)
    error = np.sqrt(variance.sum() * np.linalg.inv(table.T @ table)[1, 1])
    mean_speed = np.linalg.norm(np.diff(x, axis=0), axis=1).sum()
    slope = np.linalg.norm(solution[1])
    return solution[1] if slope > max(3.0 * error, 0.1 * mean_speed) else np.zeros(3)
