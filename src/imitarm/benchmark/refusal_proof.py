"""Proof that no path exists, by a flood fill of boxes in space over time.

Time is divided into intervals, and space into boxes. A box counts as free in an interval if any of its points may be
free at any time in this interval. If no chain of free boxes leads from the start to the goal, then no continuous
displacement of the path keeps the path clear of the obstacles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from imitarm.kinematics.pose import rotate, slerp
from imitarm.scene.obstacle import Obstacle, PosedObstacle
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_DISPLACEMENT = 0.5  # [m] as the product states it
_PROOF_SIZES = {1: (0.004, 0.002, 0.0005), 2: (0.008, 0.0004, 0.0025), 3: (0.025, 0.0015, 0.0125)}  # coarse, flat, fine
_PROOF_INTERVALS = {1: 400, 2: 150, 3: 80}
_MAX_FRAMES = 3
_DENSE = 4000
_ROUNDING = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class Question:
    """The question whether a path exists in a scene, in the form that :func:`is_impossible` takes.

    Attributes:
        nominal: the nominal path, n samples.
        basis: influence of the skill's components on the samples, shape (n, n_components).
        obstacles: obstacles at time 0; each obstacle moves with constant velocity.
        spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required [m].
        forbidden: directions in which the path must not be displaced, shape (k, 3).
        fixed_times: times at which the path must not be displaced [s].
    """

    nominal: Trajectory
    basis: Array
    obstacles: tuple[Obstacle, ...]
    spheres: Array
    clearance: float
    forbidden: Array
    fixed_times: tuple[float, ...]

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return the tip (m, 3) at times (m,), and the sphere centres relative to the tip (n_spheres, m, 3)."""
        tip, quaternions = self.nominal.at(times)
        if quaternions is None:
            return tip, np.zeros((len(self.spheres), len(times), 3))
        rotations = slerp(times, self.nominal.times, np.asarray(self.nominal.quaternions))
        return tip, np.stack([rotate(rotations, np.broadcast_to(s[:3], (len(times), 3))) for s in self.spheres])

    def axes(self) -> Array:
        """Return an orthonormal basis (d, 3) of the permitted displacements."""
        if not len(self.forbidden):
            return np.eye(3)
        unit = self.forbidden / np.linalg.norm(self.forbidden, axis=1, keepdims=True)
        both = unit[(unit @ unit.T).min(axis=1) < -1.0 + 1e-9]
        if not len(both):
            return np.eye(3)
        _, size, rows = np.linalg.svd(both)
        return np.asarray(rows[int(np.sum(size > 1e-6)) :])


def separation(question: Question, times: Array, positions: Array) -> float:
    """Return a proven lower bound of the distance along a path, minus the required clearance [m].

    For any unit vector u, a point p is at least ``u . p - max_x u . x`` away from a convex obstacle. The maximum over
    all points x of the obstacle is its support function. The proof uses no other geometry code of the library; the
    library's distance gradient only proposes u.

    Args:
        question: obstacles, spheres and clearance.
        times: times of the path [s], shape (n,).
        positions: positions of the tip, a polyline, shape (n, 3) [m].
    """
    dense = np.unique(np.concatenate([np.linspace(times[0], times[-1], _DENSE), times]))
    tip = np.stack([np.interp(dense, times, column) for column in positions.T], axis=1)
    _, relative = question.at(dense)
    lowest = np.inf
    for obstacle in question.obstacles:
        for sphere, offset in zip(question.spheres, relative, strict=True):
            points = tip + offset - dense[:, None] * obstacle.velocity
            u = obstacle.gradient(points)
            u = u / np.linalg.norm(u, axis=1, keepdims=True)
            gap = np.einsum("nd,nd->n", u, points - obstacle.support(u)) - sphere[3]
            lowest = min(lowest, float(gap.min()))
    return lowest - question.clearance


def covers_fixed_point(question: Question) -> bool:
    """Return whether an obstacle is too close to the tool at a fixed time, where the path may not be displaced."""
    times = np.asarray(question.fixed_times)
    tip, relative = question.at(times)
    for obstacle in question.obstacles:
        points = tip + relative - times[:, None] * obstacle.velocity
        needed = question.clearance + question.spheres[:, 3, None]
        if np.any(obstacle.signed_distance(points) < needed - _ROUNDING):
            return True
    return False


