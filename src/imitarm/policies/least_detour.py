"""LeastDetour: the smallest displacement of components that keeps the clearance and passes obstacles on given sides.

At each sample of the path, the distance to an obstacle is replaced by its tangent plane. The required clearance then
becomes a linear inequality in the displacements ``Delta_k`` of the components. The tangent planes never overestimate
the distance, so each solution keeps the clearance at the samples. The method alternates two steps. It minimises ``sum_k
Delta_k^T Y_k^-1 Delta_k`` under these inequalities, where ``Y_k`` is the demonstrated covariance of component k. Then
it computes new tangent planes at the solution. Each solution also satisfies the inequalities of the new planes, so the
cost never increases.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import ClosePoints, PathClearance, ToolAmongObstacles
from imitarm.policies.component_path import STILL, ComponentPath

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NEGLIGIBLE_LEVER = 0.02  # a sample that components can hardly move has no row: it would take a huge displacement
MAX_DISPLACEMENT = 0.5  # [m] no sample is led farther than this from the nominal path
MAX_STEP_RATIO = 8.0  # times the longest step of the nominal path: a longer one is a jump
MAX_JERK_RATIO = 10.0  # times the largest jerk of the nominal path
UNBOUNDED = 1e30  # daqp's infinity
_INFLUENCE = 0.04  # [m] at first, obstacles farther from a sample than this get no row
_ROUNDS = 2  # of tangents before the certificate is computed; the first brings most of the reduction
_MAX_TRIES = 12  # a segment that is still too close then is given up
_MAX_SAG = 2e-4  # [m] most that is kept beyond the clearance at samples for the segments between them
_ROUNDING = 2e-6  # [m] quadratic programs keep their rows no better
_SLACK_SCALE = 1e-4  # [m] missing the tangents by this costs as much as one demonstrated sigma
_GAIN = 0.9  # stop when a round saves less than a tenth
_STALLED = 2e-5  # [m] a try that raises the lowest bound by less is no progress either
_MAX_STALLED = 4  # tries without progress, then the search gives up
_PROGRESS = 0.9  # a try that leaves more than this fraction of what was missing is no progress
SMOOTHNESS = 1e-3  # weight of the squared jerk of the displacement, in units of the largest nominal jerk
_SMOOTHER = (1e-1, 1e1, 1e3)  # weights tried where the path would be too jerky
_WITHIN = 0.999  # of the stated limits is planned for
_SOLVED = 1  # daqp's exit flag of an optimal solution


def least_norm(rows: Array, lower: Array, upper: Array) -> Array | None:
    """Minimise ``|y|^2`` under ``lower <= rows @ y <= upper`` with an exact active-set method (daqp).

    Args:
        rows: coefficients of the inequalities, shape (m, n).
        lower: lower bounds of the m rows, shape (m,); with shape (n + m,), the first n entries are bounds of y itself.
        upper: upper bounds, of the same shape as ``lower``.

    Returns:
        The vector y, shape (n,); None when there is no solution.
    """
    n = rows.shape[1]
    y, _, flag, _ = daqp.solve(np.eye(n), np.zeros(n), np.ascontiguousarray(rows), upper, lower)
    return np.asarray(y) if flag == _SOLVED else None


@dataclass(frozen=True, eq=False)
class AllowedDirections:
    """The directions in which components may move: all ``u`` with ``u . f <= 0`` for every forbidden direction ``f``.

    Attributes:
        forbidden: forbidden directions, one unit vector per row, shape (m, 3). If a direction and its opposite are both
            forbidden, this axis is forbidden.
        axes: orthonormal basis of the space without the forbidden axes, as columns, shape (3, d).
        one_sided: forbidden directions whose opposites are allowed, as unit vectors in the basis ``axes``, shape (m',
            d).
    """

    forbidden: Array
    axes: Array
    one_sided: Array

    @classmethod
    def without(cls, forbidden: Array) -> AllowedDirections:
        """Build the allowed directions from forbidden directions, one unit vector per row, shape (m, 3).

        The latest results are cached, because many scenes forbid the same directions.
        """
        return _allowed(forbidden.tobytes())

    @classmethod
    def _without(cls, forbidden: Array) -> AllowedDirections:
        if not len(forbidden):
            return cls(forbidden, np.eye(3), np.empty((0, 3)))
        opposite = (forbidden @ forbidden.T).min(axis=1) < -1.0 + 1e-12
        axes = _complement(forbidden[opposite])
        rest = forbidden[~opposite] @ axes
        length = np.linalg.norm(rest, axis=1)
        return cls(forbidden, axes, rest[length > 1e-9] / length[length > 1e-9, None])

    @property
    def dimension(self) -> int:
        """Number of dimensions in which components can move."""
        return self.axes.shape[1]

    def enforced(self, reduced: Array) -> Array:
        """Return displacements (..., 3) without forbidden components, from coordinates (..., d) in the basis ``axes``.

        A component as small as the rounding errors may remain in a forbidden direction.
        """
        for _ in range(100 if len(self.one_sided) else 0):  # taking out one part may bring back a little of another
            for f in self.one_sided:
                reduced = reduced - np.maximum(reduced @ f, 0.0)[..., None] * f
            if (reduced @ self.one_sided.T).max() <= 1e-17:
                break
        return np.asarray(reduced @ self.axes.T)

    def projected(self, vectors: Array) -> Array:
        """Return vectors (..., 3) without their components along forbidden axes."""
        return vectors @ self.axes @ self.axes.T

    def unit_directions(self, candidates: Array) -> Array:
        """Return candidate directions (m, 3) without their forbidden components, scaled to length 1.

        A direction is left out if its length without these components is at most 0.25.
        """
        allowed = self.enforced(candidates @ self.axes) if len(self.forbidden) else candidates
        length = np.sqrt(np.einsum("md,md->m", allowed, allowed))
        allowed = allowed[length > 0.25] / length[length > 0.25, None]
        if not len(self.forbidden):
            return allowed
        return np.array(sorted(set(map(tuple, (np.round(allowed, 9) + 0.0).tolist())))).reshape(-1, 3)


@lru_cache(maxsize=16)
def _allowed(forbidden: bytes) -> AllowedDirections:
    return AllowedDirections._without(np.frombuffer(forbidden).reshape(-1, 3))


def _complement(axes: Array) -> Array:
    """Return an orthonormal basis, as columns (3, d), of the directions perpendicular to all rows of ``axes``."""
    if not len(axes):
        return np.eye(3)
    first = axes[0]
    rest = axes - (axes @ first)[:, None] * first
    far = int(np.argmax(np.einsum("md,md->m", rest, rest)))
    length = float(np.linalg.norm(rest[far]))
    if length < 1e-9:  # one axis: the columns of a Householder reflection that takes a coordinate axis to it
        i = int(np.argmax(np.abs(first)))
        v = first.copy()
        v[i] += np.copysign(1.0, first[i])
        return np.asarray(np.delete(np.eye(3) - np.outer(v, v) * (2.0 / (v @ v)), i, axis=1))
    second = rest[far] / length
    third = np.cross(first, second)
    if np.abs(rest @ third).max() > 1e-9:
        return np.empty((3, 0))
    return third[:, None]


@dataclass(frozen=True, eq=False)
class Detour:
    """A displaced path with its guaranteed clearance.

    Attributes:
        path: the path and the components that were moved.
        displacement: displacement of each component's mean, shape (n_components, 3) [m].
        clearance: distances to the obstacles along the displaced path.
        bounds: guaranteed lower bound of the clearance of each pair over the whole path, shape (n_pairs,) [m].
        feasible: whether every bound is at least the required clearance and the path is within ``MAX_DISPLACEMENT`` and
            ``MAX_STEP_RATIO``.
        out_of_limits: whether the path exceeds ``MAX_DISPLACEMENT`` or ``MAX_STEP_RATIO``.
        close: points of the path that are too close to an obstacle, although the neighbouring samples keep the
            clearance.
    """

    path: ComponentPath
    displacement: Array
    clearance: PathClearance
    bounds: Array
    feasible: bool
    out_of_limits: bool
    close: ClosePoints

    @property
    def lowest(self) -> float:
        """Guaranteed lower bound of the clearance of all pairs [m]; inf without obstacles."""
        return float(self.bounds.min(initial=np.inf))


@dataclass(frozen=True, eq=False)
class _Cuts:
    """Half-spaces ``direction . (lever @ Delta) <= bound``.

    Attributes:
        lever: factors by which the components' displacements are multiplied, shape (m, n_components).
        direction: one unit vector per row, shape (m, 3).
        bound: upper bound of each half-space, shape (m,) [m].
    """

    lever: Array
    direction: Array
    bound: Array

    @classmethod
    def none(cls, n_components: int) -> _Cuts:
        return cls(np.empty((0, n_components)), np.empty((0, 3)), np.empty(0))

    def __add__(self, other: _Cuts) -> _Cuts:
        pairs = ((self.lever, other.lever), (self.direction, other.direction), (self.bound, other.bound))
        return _Cuts(*(np.concatenate(pair) for pair in pairs))


def largest_step(positions: Array) -> float:
    """Return the longest distance between neighbouring positions (n, 3) [m]."""
    step = positions[1:] - positions[:-1]
    return float(np.sqrt(np.einsum("nd,nd->n", step, step).max()))


class LeastDetour:
    """Finds the least detours of one path among one set of obstacles, for all spheres of the tool.

    Attributes:
        target: distance from obstacles that the planner requires at the samples [m]. It is slightly larger than the
            clearance, so that the segments between the samples also keep the clearance.
        movable: whether a displacement of components can move each sample, shape (n,).
    """

    def __init__(
        self,
        path: ComponentPath,
        tool: ToolAmongObstacles,
        clearance: float,
        allowed: AllowedDirections,
        *,
        exact: bool = False,
    ) -> None:
        self.path, self.tool, self.clearance, self.allowed = path, tool, clearance, allowed
        step = self._longest_step = largest_step(path.nominal.positions)
        # Round an edge, the centre of a sphere passes on an arc of this radius; its chord sags by step^2 / 8 radius.
        # It only saves rounds: segments that are too close get rows of their own.
        radius = clearance + float(tool.radii.min())
        sag = 1.5 * step**2 / (8.0 * max(radius, 1e-3))
        self.target = clearance + (_ROUNDING if exact else _ROUNDING + min(sag, _MAX_SAG))
        self.exact = exact
        self.movable = path.lever > (1e-3 if exact else NEGLIGIBLE_LEVER)

    def _beyond_limits(self, positions: Array) -> _Cuts:
        """Return half-spaces that exclude ``positions``, but no path with allowed displacements and steps."""
        nominal, basis = self.path.nominal.positions, self.path.basis
        away, step = positions - nominal, np.diff(positions, axis=0)
        far, long = np.linalg.norm(away, axis=1), np.linalg.norm(step, axis=1)
        longest = MAX_STEP_RATIO * self._longest_step
        j, k = np.flatnonzero(far > MAX_DISPLACEMENT), np.flatnonzero(long > longest)
        direction = np.concatenate([away[j] / far[j, None], step[k] / long[k, None]])
        nominal_step = np.einsum("kd,kd->k", np.diff(nominal, axis=0)[k], direction[len(j) :])
        bound = np.concatenate([np.full(len(j), _WITHIN * MAX_DISPLACEMENT), _WITHIN * longest - nominal_step])
        return _Cuts(np.concatenate([basis[j], basis[k + 1] - basis[k]]), direction, bound)

    def evaluate(self, displacement: Array, clearance: PathClearance) -> Detour:
        """Return the displaced path with its guaranteed clearance, and whether it is within the limits."""
        bounds, close = clearance.certified(self.clearance)
        away = clearance.positions - self.path.nominal.positions
        out = bool(np.sqrt(np.einsum("nd,nd->n", away, away).max()) > MAX_DISPLACEMENT) or (
            largest_step(clearance.positions) > MAX_STEP_RATIO * self._longest_step
        )
        proven = bounds.min(axis=1, initial=np.inf)
        feasible = bool(proven.min(initial=np.inf) >= self.clearance) and not out
        return Detour(self.path, displacement, clearance, proven, feasible, out, close)

    def shrink(
        self, start: PathClearance, moved: Index | None = None, *, smoothness: float | None = None
    ) -> Detour | None:
        """Return the least detour that passes each obstacle on the same side as the path of ``start``.

        The first tangents are those of ``start``. If no detour is feasible, the method returns the best one that it
        found, or None if it found none.

        A segment may be too close to an obstacle although the samples at its ends keep the clearance. The closest point
        of such a segment gives an additional inequality. A larger required clearance at the samples would not help, for
        two reasons. First, near an edge of an obstacle, samples farther from the edge have longer steps between them,
        and a step may still cut the edge. Second, near the start, the goal and the pinned times, components hardly move
        the samples. A little more distance there would need very large displacements.

        Args:
            start: distances along the path at which the first tangents are computed. This can be any path, also one
                that no displacement of the components produces.
            moved: indices of the components that may move; None: all.
            smoothness: weight of the squared jerk of the displacement; None: 0.001 if ``exact``, otherwise 0.
        """
        moved = np.arange(self.path.n_components) if moved is None else moved
        scale = self._scale(moved, smoothness)
        best: Detour | None = None
        here, held, cuts = start, ClosePoints.none(), _Cuts.none(self.path.n_components)
        missing, lowest, stalled = np.inf, -np.inf, 0
        for _ in range(_MAX_TRIES if len(moved) and self.allowed.dimension else 0):
            cost = np.inf
            displacement: Array | None = None
            for _ in range(_ROUNDS):
                step = self._step(moved, scale, here, held, cuts)
                if step is None:
                    break
                displacement, here, previous, cost = *step[:2], cost, step[2]
                if cost > _GAIN * previous:
                    break
            if displacement is None:
                break
            detour = self.evaluate(displacement, here)
            best = best_of((best, detour))
            if detour.feasible:
                break
            still = self.clearance - here.lowest
            if still > 1e-5 and still > _PROGRESS * missing:
                break
            missing = min(missing, still) if still > 0.0 else missing
            stalled = 0 if detour.lowest > lowest + _STALLED else stalled + 1
            lowest = max(lowest, detour.lowest)
            if stalled > _MAX_STALLED:
                break
            held = held + detour.close
            if detour.out_of_limits:
                cuts = cuts + self._beyond_limits(here.positions)
        return best

    def smoothed(self, detour: Detour) -> tuple[Detour, float]:
        """If the jerk of a detour exceeds its limit, smooth the detour; return the detour and its jerk ratio."""
        ratio = self.path.jerk_ratio(detour.clearance.positions)
        best, limit = detour, max(MAX_JERK_RATIO, 1.0)
        moved = np.flatnonzero(detour.displacement.any(axis=1)) if not self.exact else None
        for weight in _SMOOTHER:
            if ratio <= limit:
                break
            trial = self.shrink(best.clearance, moved, smoothness=weight)
            if trial is None or not trial.feasible:
                break
            less = self.path.jerk_ratio(trial.clearance.positions)
            if less < ratio:
                best, ratio = trial, less
        return best, ratio

    def _scale(self, moved: Index, smoothness: float | None) -> Array:
        """Return :func:`style_scale` of the moved components; if ``smoothness`` is None, a default weight is used."""
        weight = (SMOOTHNESS if self.exact else 0.0) if smoothness is None else smoothness
        return style_scale(self.path, self.allowed, moved, weight)

    def _step(
        self, moved: Index, scale: Array, here: PathClearance, held: ClosePoints, cuts: _Cuts
    ) -> tuple[Array, PathClearance, float] | None:
        """Return the displacement of least cost that satisfies the tangents' inequalities; None if there is none.

        The clearance along the displaced path and the cost are also returned.

        At first, only samples near an obstacle have an inequality. If the solution violates the clearance at another
        sample, all samples get an inequality.
        """
        answer = None
        for influence in (_INFLUENCE, np.inf):
            solution = self._least(moved, scale, here, held, cuts, influence)
            if solution is None:
                return None
            displacement, cost = solution
            there = self.tool.clearance_of(self.path.displaced(displacement))
            answer = (displacement, there, cost)
            if there.lowest >= min(self.target, here.lowest) - STILL:
                break
        return answer

    def _least(
        self, moved: Index, scale: Array, here: PathClearance, held: ClosePoints, cuts: _Cuts, influence: float
    ) -> tuple[Array, float] | None:
        """Minimise the cost subject to the inequalities from the tangents along a path; None without a solution.

        If there is no solution, all tangents are relaxed by one common distance, as small as possible; the tangents
        along the resulting path may then have a solution.
        """
        basis, away = self.path.basis, here.positions - self.path.nominal.positions
        pair, j = np.nonzero((here.distance < self.target + influence) & self.movable)
        n, missing = here.normal[pair, j], self.target - here.distance[pair, j]
        lever, away_there = basis[j], away[j]
        if len(held):
            distance, normal = here.at(held)
            k, s = held.segment, held.fraction[:, None]  # a point between two samples is as affine as they are
            n, missing = np.concatenate([n, normal]), np.append(missing, self.clearance + 10 * _ROUNDING - distance)
            lever = np.concatenate([lever, (1.0 - s) * basis[k] + s * basis[k + 1]])
            away_there = np.concatenate([away_there, (1.0 - s) * away[k] + s * away[k + 1]])
        size, d = scale.shape[1], self.allowed.dimension
        rows = (lever[:, moved, None] * (n @ self.allowed.axes)[:, None, :]).reshape(-1, size)
        lower = missing + np.einsum("rd,rd->r", n, away_there)
        n_tangents = len(rows)
        if len(self.allowed.one_sided):
            one_sided = np.kron(np.eye(len(moved)), -self.allowed.one_sided)
            rows, lower = np.concatenate([rows, one_sided]), np.append(lower, np.zeros(len(one_sided)))
        if len(cuts.bound):
            along = (cuts.lever[:, moved, None] * (cuts.direction @ self.allowed.axes)[:, None, :]).reshape(-1, size)
            rows, lower = np.concatenate([rows, -along]), np.append(lower, -cuts.bound)
        rows, upper = rows @ scale, np.full(len(lower), UNBOUNDED)
        y = least_norm(rows, lower, upper)
        if y is None:
            slack = np.where(np.arange(len(rows)) < n_tangents, _SLACK_SCALE, 0.0)[:, None]
            y = least_norm(np.hstack([rows, slack]), lower, upper)
            if y is None:
                return None
            y = y[:-1]
        displacement = np.zeros((self.path.n_components, 3))
        displacement[moved] = self.allowed.enforced((scale @ y).reshape(-1, d))
        displacement[np.einsum("kd,kd->k", displacement, displacement) < STILL**2] = 0.0
        return displacement, float(y @ y)


def style_scale(path: ComponentPath, allowed: AllowedDirections, moved: Index, smoothness: float) -> Array:
    """Return the matrix G (m d, m d) that takes coordinates y to displacements ``delta = G y`` with the cost ``|y|^2``.

    The cost is ``delta^T H delta``. The matrix H is the sum of two matrices. The first has the inverse demonstrated
    covariances as diagonal blocks. The second gives the squared jerk of the displacement, times its weight.

    Args:
        path: the path and its components.
        allowed: directions in which components may move; for each component, ``delta`` has d coordinates along them.
        moved: indices of the m components that may move.
        smoothness: weight of the squared jerk, which is divided by the squared largest jerk of the nominal path.
    """
    axes, m, d = allowed.axes, len(moved), allowed.dimension
    index, h = np.arange(m), np.zeros((m, d, m, d))
    if smoothness == 0.0 and d == 3:
        h[index, :, index, :] = path.factors[moved]
        return h.reshape(m * d, m * d)
    blocks = axes.T @ path.precisions[moved] @ axes
    if smoothness == 0.0:
        h[index, :, index, :] = np.swapaxes(np.linalg.inv(np.linalg.cholesky(blocks)), 1, 2)
        return h.reshape(m * d, m * d)
    h[index, :, index, :] = blocks
    jerk = path.basis_jerk[:, moved] / max(path.nominal_jerk, 1e-9)
    products = smoothness * (jerk.T @ jerk)
    for axis in range(d):
        h[:, axis, :, axis] += products
    lower = np.linalg.cholesky(h.reshape(m * d, m * d))
    return np.asarray(np.linalg.inv(lower).T)


@dataclass(frozen=True, eq=False)
class AvoidanceProblem:
    """The problem that an adaptation method solves: a path, obstacles and a required clearance.

    Attributes:
        path: the nominal path and its components.
        nominal: distances from the tool to every obstacle along the nominal path.
        clearance: required clearance [m].
        allowed: directions in which components may move.
    """

    path: ComponentPath
    nominal: PathClearance
    clearance: float
    allowed: AllowedDirections

    def evaluated(self, displacement: Array) -> Detour:
        """Return the path for a displacement of the components (n_components, 3) [m], with its guaranteed clearance."""
        there = self.nominal.tool.clearance_of(self.path.displaced(displacement))
        return LeastDetour(self.path, self.nominal.tool, self.clearance, self.allowed).evaluate(displacement, there)


class PathAdapter(ABC):
    """Base class of the adaptation methods.

    To add a method, write a subclass, and register an object of it in ``ADAPTERS`` or as a plugin (entry point).

    Attributes:
        refuses: whether ``ACFRA`` refuses to move if the path of this method does not keep the clearance. If False,
            ``ACFRA`` always follows the path, so that the methods can be compared.
    """

    refuses: ClassVar[bool] = False

    @abstractmethod
    def detour(self, problem: AvoidanceProblem) -> Detour:
        """Return a displaced path with its guaranteed clearance, computed by :meth:`AvoidanceProblem.evaluated`."""


def best_of(detours: Iterable[Detour | None]) -> Detour | None:
    """Return the best detour; None when there is none.

    The order of preference is: feasible detours, detours within the limits on displacement and steps, all others. Among
    detours of the same kind, the detour with the largest guaranteed clearance is the best.
    """
    found = [detour for detour in detours if detour is not None]
    return max(found, key=lambda x: (x.feasible, not x.out_of_limits, x.lowest), default=None)
