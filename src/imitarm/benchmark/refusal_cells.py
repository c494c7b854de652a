"""Boxes of positions and times, and which of them an obstacle or a limit blocks.

A *cell* is a box of positions of the tip and an interval of time. A cell is blocked only if this is certain for every
position in the box at every time in the interval: then one inflated obstacle contains the tool's sphere throughout, or
every position is displaced too far or in a forbidden direction. The inflated obstacle is convex. It therefore contains
everything between points that it contains, and a few points suffice: the corners of the box that contains the sphere's
centre at all times. A cell is free if, just as certainly, nothing can block any part of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.refusal_question import MAX_DISPLACEMENT, Question

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]

TIME_LEVELS = 10  # a leg is divided into at most 2^10 intervals
TOUCH = 1e-12  # [m] cells that are less apart touch
_ROUNDING = 1e-9  # [m]
_STILL = 1e-12  # [m] a box that is smaller along an axis is flat
_EVERYWHERE = np.eye(3)


class Leg:
    """The part of the motion between two neighbouring fixed times, at which the position of the tip is known.

    The coordinates of a position are its components along ``frame``: first the d permitted directions, then the others.
    The tip is displaced only along the former. Everything else that moves is known: the tip along the other directions,
    the spheres relative to the tip, and the obstacles. A table contains, for each interval of time and each pair of an
    obstacle and a sphere, the box of this known motion. Level l of the table divides the leg into 2^l intervals.

    Args:
        question: scene and path.
        axes: orthonormal basis of the permitted displacements, shape (d, 3).
        start: first time of the leg [s].
        end: last time of the leg [s].

    Attributes:
        dimension: number d of permitted directions.
        frame: rows are unit vectors, the permitted ones first, shape (3, 3).
        pairs: for each pair, its obstacle and the required distance of the sphere's centre from it [m].
        ends: coordinates of the tip at the start and at the end of the leg, shape (2, d) [m].
        one_sided: components of the forbidden directions along the permitted axes, shape (m, d).
    """

    def __init__(self, question: Question, axes: Array, start: float, end: float) -> None:
        d = self.dimension = len(axes)
        self._question, self.start, self.end = question, start, end
        self.frame = np.concatenate([axes, np.linalg.svd(axes)[2][d:]])
        edges = np.linspace(start, end, 2**TIME_LEVELS + 1)
        samples = question.nominal.times
        times = np.unique(np.concatenate([edges, samples[(samples > start) & (samples < end)]]))
        first = np.searchsorted(times, edges)
        tip, relative = question.at(times)
        along = tip @ self.frame.T
        self.ends = along[[0, -1], :d]
        self.pairs = [(o, question.clearance + float(s[3])) for o in question.obstacles for s in question.spheres]
        known = np.where(np.arange(3) < d, 0.0, along)
        low, high = np.empty((2, len(edges) - 1, len(self.pairs), 3))
        bows = np.tile(_bows(question), len(question.obstacles))
        for k, (obstacle, _) in enumerate(self.pairs):
            moved = relative[k % len(question.spheres)] - times[:, None] * obstacle.velocity
            motion = known + moved @ self.frame.T
            low[:, k] = _over(np.minimum, motion, first) - bows[k]
            high[:, k] = _over(np.maximum, motion, first) + bows[k]
        self._motion = _levels(np.minimum, low), _levels(np.maximum, high)
        tips = along[:, :d]
        self._tip = (
            _levels(np.minimum, _over(np.minimum, tips, first)),
            _levels(np.maximum, _over(np.maximum, tips, first)),
        )
        slopes = question.forbidden / np.linalg.norm(question.forbidden, axis=1, keepdims=True) @ axes.T
        self.one_sided = slopes[np.linalg.norm(slopes, axis=1) > 1e-9]

    def positions(self, coordinates: Array, times: Array) -> Array:
        """Return the positions (m, 3) [m] of the tip with coordinates (m, d) at ``times`` (m,), parts of the leg."""
        tip = self._question.at(self.start + times * (self.end - self.start))[0]
        axes = self.frame[: self.dimension]
        return np.asarray(tip + (coordinates - tip @ axes.T) @ axes)

    def nominal(self) -> tuple[Array, Array]:
        """Return the times (n,) of the samples, as parts of the leg, and the undisplaced coordinates (n, d) [m]."""
        samples = self._question.nominal.times
        samples = np.concatenate([[self.start], samples[(samples > self.start) & (samples < self.end)], [self.end]])
        tip = self._question.at(samples)[0]
        return (samples - self.start) / (self.end - self.start), tip @ self.frame[: self.dimension].T

    def tip_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the box of the undisplaced tip in intervals (n,) of time: lowest and highest coordinates (n, d)."""
        return _looked_up(self._tip[0], level, at), _looked_up(self._tip[1], level, at)

    def motion_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the boxes of the known motion in intervals (n,) of time: two corners of each, (n, n_pairs, 3)."""
        return _looked_up(self._motion[0], level, at), _looked_up(self._motion[1], level, at)

    def root(self, *, timed: bool) -> tuple[Cells, Bools]:
        """Return one cell with all permitted positions and times, and whether it is blocked, shape (1,).

        Args:
            timed: see :func:`classified`.
        """
        whole = np.zeros(1, dtype=np.intp)
        low, high = self.tip_box(whole, whole)
        # Not symmetric about the path: otherwise, many scenes have an obstacle exactly at the border of two cells.
        low, high = low - 1.02 * MAX_DISPLACEMENT, high + 1.01 * MAX_DISPLACEMENT
        return classified(self, Cells.unknown(low, high, whole, whole, whole), timed=timed)


@dataclass(frozen=True, eq=False)
class Cells:
    """Boxes of positions, each with an interval of time.

    Attributes:
        low: lowest coordinates, shape (n, d) [m].
        high: highest coordinates, shape (n, d) [m].
        level: level of the interval, which is the 2^level-th part of the leg, shape (n,).
        at: number of the interval on its level, shape (n,).
        depth: number of divisions from which the cell results, shape (n,).
        free: whether the cell is certainly free, shape (n,).
        axis: axis along which the cell is divided next; d stands for time, shape (n,).
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
        """Return cells of which nothing is known yet."""
        n = len(level)
        return cls(low, high, level, at, depth, np.zeros(n, dtype=bool), np.zeros(n, dtype=np.intp))

    def __len__(self) -> int:
        return len(self.level)

    def take(self, chosen: Index) -> Cells:
        """Return some of the cells."""
        return Cells(**{name: values[chosen] for name, values in vars(self).items()})

    def __add__(self, other: Cells) -> Cells:
        return Cells(**{name: np.concatenate([values, getattr(other, name)]) for name, values in vars(self).items()})

    def times(self) -> tuple[Array, Array]:
        """Return start and end of each interval, as fractions of the leg, each of shape (n,)."""
        length = 0.5**self.level
        return self.at * length, (self.at + 1) * length

    def touch(self, i: Index, j: Index) -> Bools:
        """Return for pairs (m,) of cells whether they have a position and a time in common."""
        start, end = self.times()
        answer = (start[i] <= end[j]) & (start[j] <= end[i])
        for low, high in zip(self.low.T, self.high.T, strict=True):
            answer &= (low[i] <= high[j] + TOUCH) & (low[j] <= high[i] + TOUCH)
        return np.asarray(answer)

    def contain(self, position: Array, time: float) -> Index:
        """Return the cells that contain a position (d,) [m] at a time, a fraction of the leg."""
        start, end = self.times()
        inside = np.all((self.low - TOUCH <= position) & (position <= self.high + TOUCH), axis=1)
        return np.flatnonzero(inside & (start <= time) & (time <= end))

    def halves(self) -> Cells:
        """Return the 2 n halves of the cells: first all lower or earlier halves, then all others."""
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
    along each axis. A cell is divided along the longest span of one obstacle or limit. Three choices of the latter take
    turns, because each alone would divide some cells for ever without a result:

    * the one that needs the least additional depth to block the whole cell;
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
    """Find out which cells are blocked, which are free, and along which axis to divide them.

    Args:
        leg: obstacles, limits and motion.
        cells: new cells.
        timed: whether cells may be divided in time. If False, a limit that blocks a cell only at some time is ignored.

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
        step = half[:, axis, None] * _EVERYWHERE[axis]
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


def _bows(question: Question) -> Array:
    """Return how far each sphere's centre moves away from straight lines between samples, at most, (n_spheres,) [m]."""
    arms, quaternions = np.linalg.norm(question.spheres[:, :3], axis=1), question.nominal.quaternions
    if quaternions is None:
        return np.zeros(len(arms))
    cosine = np.abs(np.sum(quaternions[1:] * quaternions[:-1], axis=1)).min(initial=1.0)
    return np.asarray(arms * (1.0 - min(float(cosine), 1.0) + 1e-12))


def _over(reduce: np.ufunc, values: Array, first: Index) -> Array:
    """Reduce ``values`` (m, ...) over the intervals from ``first[i]`` to ``first[i + 1]``, both included."""
    return np.asarray(reduce(reduce.reduceat(values, first[:-1], axis=0), values[first[1:]]))


def _levels(reduce: np.ufunc, finest: Array) -> list[Array]:
    """Return a table with 1, 2, 4, ... rows, in which each row reduces two rows of the next level."""
    levels = [finest]
    while len(levels[-1]) > 1:
        levels.append(reduce(levels[-1][::2], levels[-1][1::2]))
    return levels[::-1]


def _looked_up(levels: list[Array], level: Index, at: Index) -> Array:
    found = np.empty((len(level), *levels[0].shape[1:]))
    for number in np.unique(level).tolist():
        own = np.flatnonzero(level == number)
        found[own] = levels[number][at[own]]
    return found