@dataclass(frozen=True, eq=False)
class _Cells:
    """A regular grid of equal boxes that fills a region of positions.

    Attributes:
        frame: unit vectors along the edges, shape (d, 3); an orthonormal basis of the permitted line, plane or space.
        size: size of a box along each edge, shape (d,) [m].
        lowest: smallest coordinates of all boxes, shape (d,) [m].
        counts: number of boxes along each edge, shape (d,).
    """

    frame: Array
    size: Array
    lowest: Array
    counts: tuple[int, ...]

    def window(self, centre: Array) -> tuple[tuple[int, int], ...]:
        """Return the boxes that the largest displacement from ``centre`` (3,) [m] can reach.

        Returns:
            For each edge, the index of the first box, and the index of the last box plus one.
        """
        low = np.floor((self.frame @ centre - MAX_DISPLACEMENT - self.lowest) / self.size).astype(int)
        high = np.ceil((self.frame @ centre + MAX_DISPLACEMENT - self.lowest) / self.size).astype(int)
        return tuple((max(a, 0), min(b, n)) for a, b, n in zip(low, high, self.counts, strict=True))

    def within(
        self, window: tuple[tuple[int, int], ...], obstacle: Obstacle, shift: Array, need: float
    ) -> tuple[tuple[int, int], ...] | None:
        """Return those boxes of a window that fit into the bounding box of an inflated obstacle.

        The boxes are moved by ``shift`` (3,) [m], and the obstacle is inflated by ``need`` [m]. Every other box has a
        corner outside the inflated obstacle.

        Returns:
            For each edge, the index of the first box, and the index of the last box plus one; None when no box fits.
        """
        part = []
        for axis, (a, b), low, size in zip(self.frame, window, self.lowest, self.size, strict=True):
            ticks = low + size * np.arange(a, b + 1) + axis @ shift
            least, most = obstacle.support(-axis) @ axis - need, obstacle.support(axis) @ axis + need
            fits = np.flatnonzero((ticks >= least - _ROUNDING) & (ticks <= most + _ROUNDING))
            if len(fits) < 2:
                return None
            part.append((a + int(fits[0]), a + int(fits[-1])))
        return tuple(part)

    def corners(self, window: tuple[tuple[int, int], ...], centre: Array) -> Array:
        """Return the corners of a window's boxes, in the plane through ``centre`` (3,); shape (n_0 + 1, ..., 3) [m]."""
        ticks = [
            low + size * np.arange(a, b + 1) for (a, b), low, size in zip(window, self.lowest, self.size, strict=True)
        ]
        grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
        return np.asarray(grid @ self.frame + (centre - self.frame.T @ (self.frame @ centre)))


def grids(question: Question, axes: Array) -> Iterator[_Cells]:
    """Yield grids to try: first coarse cubes, then flat boxes aligned with obstacles, finally finer cubes."""
    d = len(axes)
    coarse, thin, fine = _PROOF_SIZES[d]
    yield _cells(question, axes, np.full(d, coarse))
    frames = [axes]
    for obstacle in question.obstacles:
        if isinstance(obstacle, PosedObstacle) and d > 1:
            frame = _aligned(obstacle.pose.rotation.T, axes)
            if not any(np.abs(np.abs(frame @ other.T) - np.eye(d)).max() < 1e-6 for other in frames[1:]):
                frames.append(frame)
    if len(frames) > 1:
        yield _cells(question, frames[1], np.full(d, fine))
    for frame in frames[1:][:_MAX_FRAMES]:
        # The faces across an obstacle's longest extent are where a path passes it: thin boxes there first.
        extent = [max(_extent(obstacle, axis) for obstacle in question.obstacles) for axis in frame]
        for axis in np.argsort(extent)[::-1].tolist() if d == 2 or not question.spheres[:, :3].any() else ():
            # A wall blocks a box only when it is at least twice as thick as the box, wherever the box lies.
            thickness = min(_extent(obstacle, row) for obstacle in question.obstacles for row in frame)
            thickness += 2.0 * (question.clearance + float(question.spheres[:, 3].min()))
            size = np.full(d, float(np.clip(0.45 * thickness, 0.25 * coarse, (4 - d) * coarse)))
            size[axis] = thin
            yield _cells(question, frame, size)
    yield _cells(question, axes, np.full(d, fine))


