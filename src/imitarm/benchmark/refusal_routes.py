"""Make a path along a route of free cells: choose where and when the path crosses from cell to cell."""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.refusal_question import MAX_STEP_RATIO
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_POINTS = 400  # of a route, at which it may be at the time of a sample
_STEADY = 4.0  # weight of squared steps beside squared displacements


def short(start: Array, end: Array, low: Array, high: Array) -> Array:
    """Return m + 2 points from ``start`` to ``end`` with the least sum of squared steps, shape (m + 2, d) [m].

    Each of the m points between the ends is inside its box. ``low`` and ``high`` are the corners of the boxes, shape
    (m, d).
    """
    m = len(low)
    chain = 2.0 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    points = np.empty((m + 2, len(start)))
    points[0], points[-1] = start, end
    for axis in range(len(start) if m else 0):  # the axes do not depend on each other
        pull = np.zeros(m)
        pull[0] -= start[axis]
        pull[-1] -= end[axis]
        x, _, flag, _ = daqp.solve(chain, pull, np.empty((0, m)), high[:, axis].copy(), low[:, axis].copy())
        points[1:-1, axis] = np.clip(x if flag == 1 else 0.5 * (low + high)[:, axis], low[:, axis], high[:, axis])
    return points


def even(points: Array, earliest: Array, latest: Array) -> Array:
    """Return the times, from 0 to 1, at which a path should pass m + 2 points so that its speed is as even as possible.

    ``earliest`` and ``latest``, shape (m,), limit the times of the m points between the ends.
    """
    m = len(points) - 2
    earliest = np.maximum.accumulate(earliest)
    latest = np.minimum.accumulate(latest[::-1])[::-1]
    if not m:
        return np.array([0.0, 1.0])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    weight = 1.0 / (lengths + 0.01 * lengths.sum() / len(lengths) + 1e-9)
    weight /= weight.max()
    steps = np.diff(np.eye(m + 2), axis=0)[:, 1:-1]  # of the times between the ends
    pull = weight[-1] * steps[-1]  # the last time is 1
    rows = np.ascontiguousarray(steps[1:-1])
    upper = np.append(latest, np.full(len(rows), 1e30))
    lower = np.append(earliest, np.zeros(len(rows)))
    x, _, flag, _ = daqp.solve(np.asarray(steps.T * weight @ steps), pull, rows, upper, lower)
    inner = np.maximum.accumulate(np.clip(x, earliest, latest)) if flag == 1 else 0.5 * (earliest + latest)
    return np.concatenate([[0.0], inner, [1.0]])


def beside(route: Array, times: Array, nominal: Array) -> tuple[Array, Array]:
    """Return a path that follows a route and stays as near to the nominal path as possible at all times.

    For each sample, dynamic programming chooses a point of the route. The cost is the sum of the squared displacements
    from the nominal path, plus the weighted squared steps along the route. The path never goes backwards on the route,
    and keeps the permitted length of a step.

    Args:
        route: corners of a polyline, shape (m, d) [m].
        times: times of the samples, shape (n,).
        nominal: nominal path at the samples, shape (n, d) [m].

    Returns:
        Times (n,) and points (n, d) [m] of the path. If the permitted steps are too short to reach the end, the path
        follows the route at constant speed.
    """
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], _POINTS)
    points = np.stack([np.interp(at, length, column) for column in route.T], axis=1)
    longest = 0.8 * MAX_STEP_RATIO * np.linalg.norm(np.diff(nominal, axis=0), axis=1).max()
    reach = min(int(longest / max(at[1], 1e-12)), _POINTS - 1)
    steps = _STEADY * (np.arange(reach + 1) * at[1]) ** 2
    cost = np.full(_POINTS, np.inf)
    cost[0] = 0.0
    from_ = np.zeros((len(times), _POINTS), dtype=np.intp)
    for i in range(1, len(times)):
        padded = np.concatenate([np.full(reach, np.inf), cost])
        options = np.lib.stride_tricks.sliding_window_view(padded, reach + 1)[:, ::-1] + steps
        back = options.argmin(axis=1)
        from_[i] = np.arange(_POINTS) - back
        cost = options[np.arange(_POINTS), back] + np.sum((points - nominal[i]) ** 2, axis=1)
    if not np.isfinite(cost[-1]):
        return times, np.stack([np.interp(times * length[-1], length, column) for column in route.T], axis=1)
    chosen = np.full(len(times), _POINTS - 1)
    for i in range(len(times) - 1, 0, -1):
        chosen[i - 1] = from_[i, chosen[i]]
    return times, points[chosen]


def at_samples(nominal: Trajectory, times: Array, positions: Array) -> tuple[Array, Array]:
    """Interpolate ``positions`` at the times of the nominal path.

    Return these times, shape (n,), and the displacements from the nominal path, shape (n, 3) [m].
    """
    moved = np.stack([np.interp(nominal.times, times, column) for column in positions.T], axis=1)
    return nominal.times, moved - nominal.positions
