"""Prove that no path exists, by a search in a graph of cells in space and time.

A *cell* is a box of positions of the tool's tip, together with an interval of time. A cell is *blocked* if the tip
cannot be at any position of the box at any time of the interval. There are two reasons why a cell can be blocked.
First, an inflated obstacle may contain the centre of one of the tool's spheres during the whole interval. An inflated
obstacle is convex, so it contains a box if it contains the corners of the box. The proof therefore tests only the
corners of the box in which the sphere's centre stays during the interval. Second, all positions of the box may be
displaced too far or in a forbidden direction. A cell is *free* if it is proved that every position is possible at every
time of the interval. All other cells are *undecided*.

Two cells are neighbours if they have a position and a time in common. A route leads from cell to neighbouring cell, and
never back in time. If no route through cells that are not blocked leads from the start to the goal, no path avoids the
obstacles. In each round, the search finds the routes that cross the fewest undecided cells, and divides these cells. It
drops cells that no route can reach. If the search finds a route of free cells, a path exists, although its speed may
exceed the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from imitarm.benchmark.refusal_question import MAX_DISPLACEMENT, TIME_LEVELS, Leg, Question
from imitarm.benchmark.refusal_routes import beside, even, short
from imitarm.scene.obstacle import PosedObstacle

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]

_TOUCH = 1e-12  # [m] cells that are less apart touch
_ROUNDING = 1e-9  # [m]
_STILL = 1e-12  # [m] a box that is smaller along an axis is flat
_MAX_CELLS = 60_000, 300_000  # without and with division in time
_FREE_COST = 1e-3  # of a free cell; any other cell costs 1
_WIDER = 1.25, 1.5  # routes that cost up to this factor more, plus this number of cells, are refined with the cheapest
_MAX_FRAMES = 3


class Answer(Enum):
    """Possible answers to the question whether a path exists."""

    IMPOSSIBLE = "impossible"
    POSSIBLE = "possible"
    UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False)
class Exploration:
    """Result of the search for a proof or a route.

    Attributes:
        answer: POSSIBLE if the search found a route of free cells; IMPOSSIBLE if it proved that no path exists;
            otherwise UNDECIDED.
        route: times (m,) [s] and positions (m, 3) [m] of a path through free cells; None if no such path was found. The
            path may exceed the limit of speed, but keeps all other limits.
    """

    answer: Answer
    route: tuple[Array, Array] | None = None


def explored(question: Question, *, timed: bool) -> Exploration:
    """Prove that no path exists, or find a route through free cells.

    Args:
        question: scene and path. At least one direction of displacement must be permitted.
        timed: whether cells are also divided in time. If False, each cell lasts from one fixed time to the next. (At a
            fixed time, such as the start, the path must not be displaced.) The search is then faster. It finds an
            answer in most scenes without moving obstacles or rotations of the tool.
    """
    found = Exploration(Answer.UNDECIDED)
    for frame in _frames(question, question.axes()):
        legs = [Leg(question, frame, start, end) for start, end in pairwise(question.fixed_times)]
        parts = [_explored(leg, timed=timed) for leg in legs]
        if any(part.answer is Answer.IMPOSSIBLE for part in parts):
            return Exploration(Answer.IMPOSSIBLE)
        routes = [part.route for part in parts if part.route is not None]
        if len(routes) == len(legs):
            found = Exploration(
                Answer.POSSIBLE, (np.concatenate([w[0] for w in routes]), np.concatenate([w[1] for w in routes]))
            )
        if timed or found.route is not None:
            break
    return found


def _frames(question: Question, axes: Array) -> Iterator[Array]:
    """Yield orthonormal bases of the permitted displacements, aligned with obstacles if possible."""
    d = len(axes)
    found: list[Array] = []
    for obstacle in question.obstacles:
        if isinstance(obstacle, PosedObstacle) and d > 1 and len(found) < _MAX_FRAMES:
            frame = _aligned(obstacle.pose.rotation.T, axes)
            if not any(np.abs(np.abs(frame @ other.T).max(axis=1) - 1.0).max() < 1e-6 for other in found):
                found.append(frame)
    yield from found or [axes]


def _aligned(rotation: Array, axes: Array) -> Array:
    """Return an orthonormal basis (d, 3) of the space that ``axes`` (d, 3) span, aligned with ``rotation`` (3, 3)."""
    if len(axes) == 3:
        return rotation
    inside = rotation @ axes.T @ axes
    first = inside[int(np.argmax(np.linalg.norm(inside, axis=1)))]
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(np.cross(axes[0], axes[1]), first)])


def _explored(leg: Leg, *, timed: bool) -> Exploration:
    """Divide cells until there is no route, a route of free cells is found, or there are too many cells."""
    cells, blocked = _root(leg, timed=timed)
    if blocked.any():
        return Exploration(Answer.IMPOSSIBLE)
    edges = np.empty((2, 0), dtype=np.intp)
    made = 1
    while made < _MAX_CELLS[timed]:
        graph = _Graph(leg, cells, edges)
        if not graph.alive.any():
            return Exploration(Answer.IMPOSSIBLE)
        if graph.is_free:
            return Exploration(Answer.POSSIBLE, graph.route(timed=timed))
        made += 2 * int(graph.wanted.sum())
        cells, edges = _refined(leg, cells, edges, graph, timed=timed)
    return Exploration(Answer.UNDECIDED)


def _root(leg: Leg, *, timed: bool) -> tuple[Cells, Bools]:
    """Return one cell with all permitted positions and times, and whether it is blocked, shape (1,).

    Args:
        leg: the leg.
        timed: see :func:`classified`.
    """
    whole = np.zeros(1, dtype=np.intp)
    low, high = leg.tip_box(whole, whole)
    # Not symmetric about the path: otherwise, many scenes have an obstacle exactly at the border of two cells.
    low, high = low - 1.02 * MAX_DISPLACEMENT, high + 1.01 * MAX_DISPLACEMENT
    return classified(leg, Cells.unknown(low, high, whole, whole, whole), timed=timed)


def _refined(leg: Leg, cells: Cells, edges: Index, graph: _Graph, *, timed: bool) -> tuple[Cells, Index]:
    """Divide the wanted cells; drop the halves that are blocked and the cells through which no route leads."""
    kept, split = np.flatnonzero(graph.alive & ~graph.wanted), np.flatnonzero(graph.wanted)
    pieces, blocked = classified(leg, cells.take(split).halves(), timed=timed)
    stays = np.flatnonzero(~blocked)
    # The numbers of each cell, or of its two halves, among the new cells; -1 if there is none.
    number = np.full((2, len(cells)), -1, dtype=np.intp)
    number[0, kept] = np.arange(len(kept))
    halves = np.full(2 * len(split), -1, dtype=np.intp)
    halves[stays] = len(kept) + np.arange(len(stays))
    number[:, split] = halves.reshape(2, len(split))
    new = np.concatenate([np.stack([a[edges[0]], b[edges[1]]]) for a in number for b in number], axis=1)
    new = np.concatenate([new, number[:, split]], axis=1)
    new = new[:, new.min(axis=0) >= 0]
    found = cells.take(kept) + pieces.take(stays)
    return found, new[:, found.touch(*new)]


class _Graph:
    """The cheapest routes from the start to the goal through cells.

    Args:
        leg: the leg.
        cells: n cells that are not blocked.
        edges: pairs of neighbouring cells, shape (2, m).

    Attributes:
        alive: whether a route leads through the cell, shape (n,).
        wanted: whether the cell should be divided next, shape (n,).
        is_free: whether a route leads through free cells only.
    """

    def __init__(self, leg: Leg, cells: Cells, edges: Index) -> None:
        self._leg, self._cells, n = leg, cells, len(cells)
        cost = np.where(cells.free, _FREE_COST, 1.0)
        first, last = cells.contain(leg.ends[0], 0.0), cells.contain(leg.ends[1], 1.0)
        start, end = cells.times()
        source, target = np.concatenate([edges, edges[::-1]], axis=1)
        onward = end[target] > start[source]
        source, target = source[onward], target[onward]
        self._routes = _directed(source, target, first, cost)
        there = dijkstra(self._routes, indices=n)[:n]
        home = dijkstra(_directed(target, source, last, cost), indices=n)[:n]
        through = there + home - cost
        self.alive = np.isfinite(through)
        cheapest = float(through.min(initial=np.inf))
        self.wanted = self.alive & ~cells.free & (through <= _WIDER[0] * cheapest + _WIDER[1])
        self.is_free = cheapest < 1.0
        self._end = int(last[np.argmin(there[last])]) if self.is_free else -1

    def route(self, *, timed: bool) -> tuple[Array, Array]:
        """Return times (m,) [s] and positions (m, 3) [m] of a path along the cheapest route, which is free."""
        n, leg = len(self._cells), self._leg
        before = dijkstra(self._routes, indices=n, return_predecessors=True)[1]
        route = [self._end]
        while before[route[-1]] != n:
            route.append(int(before[route[-1]]))
        cells = self._cells.take(np.array(route[::-1], dtype=np.intp))
        # From each cell to the next, the path crosses what both have in common.
        low, high = np.maximum(cells.low[:-1], cells.low[1:]), np.minimum(cells.high[:-1], cells.high[1:])
        points = short(leg.ends[0], leg.ends[1], low, np.maximum(low, high))
        if timed:
            start, end = cells.times()
            times = even(points, np.maximum(start[:-1], start[1:]), np.minimum(end[:-1], end[1:]))
        else:
            times, points = beside(points, *leg.nominal())
        return leg.start + times * (leg.end - leg.start), leg.positions(points, times)


def _directed(source: Index, target: Index, first: Index, cost: Array) -> Any:
    """Return the graph of cells, in which an edge costs what its second cell costs.

    One more node, the last one, has edges to the cells ``first``.
    """
    n = len(cost)
    rows, columns = np.append(source, np.full(len(first), n)), np.append(target, first)
    return sparse.csr_matrix((cost[columns], (rows, columns)), shape=(n + 1, n + 1))


@dataclass(frozen=True, eq=False)
class Cells:
    """Boxes of positions, each with an interval of time.

    Attributes:
        low: smallest coordinates of each box, shape (n, d) [m].
        high: largest coordinates of each box, shape (n, d) [m].
        level: how many times the interval of time was halved, shape (n,). The interval is as long as the leg divided by
            2^level.
        at: index of the interval among the 2^level intervals of its level, shape (n,).
        depth: number of divisions that led to the cell, shape (n,).
        free: whether the cell is proved to be free, shape (n,).
        axis: index of the axis along which the cell will be divided next, shape (n,); the index d stands for time.
    """

    low: Array
    high: Array
    level: Index
    at: Index
    depth: Index
    free: Bools
    axis: Index

    @classmethod
    def unknown(cls, low: Array, high: Array, level: Index, at: Index, depth: Index) -> Cells:
        """Return new cells that are not yet known to be free."""
        n = len(level)
        return cls(low, high, level, at, depth, np.zeros(n, dtype=bool), np.zeros(n, dtype=np.intp))

    def __len__(self) -> int:
        return len(self.level)

    def take(self, chosen: Index) -> Cells:
        """Return the cells with the given indices."""
        return Cells(**{name: values[chosen] for name, values in vars(self).items()})

    def __add__(self, other: Cells) -> Cells:
        return Cells(**{name: np.concatenate([values, getattr(other, name)]) for name, values in vars(self).items()})

    def times(self) -> tuple[Array, Array]:
        """Return the start and the end of each cell's interval, shape (n,) each, as fractions of the leg."""
        length = 0.5**self.level
        return self.at * length, (self.at + 1) * length

    def touch(self, i: Index, j: Index) -> Bools:
        """Return whether the cells of each pair have a position and a time in common, shape (m,).

        ``i`` and ``j`` are the indices of the m pairs.
        """
        start, end = self.times()
        answer = (start[i] <= end[j]) & (start[j] <= end[i])
        for low, high in zip(self.low.T, self.high.T, strict=True):
            answer &= (low[i] <= high[j] + _TOUCH) & (low[j] <= high[i] + _TOUCH)
        return np.asarray(answer)

    def contain(self, position: Array, time: float) -> Index:
        """Return the indices of the cells that contain a position, shape (d,) [m], at a time.

        The time is a fraction of the leg.
        """
        start, end = self.times()
        inside = np.all((self.low - _TOUCH <= position) & (position <= self.high + _TOUCH), axis=1)
        return np.flatnonzero(inside & (start <= time) & (time <= end))

    def halves(self) -> Cells:
        """Return the 2 n halves of the cells. The first n are the lower (or earlier) halves of the cells."""
        d, rows = self.low.shape[1], np.arange(len(self))
        low, high = np.concatenate([self.low, self.low]), np.concatenate([self.high, self.high])
        level, at = np.tile(self.level, 2), np.tile(self.at, 2)
        later = np.flatnonzero(self.axis == d)
        for half in (0, 1):
            level[later + half * len(self)] += 1
            at[later + half * len(self)] = 2 * self.at[later] + half
        i = np.flatnonzero(self.axis < d)
        middle = 0.5 * (self.low[rows[i], self.axis[i]] + self.high[rows[i], self.axis[i]])
        high[i, self.axis[i]] = middle
        low[i + len(self), self.axis[i]] = middle
        return Cells.unknown(low, high, level, at, np.tile(self.depth + 1, 2))


