"""The least displacement of components that keeps the clearance, once it is known on which side to pass.

With one tangent plane for each sample and obstacle, "keep the clearance" is a set of linear inequalities in the
displacements, and because the planes under-estimate the distance, each of their solutions truly keeps it (an inner
convex approximation). Minimising ``sum_k Delta_k^T Y_k^-1 Delta_k`` under them and renewing the planes never leaves
the feasible set and never gets worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import Detour, Dips, Pair, distances, judged
from imitarm.policies.component_path import STILL, ComponentPath

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NEGLIGIBLE_LEVER = 0.02  # a sample that components can hardly move has no row: it would take a huge displacement
FARTHEST = 0.5  # [m] no sample is led farther than this from where it was learnt
_LONGEST_STEP = 8.0  # times the longest step of the nominal path: a longer one is a jump
UNBOUNDED = 1e30  # daqp's infinity
_INFLUENCE = 0.04  # [m] at first, obstacles farther from a sample than this get no row
_STEPS = 2  # rounds of tangents; most of what there is to save, the first one saves
_HOPELESS = 0.002  # [m] a sample that lacks this much is no dip between two of them
_TRIES = 12  # a segment that still dips then is given up
_BEYOND = 2e-5  # [m] asked beyond the clearance of a point between two samples
_SLACK_SCALE = 1e-4  # [m] missing the tangents by this costs as much as one demonstrated sigma
_GAIN = 0.9  # stop when a step saves less than a tenth
_SOLVED = 1  # daqp's exit flag of an optimal solution


def least_norm(rows: Array, lower: Array, upper: Array) -> Array | None:
    """Solve ``min |y|^2`` under ``lower <= rows @ y <= upper`` by an exact active-set method (daqp).

    Args:
        rows: shape (m, n).
        lower: shape (m,) or, to bound y itself as well, (n + m,).
        upper: as ``lower``.

    Returns:
        y, shape (n,); None when there is no solution.
    """
    n = rows.shape[1]
    y, _, flag, _ = daqp.solve(np.eye(n), np.zeros(n), np.ascontiguousarray(rows), upper, lower)
    return np.asarray(y) if flag == _SOLVED else None


def _longest_step(positions: Array) -> float:
    step = positions[1:] - positions[:-1]
    return float(np.sqrt(np.einsum("nd,nd->n", step, step).max()))


class LeastDetour:
    """Shrinks detours of one path among one set of obstacles, for all spheres of the tool.

    Attributes:
        wanted: distance planned for at the samples: the clearance, and what a chord may sag between two of them [m].
        movable: which samples some component can move, shape (n,).
    """

    def __init__(self, path: ComponentPath, pairs: Sequence[Pair], clearance: float, forbidden: Array) -> None:
        self.path, self.pairs, self.clearance, self.forbidden = path, pairs, clearance, forbidden
        step = self._longest_step = _longest_step(path.nominal.positions)
        # Round a corner of an obstacle the centre of a sphere passes on an arc of this radius; its chord sags by
        # step^2 / 8 radius.
        radius = clearance + min(pair.radius for pair in pairs)
        self.wanted = clearance + 1e-4 + 1.5 * step**2 / (8.0 * max(radius, 1e-3))
        self.movable = path.basis.max(axis=1) > NEGLIGIBLE_LEVER

    def judged(self, displacement: Array, positions: Array, distance: Array, normal: Array, expanded: int) -> Detour:
        """Judge a path by its certificate, and by whether it is one that a robot could follow."""
        detour = judged(self.pairs, displacement, positions, distance, normal, self.clearance, expanded)
        away = self._away(positions)
        far = bool(np.sqrt(np.einsum("nd,nd->n", away, away).max()) > FARTHEST)
        if far or _longest_step(positions) > _LONGEST_STEP * self._longest_step:
            return replace(detour, feasible=False, strays=True)
        return detour

    def shrink(self, detour: Detour, distance: Array, normal: Array) -> Detour:
        """Shrink a displacement to the least one that its tangents allow; where a segment dips, hold that point too.

        To ask for more at the samples instead would not do: with longer steps round the corner the path can have them
        farther out and yet cut it as before, and next to a pinned instant a little more takes a huge displacement.
        """
        best: Detour | None = None
        moved = np.flatnonzero(detour.displacement.any(axis=1))
        displacement, positions, held = detour.displacement, detour.positions, Dips.none()
        for _ in range(_TRIES if len(moved) else 0):
            cost = self._cost(displacement)
            for _ in range(_STEPS):
                step = self._step(moved, positions, distance, normal, held)
                if step is None:
                    break
                displacement, positions, distance, normal = step
                previous, cost = cost, self._cost(displacement)
                if cost > _GAIN * previous:
                    break
            trial = self.judged(displacement, positions, distance, normal, detour.expanded)
            if best is None or trial.bounds.min() > best.bounds.min():
                best = trial
            if trial.feasible or trial.strays or distance.min() < self.clearance - _HOPELESS:
                break
            held = held.and_also(trial.dips)
        return detour if best is None else best

    def _step(
        self, moved: Index, positions: Array, distance: Array, normal: Array, held: Dips
    ) -> tuple[Array, Array, Array, Array] | None:
        """Return the displacement of least cost under the tangents, its path, distances and normals; None: no solution.

        At first only samples near an obstacle get a row. Where that lets another one in, all of them do.
        """
        answer = None
        for influence in (_INFLUENCE, np.inf):
            displacement = self._least(moved, positions, distance, normal, held, influence)
            if displacement is None:
                return None
            new = self.path.displaced(displacement)
            answer = (displacement, new, *distances(self.pairs, new))
            if answer[2].min() >= min(self.wanted, float(distance.min())) - STILL:
                break
        return answer

    def _away(self, positions: Array) -> Array:
        return positions - self.path.nominal.positions

    def _between(self, dips: Dips, positions: Array) -> tuple[Array, Array, Array, Array]:
        """Return normals (m, 3), missing clearance (m,), basis (m, n_components) and distance from nominal (m, 3).

        A point between two samples is a fixed mean of them, so it is as affine in the displacements as they are.
        """
        j, s = dips.segment, dips.fraction[:, None]
        normal, missing = np.empty((len(j), 3)), np.empty(len(j))
        for i in np.unique(dips.pair).tolist():
            pair, of = self.pairs[i], np.flatnonzero(dips.pair == i)
            start, end = pair.centres(positions[j[of]], j[of]), pair.centres(positions[j[of] + 1], j[of] + 1)
            distance, normal[of] = pair.distance_and_normal(start + s[of] * (end - start))
            bow = np.broadcast_to(pair.bow, len(positions) - 1)[j[of]]
            missing[of] = self.clearance + _BEYOND - (distance - bow)
        away, basis = self._away(positions), self.path.basis
        return normal, missing, (1.0 - s) * basis[j] + s * basis[j + 1], (1.0 - s) * away[j] + s * away[j + 1]

    def _cost(self, displacement: Array) -> float:
        return float(np.einsum("kd,kde,ke->", displacement, self.path.precisions, displacement))

    def _least(
        self, moved: Index, positions: Array, distance: Array, normal: Array, held: Dips, influence: float
    ) -> Array | None:
        """Minimise ``sum Delta_k^T Y_k^-1 Delta_k`` under the tangents at ``positions``; None: no solution.

        With the yields ``Y_k = L_k L_k^T`` and ``Delta_k = L_k y_k`` the cost is ``|y|^2``: a least-norm problem. Where
        it has no solution, one more unknown lets all tangents be missed by the same, smallest length; from the path
        that comes of it the renewed tangents may have one.
        """
        o, j = np.nonzero((distance < self.wanted + influence) & self.movable)
        at_samples = (normal[o, j], self.wanted - distance[o, j], self.path.basis[j], self._away(positions)[j])
        n, missing, lever, away = at_samples
        if len(held.pair):
            between = self._between(held, positions)
            n, missing, lever, away = map(np.concatenate, zip(at_samples, between, strict=True))
        factors = self.path.factors[moved]
        rows = lever[:, moved][:, :, None] * np.swapaxes(n @ factors, 0, 1)
        lower = missing + np.einsum("rd,rd->r", n, away)
        size = 3 * len(moved)
        n_tangents = len(rows)
        if len(self.forbidden):
            blocks = np.zeros((len(self.forbidden), len(moved), len(moved), 3))
            index = np.arange(len(moved))
            blocks[:, index, index] = np.swapaxes(self.forbidden @ factors, 0, 1)
            rows = np.vstack([rows.reshape(-1, size), -blocks.reshape(-1, size)])
            lower = np.concatenate([lower, np.zeros(len(self.forbidden) * len(moved))])
        rows, upper = rows.reshape(-1, size), np.full(len(lower), UNBOUNDED)
        y = least_norm(rows, lower, upper)
        if y is None:
            slack = np.where(np.arange(len(rows)) < n_tangents, _SLACK_SCALE, 0.0)[:, None]
            y = least_norm(np.hstack([rows, slack]), lower, upper)
            if y is None:
                return None
            y = y[:-1]
        displacement = np.zeros((self.path.n_components, 3))
        displacement[moved] = (factors @ y.reshape(-1, 3, 1))[..., 0]
        for f in self.forbidden:  # the solver keeps them to its tolerance; here they hold exactly
            displacement -= np.maximum(displacement @ f, 0.0)[:, None] * f
        displacement[np.linalg.norm(displacement, axis=1) < STILL] = 0.0
        return displacement