def _extent(obstacle: Obstacle, direction: Array) -> float:
    return float((obstacle.support(direction) - obstacle.support(-direction)) @ direction)


def _aligned(rotation: Array, axes: Array) -> Array:
    """Return an orthonormal basis (d, 3) of the space that ``axes`` (d, 3) span, aligned with ``rotation`` (3, 3)."""
    d = len(axes)
    inside = rotation @ axes.T @ axes
    first = inside[int(np.argmax(np.linalg.norm(inside, axis=1)))]
    first = first / np.linalg.norm(first)
    if d == 3:
        return rotation
    return np.stack([first, np.cross(np.cross(axes[0], axes[1]), first)])


def _cells(question: Question, frame: Array, size: Array) -> _Cells:
    along = question.nominal.positions @ frame.T
    lowest = along.min(axis=0) - MAX_DISPLACEMENT - size
    counts = np.ceil((along.max(axis=0) + MAX_DISPLACEMENT + size - lowest) / size).astype(int)
    return _Cells(frame, size, lowest, tuple(counts.tolist()))


def is_impossible(question: Question, cells: _Cells) -> bool:
    """Return whether there is provably no path, because a flood fill of possibly free boxes can't reach the goal.

    A box is blocked if all of its corners are inside the same inflated obstacle. The corners suffice, because the
    obstacle is convex. Boxes are fixed in space, so the motion of the tip in the permitted plane does not matter. For
    all other motions, the obstacles are made smaller. These are motions of the tip out of the permitted plane, of the
    spheres relative to the tip, and of the obstacles.
    """
    d = len(cells.frame)
    moving = any(obstacle.velocity.any() for obstacle in question.obstacles)
    spans = np.linspace(0.0, question.nominal.times[-1], (4 if moving else 1) * _PROOF_INTERVALS[d] + 1)
    spans = np.unique(np.concatenate([spans, question.fixed_times]))
    first = question.at(np.array([0.0]))[0][0]
    window = cells.window(first)
    reached = _touching(cells, window, first)
    # Where nothing but the tip moves, and it hardly leaves the plane, what is free stays free.
    steady = not moving and not question.spheres[:, :3].any()
    everything = tuple((0, n) for n in cells.counts)
    drift = 0.02 * float(cells.size.min())
    known: tuple[Array, Bools] | None = None
    for start, end in pairwise(spans.tolist()):
        times = np.unique(np.concatenate([[start, 0.5 * (start + end), end], _inside(question, start, end)]))
        tip, relative = question.at(times)
        middle = int(np.searchsorted(times, 0.5 * (start + end)))
        new = cells.window(tip[middle])
        reached = _shifted(reached, window, new)
        window = new
        if steady:
            out = tip - tip @ cells.frame.T @ cells.frame
            if known is None or np.linalg.norm(out - known[0], axis=1).max() > drift:
                extra = max(drift, float(np.linalg.norm(out - out[middle], axis=1).max()))
                slack = np.full((len(question.obstacles), len(question.spheres)), extra)
                known = (
                    out[middle],
                    _maybe_free(question, cells, everything, 0.0, tip[middle], relative[:, middle], slack),
                )
            free = known[1][tuple(slice(a, b) for a, b in window)]
        else:
            slack = _leftover_motion(question, cells, times, tip, relative, middle)
            free = _maybe_free(question, cells, window, times[middle], tip[middle], relative[:, middle], slack)
        usable = free & _permitted(question, cells, window, times, tip)
        labels, _ = ndimage.label(usable, structure=np.ones((3,) * d))
        seen = np.zeros(int(labels.max()) + 1, dtype=bool)
        seen[labels[reached & usable]] = True
        seen[0] = False
        reached = seen[labels]
        if not reached.any():
            return True
        if np.min(np.abs(end - np.asarray(question.fixed_times))) < 1e-12:
            reached &= _touching(cells, window, tip[-1])
            if not reached.any():
                return True
    return False


