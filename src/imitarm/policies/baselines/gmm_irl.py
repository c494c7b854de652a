"""GMM+IRL: a path cost learned by inverse reinforcement learning (Ghalamzan et al. 2015)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.expert import PathProblem, displaced_paths
from imitarm.policies.baselines.path_cost import FEATURES, N_FREE, N_SAMPLES, PRECISION, RANGES, PathCost, bump, depth
from imitarm.policies.baselines.reaction import Reaction
from imitarm.policies.component_path import quintic_step
from imitarm.policies.headings import allowed_axes
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number

Array = NDArray[np.float64]

HORIZON = 20
"""Number of points of the receding horizon."""
_SPACING = 2  # of the horizon's points, in samples of the whole path, which has 100
_N_FREE = N_FREE / _SPACING  # points to which the mean features refer
PERIOD = 1.0 / 30.0
"""Time between two plans [s]."""
_ITERATIONS = 30
_ASIDE = 0.08  # [m] height of the first displacements
_NEAR = 0.10  # [m] gap below which displacements to the sides are tried
_STARTS = 3  # of the optimiser, those of least cost
WEIGHTS = Path(__file__).with_name("gmm_irl_weights.json")


@lru_cache(maxsize=1)
def learned_weights() -> dict[str, float]:
    """Return the learned weight of each feature, from the file that ``imitarm.benchmark.train_irl`` writes."""
    weights: dict[str, float] = json.loads(WEIGHTS.read_text(encoding="utf-8"))["weights"]
    return {name: weights[name] for name in FEATURES}


class GmmIrl(BaselinePolicy):
    r"""Follow the path of least cost; the weights of this cost were learned from the paths of an expert.

    The cost ``J = sum_k w_k phi_k`` has features ``phi_k`` with weights ``w_k``. The features measure the deviation
    from the learned path, the jerk of the deviation, and the nearness to obstacles
    (:mod:`imitarm.policies.baselines.path_cost`). The expert is an optimiser
    (:mod:`~imitarm.policies.baselines.expert`). Its paths in other scenes gave the weights, by maximum-entropy inverse
    reinforcement learning (:mod:`imitarm.benchmark.train_irl`). To plan a path, the policy runs the optimiser L-BFGS
    several times. One run starts from the learned path, and each other run starts from a path that is displaced to one
    side of the obstacles. Each run ends at a path with a local minimum of the cost. The policy follows the path with
    the least cost.

    While obstacles move, the policy minimises the cost 30 times a second over the next 20 points
    (:class:`HorizonReaction`). The distance to obstacles is a part of the cost and not a constraint. The path may
    therefore violate the required clearance.

    Args:
        skill: skill to reproduce.
        weights: weight of each feature in ``path_cost.FEATURES``; None: the learned weights.
        closeness: additional factor of the weight of the feature "deviation".
        avoidance: additional factor of the weights of the three features "obstacles".
        margin: distance that is subtracted from each gap [m].
        options: arguments of :class:`~imitarm.policies.baselines.baseline_policy.BaselinePolicy`.
    """

    predicts = True
    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "closeness": (0.1, 1e3),
        "avoidance": (0.1, 100.0),
        "margin": (1e-3, 0.03),
    }

    def __init__(
        self,
        skill: Skill,
        *,
        weights: Sequence[float] | None = None,
        closeness: float = 1.0,
        avoidance: float = 1.0,
        margin: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        values = list(learned_weights().values()) if weights is None else weights
        self.weights = finite_array(values, (len(FEATURES),), "GmmIrl: weights").copy()
        self.weights[0] *= finite_number(closeness, "GmmIrl: closeness", above=0.0)
        self.weights[2:-1] *= finite_number(avoidance, "GmmIrl: avoidance", above=0.0)
        self.margin = finite_number(margin, "GmmIrl: margin", "m", at_least=0.0)

    def reaction(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> Reaction:
        """Return a motion that plans the path of least cost again and again, over the next 20 points."""
        axes, one_sided = allowed_axes(self._forbidden)
        cost = Weighted(self.skill, self.weights, self.margin, axes, one_sided, self.tool_spheres)
        return HorizonReaction(cost, nominal, position, velocity, fraction)

    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the path of least cost that was found."""
        del scene
        problem = PathProblem.of(nominal, gaps, self.clearance, self._forbidden)
        cost = path_cost(problem, self.skill, self.margin)
        starts = [problem.nominal, *displaced_paths(problem)]
        found = [cost.minimised(self.weights, cost.deviation(start)) for start in starts]
        best = min(found, key=lambda deviation: float(self.weights @ cost.features(deviation)))
        return problem.times, cost.path(best)


