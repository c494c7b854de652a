"""An oracle that checks the refusals of ``adapt``: it decides whether a path around the obstacles exists.

The oracle does not use the library's search for a path. It gives one of three answers:

* **impossible**: the oracle proved that no continuous displacement of the path avoids the obstacles. An obstacle covers
  a point that must not move, or every sequence of boxes from the start to the goal is blocked
  (:mod:`imitarm.benchmark.refusal_proof`). A box contains positions and times.
* **possible**: the oracle found and verified a path. It searches in two ways. The first search looks for a sequence of
  free boxes from the start to the goal. The second search uses a grid of displacements at many times, called layers. A
  cell of the grid is free if an obstacle is far enough from its centre. A move between two cells is free if a lower
  bound of the distance to the obstacles, computed from tangents, is large enough. Dynamic programming finds the
  sequence of free cells with the smallest displacements. The oracle then approximates this sequence by a sum of the
  skill's components. If the components are too wide, it uses hat functions of time instead.
* **undecided**: the oracle found no proof and no path, even with its finest grid and its largest number of boxes.

The oracle keeps the same limits as the library's search. No sample of the path is displaced by more than 0.5 m. No step
is longer than 8 times the longest step of the nominal path. At fixed times (start, goal and pinned times), the path is
not displaced. No displacement has a component in a forbidden direction.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.refusal_proof import Answer, explored
from imitarm.benchmark.refusal_question import (
    MAX_DISPLACEMENT,
    MAX_STEP_RATIO,
    Question,
    covers_fixed_point,
    separation,
)
from imitarm.benchmark.refusal_routes import at_samples

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SEARCH_GRIDS = {
    1: ((0.5, 0.002),),
    2: ((0.2, 0.01), (0.5, 0.01), (0.5, 0.004), (0.3, 0.002), (0.12, 0.001)),
    3: ((0.2, 0.02), (0.5, 0.025), (0.3, 0.0125), (0.12, 0.006)),
}
_SEARCH_LAYERS, _SEARCH_LAYERS_MOVING = 80, 200
_LATERAL_SWEEPS = 16  # cells that a chain may move sideways within a layer
_CHANGE_COST = 20.0  # [1/m]
_AWAY_COST = 2.0  # [1/m^2] at each layer
_FIT_ROUNDS = 12


def answer(question: Question) -> Answer:
    """Decide whether a path exists."""
    return decide(question)[0]


def decide(question: Question) -> tuple[Answer, Array | None]:
    """Decide whether a path exists; return the answer, and the positions of the path, shape (n, 3) [m], or None.

    The positions belong to the times of ``question.nominal``. They are None if no path was found.
    """
    if covers_fixed_point(question):
        return Answer.IMPOSSIBLE, None
    return _searched(question)


def is_solved(question: Question) -> bool:
    """Return whether the oracle finds a path and verifies its clearance."""
    return _searched(question)[0] is Answer.POSSIBLE


def _searched(question: Question) -> tuple[Answer, Array | None]:
    """Search for a proof or a path: in cells without and with division in time, and on coarse and finer grids."""
    if separation(question, question.nominal.times, question.nominal.positions) >= -1e-9:
        return Answer.POSSIBLE, question.nominal.positions
    axes = question.axes()
    if not len(axes):  # nothing may move
        return Answer.IMPOSSIBLE, None
    coarse, *finer = _SEARCH_GRIDS[len(axes)]
    found: Array | None = None
    for timed in (False, True):
        seen = explored(question, timed=timed)
        if seen.answer is Answer.IMPOSSIBLE:
            return Answer.IMPOSSIBLE, None
        if seen.route is not None:
            found = _fits(question, axes, at_samples(question.nominal, *seen.route))
        if found is None and not timed:
            found = _on_grid(question, axes, *coarse)
        if found is not None:
            return Answer.POSSIBLE, found
    for reach, h in finer:
        if (found := _on_grid(question, axes, reach, h)) is not None:
            return Answer.POSSIBLE, found
    return Answer.UNDECIDED, None


def _on_grid(question: Question, axes: Array, reach: float, h: float) -> Array | None:
    """Return the positions (n, 3) [m] of a path that was found on one grid and verified; None if none is found."""
    chain = _chain(question, axes, reach, h)
    return None if chain is None else _fits(question, axes, chain)


def _chain(question: Question, axes: Array, reach: float, h: float) -> tuple[Array, Array] | None:
    """Return the times (k,) and displacements (k, 3) of the cheapest chain of free cells; None if there is no chain.

    Cell centres are multiples of ``h`` [m], so that the undisplaced position is a cell centre.
    """
    d, half = len(axes), round(reach / h)
    side, n = 2 * half + 1, len(question.nominal)
    ticks = np.asarray((np.arange(side) - half) * h, dtype=np.float64)
    times = _layer_times(question)
    grid = np.stack(np.meshgrid(*[ticks] * d, indexing="ij"), axis=-1)
    flat = grid.reshape(-1, d) @ axes
    permitted = np.sum(grid**2, axis=-1) <= MAX_DISPLACEMENT**2
    for f in question.forbidden:
        permitted &= grid @ (axes @ (f / np.linalg.norm(f))) <= 1e-9
    away = _AWAY_COST * np.sum(grid**2, axis=-1)
    middle = (half,) * d
    tip, relative = question.at(times)
    longest = np.linalg.norm(np.diff(question.nominal.positions, axis=0), axis=1).max()
    per_sample = (question.nominal.times[-1] - question.nominal.times[0]) / (n - 1)
    costs: list[Array] = []
    sideways: list[list[Bools]] = []
    arrivals: list[Any] = []  # at fixed times: the cell of the layer before from which the chain arrives
    distance_away = np.linalg.norm(grid, axis=-1)
    was_fixed = True
    cost = np.full((side,) * d, np.inf)
    cost[middle] = 0.0
    previous: list[tuple[Array, Array]] | None = None
    for k, time in enumerate(times.tolist()):
        is_fixed = bool(np.min(np.abs(time - np.asarray(question.fixed_times))) < 1e-12)
        here, open_sides, open_ahead, free = _layer(
            question, flat, d, side, h, axes, k, time, tip, relative, previous, times, was_fixed, is_fixed
        )
        allowed = MAX_STEP_RATIO * longest * (times[k] - times[k - 1]) / per_sample if k > 0 else 0.0
        if k > 0:
            cost = _advanced(cost, middle, distance_away, 0.8 * allowed, was_fixed, is_fixed)
            cost = np.where(open_ahead, cost, np.inf)
        if is_fixed:
            arrivals.append(np.unravel_index(int(np.argmin(cost)), cost.shape))
            value = cost.min() if k > 0 else 0.0
            cost = np.full((side,) * d, np.inf)
            cost[middle] = value if free[middle] else np.inf
        else:
            arrivals.append(None)
            cost = np.where(free & permitted, cost + away, np.inf)
        was_fixed = is_fixed
        if not is_fixed and k + 1 < len(times):
            sweeps = min(_LATERAL_SWEEPS if reach > 0.3 else _LATERAL_SWEEPS // 2, max(int(0.9 * allowed / h), 1))
            usable = free & permitted
            for _ in range(sweeps):
                before = cost
                cost = _swept(cost, open_sides, usable, h)
                if np.array_equal(before, cost):
                    break
        if not np.isfinite(cost).any():
            return None
        costs.append(cost)
        sideways.append(open_sides)
        previous = here
    if not np.isfinite(costs[-1][middle]):
        return None
    return times, _backtracked(costs, sideways, arrivals, away, middle, h) @ axes


def _advanced(
    cost: Array, middle: tuple[int, ...], away: Array, longest: float, from_fixed: bool, to_fixed: bool
) -> Array:
    """Return, for each cell of the next layer, the cost of reaching it directly from the previous layer.

    From one layer to the next, the path stays in the same cell. There is one exception: next to a fixed time, the path
    moves from the undisplaced position to a cell, or back.
    """
    if from_fixed and not to_fixed:
        return np.where(away <= longest, cost[middle] + _CHANGE_COST * away, np.inf)
    if to_fixed and not from_fixed:
        return np.where(away <= longest, cost + _CHANGE_COST * away, np.inf)
    return cost


def _layer_times(question: Question) -> Array:
    """Return the times of the layers: evenly spaced, plus the first few samples around each fixed time."""
    moving = any(obstacle.velocity.any() for obstacle in question.obstacles)
    samples = question.nominal.times
    even = np.linspace(samples[0], samples[-1], _SEARCH_LAYERS_MOVING if moving else _SEARCH_LAYERS)
    near = [samples[max(at - 5, 0) : at + 6] for at in np.searchsorted(samples, question.fixed_times).tolist()]
    apart = np.abs(even[:, None] - np.concatenate(near)).min(axis=1) > 1e-3 * (even[1] - even[0])
    return np.unique(np.concatenate([even[apart], *near, question.fixed_times]))


def _layer(
    question: Question,
    flat: Array,
    d: int,
    side: int,
    h: float,
    axes: Array,
    k: int,
    time: float,
    tip: Array,
    relative: Array,
    previous: list[tuple[Array, Array]] | None,
    times: Array,
    from_fixed: bool,
    to_fixed: bool,
) -> tuple[list[tuple[Array, Array]], list[Bools], Bools, Bools]:
    """Return what the search must know about one layer.

    Returns:
        Distances and gradients at the cell centres, one pair for each obstacle and sphere; for each axis, whether the
        move to the next cell is free; whether the move from the previous layer is free; whether each cell is free.
    """
    shape = (side,) * d
    free, ahead = np.ones(shape, dtype=bool), np.ones(shape, dtype=bool)
    sides = [np.ones(shape, dtype=bool) for _ in range(d)]
    here: list[tuple[Array, Array]] = []
    far = h * side * np.sqrt(d)
    pair = 0
    for obstacle in question.obstacles:
        for j, sphere in enumerate(question.spheres):
            centre = tip[k] + relative[j, k] - time * obstacle.velocity
            need = question.clearance + sphere[3]
            step = np.zeros(3)
            if k > 0:
                step = centre - (tip[k - 1] + relative[j, k - 1] - times[k - 1] * obstacle.velocity)
            distance: Array
            if float(obstacle.signed_distance(centre)) > need + far + float(np.linalg.norm(step)):
                here.append((np.full(len(flat), np.inf), np.zeros((len(flat), 3))))
                pair += 1
                continue
            distance, gradient = obstacle.distance_and_gradient(flat + centre)
            free &= (distance >= need).reshape(shape)
            value, slopes = distance.reshape(shape), gradient.reshape((*shape, 3))
            for axis in range(d):
                first, last = _neighbours_along(axis, d)
                sides[axis][first] &= _keeps(
                    need, value[first], value[last], slopes[first], slopes[last], h * axes[axis]
                )
            if previous is not None and np.isfinite(previous[pair][0][0]):
                before, slope = previous[pair]
                if from_fixed == to_fixed:
                    kept = _keeps(need, before, distance, slope, gradient, step)
                else:
                    row = len(flat) // 2
                    steps = step + flat if from_fixed else step - flat
                    starts = np.full(len(flat), before[row]) if from_fixed else before
                    ends = distance if from_fixed else np.full(len(flat), distance[row])
                    a = steps @ slope[row] if from_fixed else np.einsum("nd,nd->n", slope, steps)
                    b = np.einsum("nd,nd->n", gradient, steps) if from_fixed else steps @ gradient[row]
                    kept = _tangent_bound(starts, a, ends, b) >= need
                ahead &= kept.reshape(shape)
            here.append((distance, gradient))
            pair += 1
    return here, sides, ahead, free


def _keeps(need: float, f0: Array, f1: Array, slope0: Array, slope1: Array, step: Array) -> Bools:
    """Return whether the distance to an obstacle is proven to be at least ``need`` [m] along a step.

    The distance changes by at most the length of the step. If the distance at one end exceeds ``need`` by more than the
    length of the step, the answer is True. If the distance at one end is below ``need``, the answer is False. In all
    other cases, :func:`_tangent_bound` decides.

    Args:
        need: required distance [m].
        f0: distances to the obstacle at the beginning of the step, shape (...) [m].
        f1: distances to the obstacle at the end of the step, shape (...) [m].
        slope0: gradients of ``f0``, shape (..., 3).
        slope1: gradients of ``f1``, shape (..., 3).
        step: shape (3,) [m].
    """
    kept = np.asarray(np.minimum(f0, f1) >= need)
    near = kept & (np.maximum(f0, f1) < need + float(np.linalg.norm(step)) + 1e-9)
    kept[near] = _tangent_bound(f0[near], slope0[near] @ step, f1[near], slope1[near] @ step) >= need
    return kept


def _tangent_bound(f0: Array, a: Array, f1: Array, b: Array) -> Array:
    """Return a lower bound of a convex function on [0, 1] with values f0, f1 and slopes a, b at the two ends."""
    inside = (a < 0.0) & (b > 0.0)
    s = np.clip((f1 - f0 - b) / np.where(inside, a - b, -1.0), 0.0, 1.0)
    return np.where(inside, np.maximum(f0 + a * s, f1 + b * (s - 1.0)), np.minimum(f0, f1))


def _swept(cost: Array, sides: list[Bools], usable: Bools, h: float) -> Array:
    """Return the costs when a chain may make one more move: to a neighbouring cell, without an obstacle in between."""
    d = cost.ndim
    result = cost.copy()
    for axis in range(d):
        first, last = _neighbours_along(axis, d)
        passable = sides[axis][first]
        up = np.where(passable, cost[first], np.inf) + _CHANGE_COST * h
        down = np.where(passable, cost[last], np.inf) + _CHANGE_COST * h
        result[last] = np.minimum(result[last], np.where(usable[last], up, np.inf))
        result[first] = np.minimum(result[first], np.where(usable[first], down, np.inf))
    return result


def _backtracked(
    costs: list[Array], sides: list[list[Bools]], arrivals: list[Any], away: Array, middle: tuple[int, ...], h: float
) -> Array:
    """Return the displacements (k, d) [m] of the cheapest chain: in each layer, the position of its last cell there."""
    chain = np.zeros((len(costs), len(middle)))
    cell = middle
    for k in range(len(costs) - 1, 0, -1):
        chain[k] = (np.array(cell) - np.array(middle)) * h
        if arrivals[k] is not None:
            cell = tuple(int(i) for i in arrivals[k])
            continue
        if arrivals[k - 1] is not None:
            cell = middle
            continue
        cost = costs[k]
        while costs[k - 1][cell] + away[cell] > cost[cell] + 1e-9:  # sideways moves within this layer, backwards
            for neighbour, passable in _neighbours(cell, sides[k], cost.shape):
                if passable and cost[neighbour] + _CHANGE_COST * h <= cost[cell] + 1e-9:
                    cell = neighbour
                    break
            else:
                break
    return chain


def _neighbours(
    cell: tuple[int, ...], sides: list[Bools], shape: tuple[int, ...]
) -> Iterator[tuple[tuple[int, ...], bool]]:
    for axis in range(len(cell)):
        for step in (-1, 1):
            other = (*cell[:axis], cell[axis] + step, *cell[axis + 1 :])
            if 0 <= other[axis] < shape[axis]:
                yield other, bool(sides[axis][min(cell, other)])


def _fits(question: Question, axes: Array, chain: tuple[Array, Array]) -> Array | None:
    """Return a path (n, 3) [m] that follows a chain, as a sum of components or of hat functions; None if there is none.

    The path keeps the required clearance.
    """
    times = question.nominal.times
    wanted = np.stack([np.interp(times, chain[0], column) for column in chain[1].T], axis=1)
    for basis in (question.basis, _hats(question, 4), _hats(question, 1)):
        if (found := _fit(question, axes, basis, wanted)) is not None:
            return found
    return None


def _hats(question: Question, every: int) -> Array:
    """Return the values of m hat functions at the n samples, shape (n, m).

    The hat functions have their peaks at every ``every``-th sample and near fixed times.
    """
    times, n = question.nominal.times, len(question.nominal)
    fixed = [int(np.argmin(np.abs(times - time))) for time in question.fixed_times]
    peaks = set(range(0, n, every)) | {n - 1}
    for at in fixed:
        peaks |= {j for j in range(at - 6, at + 7) if 0 <= j < n}
    ordered = sorted(peaks)
    hats = np.stack([np.interp(times, times[ordered], row) for row in np.eye(len(ordered))], axis=1)
    return np.asarray(hats[:, [i for i, j in enumerate(ordered) if j not in fixed]])


def _fit(question: Question, axes: Array, basis: Array, wanted: Array) -> Array | None:
    """Fit displacements (n, 3) by least squares, constrained by tangents of the distances.

    Returns:
        The positions of the path, shape (n, 3) [m]; None if the path does not keep the clearance and the limits.
    """
    times = question.nominal.times
    d, m = len(axes), basis.shape[1]
    tip, relative = question.at(times)
    steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    smooth = np.diff(basis, 2, axis=0)
    quadratic = np.kron(basis.T @ basis + 4.0 * (smooth.T @ smooth) + 1e-6 * np.eye(m), np.eye(d))
    linear = -(basis.T @ (wanted @ axes.T)).reshape(-1)
    here = wanted
    extra = np.empty((0, 2))  # points between samples that were too close: sample and fraction
    for _ in range(_FIT_ROUNDS):
        rows, lower = _tangent_rows(question, axes, basis, tip, relative, here, extra)
        for f in question.forbidden:
            part = axes @ (f / np.linalg.norm(f))
            if np.abs(part).max() > 1e-9:
                rows = np.concatenate([rows, np.kron(np.eye(m), -part[None])])
                lower = np.append(lower, np.zeros(m))
        size = rows.shape[1]
        slack_rows = np.hstack([rows, np.ones((len(rows), 1))])
        weight = np.zeros((size + 1, size + 1))
        weight[:size, :size], weight[size, size] = quadratic, 1e6
        x, _, flag, _ = daqp.solve(
            weight, np.append(linear, 0.0), np.ascontiguousarray(slack_rows), np.full(len(lower), 1e30), lower
        )
        if flag != 1:
            return None
        here = basis @ (np.asarray(x)[:size].reshape(m, d) @ axes)
        for f in question.forbidden:
            unit = f / np.linalg.norm(f)
            here = here - np.maximum(here @ unit, 0.0)[:, None] * unit
        if separation(question, times, tip + here) >= 0.0:
            longest = np.linalg.norm(np.diff(tip + here, axis=0), axis=1).max()
            inside = np.linalg.norm(here, axis=1).max() <= MAX_DISPLACEMENT
            return np.asarray(tip + here) if inside and longest <= MAX_STEP_RATIO * steps.max() else None
        extra = np.concatenate([extra, _close_points(question, times, tip, relative, here)])
    return None


def _tangent_rows(
    question: Question, axes: Array, basis: Array, tip: Array, relative: Array, here: Array, extra: Array
) -> tuple[Array, Array]:
    """Return r linear constraints that keep the path away from obstacles: rows (r, m d) and lower bounds (r,).

    The variables are the weights of m functions along d axes. Each constraint is the tangent of one small distance at
    the path ``tip + here``.
    """
    times = question.nominal.times
    j, s = extra[:, 0].astype(int), extra[:, 1:2]

    def between(values: Array) -> Array:
        last = np.minimum(j + 1, len(values) - 1)
        return np.concatenate([values, (1.0 - s) * values[j] + s * values[last]])

    lever, moved, clock = between(basis), between(here), between(times[:, None])[:, 0]
    base = between(tip)
    rows, lower = [np.empty((0, basis.shape[1] * len(axes)))], [np.empty(0)]
    for obstacle in question.obstacles:
        for sphere, offset in zip(question.spheres, relative, strict=True):
            points = base + between(offset) + moved - clock[:, None] * obstacle.velocity
            distance, gradient = obstacle.distance_and_gradient(points)
            missing = question.clearance + sphere[3] + 1e-5 - distance
            near = np.flatnonzero((missing > -0.06) & (lever.max(axis=1) > 1e-3))
            reduced = gradient[near] @ axes.T
            rows.append((lever[near, :, None] * reduced[:, None, :]).reshape(len(near), basis.shape[1] * len(axes)))
            lower.append(missing[near] + np.einsum("rd,rd->r", gradient[near], moved[near]))
    return np.concatenate(rows), np.concatenate(lower)


def _close_points(question: Question, times: Array, tip: Array, relative: Array, here: Array) -> Array:
    """Return the r places at which the path comes too close to an obstacle, shape (r, 2).

    On each segment between samples, 49 points are examined. If any point is too close, the closest point of the segment
    is returned. Each place is a pair: the index of the segment's first sample, and the position of the point on the
    segment, from 0 to 1.
    """
    found = []
    fractions = np.linspace(0.02, 0.98, 49)[:, None, None]
    path = tip + here
    for obstacle in question.obstacles:
        for sphere, offset in zip(question.spheres, relative, strict=True):
            points = path + offset - times[:, None] * obstacle.velocity
            inner = (1.0 - fractions) * points[:-1] + fractions * points[1:]
            gap = obstacle.signed_distance(inner) - sphere[3] - question.clearance
            for segment in np.flatnonzero(gap.min(axis=0) < 2e-6).tolist():
                found.append((segment, float(fractions[int(np.argmin(gap[:, segment])), 0, 0])))
    return np.array(found).reshape(-1, 2)


def _neighbours_along(axis: int, d: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return two indices of a d-dimensional array.

    Along ``axis``, the first index omits the last entry, and the second index omits the first entry.
    """
    first, last = [slice(None)] * d, [slice(None)] * d
    first[axis], last[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(last)
