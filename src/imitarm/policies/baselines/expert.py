r"""The expert: paths of least jerk around obstacles, found by sequential quadratic programming.

The baselines that learn (``gmm-irl``, ``dmp-ann``) are trained with these paths. In benchmarks, the paths show which
result an independent optimiser reaches. The optimiser uses no part of the compared methods: no Gaussian components, no
motion primitive and no potential.

Let ``x_i`` be the nominal path and ``x_i + d_i`` the path to find, with ``i = 0..99``. The deviation ``d_i`` minimises
the integral of its squared jerk, computed from third differences. The constraints keep a gap ``g_o`` to every obstacle
``o``::

    min  1 / dt^5 sum_i |d_(i+3) - 3 d_(i+2) + 3 d_(i+1) - d_i|^2
    s.t. g_o(x_i + d_i) >= clearance,   f . d_i <= 0 for every forbidden direction f,
         d_0 = d_1 = d_2 = 0 = d_97 = d_98 = d_99

The zero deviations at both ends keep the nominal velocity and acceleration at the start and at the goal. All obstacles
are convex, so the gap is a convex function of the position. Its tangent ``g_o(y_i) + n_o . (x_i + d_i - y_i)`` at any
path ``y`` is therefore never larger than the gap. Each quadratic program has tangents as constraints, so its solution
also keeps the constraints on the gaps. The tangents at this solution are the constraints of the next quadratic program,
whose cost is not larger. The iteration converges to a path that meets the first-order optimality conditions.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.headings import allowed_axes
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number

Array = NDArray[np.float64]

N_SAMPLES = 100  # of every path
_FIXED = 3  # samples at each end: position, velocity and acceleration
_FREE = slice(_FIXED, N_SAMPLES - _FIXED)
_REACH = 0.05  # [m] obstacles farther from a sample than the clearance plus this get no row
_ITERATIONS = 500
_SETTLED = 1e-7  # [m] the iteration ends when no sample moves farther
_KEPT = 1e-5  # [m] a path may violate a constraint by so much: the tolerance of the quadratic programs is 1e-6
_N_DIRECTIONS = 8  # of the first displacement, around the path
_MOST_COMBINATIONS = 16  # of directions, if the path hits obstacles in several places
_FARTHEST = 0.5  # [m] no sample is displaced farther
_SAME = 2e-3  # [m] paths whose samples are nearer than this are the same
_MOST_SAG = 1e-3  # [m] a segment that is closer than this beyond the clearance jumps over an edge
_DENSE = 8  # points on each segment where a found path is checked
_SOLVED = 1  # daqp's exit flag of an optimal solution


def expert_paths(nominal: Trajectory, gaps: ToolGaps, *, clearance: float, forbidden: ArrayLike = ()) -> list[Array]:
    """Find locally optimal paths around the obstacles; return them in the order of their jerk, the smallest first.

    The optimiser starts from several displaced paths. For each of these paths, every part of the nominal path that is
    too close to an obstacle is displaced in one of 8 directions. The result is deterministic.

    Args:
        nominal: the path without obstacles.
        gaps: distances to the obstacles; a moving obstacle is placed where it is at the time of each sample.
        clearance: required gap at the samples [m]. Between two samples at the distance ``h``, the gap may be smaller by
            up to ``h^2 / (8 (clearance + radius of the tool))``.
        forbidden: directions in which the path must not be displaced from the nominal path, shape (m, 3).

    Returns:
        Positions at 100 equally spaced times, each of shape (100, 3) [m]; empty if no path was found, for example
        because the start is too close to an obstacle. Paths that deviate from the nominal path by more than 0.5 m are
        not returned.
    """
    clearance = finite_number(clearance, "expert_paths: clearance", "m", at_least=0.0)
    directions = finite_array(np.reshape(np.asarray(forbidden, dtype=float), (-1, 3)), (None, 3), "forbidden")
    problem = PathProblem.of(nominal, gaps, clearance, directions)
    lowest = problem.gaps_at(problem.nominal)[0].min(axis=0, initial=np.inf)
    if not gaps.n_obstacles or lowest.min() >= clearance:
        return [problem.nominal]
    if min(lowest[:_FIXED].min(), lowest[-_FIXED:].min()) < clearance - _KEPT:
        return []
    found: list[tuple[float, Array]] = []
    for start in displaced_paths(problem):
        path = _optimised(problem, start)
        if path is not None and all(np.abs(path - other).max() > _SAME for _, other in found):
            found.append((problem.cost(path), path))
    return [path for _, path in sorted(found, key=lambda pair: pair[0])]


def jerk_cost(positions: Array, dt: float) -> float:
    """Return the integral of the squared jerk of samples (n, 3) [m] at equal intervals ``dt`` [s], in m^2/s^5."""
    return float(np.sum(np.diff(positions, 3, axis=0) ** 2) / dt**5)


class PathProblem(NamedTuple):
    """One scene: the nominal path, the gaps, and the directions in which the path may be displaced.

    Attributes:
        nominal: positions at equal time steps, shape (100, 3) [m].
        times: times of the samples since the motion began, shape (100,) [s].
        gaps: distances to the obstacles.
        clearance: required gap [m].
        axes: orthonormal basis of the space in which the path may be displaced, as d columns, shape (3, d).
        one_sided: forbidden directions whose opposites are allowed, in the basis ``axes``, shape (m, d).
    """

    nominal: Array
    times: Array
    gaps: ToolGaps
    clearance: float
    axes: Array
    one_sided: Array

    @classmethod
    def of(cls, nominal: Trajectory, gaps: ToolGaps, clearance: float, forbidden: Array) -> PathProblem:
        """Return the problem for a nominal path; ``forbidden`` are its forbidden directions, shape (m, 3)."""
        times = nominal.times[0] + np.linspace(0.0, nominal.duration, N_SAMPLES)
        axes, one_sided = allowed_axes(forbidden / np.linalg.norm(forbidden, axis=1, keepdims=True))
        return cls(nominal.at(times)[0], times - times[0], gaps, clearance, axes, one_sided)

    def gaps_at(self, path: Array) -> tuple[Array, Array]:
        """Return the gaps (n_obstacles, 100) and normals (n_obstacles, 100, 3) of a path."""
        gap, normal = self.gaps.gaps_and_normals(path[:, None, :], self.times)
        return gap[:, :, 0], normal[:, :, 0]

    def cost(self, path: Array) -> float:
        """Return the integral of the squared jerk of the deviation [m^2/s^5]."""
        return jerk_cost(path - self.nominal, float(self.times[1]))

    def keeps_clearance(self, path: Array) -> bool:
        """Whether all samples keep the clearance and deviate by at most 0.5 m, with no obstacle between two samples."""
        strays = np.linalg.norm(path - self.nominal, axis=1).max() > _FARTHEST
        if strays or self.gaps_at(path)[0].min() < self.clearance - _KEPT:
            return False
        u = np.linspace(0.0, N_SAMPLES - 1.0, _DENSE * (N_SAMPLES - 1) + 1)
        dense = np.stack([np.interp(u, np.arange(N_SAMPLES), column) for column in path.T], axis=1)
        gap = self.gaps.gaps(dense[:, None, :], np.interp(u, np.arange(N_SAMPLES), self.times))
        return bool(gap.min() >= self.clearance - _MOST_SAG)


@lru_cache(maxsize=1)
def _influence() -> Array:
    """Return S, shape (94, 94): ``d = S y`` has the cost ``|y|^2``, up to a factor that makes the largest row 1."""
    differences = np.diff(np.eye(N_SAMPLES), 3, axis=0)[:, _FREE]
    influence = np.linalg.inv(np.linalg.qr(differences, mode="r"))
    return np.asarray(influence / np.linalg.norm(influence, axis=1).max())


def _least_jerk(samples: NDArray[np.intp], directions: Array, lower: Array) -> Array | None:
    """Return the deviation of least jerk with ``directions_j . d[samples_j] >= lower_j``.

    Args:
        samples: indices of free samples, counted from the first free sample, shape (m,).
        directions: shape (m, k) for a deviation in k dimensions.
        lower: lower bounds, shape (m,) [m].

    Returns:
        Shape (94, k) [m]; None if there is no solution.
    """
    k = directions.shape[1]
    if not len(samples):
        return np.zeros((len(_influence()), k))
    rows = (_influence()[samples][:, :, None] * directions[:, None, :]).reshape(len(samples), -1)
    n = rows.shape[1]
    sense = np.zeros(len(samples), dtype=np.intc)
    y, _, flag, _ = daqp.solve(np.eye(n), np.zeros(n), rows, np.full(len(samples), 1e30), lower, sense)
    return _influence() @ np.reshape(y, (-1, k)) if flag == _SOLVED else None


def displaced_paths(problem: PathProblem) -> list[Array]:
    """Return paths (100, 3) on different sides of the obstacles, from which an optimiser can start.

    Each part of the nominal path that is too close to an obstacle is displaced in several directions, by the deviation
    of least jerk. If several parts are too close, at most 16 combinations of the best directions are returned.
    """
    too_close = problem.gaps_at(problem.nominal)[0].min(axis=0, initial=np.inf) < problem.clearance
    edges = np.flatnonzero(np.diff(np.concatenate([[False], too_close, [False]]).astype(int)))
    stretches = [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    ranked = [bumps for bumps in (_ranked_bumps(problem, stretch) for stretch in stretches) if bumps]
    if not ranked:
        return []
    each = len(ranked[0]) if len(ranked) == 1 else max(int(_MOST_COMBINATIONS ** (1.0 / len(ranked))), 1)
    return [problem.nominal + np.sum(bumps, axis=0) for bumps in product(*[bumps[:each] for bumps in ranked])]


def _ranked_bumps(problem: PathProblem, stretch: slice) -> list[Array]:
    """Return smooth displacements (100, 3) that lift one stretch off the obstacles, in the order of their jerk."""
    ahead = np.gradient(problem.nominal, axis=0)[(stretch.start + stretch.stop) // 2] @ problem.axes
    bumps = []
    for u in _around(ahead):
        lift = _lift(problem, stretch, problem.axes @ u)
        if lift is None or np.any(problem.one_sided @ u > 1e-9):
            continue
        samples = np.arange(stretch.start, stretch.stop) - _FIXED
        free = (samples >= 0) & (samples < len(_influence()))
        height = _least_jerk(samples[free], np.ones((np.count_nonzero(free), 1)), lift[free])
        if height is not None and height.max() <= _FARTHEST:
            bump = np.zeros((N_SAMPLES, 3))
            bump[_FREE] = height * (problem.axes @ u)
            bumps.append((float(np.sum(np.diff(bump, 3, axis=0) ** 2)), bump))
    return [bump for _, bump in sorted(bumps, key=lambda pair: pair[0])]


def _around(ahead: Array) -> list[Array]:
    """Return unit vectors that are perpendicular to ``ahead`` (d,): 8 around it in space, 2 in a plane."""
    _, _, basis = np.linalg.svd(ahead[None, :])
    across = basis[1:] if np.linalg.norm(ahead) > 0.0 else basis
    if len(across) < 2:
        return [sign * u for u in across for sign in (1.0, -1.0)]
    angles = 2.0 * np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS
    return list(np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1])


def _lift(problem: PathProblem, stretch: slice, u: Array) -> Array | None:
    """Return how far each sample of a stretch must move along ``u`` until it keeps the clearance; None if too far."""
    heights = np.linspace(0.0, _FARTHEST, 101)
    points = problem.nominal[stretch, None, :] + heights[:, None] * u
    clear = problem.gaps.gaps(points, problem.times[stretch]).min(axis=0) >= problem.clearance
    return heights[np.argmax(clear, axis=1)] if clear.any(axis=1).all() else None


def _optimised(problem: PathProblem, path: Array) -> Array | None:
    """Return the local optimum that the tangents of ``path`` lead to; None if it does not keep the clearance."""
    for _ in range(_ITERATIONS):
        gap, normal = problem.gaps_at(path)
        gap, normal, before = gap[:, _FREE], normal[:, _FREE] @ problem.axes, (path - problem.nominal)[_FREE]
        obstacle, sample = np.nonzero(gap < problem.clearance + _REACH)
        rows = normal[obstacle, sample]
        lower = problem.clearance - gap[obstacle, sample] + np.sum(rows * (before @ problem.axes)[sample], axis=1)
        every = np.arange(N_SAMPLES - 2 * _FIXED)
        for f in problem.one_sided:
            sample, lower = np.concatenate([sample, every]), np.concatenate([lower, np.zeros(len(every))])
            rows = np.concatenate([rows, np.broadcast_to(-f, (len(every), len(f)))])
        deviation = _least_jerk(sample, rows, lower)
        if deviation is None:
            return None
        moved = problem.nominal.copy()
        moved[_FREE] += deviation @ problem.axes.T
        change = float(np.abs(moved - path).max())
        path = moved
        if change < _SETTLED:
            break
    return path if problem.keeps_clearance(path) else None
