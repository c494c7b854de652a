"""Methods that check the moving benchmark: their results are known, so they show whether it measures correctly.

* ``no-avoidance`` follows the learned motion. If this method succeeded, the obstacles would not block the learned
  motion.
* ``aims-at-obstacle`` steers to the middle of the nearest tracked obstacle. If this method ever succeeded, the
  benchmark would measure contacts wrongly.
* ``oracle-future`` knows the true future motion of the obstacles. If this oracle does not solve a scene, the scene may
  have no solution.
* ``oracle-tracks`` knows only the tracked obstacles, like the compared methods (:class:`CausalOracle`). If this oracle
  avoids a contact, the contact was avoidable.

``oracle-future`` searches for a motion in space and time (:func:`search`). The oracles do not use the code of the
compared methods.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

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
Indices = NDArray[np.intp]
Gap = Callable[[Array, float], Array]
"""Type of a function of points, shape (n, 3) [m], and a time [s]. The function returns the gap between a tool at each
point and the nearest obstacle at this time, shape (n,) [m]."""

LAYER = 0.05
"""Time between two layers of the search [s]. A layer contains all cells of the grid at one instant."""
_CELL = {2: 0.02, 3: 0.03}  # [m]
_BESIDE = {2: 0.30, 3: 0.24}  # [m] the grid reaches so far beyond the learned path
_REACH = 2  # cells that the tool may move between two layers
_STEP_COST = 0.3  # of the squared length of a step, relative to the squared distance from the learned motion
_BLUR = 1.2  # layers: standard deviation of the filter that smooths a chain of cells
_SPEED = 0.4  # [m/s] at which the tool aims at an obstacle
_GAIN = 8.0  # [1/s]
_ARRIVED = 3e-3  # [m]
_MARGINS = (0.045, 0.03, 0.02, 0.012, 0.006)  # [m] of the oracle, largest first
_LAYERS = 18  # of the causal oracle, in one search
_AGAIN = 0.1  # [s] between two searches
_APART = {2: 0.025, 3: 0.04}  # [m] between two deviations
_BESIDE_IT = {2: 16, 3: 9}  # deviations to each side of the learned motion
_STEPS = {2: 3, 3: 2}  # deviations that the tool may move between two layers
_WANTED, _GROWTH = 0.045, 0.1  # [m], [m/s] wanted gap, which grows with the look-ahead
_LOCAL_STEP_COST = 2.0  # of the squared length of a step, relative to the squared distance from the learned motion
_NEAR_COST = 400.0  # of the squared lack of gap, relative to the squared distance from the learned motion
_TOUCHING, _TOUCH_COST = 0.008, 10.0  # [m], [m^2]
_INERTIA = 3.0  # of the squared distance from the motion at the present velocity, in the first two layers
_LOCAL_BLUR = 0.8  # layers: standard deviation of the filter that smooths a chain of deviations
_AHEAD = 0.97  # of the longest duration, for the arrival


@dataclass(frozen=True, eq=False)
class Grid:
    """The grid of cells around a learned path in which ``oracle-future`` searches.

    Attributes:
        points: centres of the cells, shape (n, 3) [m].
        shape: number of cells along each axis.
        cell: width of a cell [m].
        low: centre of the cell with the smallest coordinates, shape (3,) [m].
    """

    points: Array
    shape: tuple[int, int, int]
    cell: float
    low: Array

    @classmethod
    def around(cls, path: Array, *, planar: bool) -> Grid:
        """Return the grid around a path, shape (n, 3) [m]. If ``planar`` is True, all cells have the same height z."""
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
        """Return the allowed moves from one layer of time to the next, as numbers of cells.

        The first move is (0, 0, 0).
        """
        x, y, z = (range(-min(_REACH, n - 1), min(_REACH, n - 1) + 1) for n in self.shape)
        found = [m for m in itertools.product(x, y, z) if sum(i * i for i in m) <= _REACH**2]
        return sorted(found, key=lambda m: sum(i * i for i in m))


def search(
    grid: Grid, start: Array, nominal: Trajectory, gap: Gap, *, begin: float, end: float, margin: float
) -> Trajectory | None:
    """Return the motion of least cost from ``start`` to the goal; None if the goal cannot be reached.

    From one layer of time to the next, the tool may stay or move to a near cell. A cell is free in a layer if a tool in
    this cell keeps ``margin`` from every obstacle at this instant. Dynamic programming finds the cheapest sequence of
    free cells. The cost is the sum of the squared distances from the learned motion and of the squared lengths of the
    moves.

    Args:
        grid: the cells.
        start: position at the time ``begin``, shape (3,) [m].
        nominal: the learned motion from time 0.
        gap: function that returns the gap between tool and obstacles, see :data:`Gap`.
        begin: time of the first layer [s].
        end: latest time at which the tool may arrive at the goal [s].
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
    """Return the cells that a move can reach, and for each of them the cell from which the move starts."""
    here = tuple(slice(max(m, 0), n + min(m, 0)) for m, n in zip(move, shape, strict=True))
    there = tuple(slice(max(-m, 0), n + min(-m, 0)) for m, n in zip(move, shape, strict=True))
    return here, there