def _touching(cells: _Cells, window: tuple[tuple[int, int], ...], point: Array) -> Bools:
    """Return for each box of a window whether the box contains ``point`` (3,) [m] or touches it."""
    at = (cells.frame @ point - cells.lowest) / cells.size
    lines = [
        (np.arange(a, b) - 1e-9 <= x) & (x <= np.arange(a, b) + 1.0 + 1e-9)
        for (a, b), x in zip(window, at, strict=True)
    ]
    answer = lines[0]
    for line in lines[1:]:
        answer = answer[..., None] & line
    return np.asarray(answer)


def _shifted(values: Bools, old: tuple[tuple[int, int], ...], new: tuple[tuple[int, int], ...]) -> Bools:
    """Copy the values of the boxes from window ``old`` to window ``new``; boxes outside the old window get False."""
    answer = np.zeros([b - a for a, b in new], dtype=bool)
    low = [max(a, c) for (a, _), (c, _) in zip(old, new, strict=True)]
    high = [min(b, e) for (_, b), (_, e) in zip(old, new, strict=True)]
    here = tuple(slice(i - a, j - a) for i, j, (a, _) in zip(low, high, new, strict=True))
    there = tuple(slice(i - a, j - a) for i, j, (a, _) in zip(low, high, old, strict=True))
    answer[here] = values[there]
    return answer


def _inside(question: Question, start: float, end: float) -> Array:
    times = question.nominal.times
    return np.asarray(times[(times > start) & (times < end)])


def _leftover_motion(
    question: Question, cells: _Cells, times: Array, tip: Array, relative: Array, middle: int
) -> Array:
    """Return how far each of m spheres moves relative to each obstacle, shape (n_obstacles, m) [m].

    Displacements are measured from the sample ``middle``. Motion of the tip in the permitted plane does not count.
    """
    out_of_plane = tip - tip @ cells.frame.T @ cells.frame
    bow = np.linalg.norm(question.spheres[:, :3], axis=1) * 1e-3 * bool(np.abs(np.diff(relative, axis=1)).max() > 0.0)
    answer = np.empty((len(question.obstacles), len(question.spheres)))
    for i, obstacle in enumerate(question.obstacles):
        points = out_of_plane + relative - times[:, None] * obstacle.velocity
        answer[i] = np.linalg.norm(points - points[:, middle : middle + 1], axis=-1).max(axis=1) + bow
    return np.asarray(answer)


def _maybe_free(
    question: Question,
    cells: _Cells,
    window: tuple[tuple[int, int], ...],
    time: float,
    tip: Array,
    relative: Array,
    slack: Array,
) -> Bools:
    """Return for each box whether any of its points may be free of obstacles."""
    d = len(cells.frame)
    blocked = np.zeros([b - a for a, b in window], dtype=bool)
    for i, obstacle in enumerate(question.obstacles):
        for j, sphere in enumerate(question.spheres):
            shift = relative[j] - time * obstacle.velocity
            need = question.clearance + sphere[3] - slack[i, j]
            part = cells.within(window, obstacle, shift, need)
            if part is None:
                continue
            inside = obstacle.signed_distance(cells.corners(part, tip) + shift) < need
            for axis in range(d):
                first, last = halves(axis, d)
                inside = inside[first] & inside[last]
            blocked[tuple(slice(a - c, b - c) for (a, b), (c, _) in zip(part, window, strict=True))] |= inside
    return ~blocked


def _permitted(
    question: Question, cells: _Cells, window: tuple[tuple[int, int], ...], times: Array, tip: Array
) -> Bools:
    """Return for each box whether the path may be displaced into the box at some time of an interval."""
    answer = np.ones([b - a for a, b in window], dtype=bool)
    corners: Array | None = None
    for f in question.forbidden:
        unit = f / np.linalg.norm(f)
        if np.linalg.norm(cells.frame @ unit) < 1e-9:
            continue
        corners = cells.corners(window, tip[0]) if corners is None else corners
        height = corners @ unit
        for axis in range(len(window)):
            first, last = halves(axis, len(window))
            height = np.minimum(height[first], height[last])
        answer &= height <= (tip @ unit).max() + 1e-9
    return answer


def halves(axis: int, d: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return two indices of a d-dimensional array.

    Along ``axis``, the first index omits the last entry, and the second index omits the first entry.
    """
    first, last = [slice(None)] * d, [slice(None)] * d
    first[axis], last[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(last)
