"""Passages between obstacles: a grid of tool positions that proposes a path, or proves that no path exists.

The grid covers all positions that the path may reach, and is aligned with an obstacle. The obstacles are enlarged by
the required clearance and the radius of the tool. A cell of the grid is blocked if all its corners are inside one
enlarged obstacle. Enlarged obstacles are convex, so the whole cell is then inside. If no chain of free cells joins the
start, the pinned points and the goal of the path, there is no path. Otherwise, the cheapest chain proposes a path. Such
a path may reach positions that no straight ray from the nominal path reaches, for example out of a shelf.

The grid does not depend on time, so it contains only obstacles at rest. The largest of the tool's spheres with the
centre at the tip represents the tool. If there is no such sphere, the grid is not used.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from imitarm.policies.certificate import ToolAmongObstacles
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import MAX_DISPLACEMENT, MAX_STEP_RATIO, AllowedDirections, largest_step
from imitarm.scene.obstacle import Obstacle, PosedObstacle

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Index = NDArray[np.intp]
Box = tuple[slice, ...]

_SIZE = {2: 0.004, 3: 0.02}  # [m] of a cell, by the number of dimensions
_COARSER = {2: 2, 3: 1}  # of these cells along each axis are one cell of the search for a chain
_ROUNDING = 1e-9  # [m]
_MISSING_COST = 50.0  # of a metre of missing clearance, per cell, beside the length of the chain in cells
_POINTS = 300  # of a chain, at which the path may be at the time of a sample
_STEADY = 4.0  # weight of squared steps beside squared displacements


class Passages:
    """The grid of positions among one set of obstacles.

    Args:
        path: the nominal path and its components.
        tool: the tool and the obstacles.
        clearance: required clearance [m].
        allowed: directions in which components may move; they must span at least two dimensions.
    """

    def __init__(
        self, path: ComponentPath, tool: ToolAmongObstacles, clearance: float, allowed: AllowedDirections
    ) -> None:
        self._path, self._allowed = path, allowed
        d = self._d = allowed.dimension
        at_tip = [s[3] for s in tool.spheres if not s[:3].any()]
        self._obstacles = tuple(o for o in tool.obstacles if not o.velocity.any()) if at_tip else ()
        self._need = clearance + max(at_tip, default=0.0)
        frame = _aligned(allowed.axes.T, self._obstacles)
        self._frame = np.concatenate([frame, np.linalg.svd(frame)[2][d:]])
        self._along = path.nominal.positions @ self._frame.T  # coordinates of the path, (n, 3)
        self._size = _SIZE[d]
        self._lowest = self._along[:, :d].min(axis=0) - MAX_DISPLACEMENT
        extent = self._along[:, :d].max(axis=0) + MAX_DISPLACEMENT - self._lowest
        more = _COARSER[d]
        self.counts = tuple((more * np.ceil(extent / (more * self._size))).astype(int).tolist())
        rest = self._along[:, d:]
        self._levels = np.unique(np.stack([rest.min(axis=0), rest.max(axis=0)]), axis=0)
        self._fixed = [0, *path.fixed[(path.fixed > 0) & (path.fixed < len(path.nominal) - 1)].tolist(), -1]

    @cached_property
    def _blocked(self) -> Bools:
        """Whether each cell is blocked."""
        blocked = np.zeros(self.counts, dtype=bool)
        for obstacle in self._obstacles:
            box = self._around(obstacle, self._need, inwards=True)
            if box is None:
                continue
            nodes = tuple(slice(s.start, s.stop + 1) for s in box)
            inside = self._distance(obstacle, nodes, 0.0) < self._need - _ROUNDING
            for axis in range(self._d):
                first, last = [slice(None)] * self._d, [slice(None)] * self._d
                first[axis], last[axis] = slice(None, -1), slice(1, None)
                inside = inside[tuple(first)] & inside[tuple(last)]
            blocked[box] |= inside
        return blocked

    def _around(self, obstacle: Obstacle, reach: float, *, inwards: bool) -> Box | None:
        """Return the cells in the bounding box of an inflated obstacle; None if there are none.

        Args:
            obstacle: the obstacle.
            reach: distance by which the obstacle is inflated [m].
            inwards: whether cells that are only partly in the bounding box are left out.
        """
        box = []
        for axis, low, n in zip(self._frame, self._lowest, self.counts, strict=False):
            least = (float(obstacle.support(-axis) @ axis) - reach - low) / self._size
            most = (float(obstacle.support(axis) @ axis) + reach - low) / self._size
            a, b = (np.ceil(least), np.floor(most)) if inwards else (np.floor(least), np.ceil(most))
            a, b = max(int(a), 0), min(int(b), n)
            if b <= a:
                return None
            box.append(slice(a, b))
        return tuple(box)

    def _distance(self, obstacle: Obstacle, box: Box, offset: float, step: int = 1) -> Array:
        """Return the distances at points of the grid [m].

        In a plane, the path itself may leave the plane. The result is then the largest distance at the two levels
        between which the path stays. Because the distance is convex, it is not larger at any level between them.

        Args:
            obstacle: the obstacle.
            box: indices of the points along each axis.
            offset: distance of the points from the corners of cells, in cells.
            step: distance between the points, in cells.
        """
        ticks = [
            low + self._size * (np.arange(s.start, s.stop, step) + offset)
            for low, s in zip(self._lowest, box, strict=True)
        ]
        grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1) @ self._frame[: self._d]
        distances = [obstacle.signed_distance(grid + level @ self._frame[self._d :]) for level in self._levels]
        return np.asarray(distances[0] if len(distances) == 1 else np.max(distances, axis=0))

    def _cell_of(self, coordinates: Array) -> Index:
        """Return the indices (..., d) of the cells that contain coordinates (..., d) [m]."""
        index = np.floor((coordinates - self._lowest) / self._size).astype(np.intp)
        return np.minimum(index, np.array(self.counts) - 1)

    @cached_property
    def are_closed(self) -> bool:
        """Whether the grid proves that no path exists."""
        if not self._obstacles:
            return False
        labels, _ = ndimage.label(~self._blocked, structure=np.ones((3,) * self._d))
        met = labels[tuple(self._cell_of(self._along[self._fixed, : self._d]).T)]
        return bool(met.min() == 0 or np.ptp(met) > 0)

    def route(self) -> Array | None:
        """Return the cheapest chain as displacements of the tip at all samples (n, 3) [m]; None if there is no chain.

        The positions of the chain may be a little too close to obstacles.
        """
        if not self._obstacles:
            return None
        d, k = self._d, _COARSER[self._d]
        missing = np.zeros(tuple(n // k for n in self.counts))
        for obstacle in self._obstacles:
            box = self._around(obstacle, self._need + k * self._size, inwards=False)
            if box is None:
                continue
            box = tuple(slice(s.start // k * k, -(-s.stop // k) * k) for s in box)
            lacking = self._need - self._distance(obstacle, box, 0.5 * k, k)
            part = missing[tuple(slice(s.start // k, s.stop // k) for s in box)]
            np.maximum(part, lacking, out=part)
        blocked = self._blocked
        for axis in range(d):
            blocked = np.logical_and.reduceat(blocked, np.arange(0, self.counts[axis], k), axis=axis)
        graph = _graph(np.where(blocked, np.inf, 1.0 + _MISSING_COST / self._size * missing))
        corners = np.ravel_multi_index(tuple((self._cell_of(self._along[self._fixed, :d]) // k).T), blocked.shape)
        moved = np.zeros((len(self._along), 3))
        samples = [j % len(self._along) for j in self._fixed]
        for (a, b), (i, j) in zip(pairwise(corners.tolist()), pairwise(samples), strict=True):
            chain = _chain(graph, a, b)
            if chain is None:
                return None
            cells = np.stack(np.unravel_index(chain, blocked.shape), axis=1)
            points = self._lowest + self._size * k * (cells + 0.5)
            points[[0, -1]] = self._along[[i, j], :d]
            nominal = self._along[i : j + 1, :d]
            longest = MAX_STEP_RATIO * largest_step(self._path.nominal.positions)
            followed = _followed(points, nominal, longest)
            if followed is None:
                return None
            moved[i : j + 1] = (followed - nominal) @ self._frame[:d]
        return moved


def _aligned(axes: Array, obstacles: tuple[Obstacle, ...]) -> Array:
    """Return an orthonormal basis (d, 3) of what ``axes`` (d, 3) span, aligned with an obstacle if possible."""
    posed = [o for o in obstacles if isinstance(o, PosedObstacle)]
    if not posed:
        return axes
    rotation = posed[0].pose.rotation.T
    if len(axes) == 3:
        return rotation
    inside = rotation @ axes.T @ axes
    first = inside[int(np.argmax(np.linalg.norm(inside, axis=1)))]
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(np.cross(axes[0], axes[1]), first)])


def _graph(cost: Array) -> sparse.csr_matrix:
    """Return the graph of a grid, in which an edge joins neighbouring cells with finite costs, and costs their mean."""
    number = np.arange(cost.size).reshape(cost.shape)
    rows, columns, values = [], [], []
    for axis in range(cost.ndim):
        first, last = [slice(None)] * cost.ndim, [slice(None)] * cost.ndim
        first[axis], last[axis] = slice(None, -1), slice(1, None)
        price = 0.5 * (cost[tuple(first)] + cost[tuple(last)])
        open_ = np.isfinite(price)
        rows.append(number[tuple(first)][open_])
        columns.append(number[tuple(last)][open_])
        values.append(price[open_])
    joined = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(joined, shape=(cost.size, cost.size))


def _chain(graph: sparse.csr_matrix, start: int, end: int) -> Index | None:
    """Return the cells of the cheapest chain, in order; None if there is none."""
    cost, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    if not np.isfinite(cost[end]):
        return None
    chain = [end]
    while chain[-1] != start:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1], dtype=np.intp)


def _followed(chain: Array, nominal: Array, longest: float) -> Array | None:
    """Return points (n, d) [m] of a polyline, one for each sample, that stay as near the nominal path as possible.

    Dynamic programming minimises the squared displacements and the squared steps. The points never go backwards.

    Args:
        chain: corners of the polyline, shape (m, d) [m].
        nominal: nominal path, shape (n, d) [m].
        longest: largest length of a step [m].

    Returns:
        The points; None if the polyline is too long.
    """
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], _POINTS)
    points = np.stack([np.interp(at, length, column) for column in chain.T], axis=1)
    steps = np.arange(1 + min(int(0.8 * longest / max(at[1], 1e-9)), _POINTS - 1))
    prices = _STEADY * (steps * at[1]) ** 2
    away = np.sum((points[None] - nominal[:, None]) ** 2, axis=-1)
    cost = np.full(_POINTS, np.inf)
    cost[0] = 0.0
    best = np.zeros((len(nominal), _POINTS), dtype=np.intp)
    for i in range(1, len(nominal)):
        padded = np.concatenate([np.full(len(steps) - 1, np.inf), cost])
        options = np.lib.stride_tricks.sliding_window_view(padded, len(steps))[:, ::-1] + prices
        best[i] = options.argmin(axis=1)
        cost = np.take_along_axis(options, best[i][:, None], axis=1)[:, 0] + away[i]
    if not np.isfinite(cost[-1]):
        return None
    chosen = np.full(len(nominal), _POINTS - 1)
    for i in range(len(nominal) - 1, 0, -1):
        chosen[i - 1] = chosen[i] - best[i, chosen[i]]
    return points[chosen]