class _Choice:
    """Choice of the axis along which each of n cells is divided next.

    Each obstacle or limit that may block a part of a cell has a *span*: how much its distance varies over the cell
    along each axis. A cell is divided along the longest span of one obstacle or limit. Three rules choose this obstacle
    or limit in turn, because each rule alone would divide some cells for ever:

    * the obstacle or limit that needs the least additional depth to block the whole cell;
    * the one with the longest span in space;
    * the one that blocks the largest fraction of the cell.
    """

    def __init__(self, n: int) -> None:
        self._best = np.full((3, n), -np.inf)
        self._axes = np.zeros((3, n), dtype=np.intp)

    def add(self, cells: Index, value: Array, spans: Array) -> None:
        """Add an obstacle or limit.

        Args:
            cells: the cells of which it may block a part, shape (m,).
            value: distance to it at the centre of each cell, shape (m,) [m]; negative if the centre is blocked.
            spans: see above, along the d axes and time, shape (m, d + 1) [m].
        """
        if not len(cells):
            return
        total, longest = spans.sum(axis=1), spans.argmax(axis=1)
        in_space = spans[:, :-1]
        scores = (-value - total, in_space.max(axis=1), -value / np.maximum(total, 1e-15))
        for own, axes, score, axis in zip(
            self._best, self._axes, scores, (longest, in_space.argmax(axis=1), longest), strict=True
        ):
            better = score > own[cells]
            own[cells[better]] = score[better]
            axes[cells[better]] = axis[better]

    def axis(self, depth: Index, *, timed: bool) -> Index:
        """Return the axis for each cell, shape (n,); it depends on the number of divisions ``depth`` (n,) so far."""
        turns = np.array((0, 1, 0, 2) if timed else (0, 1))
        return np.asarray(self._axes[turns[depth % len(turns)], np.arange(len(depth))])