def path_cost(problem: PathProblem, skill: Skill, margin: float = 0.0) -> PathCost:
    """Return the cost of paths in a scene for one skill; ``margin`` [m] is subtracted from each gap."""
    covariances = skill.gmr_.predict(problem.times / problem.times[-1] * skill.duration_)[1]
    return PathCost(problem.nominal, covariances, problem.times, problem.gaps, margin, problem.axes, problem.one_sided)


class Weighted(NamedTuple):
    """The cost of :mod:`~imitarm.policies.baselines.path_cost` with its weights and directions.

    Attributes:
        skill: the skill, for the covariances of the demonstrations.
        weights: weight of each feature in ``path_cost.FEATURES``.
        margin: distance that is subtracted from each gap [m].
        axes: orthonormal basis of the allowed directions, as columns, shape (3, k).
        one_sided: directions in which the path must not be displaced, in the basis ``axes``, shape (m, k).
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m]; None: the tool
            is a point.
    """

    skill: Skill
    weights: Array
    margin: float
    axes: Array
    one_sided: Array
    tool_spheres: Array | None


@dataclass(frozen=True, eq=False)
class _Horizon:
    """The cost of the next 20 deviations d_1 ... d_20, after the known d_-2, d_-1, d_0; shapes (20, k), (3, k).

    The features are those of the whole path, over the points of the horizon. The jerk couples the first points with the
    known ones, so that the plan continues the motion smoothly. As for the whole path, the three deviations after the
    last one are 0: the weight of the deviation alone would not bring the tool back.
    """

    cost: Weighted
    points: Array  # learned positions, (20, 3) [m]
    times: Array  # of the points, from now (20,) [s]
    gaps: ToolGaps
    factor: Array  # upper Cholesky factor of the Hessian of the quadratic features
    lowest: Array  # deviation of least quadratic cost, (20, k)

    @classmethod
    def of(
        cls, cost: Weighted, points: Array, fractions: Array, times: Array, gaps: ToolGaps, known: Array
    ) -> _Horizon:
        k = cost.axes.shape[1]
        covariances = cost.skill.gmr_.predict(np.minimum(fractions, 1.0) * cost.skill.duration_)[1]
        inverse = np.linalg.inv(covariances + PRECISION**2 * np.eye(3))
        precisions = cost.axes.T @ inverse @ cost.axes
        third = np.diff(np.eye(HORIZON + 6), 3, axis=0)[:, :-3]  # of the known and the free deviations
        jerk = 2.0 * cost.weights[1] * (float(N_SAMPLES - 1) / _SPACING) ** 5
        hessian = np.kron(jerk * third[:, 3:].T @ third[:, 3:], np.eye(k))
        for i, block in enumerate(precisions):
            hessian[i * k : (i + 1) * k, i * k : (i + 1) * k] += 2.0 * cost.weights[0] / _N_FREE * block
        linear = jerk * third[:, 3:].T @ (third[:, :3] @ known)
        factor = cholesky(hessian)
        lowest = -solve_triangular(factor, solve_triangular(factor, linear.ravel(), trans=1))
        return cls(cost, points, times, gaps, factor, lowest.reshape(HORIZON, k))

    def value(self, deviation: Array) -> tuple[float, Array]:
        """Return the cost, up to a constant, and its gradient (20, k)."""
        y = self.factor @ (deviation - self.lowest).ravel()
        value, slope = self._avoidance(deviation)
        return 0.5 * float(y @ y) + value, (self.factor.T @ y).reshape(deviation.shape) + slope

    def minimised(self, start: Array) -> tuple[float, Array]:
        """Return the least cost that L-BFGS reaches from a deviation, and its deviation (20, k)."""

        def cost(y: Array) -> tuple[float, Array]:
            deviation = self.lowest + solve_triangular(self.factor, y).reshape(start.shape)
            value, slope = self._avoidance(deviation)
            return 0.5 * float(y @ y) + value, y + solve_triangular(self.factor, slope.ravel(), trans=1)

        options = {"maxiter": _ITERATIONS, "maxcor": 10}
        found = minimize(
            cost, self.factor @ (start - self.lowest).ravel(), jac=True, method="L-BFGS-B", options=options
        )
        return float(found.fun), self.lowest + solve_triangular(self.factor, found.x).reshape(start.shape)

    def _avoidance(self, deviation: Array) -> tuple[float, Array]:
        """Return the features about obstacles, weighted, and their gradient."""
        weights, axes, one_sided = self.cost.weights, self.cost.axes, self.cost.one_sided
        points = self.points + deviation @ axes.T
        gap, normal = self.gaps.gaps_and_normals(points[:, None], self.times)
        gap, normal = gap[:, :, 0] - self.cost.margin, normal[:, :, 0] @ axes
        value, slope = 0.0, np.zeros_like(gap)
        for w, r in zip(weights[2:-1], RANGES, strict=True):
            found = bump(gap, r)
            value, slope = value + w * float(found[0].sum()), slope + w * found[1]
        deep, sided = depth(-gap), depth(deviation @ one_sided.T)
        value += weights[-1] * float(deep[0].sum() + sided[0].sum())
        gradient = np.einsum("oi,oik->ik", slope - weights[-1] * deep[1], normal)
        return value / _N_FREE, (gradient + weights[-1] * sided[1] @ one_sided) / _N_FREE


