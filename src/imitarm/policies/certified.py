"""The default adaptation method: the smallest displacement of the components with which the path keeps its clearance.

The algorithm of :func:`find_detour`:

1. **Side.** Take the obstacle that violates the clearance most, and try directions across the path. The *lift* of a
   sample is how far the sample must move along a direction until it keeps the clearance. A small quadratic program
   computes the smallest displacements of the components that give all samples their lift. The cost of a direction is
   the displacement relative to the demonstrated variance, plus the violations that remain. The search follows the
   direction of least cost until no sample violates the clearance. If this direction fails, the search returns to other
   directions.
2. **Least detour** (:mod:`~imitarm.policies.least_detour`): the smallest displacement that keeps the clearance and
   passes each obstacle on the chosen side.
3. **Certificate** (:mod:`~imitarm.policies.certificate`): a lower bound of the distance on the whole path, not only at
   samples.
4. If steps 1 to 3 find no path, a grid of positions (:mod:`~imitarm.policies.passages`) often proves that no path
   exists. Otherwise, a roadmap (:mod:`~imitarm.policies.roadmap`) gives routes around the obstacles. Step 2 follows
   each route, first with the learned components, then with more, narrower components. If no route leads to a path, step
   2 follows the cheapest chain of the grid's cells. If components can move only in a plane, grid and roadmap are built
   earlier: as soon as the next choice of sides costs more than 70 % of the previous choice. If there is no route, the
   search over sides ends.
5. The path of step 3 may be displaced by more than twice the depth by which the learned path violates the clearance.
   Then, the learned components are too wide for the scene, or another side is better. In this case, step 2 also follows
   a route of the roadmap with narrower components. The function returns the path with the smaller mean deviation from
   the demonstrations.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import PathClearance, ToolAmongObstacles
from imitarm.policies.component_path import TOLERANCE_FLOOR, ComponentPath
from imitarm.policies.least_detour import (
    NEGLIGIBLE_LEVER,
    UNBOUNDED,
    AllowedDirections,
    AvoidanceProblem,
    Detour,
    LeastDetour,
    PathAdapter,
    best_of,
    least_norm,
)
from imitarm.policies.passages import Passages
from imitarm.policies.roadmap import Roadmap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_LIFT = 0.35  # [m] a sample that would have to move farther than this is given up in that direction
AFFECTED_DISTANCE = 0.05  # [m] components nearer to an obstacle than this may help
_ANGLES = np.arange(12) * (np.pi / 6.0)
_RING = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # directions tried across the path
_IDENTITY = np.eye(3)
_OTHERS = ([1, 2], [0, 2], [0, 1])
_MAX_CHOICES = 4  # of a side, before all times are searched together
_HARDLY_CHEAPER = 0.7  # times the cost of the previous choice of sides
_STRAY_RATIO = 2.0  # a path that is displaced by more than this many depths of the violation is too far away
_MAX_ROUTES = 3  # through the roadmap
_ALMOST = 0.003  # [m] an attempt that lacks less clearance than this is tried again with narrower components
_MAX_ROWS = 12  # violated samples that vote on a direction; the least detour then respects all of them
_REFINED = 2  # directions whose amplitudes are minimised; the others wait with a rougher answer
_VIOLATION_COST = 1e3  # [1/m] price of violated clearance against the style cost
_STYLE_COST = 1e-3
_REPAIRABLE = 0.003  # [m] a violation that the least detour can remove itself
_SAME = 1e-5  # [m] choices that differ by less are one and the same up to rounding
_ROUNDING = 1e-6  # [m] a sample that lacks less is not too near: quadratic programs keep their rows no better
_LIFT_TOLERANCE = 1e-3  # [m] lifts are this much too long at most
_THINNED = 3  # sides are rated on every third sample
_FEW_PAIRS = 4  # of spheres and obstacles: measuring all samples then takes less time than choosing those nearby


class CertifiedAdapter(PathAdapter):
    """The default method: the smallest detour with a guaranteed clearance, or a detour that is not feasible."""

    refuses = True

    def detour(self, problem: AvoidanceProblem) -> Detour:
        """Return a feasible detour, or the best attempt."""
        return find_detour(problem.path, problem.nominal, problem.clearance, problem.allowed)


CERTIFIED = CertifiedAdapter()


def find_detour(path: ComponentPath, nominal: PathClearance, clearance: float, allowed: AllowedDirections) -> Detour:
    """Move components so that every sphere of the tool keeps the clearance to every obstacle.

    Args:
        path: the nominal path and its components.
        nominal: clearance along the nominal path.
        clearance: required clearance [m].
        allowed: directions in which components may move.

    Returns:
        The detour; when it is not feasible, the best attempt with its bounds.
    """
    search = _SideSearch(path, nominal, clearance, allowed)
    around = _Surroundings(path, nominal.tool, clearance, allowed)
    best = search.run(while_cheaper=allowed.dimension < 3)
    if best is None:  # in a plane, this costs no more than further sides, and often shows that there is no path
        best = search.best() if around.are_closed or around.roadmap.is_hopeless else search.run()
    assert best is not None
    if not allowed.dimension or (best.feasible and not _strays(best, nominal, clearance)):
        return best
    if best.feasible:
        return _nearer(best, around)
    return best if around.are_closed else _followed(best, around)


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """What is known about the free space around one path; each part is computed when it is first needed."""

    path: ComponentPath
    tool: ToolAmongObstacles
    clearance: float
    allowed: AllowedDirections

    @cached_property
    def roadmap(self) -> Roadmap:
        """A roadmap with a route, if possible by rays that are aimed at gaps between the obstacles."""
        roadmap = Roadmap(self.path, self.tool, self.clearance, self.allowed)
        if not roadmap.is_hopeless:
            return roadmap
        return Roadmap(self.path, self.tool, self.clearance, self.allowed, aimed=True)

    @cached_property
    def passages(self) -> Passages | None:
        """The passages between obstacles; None if components can move in less than two dimensions."""
        few = self.allowed.dimension < 2
        return None if few else Passages(self.path, self.tool, self.clearance, self.allowed)

    @property
    def are_closed(self) -> bool:
        """Whether there is provably no path."""
        return self.passages is not None and self.passages.are_closed

    def least(self, path: ComponentPath) -> LeastDetour:
        """Return the search for the least detour with the components of ``path``."""
        return LeastDetour(path, self.tool, self.clearance, self.allowed, exact=True)

    def along(self, route: Array) -> PathClearance:
        """Return the clearance along a route, given by its displacements (n, 3) [m]."""
        return self.tool.clearance_of(self.path.nominal.positions + route)


def _nearer(best: Detour, around: _Surroundings) -> Detour:
    """Return a feasible detour that is divided and follows the roadmap, if it is nearer than the feasible ``best``."""
    start = best.clearance
    if not around.roadmap.is_hopeless:
        start = around.along(next(around.roadmap.routes(1)))
    nearer = around.least(around.path.divided).shrink(start)
    return best if nearer is None or not nearer.feasible else min(best, nearer, key=_deviation)


def _followed(best: Detour, around: _Surroundings) -> Detour:
    """Return the first feasible detour that is found along proposed routes; if there is none, the best attempt."""
    for start, pieces in _proposals(best, around):
        best = best_of((best, around.least(pieces).shrink(start))) or best
        if best.feasible:
            break
    return best


def _proposals(best: Detour, around: _Surroundings) -> Iterator[tuple[PathClearance, ComponentPath]]:
    """Yield the clearance along proposed routes, with the components that are to follow each of them."""
    path = around.path
    if best.lowest > around.clearance - _ALMOST:
        yield best.clearance, path.divided
    for route in () if around.roadmap.is_hopeless else around.roadmap.routes(_MAX_ROUTES):
        along = around.along(route)
        yield along, path
        yield along, path.divided
    passage = None if around.passages is None else around.passages.route()
    if passage is not None:
        along = around.along(passage)
        yield along, path.divided
        yield along, path.finely_divided


def _strays(detour: Detour, nominal: PathClearance, clearance: float) -> bool:
    """Return whether a path is displaced much farther than the obstacles are wide.

    The learned components are then too wide for this scene, or the path passes an obstacle on the wrong side.
    """
    away = detour.clearance.positions - detour.path.nominal.positions
    farthest = np.sqrt(np.einsum("nd,nd->n", away, away).max())
    return bool(farthest > _STRAY_RATIO * max(clearance - nominal.lowest, 0.0))


def _deviation(detour: Detour) -> float:
    """Return the mean squared displacement of a path, in standard deviations of the demonstrations."""
    path, away = detour.path, detour.clearance.positions - detour.path.nominal.positions
    covariance = path.tolerance + TOLERANCE_FLOOR**2 * np.eye(3)
    return float(np.einsum("nd,nd->n", away, np.linalg.solve(covariance, away[..., None])[..., 0]).mean())


@dataclass(order=True)
class _Node:
    cost: float
    order: int
    displacement: Array = field(compare=False)


class _SideSearch:
    """The state of one best-first search over the sides on which the path passes the obstacles."""

    def __init__(
        self, path: ComponentPath, nominal: PathClearance, clearance: float, allowed: AllowedDirections
    ) -> None:
        self.path, self.nominal, self.tool = path, nominal, nominal.tool
        self.clearance, self.allowed = clearance, allowed
        self.least = LeastDetour(path, self.tool, clearance, allowed)
        self.target = self.least.target
        missing = np.maximum(0.0, self.target - nominal.distance[:, ::_THINNED])
        cost = _THINNED * _VIOLATION_COST * float(missing.sum())
        self._heap = [_Node(cost, 0, np.zeros((path.n_components, 3)))]
        self._tried: list[Array] = []
        self._best: Detour | None = None
        self._order, self._choices, self._cost = 0, 0, cost

    def run(self, *, while_cheaper: bool = False) -> Detour | None:
        """Follow the cheapest choice of sides until a path is feasible, starting at the nominal path.

        A second call continues where the first call stopped.

        Args:
            while_cheaper: stop and return None as soon as the next choice costs more than 70 % of the previous choice.
        """
        while self._heap:
            if while_cheaper and 0 < self._choices < _MAX_CHOICES and self._heap[0].cost > _HARDLY_CHEAPER * self._cost:
                return None
            node = heapq.heappop(self._heap)
            if any(np.abs(node.displacement - other).max() < _SAME for other in self._tried):
                continue
            self._tried.append(node.displacement)
            here = self.nominal
            if node.order > 0:
                here = self.tool.clearance_of(self.path.displaced(node.displacement))
            if here.lowest >= self.target - _REPAIRABLE and node.displacement.any():
                detour = self.least.shrink(here, np.flatnonzero(node.displacement.any(axis=1)))
                self._best = best_of((self._best, detour))
                if self._best is not None and self._best.feasible:
                    return self._best
            if self._choices >= _MAX_CHOICES or not self.allowed.dimension:
                break
            self._choices += 1
            self._cost = node.cost
            for cost, displacement in self._children(node.displacement, here):
                self._order += 1
                heapq.heappush(self._heap, _Node(cost, self._order, displacement))
        return self.best()

    def best(self) -> Detour:
        """Return the best path so far, at worst the nominal one."""
        still = np.zeros((self.path.n_components, 3))
        return best_of((self._best, self.least.evaluate(still, self.nominal)))  # type: ignore[return-value]

    def _children(self, displacement: Array, here: PathClearance) -> list[tuple[float, Array]]:
        """Return (cost, displacement) for each direction around the obstacle with the largest violation."""
        distance = here.distance
        worst = int(np.argmin(distance.min(axis=1)))
        rows = np.flatnonzero((distance[worst] < self.target - _ROUNDING) & self.least.movable)
        if not len(rows):
            return []
        rows = rows[:: -(-len(rows) // _MAX_ROWS)]
        directions = self._directions(here.positions, here.normal[worst], int(np.argmin(distance[worst])))
        if not len(directions):
            return []
        affected = self._affected(rows, worst, here)
        lever = self.path.basis[np.ix_(rows, affected)]
        lifts = self._exits(worst, here.positions, rows, directions)
        children, costs, entered = self._rated(displacement, lever, lifts, directions, affected, worst, here)
        if entered:  # the best exit from this obstacle enters another one: also try to go beyond all of them
            near = distance[:, rows].min(axis=1) < self.target + MAX_LIFT
            for i in np.flatnonzero(near).tolist():
                if i != worst:
                    lifts = np.maximum(lifts, self._exits(i, here.positions, rows, directions))
            more, prices, _ = self._rated(displacement, lever, lifts, directions, affected, worst, here)
            children, costs = children + more, costs + prices
        return list(zip(costs, children, strict=True))

    def _rated(
        self,
        displacement: Array,
        lever: Array,
        lifts: Array,
        directions: Array,
        affected: Index,
        worst: int,
        here: PathClearance,
    ) -> tuple[list[Array], list[float], bool]:
        """Return a displacement of the components for each direction, and the cost of each displacement.

        ``directions`` (m, 3) are the directions, and ``lifts`` (m, p) [m] is how far each of p samples must move along
        each of them.

        First, every direction is rated with one common amplitude for all affected components. Then the smallest
        sufficient amplitudes are computed for the best few directions. The function also returns whether the cheapest
        displacement brings the path closer to another obstacle.
        """
        uniform = (lifts / np.maximum(lever.sum(axis=1), NEGLIGIBLE_LEVER)).max(axis=1, initial=0.0)
        affordable = uniform <= 2.0 * MAX_LIFT
        if not affordable.any():
            return [], [], True
        lifts, directions, uniform = lifts[affordable], directions[affordable], uniform[affordable]
        children = np.repeat(displacement[None], len(uniform), axis=0)
        children[:, affected] += (uniform[:, None] * directions)[:, None, :]
        costs, best = np.zeros(len(children)), np.arange(len(children))
        if len(children) > _REFINED or self.tool.n_pairs == 1:
            costs, _ = self._costs(children, here)
            best = np.argsort(costs)[:_REFINED]
        for i in best:
            amplitude = self._amplitudes(lever, lifts[i], directions[i], affected)
            if amplitude is not None:
                children[i] = displacement
                children[i, affected] += amplitude[:, None] * directions[i]
        if self.tool.n_pairs == 1:  # nothing else to run into, and the cheapest direction stays the cheapest
            return list(children), costs.tolist(), False
        costs[best], violation = self._costs(children[best], here)
        before = np.maximum(0.0, self.target - here.distance[:, ::_THINNED]).sum(axis=1)
        after = violation[:, np.argmin(costs[best])]
        nearer = after > before
        nearer[worst] = False
        return list(children), costs.tolist(), bool(nearer.any())

    def _costs(self, displacements: Array, here: PathClearance) -> tuple[Array, Array]:
        """Return the costs of displacements (c, n_components, 3): their size plus the remaining violation.

        Returns:
            Costs (c,), and for each pair the violation summed over every third sample (n_pairs, c) [m].
        """
        style = np.einsum("ckd,kde,cke->c", displacements, self.path.precisions, displacements)
        sampled = self.path.nominal.positions[::_THINNED] + self.path.basis[::_THINNED] @ displacements
        if self.tool.n_pairs <= _FEW_PAIRS:
            every = slice(None, None, _THINNED)
            distances = (self.tool.distance(pair, sampled, every) for pair in range(self.tool.n_pairs))
            violation = np.stack([np.maximum(0.0, self.target - d).sum(axis=1) for d in distances])
        else:
            violation = self._violations_near(sampled, here)
        return _STYLE_COST * style + _THINNED * _VIOLATION_COST * violation.sum(axis=0), violation

    def _violations_near(self, sampled: Array, here: PathClearance) -> Array:
        """Return the violation by each pair, summed over the samples of each path in ``sampled``, (n_pairs, c) [m].

        A distance changes by at most the displacement of the sample, so only samples near an obstacle can violate its
        clearance.
        """
        moved = sampled - here.positions[::_THINNED]
        farthest = np.sqrt(np.einsum("csd,csd->cs", moved, moved).max(axis=0))
        near = here.distance[:, ::_THINNED] < self.target + farthest
        violation = np.zeros((self.tool.n_pairs, len(sampled)))
        for pair in np.flatnonzero(near.any(axis=1)).tolist():
            samples = np.flatnonzero(near[pair])
            distance = self.tool.distance(pair, sampled.take(samples, axis=1), _THINNED * samples)
            violation[pair] = np.maximum(0.0, self.target - distance).sum(axis=1)
        return violation

    def _directions(self, positions: Array, normal: Array, at: int) -> Array:
        """Return unit directions (m, 3) across the path at sample ``at``, none of them forbidden."""
        tangent = positions[min(at + 1, len(positions) - 1)] - positions[max(at - 1, 0)]
        tangent = tangent / max(float(np.sqrt(tangent @ tangent)), 1e-12)
        # The columns of a Householder reflection that takes an axis to the tangent are a basis across it.
        axis = int(np.argmax(np.abs(tangent)))
        v = tangent.copy()
        v[axis] += np.copysign(1.0, tangent[axis])
        across = (_IDENTITY - v[:, None] * v * (2.0 / (v @ v)))[_OTHERS[axis]]
        candidates = np.concatenate([_RING @ across, (normal[at] - (normal[at] @ tangent) * tangent)[None]])
        return self.allowed.unit_directions(candidates)

    def _exits(self, pair: int, positions: Array, rows: Index, directions: Array) -> Array:
        """Return how far samples (p,) must move along directions (m, 3) to leave the obstacles, shape (m, p) [m].

        A lift above ``MAX_LIFT`` becomes inf.
        """
        points = self.tool.centres(pair, positions[rows], rows)
        margin = self.tool.margin(pair, rows)
        lift = self.tool.exits(pair, points, directions, self.target, _LIFT_TOLERANCE, margin)
        return np.where(lift > MAX_LIFT, np.inf, lift)

    def _affected(self, rows: Index, worst: int, here: PathClearance) -> Index:
        """Return the indices of the components that are near the obstacle or influence a violated sample.

        Distances are known only at the samples of the path. The function therefore uses, for each component, the sample
        at the time of the component's centre.
        """
        centre, n = here.distance[worst, self.path.centres], here.normal[worst, self.path.centres]
        spread = np.sqrt(np.einsum("kd,kde,ke->k", n, self.path.covariances, n))
        near = centre - spread - self.clearance <= AFFECTED_DISTANCE
        in_charge = self.path.responsibilities[rows].max(axis=0) > 0.25
        return np.flatnonzero((near | in_charge) & (self.path.basis[rows].max(axis=0) > NEGLIGIBLE_LEVER))

    def _amplitudes(self, lever: Array, lift: Array, u: Array, affected: Index) -> Array | None:
        """Return the amplitudes a >= 0 with the least ``sum a_k^2 / (u^T Y_k u)`` and ``lever @ a >= lift``; or None.

        Args:
            lever: influence of each affected component on each violated sample, shape (p, k).
            lift: required displacement of each sample, shape (p,) [m].
            u: unit direction (3,).
            affected: indices of the components, shape (k,).

        Returns:
            Amplitudes (k,) [m].
        """
        spread = np.sqrt(self.path.yields[affected] @ u @ u)
        upper = np.concatenate([2.0 * MAX_LIFT / spread, np.full(len(lift), UNBOUNDED)])
        lower = np.concatenate([np.zeros(len(spread)), lift])
        z = least_norm(lever * spread, lower, upper)
        return None if z is None else spread * z
