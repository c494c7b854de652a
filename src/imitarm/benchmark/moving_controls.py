"""Controls of the moving benchmark: methods whose results show that the benchmark measures what it should.

* ``no-avoidance`` follows the learned motion. If it succeeded, the scenes would test nothing.
* ``aims-at-obstacle`` steers to the middle of the nearest tracked obstacle. If it ever succeeded, the measures would be
  wrong.
* ``oracle-future`` knows the true motion of the obstacles. A scene that this oracle does not solve may have no
  solution.
* ``oracle-tracks`` knows only the tracked obstacles, as the methods do. It searches again every 0.1 s.

The oracles search space and time (:func:`search`) and share no code with the compared methods.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from imitarm.benchmark.controls import NoAvoidance, middle
from imitarm.benchmark.moving_scenes import MovingCase, distances_in_time
from imitarm.benchmark.static_measures import LATEST
from imitarm.command import Command
from imitarm.errors import InfeasibleError
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.policy import Observation, Policy
from imitarm.scene import Scene
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Gap = Callable[[Array, float], Array]
"""Type of a function of points (n, 3) [m] and a time [s]. The function returns, for a tool at each of the points, the
gap to the nearest obstacle at that time, shape (n,) [m]."""

LAYER = 0.05
"""Time between two layers of the search [s]; a layer is the grid of cells at one instant."""
_CELL = {2: 0.02, 3: 0.03}  # [m]
_BESIDE = {2: 0.30, 3: 0.24}  # [m] the grid reaches so far beyond the learned path
_REACH = 2  # cells that the tool may move between two layers
_STEP_COST = 0.3  # of the squared length of a step, relative to the squared distance from the learned motion
_BLUR = 1.2  # layers: standard deviation of the filter that smooths a chain of cells
_SPEED = 0.4  # [m/s] at which the tool aims at an obstacle
_GAIN = 8.0  # [1/s]
_ARRIVED = 3e-3  # [m]
_MARGINS = (0.045, 0.03, 0.02, 0.012, 0.006)  # [m] of the oracle, largest first
_PERIOD = 0.1  # [s] between two searches of the oracle with tracks
_LATER = 0.3  # durations after the learned one that the oracle with tracks searches
_AHEAD = 0.97  # of the longest duration, for the arrival


@dataclass(frozen=True, eq=False)
class Grid:
    """The grid of cells around a learned path in which the oracles search.

    Attributes:
        points: centres of the cells, shape (n, 3) [m].
        shape: number of cells along each axis.
        cell: width of a cell [m].
        low: centre of the first cell, shape (3,) [m].
    """

    points: Array
    shape: tuple[int, int, int]
    cell: float
    low: Array

    @classmethod
    def around(cls, path: Array, *, planar: bool) -> Grid:
        """Return the grid around a path (n, 3) [m]; in a plane, it has one layer of cells in height."""
        d = 2 if planar else 3
        cell, beside = _CELL[d], np.array([_BESIDE[d], _BESIDE[d], 0.0 if planar else _BESIDE[d]])
        low = path.min(axis=0) - beside
        low += np.mod(path[0] - low, cell) - cell * (np.mod(path[0] - low, cell) > 0.0)  # the start is a centre
        count = np.floor((path.max(axis=0) + beside - low) / cell + 1e-9).astype(int) + 1
        axes = [low[i] + cell * np.arange(count[i]) for i in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return cls(points, (int(count[0]), int(count[1]), int(count[2])), cell, low)

    def index(self, position: Array) -> tuple[int, int, int]:
        """Return the cell that contains a position."""
        i = np.clip(np.round((position - self.low) / self.cell).astype(int), 0, np.array(self.shape) - 1)
        return int(i[0]), int(i[1]), int(i[2])

    def moves(self) -> list[tuple[int, int, int]]:
        """Return the allowed moves from one layer to the next, in cells; the first move is to stay in the same cell."""
        x, y, z = (range(-min(_REACH, n - 1), min(_REACH, n - 1) + 1) for n in self.shape)
        found = [m for m in itertools.product(x, y, z) if sum(i * i for i in m) <= _REACH**2]
        return sorted(found, key=lambda m: sum(i * i for i in m))


def search(
    grid: Grid, start: Array, nominal: Trajectory, gap: Gap, *, begin: float, end: float, margin: float
) -> Trajectory | None:
    """Return the motion of least cost from ``start`` to the goal, or None if there is no such motion.

    From one layer to the next, the tool may stay or move to a near cell. A cell is free in a layer if the tool in this
    cell keeps ``margin`` from every obstacle at this instant. Dynamic programming finds the chain of free cells with
    the least sum of squared distances from the learned motion.

    Args:
        grid: the cells.
        start: position at the time ``begin``, shape (3,) [m].
        nominal: the learned motion from time 0.
        gap: function that returns the gap between the tool and the nearest obstacle, see :data:`Gap`.
        begin: time of the first layer [s].
        end: latest time of arrival [s].
        margin: smallest gap of a free cell [m].
    """
    times = np.arange(begin, end + 1e-9, LAYER)
    targets = nominal.at(np.minimum(times, nominal.times[-1]))[0]
    moves = grid.moves()
    cost = np.full(grid.shape, np.inf)
    cost[grid.index(start)] = 0.0
    chosen = np.zeros((len(times), *grid.shape), dtype=np.int8)
    lengths = [_STEP_COST * grid.cell**2 * sum(i * i for i in move) for move in moves]
    for k in range(1, len(times)):
        free = gap(grid.points, float(times[k])).reshape(grid.shape) >= margin
        best = np.full(grid.shape, np.inf)
        for number, (move, length) in enumerate(zip(moves, lengths, strict=True)):
            here, there = _slices(move, grid.shape)
            moved = cost[there] + length
            better = moved < best[here]
            best[here] = np.where(better, moved, best[here])
            chosen[k][here] = np.where(better, number, chosen[k][here])
        away = np.sum((grid.points - targets[k]) ** 2, axis=1).reshape(grid.shape)
        cost = np.where(free, best + away, np.inf)
    goal = grid.index(nominal.positions[-1])
    if not np.isfinite(cost[goal]):
        return None
    cells = [goal]
    for k in range(len(times) - 1, 0, -1):
        move = moves[chosen[k][cells[-1]]]
        at = cells[-1]
        cells.append((at[0] - move[0], at[1] - move[1], at[2] - move[2]))
    path = grid.low + grid.cell * np.array(cells[::-1], dtype=float)
    path[0] = start
    return _smoothed(times, path, nominal.positions[-1])


def _slices(move: tuple[int, int, int], shape: tuple[int, int, int]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the cells that are reached by a move, and the cells from which it leads there."""
    here = tuple(slice(max(m, 0), n + min(m, 0)) for m, n in zip(move, shape, strict=True))
    there = tuple(slice(max(-m, 0), n + min(-m, 0)) for m, n in zip(move, shape, strict=True))
    return here, there