def classified(leg: Leg, cells: Cells, *, timed: bool) -> tuple[Cells, Bools]:
    """Determine which cells are blocked, which cells are free, and along which axis to divide each cell.

    Args:
        leg: the part of the motion between two successive fixed times, with its obstacles and limits.
        cells: new cells.
        timed: whether cells may be divided in time. If False, a limit counts only if it blocks the cell at all times.

    Returns:
        The cells, and whether each cell is blocked, shape (n,).
    """
    n = len(cells)
    blocked, free, choice = np.zeros(n, dtype=bool), np.ones(n, dtype=bool), _Choice(n)
    may_wait = (cells.level < TIME_LEVELS) & timed
    _apply_limits(leg, cells, blocked, free if timed else None, choice, may_wait)
    low, high = leg.motion_box(cells.level, cells.at)
    d = leg.dimension
    low[..., :d] += cells.low[:, None]
    high[..., :d] += cells.high[:, None]
    for k, (obstacle, need) in enumerate(leg.pairs):
        left = np.flatnonzero(~blocked)
        centre, half = 0.5 * (low[left, k] + high[left, k]), 0.5 * (high[left, k] - low[left, k])

        def distance(points: Array, obstacle: Any = obstacle, need: float = need) -> Array:
            return np.asarray(obstacle.signed_distance(points @ leg.frame) - need)

        value, gradient = obstacle.distance_and_gradient(centre @ leg.frame)
        value = value - need
        slopes = np.abs(gradient @ leg.frame.T)
        near = np.flatnonzero(value < np.einsum("ne,ne->n", slopes, half) + _ROUNDING)  # the tangent bounds the rest
        left, centre, half, value = left[near], centre[near], half[near], value[near]
        free[left] = False
        rises = _rises(distance, centre, half, value)
        own = np.divide(
            0.5 * (cells.high - cells.low)[left], half[:, :d], out=np.ones((len(left), d)), where=half[:, :d] > _STILL
        )
        in_space = rises[:, :d] * own
        in_time = (rises.sum(axis=1) - in_space.sum(axis=1)) * may_wait[left]
        choice.add(left, value, np.column_stack([in_space, in_time]))
        deep = np.flatnonzero(value + rises.max(axis=1, initial=0.0) < -_ROUNDING)
        blocked[left[deep[_contained(distance, centre[deep], half[deep])]]] = True
    axis = choice.axis(cells.depth, timed=timed)
    return Cells(cells.low, cells.high, cells.level, cells.at, cells.depth, free & ~blocked, axis), blocked


