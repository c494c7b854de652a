"""GMM+IRL: a path cost learned by inverse reinforcement learning (Ghalamzan et al. 2015)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.expert import PathProblem, displaced_paths
from imitarm.policies.baselines.path_cost import FEATURES, PathCost
from imitarm.policies.baselines.reaction import Reaction
from imitarm.policies.baselines.receding_horizon import HorizonReaction, Weighted
from imitarm.policies.least_cost import allowed_axes
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number

Array = NDArray[np.float64]

WEIGHTS = Path(__file__).with_name("gmm_irl_weights.json")


@lru_cache(maxsize=1)
def learned_weights() -> dict[str, float]:
    """Return the learned weight of each feature, from the file that ``imitarm.benchmark.train_irl`` writes."""
    weights: dict[str, float] = json.loads(WEIGHTS.read_text(encoding="utf-8"))["weights"]
    return {name: weights[name] for name in FEATURES}


class GmmIrl(BaselinePolicy):
    r"""Follow the path of least cost, with a cost whose weights were learned from demonstrated detours.

    The cost ``J = sum_k w_k phi_k`` has features about the deviation from the learned path, the jerk of the deviation,
    and the obstacles (:mod:`imitarm.policies.baselines.path_cost`). The weights were learned by maximum-entropy inverse
    reinforcement learning from the optimal paths of an independent expert in other scenes
    (:mod:`imitarm.policies.baselines.irl_learning`). L-BFGS finds a local minimum from the learned path, and from paths
    that are displaced to each side; the policy follows the minimum of least cost.

    Among obstacles that move, the cost is minimised again 30 times a second over the next 20 points
    (:mod:`imitarm.policies.baselines.receding_horizon`).

    The distance to obstacles is a cost, not a constraint, so the path can be closer than the required clearance.

    Args:
        skill: skill to reproduce.
        weights: weight of each feature in ``path_cost.FEATURES``; None: the learned ones.
        closeness: factor of the weight of the deviation.
        avoidance: factor of the weights of the obstacles.
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
        """Return the motion along paths of least cost over a receding horizon."""
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
    """Return the features of paths in a scene, with the covariances of a skill; ``margin`` reduces each gap [m]."""
    covariances = skill.gmr_.predict(problem.times / problem.times[-1] * skill.duration_)[1]
    return PathCost(problem.nominal, covariances, problem.times, problem.gaps, margin, problem.axes, problem.one_sided)