class HorizonReaction(Reaction):
    """A motion that plans the path of least cost 30 times a second, over the next 40 % of the duration (20 points).

    Each plan assumes that the obstacles keep their velocities. The optimiser L-BFGS starts from the last plan, from the
    learned path, and from paths that are displaced to the sides.
    """

    def __init__(self, cost: Weighted, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> None:
        super().__init__(nominal, position, velocity, fraction)
        self._cost, self._spacing = cost, float(_SPACING * nominal.duration / (N_SAMPLES - 1))
        self._plan, self._age = np.zeros((HORIZON + 1, cost.axes.shape[1])), np.inf
        if fraction > 0.0:
            step = self._spacing / nominal.duration
            learned = (self.learned(fraction + 0.5 * step) - self.learned(fraction - 0.5 * step)) / self._spacing
            self._plan[1] = self._spacing * (velocity - learned) @ cost.axes

    def step(self, scene: Scene, dt: float) -> None:
        """Plan again if the last plan is older than 1/30 s, then follow the plan for one control period."""
        if self._age >= PERIOD - 1e-9:
            self._plan, self._age = self._planned(scene), 0.0
        self._age += dt
        self.fraction += dt / self.nominal.duration
        self.position = self.learned(self.fraction) + self._deviation(self._age) @ self._cost.axes.T

    def _deviation(self, age: float) -> Array:
        """Return the planned deviation at a time after the plan was made, shape (k,)."""
        i = min(age / self._spacing, HORIZON - 1e-6)
        low = int(i)
        return np.asarray(self._plan[low] + (i - low) * (self._plan[low + 1] - self._plan[low]))

    def _planned(self, scene: Scene) -> Array:
        """Return the deviations now and at the 20 points of the horizon, shape (21, k)."""
        axes, T = self._cost.axes, self.nominal.duration
        times: Array = self._spacing * np.arange(1.0, HORIZON + 1.0)
        points = self._learned_at(self.fraction + times / T)
        deviation = (self.position - self.learned(self.fraction)) @ axes
        rate = (self._plan[1] - self._plan[0]) / self._spacing
        known = deviation - self._spacing * np.array([2.0, 1.0, 0.0])[:, None] * rate
        gaps = ToolGaps(scene, self._cost.tool_spheres)
        horizon = _Horizon.of(self._cost, points, self.fraction + times / T, times, gaps, known)
        starts = [np.zeros((HORIZON, len(deviation))), horizon.lowest]
        if np.isfinite(self._age):
            starts.append(np.array([self._deviation(self._age + t) for t in times]))
        starts += self._aside(points, times, gaps)
        if not gaps.n_obstacles:
            return np.concatenate([deviation[None], horizon.lowest])
        starts = sorted(starts, key=lambda start: horizon.value(start)[0])[:_STARTS]
        best = min((horizon.minimised(start) for start in starts), key=lambda found: found[0])
        return np.concatenate([deviation[None], best[1]])

    def _aside(self, points: Array, times: Array, gaps: ToolGaps) -> list[Array]:
        """Return displacements to all sides where the learned path comes near an obstacle."""
        gap = gaps.gaps(points[:, None], times)[:, :, 0].min(axis=0, initial=np.inf)
        if gap.min() > _NEAR:
            return []
        at = int(np.argmin(gap))
        ahead = (points[min(at + 1, HORIZON - 1)] - points[max(at - 1, 0)]) @ self._cost.axes
        _, _, basis = np.linalg.svd(ahead[None])
        weight = quintic_step(1.0 - np.abs(np.arange(HORIZON) - at) / (0.5 * HORIZON))
        return [sign * _ASIDE * weight[:, None] * side for side in basis[1:] for sign in (1.0, -1.0)]

    def _learned_at(self, fractions: Array) -> Array:
        phases = np.clip(fractions, 0.0, 1.0)
        found: Array = self.nominal.at(self.nominal.times[0] + phases * self.nominal.duration)[0]
        return found
