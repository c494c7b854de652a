"""DMP with a barrier: a dynamic movement primitive (DMP) with a velocity filter that keeps the clearance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.barrier import nearest_velocity
from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]


class DMPBarrier(CoupledMotion):
    r"""Follow a movement primitive, and change its velocity as little as possible to keep the clearance.

    In each step, the spring of the primitive proposes the velocity u. The tool moves with the velocity v that solves

    .. math:: \min |v - u|^2 \quad \text{s.t.} \quad n_o \cdot (v - v_o) \ge -\gamma h_o

    Here, :math:`h_o` is the distance to obstacle o minus the required clearance, :math:`n_o` is the outward normal, and
    :math:`v_o` is the velocity of the obstacle's closest point. The spring starts each step at the actual position of
    the tool, so it pulls harder the farther the tool is behind its target. The method combines a dynamic movement
    primitive with a control barrier function (Ames et al. 2019).

    **Known failure.** The tool stops in front of an obstacle that it approaches head on, as with every barrier
    function.

    Args:
        skill: skill to reproduce.
        gamma: factor [1/s]; the gap :math:`h_o` [m] may shrink by at most :math:`\gamma h_o` [m/s].
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"gamma": (0.5, 30.0)}

    def __init__(self, skill: Skill, *, gamma: float = 5.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.gamma = finite_number(gamma, "DMPBarrier: gamma", "1/s", above=0.0)

    def term(self, state: MotionState) -> Array:
        """Return a zero coupling term, because the barrier acts on the velocity."""
        return np.zeros(3)

    def constrained(self, before: Array, after: Array, state: MotionState, step: float) -> Array:
        """Return position and scaled velocity [x; T x'] after a step with the velocity v of the class docstring."""
        proposed = (after[0] - before[0]) / step
        rows = np.concatenate([state.normal, -self._forbidden])
        duration = self.skill.duration_
        approach = np.einsum("nd,nd->n", state.normal, state.velocity_of_obstacles) - self.gamma * duration * state.gap
        aside = np.maximum(self._forbidden @ proposed, 0.0)
        kept = nearest_velocity(proposed, rows, np.concatenate([approach, -aside]))
        return np.stack([before[0] + step * kept, after[1] + kept - proposed])