def _smoothed(times: Array, path: Array, goal: Array) -> Trajectory:
    """Return a smooth motion along a chain of cells, which ends at the goal."""
    arrived = len(path) - 1
    while arrived > 1 and np.allclose(path[arrived - 1], path[-1]):
        arrived -= 1
    path = path[: arrived + 1]
    path[-1] = goal
    n = round(4 * _BLUR)
    padded = np.concatenate([np.repeat(path[:1], n, axis=0), path, np.repeat(path[-1:], n, axis=0)])
    smooth = gaussian_filter1d(padded, _BLUR, axis=0, mode="nearest")
    clock = times[0] + LAYER * (np.arange(len(padded)) - n)
    keep = clock >= times[0] - 1e-9
    smooth, clock = smooth[keep], clock[keep]
    smooth[0] = path[0]
    return Trajectory(clock, smooth)


class AimsAtNearest(Policy):
    """Steer to the middle of the nearest tracked obstacle; if no obstacle is tracked, follow the learned motion."""

    title: ClassVar[str] = "aims at the obstacle"

    def reset(self, observation: Observation) -> None:
        """Begin the motion."""
        self._began = observation.time

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the velocity towards the obstacle."""
        del dt
        scene, x = observation.scene.now(observation.time), observation.tool_to_base.position
        if not len(scene.packed):
            return _follow(self.skill.nominal(_clock(self.skill.duration_)), observation.time - self._began, x)
        nearest = scene.obstacles[int(np.argmin(scene.distances(x)))]
        towards = middle(nearest) - x
        for direction in np.asarray(self.forbidden, dtype=float).reshape(-1, 3):
            towards = towards - max(towards @ direction, 0.0) * direction
        velocity = _SPEED * towards / max(float(np.linalg.norm(towards)), 0.01) + nearest.velocity
        return Command(np.concatenate([velocity, np.zeros(3)]))

    def finished(self, observation: Observation) -> bool:
        """Return whether the tool happens to be at the goal at the end of the learned duration."""
        away = np.linalg.norm(observation.tool_to_base.position - self.skill.goal_.position)
        return bool(observation.time - self._began >= self.skill.duration_ and away < _ARRIVED)


class Oracle(Policy):
    """Follow the motion that the search finds, with the true future or with the tracked obstacles.

    Args:
        case: the scene, with the true future.
        tracked: True: search with the observed obstacles, every 0.1 s. False: search once, with the true future.
        options: arguments of :class:`~imitarm.policies.Policy`.
    """

    title: ClassVar[str] = "oracle"

    def __init__(self, case: MovingCase, *, tracked: bool, **options: Any) -> None:
        super().__init__(case.skill, **options)
        self.case, self.tracked = case, tracked
        self._nominal = case.skill.nominal(_clock(case.skill.duration_))
        self._grid = Grid.around(self._nominal.positions, planar=case.dimension == 2)
        self._end = _AHEAD * LATEST * case.skill.duration_

    def reset(self, observation: Observation) -> None:
        """Search.

        Raises:
            InfeasibleError: when the true future is known, and no motion is found.
        """
        self._motion, self._searched = self._nominal, -np.inf
        if self.tracked:
            return
        found = self._found(self._nominal.positions[0], 0.0, self._gap_in_truth())
        if found is None:
            raise InfeasibleError("the search finds no motion")
        self._motion = found

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the velocity that follows the last motion that the search found."""
        del dt
        time, x = observation.time, observation.tool_to_base.position
        if self.tracked and time - self._searched >= _PERIOD - 1e-9 and time < self._end - 2.0 * _PERIOD:
            self._searched = time
            found = self._found(x, time, _gap_in_scene(observation.scene, self.tool_spheres))
            self._motion = self._motion if found is None else found
        return _follow(self._motion, time, x)

    def finished(self, observation: Observation) -> bool:
        """Return whether the tool is at the goal at the end of the motion."""
        away = np.linalg.norm(observation.tool_to_base.position - self._nominal.positions[-1])
        late = min(self._motion.times[-1], self.case.skill.duration_)
        return bool(observation.time >= late and away < _ARRIVED)

    def _found(self, start: Array, begin: float, gap: Gap) -> Trajectory | None:
        end = self._end
        if self.tracked:  # a later arrival takes longer to search, and the next search may still choose it
            end = min(end, max(begin, self.case.skill.duration_) + _LATER * self.case.skill.duration_)
        for margin in _MARGINS:
            found = search(self._grid, start, self._nominal, gap, begin=begin, end=end, margin=margin)
            if found is not None and self._is_clear(found, gap):
                return found
        return None

    def _is_clear(self, motion: Trajectory, gap: Gap) -> bool:
        """Return whether a motion touches nothing, with the obstacles for which it was searched."""
        if self.tracked:
            return True
        times = np.arange(motion.times[0], motion.times[-1], 0.005)
        points = motion.at(times)[0]
        return bool(distances_in_time(self.case.truth, times, points).min() - self.case.tool_spheres[0, 3] > 0.002)

    def _gap_in_truth(self) -> Gap:
        radius = float(self.case.tool_spheres[0, 3])
        return lambda points, time: self.case.truth.at(time).clearance(points) - radius