def _apply_limits(leg: Leg, cells: Cells, blocked: Bools, free: Bools | None, choice: _Choice, may_wait: Bools) -> None:
    """Apply the largest displacement and the forbidden directions; change ``blocked``, ``free`` and ``choice``.

    If ``free`` is None, a limit that blocks only a part of a cell is ignored.
    """
    first, last = leg.tip_box(cells.level, cells.at)
    gap = np.maximum(np.maximum(first - cells.high, cells.low - last), 0.0)
    blocked |= np.linalg.norm(gap, axis=1) > MAX_DISPLACEMENT + _ROUNDING
    own, its = 0.5 * (cells.high - cells.low), 0.5 * (last - first)
    away = 0.5 * (cells.low + cells.high) - 0.5 * (first + last)
    far = np.linalg.norm(away, axis=1)
    limits = [(MAX_DISPLACEMENT - far, away / np.maximum(far, _STILL)[:, None], np.linalg.norm(own + its, axis=1))]
    for f in leg.one_sided:
        reach = (own + its) @ np.abs(f)
        blocked |= away @ f - reach > _ROUNDING
        limits.append((-(away @ f), np.broadcast_to(f, away.shape), reach))
    if free is None:
        return
    for value, slopes, reach in limits:
        near = np.flatnonzero(value <= reach)
        free[near] = False
        steep = np.abs(slopes[near])
        in_time = np.einsum("nd,nd->n", steep, its[near]) * may_wait[near]
        choice.add(near, value[near], np.column_stack([steep * own[near], in_time]))