def _smoothed(times: Array, path: Array, goal: Array) -> Trajectory:
    """Return a smooth motion along a sequence of positions, which ends at the goal."""
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
        """Return whether the learned duration has passed and the tool is at the goal."""
        away = np.linalg.norm(observation.tool_to_base.position - self.skill.goal_.position)
        return bool(observation.time - self._began >= self.skill.duration_ and away < _ARRIVED)


class Oracle(Policy):
    """Follow the motion that :func:`search` finds with the true future motion of the obstacles.

    Args:
        case: the scene, which contains the true motion of the obstacles.
        options: arguments of :class:`~imitarm.policies.Policy`.
    """

    title: ClassVar[str] = "oracle"

    def __init__(self, case: MovingCase, **options: Any) -> None:
        super().__init__(case.skill, **options)
        self.case = case
        self._nominal = case.skill.nominal(_clock(case.skill.duration_))
        self._grid = Grid.around(self._nominal.positions, planar=case.dimension == 2)

    def reset(self, observation: Observation) -> None:
        """Search for a motion from start to goal.

        Raises:
            InfeasibleError: when no motion is found.
        """
        del observation
        radius, truth = float(self.case.tool_spheres[0, 3]), self.case.truth
        end = _AHEAD * LATEST * self.case.skill.duration_

        def gap(points: Array, time: float) -> Array:
            return truth.at(time).clearance(points) - radius

        for margin in _MARGINS:
            found = search(
                self._grid, self._nominal.positions[0], self._nominal, gap, begin=0.0, end=end, margin=margin
            )
            if found is not None and self._is_clear(found):
                self._motion = found
                return
        raise InfeasibleError("the search finds no motion")

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the velocity with which the tool follows the motion."""
        del dt
        return _follow(self._motion, observation.time, observation.tool_to_base.position)

    def finished(self, observation: Observation) -> bool:
        """Return whether the motion, or the learned duration, has ended and the tool is at the goal."""
        away = np.linalg.norm(observation.tool_to_base.position - self._nominal.positions[-1])
        late = min(self._motion.times[-1], self.case.skill.duration_)
        return bool(observation.time >= late and away < _ARRIVED)

    def _is_clear(self, motion: Trajectory) -> bool:
        """Return whether a motion touches nothing."""
        times = np.arange(motion.times[0], motion.times[-1], 0.005)
        points = motion.at(times)[0]
        return bool(distances_in_time(self.case.truth, times, points).min() - self.case.tool_spheres[0, 3] > 0.002)


class Cells(NamedTuple):
    """The grid of displacements from the learned motion in which ``oracle-tracks`` searches.

    Attributes:
        deviations: displacement of each cell from the learned motion, shape (n, 3) [m]; the displacement of the middle
            cell is 0.
        before: indices of the cells from which a move leads to each cell, shape (n, k). The index n stands for a cell
            outside the grid.
        lengths: squared length of each of the k moves, shape (k,) [m^2].
    """

    deviations: Array
    before: Indices
    lengths: Array


@lru_cache(maxsize=2)
def cells(dimension: int) -> Cells:
    """Return the grid: in the horizontal plane for dimension 2, in space for dimension 3."""
    half, reach, cell = _BESIDE_IT[dimension], _STEPS[dimension], _APART[dimension]
    spans = [range(-half, half + 1)] * dimension + [range(1)] * (3 - dimension)
    grid = np.array(list(itertools.product(*spans)))
    steps = [range(-reach, reach + 1)] * dimension + [range(1)] * (3 - dimension)
    moves = np.array([m for m in itertools.product(*steps) if sum(i * i for i in m) <= reach**2])
    came = grid[:, None] - moves
    inside = (np.abs(came) <= half).all(axis=2)
    width = 2 * half + 1
    number = came[..., 0] + half
    for axis in range(1, dimension):
        number = number * width + came[..., axis] + half
    before = np.where(inside, number, len(grid))
    return Cells(cell * grid, before, cell**2 * np.sum(moves * moves, axis=1))


def cheapest(costs: Array, begin: int, grid: Cells) -> Indices:
    """Return the cheapest sequence of cells, one cell for each layer of time, as indices of shape (L,).

    Args:
        costs: cost of each cell in each of the L layers, shape (L, n). The squared lengths of the moves are added to
            these costs.
        begin: index of the cell in the first layer.
        grid: the cells.
    """
    n = len(grid.deviations)
    total = np.full(n + 1, np.inf)
    total[begin] = 0.0
    came = np.empty((len(costs), n), dtype=np.intp)
    every = np.arange(n)
    for k in range(1, len(costs)):
        through = total[grid.before] + _LOCAL_STEP_COST * grid.lengths
        best = through.argmin(axis=1)
        came[k] = grid.before[every, best]
        total[:n] = through[every, best] + costs[k]
    chain = [int(total[:n].argmin())]
    for k in range(len(costs) - 1, 0, -1):
        chain.append(int(came[k][chain[-1]]))
    return np.array(chain[::-1], dtype=np.intp)


class CausalOracle(Policy):
    """Search for a motion among the tracked obstacles ten times per second, and follow the latest motion.

    The search covers the next 0.9 s. Each cell of a grid is a displacement from the learned motion. A cell costs the
    square of its displacement. If the predicted gap to an obstacle is too small, the cell costs more. Dynamic
    programming finds the cheapest sequence of cells.

    Args:
        case: the scene; only its skill and its dimension are used.
        options: arguments of :class:`~imitarm.policies.Policy`.
    """

    title: ClassVar[str] = "oracle with tracks"

    def __init__(self, case: MovingCase, **options: Any) -> None:
        super().__init__(case.skill, **options)
        self._nominal = case.skill.nominal(np.linspace(0.0, case.skill.duration_, 400))
        self._cells = cells(case.dimension)

    def reset(self, observation: Observation) -> None:
        """Begin the motion."""
        self._motion, self._searched = self._nominal, -np.inf
        self._before = observation.time, observation.tool_to_base.position

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the velocity with which the tool follows the latest motion."""
        del dt
        time, x = observation.time, observation.tool_to_base.position
        if time - self._searched >= _AGAIN - 1e-9:
            self._searched = time
            before, place = self._before
            velocity = (x - place) / (time - before) if time > before else np.zeros(3)
            self._motion = self._found(observation.scene, time, x, velocity)
        self._before = time, x
        return _follow(self._motion, time, x)

    def finished(self, observation: Observation) -> bool:
        """Return whether the learned duration has passed and the tool is at the goal."""
        away = np.linalg.norm(observation.tool_to_base.position - self._nominal.positions[-1])
        return bool(observation.time >= self._nominal.times[-1] and away < _ARRIVED)

    def _found(self, scene: Scene, time: float, x: Array, velocity: Array) -> Trajectory:
        times: Array = time + LAYER * np.arange(_LAYERS + 1.0)
        targets = self._nominal.at(np.minimum(times, self._nominal.times[-1]))[0]
        deviations = self._cells.deviations
        first = x - targets[0]
        begin = int(np.argmin(np.sum((deviations - first) ** 2, axis=1)))
        away = np.sum(deviations * deviations, axis=1)
        costs = np.empty((len(times), len(deviations)))
        for k, at in enumerate(times):
            gaps = ToolGaps(scene.at(float(at)), self.tool_spheres).gaps(targets[k] + deviations)
            gap = gaps.min(axis=0, initial=np.inf)
            lack = np.maximum(_WANTED + _GROWTH * (at - time) - gap, 0.0)
            costs[k] = away + _NEAR_COST * lack * lack + np.where(gap < _TOUCHING, _TOUCH_COST * (1.0 + lack), 0.0)
        for k in (1, 2):  # the tool goes on as it moves now, if nothing is in the way
            onwards = x + k * LAYER * velocity - targets[k]
            costs[k] += _INERTIA * np.sum((deviations - onwards) ** 2, axis=1)
        chain = deviations[cheapest(costs, begin, self._cells)]
        chain[0] = first
        ahead = np.concatenate([np.repeat(chain[:1], 4, axis=0), chain])
        smooth = gaussian_filter1d(ahead, _LOCAL_BLUR, axis=0, mode="nearest")[4:]
        smooth += np.exp(-np.arange(len(smooth)))[:, None] * (first - smooth[0])  # begins where the tool is
        return Trajectory(times, targets + smooth)


def _clock(duration: float) -> Array:
    return np.linspace(0.0, duration, 400)


def _follow(motion: Trajectory, time: float, x: Array) -> Command:
    """Return the command with which a tool at ``x`` follows a motion at the given time."""
    at = motion.at(np.clip([time, time + 0.01], motion.times[0], motion.times[-1]))[0]
    velocity = (at[1] - at[0]) / 0.01 + _GAIN * (at[0] - x)
    return Command(np.concatenate([velocity, np.zeros(3)]))


CONTROLS = ("no-avoidance", "aims-at-obstacle", "oracle-future", "oracle-tracks")
"""The names of the methods that check the benchmark."""


def control(name: str, case: MovingCase, **options: Any) -> Policy:
    """Return the policy of a method that checks the benchmark, for a scene.

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
    return CausalOracle(case, **options) if name == "oracle-tracks" else Oracle(case, **options)
