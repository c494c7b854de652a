"""Move the fewest components by the least so that the whole path keeps its clearance, or say why it can't be done.

The algorithm of :func:`find_detour` (METHODS D.2.5, with its last step replaced by an exact one):

1. **Side.** Take the obstacle that is violated worst. Try directions across the path; along each, the lift that every
   violated sample needs is the exit from the inflated convex obstacle, found by Newton's method from outside, which
   on a convex function never overshoots. The smallest amplitudes of the components that give this lift are a small
   quadratic program. The direction that costs the least (in demonstrated variance, and in what is violated afterwards)
   is followed, best first, until nothing is violated; the others are kept and come up again if it leads nowhere.
2. **Least detour** (``least_detour``): on that side, the smallest displacement that keeps the clearance.
3. **Certificate** (``certificate``): a lower bound of the distance on the whole path, not only at samples.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import Detour, Pair, distances
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import NEGLIGIBLE_LEVER, UNBOUNDED, LeastDetour, least_norm

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_LIFT = 0.35  # [m] a sample that would have to move farther than this is given up in that direction
AFFECTED_DISTANCE = 0.05  # [m] d_0 of METHODS D.2.4: components nearer than this may help
_ANGLES = np.arange(12) * (np.pi / 6.0)
_RING = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # directions tried across the path in 3-D
_IDENTITY = np.eye(3)
_OTHERS = ([1, 2], [0, 2], [0, 1])
_MAX_ROWS = 12  # violated samples that vote on a direction; the polish then holds all of them
_REFINED = 2  # directions whose amplitudes are made smallest; the others wait with a rougher answer
_VIOLATION_COST = 1e3  # [1/m] price of violated clearance against the style cost (METHODS D.2.5)
_STYLE_COST = 1e-3
_REPAIRABLE = 0.003  # [m] a violation that the polish can take out itself
_SAME = 1e-5  # [m] choices that differ by less are one and the same up to rounding
_ROUNDING = 1e-6  # [m] a sample that lacks less is not too near: quadratic programs keep their rows no better
_NEWTON_STEPS = 12
_LIFT_TOLERANCE = 1e-3  # [m] lifts are this much too long at most
_THINNED = 3  # sides are rated on every third sample


@dataclass(order=True)
class _Node:
    cost: float
    order: int
    displacement: Array = field(compare=False)


def find_detour(
    path: ComponentPath,
    pairs: Sequence[Pair],
    clearance: float,
    distance: Array,
    normal: Array,
    *,
    forbidden: Array,
    max_choices: int = 60,
) -> Detour:
    """Move components so that every sphere of the tool keeps the clearance to every obstacle.

    Args:
        path: the nominal path and its components.
        pairs: spheres of the tool and convex obstacles.
        clearance: asked [m].
        distance: clearance of each pair at the nominal path's samples, shape (n_pairs, n) [m].
        normal: gradients there, shape (n_pairs, n, 3).
        forbidden: directions in which no component may move, unit rows, shape (m, 3); each displacement has
            ``Delta . f <= 0``. A direction and its opposite forbid the axis.
        max_choices: how many choices of a side before giving up, once with the components near the obstacles and
            once with all of them.

    Returns:
        The detour; when it is not feasible, the best attempt with its bounds.
    """
    search = _Search(path, pairs, clearance, forbidden)
    detour = search.run(max_choices, distance, normal)
    if not detour.feasible:  # moving the components next to the obstacle was not enough: let all of them help
        search.everywhere = True
        wider = search.run(max_choices, distance, normal)
        detour = wider if wider.bounds.min() > detour.bounds.min() else detour
    return detour


class _Search:
    """One call's arrays: the state of the best-first search over sides, and the polish."""

    def __init__(self, path: ComponentPath, pairs: Sequence[Pair], clearance: float, forbidden: Array) -> None:
        self.path, self.pairs, self.clearance, self.forbidden = path, pairs, clearance, forbidden
        self.least = LeastDetour(path, pairs, clearance, forbidden)
        self.wanted = self.least.wanted
        self.everywhere = False  # whether components far from the obstacle may move too

    def run(self, max_choices: int, distance: Array, normal: Array) -> Detour:
        """Follow the cheapest choice of sides until one is feasible; begin at the nominal path."""
        heap = [_Node(0.0, 0, np.zeros((self.path.n_components, 3)))]
        tried: list[Array] = []
        best: Detour | None = None
        order = expanded = 0
        while heap:
            node = heapq.heappop(heap)
            if any(np.abs(node.displacement - other).max() < _SAME for other in tried):
                continue
            tried.append(node.displacement)
            positions = self.path.displaced(node.displacement)
            if node.order > 0:
                distance, normal = distances(self.pairs, positions)
            bounds = distance.min(axis=1)
            detour = Detour(node.displacement, positions, bounds, bounds, False, expanded)
            if bounds.min() >= self.wanted - _REPAIRABLE:
                detour = self.least.shrink(detour, distance, normal)
            if best is None or (detour.feasible, detour.nearest.min()) > (best.feasible, best.nearest.min()):
                best = detour
            if detour.feasible or expanded >= max_choices:
                break
            expanded += 1
            for cost, displacement in self._children(node.displacement, positions, distance, normal):
                order += 1
                heapq.heappush(heap, _Node(cost, order, displacement))
        assert best is not None
        if not best.feasible:  # say what is proven of the best attempt, not what its samples look like
            distance, normal = distances(self.pairs, best.positions)
            best = self.least.judged(best.displacement, best.positions, distance, normal, expanded)
            best = replace(best, feasible=False)
        return best

    def _children(
        self, displacement: Array, positions: Array, distance: Array, normal: Array
    ) -> list[tuple[float, Array]]:
        """Return what each direction round the worst obstacle leads to: (cost, displacement), affordable ones only."""
        worst = int(np.argmin(distance.min(axis=1)))
        rows = np.flatnonzero((distance[worst] < self.wanted - _ROUNDING) & self.least.movable)
        if not len(rows):
            return []
        rows = rows[:: -(-len(rows) // _MAX_ROWS)]
        directions = self._directions(positions, normal[worst], int(np.argmin(distance[worst])))
        affected = self._affected(rows, worst, distance, normal)
        lever = self.path.basis[np.ix_(rows, affected)]
        lifts = self._exits(self.pairs[worst], positions, rows, directions)
        children, costs, entered = self._rated(displacement, lever, lifts, directions, affected, worst, distance)
        if entered:  # the best way out of this obstacle runs into another one: also try to go beyond all of them
            near = distance[:, rows].min(axis=1) < self.wanted + MAX_LIFT
            for i in np.flatnonzero(near).tolist():
                if i != worst:
                    lifts = np.maximum(lifts, self._exits(self.pairs[i], positions, rows, directions))
            more, prices, _ = self._rated(displacement, lever, lifts, directions, affected, worst, distance)
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
        distance: Array,
    ) -> tuple[list[Array], list[float], bool]:
        """Turn lifts (m, p) along directions (m, 3) into displacements with their costs.

        All directions are first rated with one amplitude for all affected components; the best few then get the
        smallest amplitudes that do. Also tells whether the cheapest one comes nearer to another obstacle than before.
        """
        uniform = (lifts / np.maximum(lever.sum(axis=1), NEGLIGIBLE_LEVER)).max(axis=1, initial=0.0)
        affordable = uniform <= 2.0 * MAX_LIFT
        if not affordable.any():
            return [], [], True
        lifts, directions, uniform = lifts[affordable], directions[affordable], uniform[affordable]
        children = np.repeat(displacement[None], len(uniform), axis=0)
        children[:, affected] += (uniform[:, None] * directions)[:, None, :]
        costs, _ = self._costs(children)
        best = np.argsort(costs)[:_REFINED]
        for i in best:
            amplitude = self._amplitudes(lever, lifts[i], directions[i], affected)
            if amplitude is not None:
                children[i] = displacement
                children[i, affected] += amplitude[:, None] * directions[i]
        if len(self.pairs) == 1:  # nothing else to run into, and the cheapest direction stays the cheapest
            return list(children), costs.tolist(), False
        costs[best], violation = self._costs(children[best])
        before = np.maximum(0.0, self.wanted - distance[:, ::_THINNED]).sum(axis=1)
        after = violation[:, np.argmin(costs[best])]
        nearer = after > before
        nearer[worst] = False
        return list(children), costs.tolist(), bool(nearer.any())

    def _costs(self, displacements: Array) -> tuple[Array, Array]:
        """Rate displacements (c, n_components, 3): demonstrated variance they use up, and clearance still violated.

        Returns:
            costs (c,) and, by pair, the violation summed over every third sample (n_pairs, c) [m].
        """
        style = np.einsum("ckd,kde,cke->c", displacements, self.path.precisions, displacements)
        sampled = self.path.nominal.positions[::_THINNED] + self.path.basis[::_THINNED] @ displacements
        every = slice(None, None, _THINNED)
        lacking = [np.maximum(0.0, self.wanted - pair.distance(sampled, every)).sum(axis=1) for pair in self.pairs]
        violation = np.stack(lacking)
        return _STYLE_COST * style + _THINNED * _VIOLATION_COST * violation.sum(axis=0), violation

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
        for _ in range(2 if len(self.forbidden) else 0):  # taking out one part may bring back a little of another
            for f in self.forbidden:
                candidates = candidates - np.maximum(candidates @ f, 0.0)[:, None] * f
        length = np.sqrt(np.einsum("md,md->m", candidates, candidates))
        candidates = candidates[length > 0.25] / length[length > 0.25, None]
        return np.unique(np.round(candidates, 9) + 0.0, axis=0) if len(self.forbidden) else candidates

    def _exits(self, pair: Pair, positions: Array, rows: Index, directions: Array) -> Array:
        """Return how far each sample has to go along each direction to be clear of the obstacle for good.

        Newton's method from outside: the signed distance along a ray is convex, so it comes down to the largest root
        without passing it. A lift above ``MAX_LIFT`` becomes inf.

        Args:
            pair: sphere and obstacle.
            positions: of the tip, shape (n, 3).
            rows: which samples, shape (p,).
            directions: unit, shape (m, 3).

        Returns:
            Lifts, shape (m, p) [m].
        """
        points = pair.centres(positions[rows], rows)
        # Beyond the obstacle's farthest plane along a direction every point is clear: begin there.
        farthest = np.einsum("md,md->m", pair.obstacle.support(directions), directions) + self.wanted + pair.radius
        lift = np.maximum(farthest[:, None] - directions @ points.T, 0.0)
        for _ in range(_NEWTON_STEPS):
            d, n = pair.distance_and_normal(points + lift[..., None] * directions[:, None, :])
            gap = d - self.wanted
            slope = (n @ directions[:, :, None])[..., 0]
            falling = slope <= 1e-9  # past the point of closest approach: the ray never enters
            lift = np.where(falling, 0.0, np.maximum(lift - gap / np.where(falling, 1.0, slope), 0.0))
            if np.all((gap < _LIFT_TOLERANCE) | (lift <= 0.0)):
                break
        return np.where(lift > MAX_LIFT, np.inf, lift)

    def _affected(self, rows: Index, worst: int, distance: Array, normal: Array) -> Index:
        """Return the indices of the components near the obstacle or in charge of a violated sample (METHODS D.2.4).

        A component's centre is taken to be where the path is at its instant; there the distances are known.
        """
        centre, n = distance[worst, self.path.centres], normal[worst, self.path.centres]
        spread = np.sqrt(np.einsum("kd,kde,ke->k", n, self.path.covariances, n))
        near = centre - spread - self.clearance <= AFFECTED_DISTANCE
        in_charge = self.path.responsibilities[rows].max(axis=0) > 0.25
        return np.flatnonzero(
            (near | in_charge | self.everywhere) & (self.path.basis[rows].max(axis=0) > NEGLIGIBLE_LEVER)
        )

    def _amplitudes(self, lever: Array, lift: Array, u: Array, affected: Index) -> Array | None:
        """Return amplitudes a >= 0 of least ``sum a_k^2 / (u^T Y_k u)`` with ``lever @ a >= lift``, or None.

        Args:
            lever: basis of the violated samples and affected components, shape (p, k).
            lift: what each sample needs, shape (p,) [m].
            u: unit direction (3,).
            affected: indices of the components, shape (k,).

        Returns:
            Amplitudes (k,) [m].
        """
        spread = np.sqrt(np.einsum("d,kde,e->k", u, self.path.yields[affected], u))
        upper = np.concatenate([2.0 * MAX_LIFT / spread, np.full(len(lift), UNBOUNDED)])
        lower = np.concatenate([np.zeros(len(spread)), lift])
        z = least_norm(lever * spread, lower, upper)
        return None if z is None else spread * z