def _rises(distance: Callable[[Array], Array], centre: Array, half: Array, value: Array) -> Array:
    """Return how much a convex function rises from the centre of boxes to their faces, along each axis, (n, 3) [m].

    Args:
        distance: the function, for points (..., 3).
        centre: centres of the boxes, shape (n, 3) [m].
        half: half the sizes of the boxes, shape (n, 3) [m].
        value: values at the centres, shape (n,) [m].
    """
    rises = np.zeros(centre.shape)
    for axis in np.flatnonzero(half.max(axis=0, initial=0.0) > _STILL):
        step = half[:, axis, None] * np.eye(3)[axis]
        rises[:, axis] = distance(np.stack([centre - step, centre + step])).max(axis=0) - value
    return np.maximum(rises, 0.0)


def _contained(distance: Callable[[Array], Array], centre: Array, half: Array) -> Bools:
    """Return for each box whether all its corners are inside, where the function ``distance`` is negative."""
    answer = np.ones(len(centre), dtype=bool)
    thick = [1 if extent > _STILL else 0 for extent in half.max(axis=0, initial=0.0)]
    for corner in np.ndindex(*(1 + x for x in thick)):
        signs = np.where(np.array(thick) > 0, 2.0 * np.array(corner) - 1.0, 0.0)
        rest = np.flatnonzero(answer)
        answer[rest] = distance(centre[rest] + signs * half[rest]) < -_ROUNDING
    return answer