def _gap_in_scene(scene: Scene, tool_spheres: Array | None) -> Gap:
    return lambda points, time: ToolGaps(scene.at(time), tool_spheres).gaps(points).min(axis=0, initial=np.inf)


def _clock(duration: float) -> Array:
    return np.linspace(0.0, duration, 400)


def _follow(motion: Trajectory, time: float, x: Array) -> Command:
    """Return the command that follows a motion at its own times."""
    at = motion.at(np.clip([time, time + 0.01], motion.times[0], motion.times[-1]))[0]
    velocity = (at[1] - at[0]) / 0.01 + _GAIN * (at[0] - x)
    return Command(np.concatenate([velocity, np.zeros(3)]))


CONTROLS = ("no-avoidance", "aims-at-obstacle", "oracle-future", "oracle-tracks")
"""The controls by name."""


def control(name: str, case: MovingCase, **options: Any) -> Policy:
    """Return a control for a scene.

    Args:
        name: one of :data:`CONTROLS`.
        case: the scene.
        options: arguments of :class:`~imitarm.policies.Policy`.
    """
    if name == "no-avoidance":
        return NoAvoidance.build(case.skill, **options)
    if name == "aims-at-obstacle":
        return AimsAtNearest.build(case.skill, **options)
    options.pop("pinned", None)
    return Oracle(case, tracked=name == "oracle-tracks", **options)
