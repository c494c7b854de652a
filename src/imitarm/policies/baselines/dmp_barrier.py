"""DMP with a barrier: the motion of a primitive, filtered so that the clearance is kept."""

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
    r"""The motion of a primitive whose velocity is changed as little as possible to keep the clearance.

    In each step, the spring of the primitive proposes the velocity u. The tool moves with the velocity v that solves

    .. math:: \min |v - u|^2 \quad \text{s.t.} \quad n_o \cdot (v - v_o) \ge -\gamma h_o

    with the gap :math:`h_o` beyond the required clearance, the outward normal :math:`n_o` and the velocity :math:`v_o`
    of each obstacle's closest point. The spring continues from where the tool is, so that it pulls harder the farther
    the tool falls behind. The combination is that of dynamic movement primitives with control barrier functions (Ames
    et al. 2019 for the barrier).

    **Known failure.** As for every barrier, the tool stops in front of an obstacle that it approaches head on.

    Args:
        skill: skill to reproduce.
        gamma: how fast the tool may use up the gap [1/s].
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"gamma": (0.5, 30.0)}

    def __init__(self, skill: Skill, *, gamma: float = 5.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.gamma = finite_number(gamma, "DMPBarrier: gamma", "1/s", above=0.0)

    def term(self, state: MotionState) -> Array:
        """Return no force: the barrier acts on the velocity."""
        return np.zeros(3)

    def constrained(self, before: Array, after: Array, state: MotionState, step: float) -> Array:
        """Return the state after a step whose velocity keeps all gaps; velocities are per duration, as in z."""
        proposed = (after[0] - before[0]) / step
        rows = np.concatenate([state.normal, -self._forbidden])
        duration = self.skill.duration_
        approach = np.einsum("nd,nd->n", state.normal, state.velocity_of_obstacles) - self.gamma * duration * state.gap
        aside = np.maximum(self._forbidden @ proposed, 0.0)
        kept = nearest_velocity(proposed, rows, np.concatenate([approach, -aside]))
        return np.stack([before[0] + step * kept, after[1] + kept - proposed])
