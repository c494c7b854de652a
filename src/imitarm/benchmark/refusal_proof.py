"""Proof that no path exists: a graph of cells, divided only where a path may still lead.

Two cells are neighbours if they have a position and a time in common. A path leads from cell to neighbouring cell, and
never back in time. If the graph of all cells that are not blocked contains no way from the start to the goal, then no
continuous displacement of the path keeps the path clear of the obstacles. Each round finds the ways that cross the
fewest cells of which it is not known whether they are free, and divides these cells. Cells to which no way leads are
left out. A way of free cells only ends the search, because then a path exists, except for the limit of its speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from imitarm.benchmark.refusal_cells import Cells, Leg, classified
from imitarm.benchmark.refusal_question import Question
from imitarm.benchmark.refusal_ways import beside, even, short
from imitarm.scene.obstacle import PosedObstacle

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]

_MAX_CELLS = 60_000, 300_000  # without and with division in time
_FREE_COST = 1e-3  # of a free cell; any other cell costs 1
_WIDER = 1.25, 1.5  # ways that cost up to this factor more, plus this number of cells, are refined with the cheapest
_MAX_FRAMES = 3


@dataclass(frozen=True, eq=False)
class Exploration:
    """What is known of one question.

    Attributes:
        impossible: whether it is proved that no path exists.
        way: times (m,) [s] and positions (m, 3) [m] of a path through free cells; None if no such path was found. Only
            the speed along this path may be too high.
    """

    impossible: bool
    way: tuple[Array, Array] | None = None


def explored(question: Question, *, timed: bool) -> Exploration:
    """Prove that no path exists, or find a way through free cells.

    Args:
        question: scene and path; at least one direction of displacement is permitted.
        timed: whether cells are also divided in time. If False, all cells have the whole duration of a leg. This takes
            little time, and suffices for most scenes in which nothing but the tip moves.
    """
    found = Exploration(False)
    for frame in _frames(question, question.axes()):
        legs = [Leg(question, frame, start, end) for start, end in pairwise(question.fixed_times)]
        parts = [_explored(leg, timed=timed) for leg in legs]
        if any(part.impossible for part in parts):
            return Exploration(True)
        ways = [part.way for part in parts if part.way is not None]
        if len(ways) == len(legs):
            found = Exploration(False, (np.concatenate([w[0] for w in ways]), np.concatenate([w[1] for w in ways])))
        if timed or found.way is not None:
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
    """Divide cells until no way is left, or a way of free cells is found, or there are too many cells."""
    cells, blocked = leg.root(timed=timed)
    if blocked.any():
        return Exploration(True)
    edges = np.empty((2, 0), dtype=np.intp)
    made = 1
    while made < _MAX_CELLS[timed]:
        graph = _Graph(leg, cells, edges)
        if not graph.alive.any():
            return Exploration(True)
        if graph.is_free:
            return Exploration(False, graph.way(timed=timed))
        made += 2 * int(graph.wanted.sum())
        cells, edges = _refined(leg, cells, edges, graph, timed=timed)
    return Exploration(False)


def _refined(leg: Leg, cells: Cells, edges: Index, graph: _Graph, *, timed: bool) -> tuple[Cells, Index]:
    """Divide the wanted cells, and leave out those that are blocked or that no way leads through."""
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
    """The cheapest ways from the start to the goal through cells.

    Args:
        leg: the leg.
        cells: n cells that are not blocked.
        edges: pairs of neighbouring cells, shape (2, m).

    Attributes:
        alive: whether a way leads through the cell, shape (n,).
        wanted: whether the cell is to be divided, shape (n,).
        is_free: whether a way leads through free cells only.
    """

    def __init__(self, leg: Leg, cells: Cells, edges: Index) -> None:
        self._leg, self._cells, n = leg, cells, len(cells)
        cost = np.where(cells.free, _FREE_COST, 1.0)
        first, last = cells.contain(leg.ends[0], 0.0), cells.contain(leg.ends[1], 1.0)
        start, end = cells.times()
        source, target = np.concatenate([edges, edges[::-1]], axis=1)
        onward = end[target] > start[source]
        source, target = source[onward], target[onward]
        self._ways = _directed(source, target, first, cost)
        there = dijkstra(self._ways, indices=n)[:n]
        home = dijkstra(_directed(target, source, last, cost), indices=n)[:n]
        through = there + home - cost
        self.alive = np.isfinite(through)
        cheapest = float(through.min(initial=np.inf))
        self.wanted = self.alive & ~cells.free & (through <= _WIDER[0] * cheapest + _WIDER[1])
        self.is_free = cheapest < 1.0
        self._end = int(last[np.argmin(there[last])]) if self.is_free else -1

    def way(self, *, timed: bool) -> tuple[Array, Array]:
        """Return times (m,) [s] and positions (m, 3) [m] of a path along the cheapest way, whose cells are all free."""
        n, leg = len(self._cells), self._leg
        before = dijkstra(self._ways, indices=n, return_predecessors=True)[1]
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
