"""A movement primitive that steers around obstacles (Hoffmann et al. 2009); one form of the thesis's DMP+AT."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_HEAD_ON = 1e-9  # sine of an angle at which the side is not defined


def steering_rate(angle: Array, gain: float, decay: float) -> Array:
    """Return ``gamma theta exp(-beta theta)``, the rate at which the velocity rotates away from an obstacle.

    The rate is largest at ``theta = 1 / beta``, where it is ``gamma / (beta e)``.

    Args:
        angle: theta, angle between the velocity and the direction to the obstacle [rad].
        gain: gamma, the factor of the rate.
        decay: beta, the decay of the rate with the angle [1/rad].
    """
    return np.asarray(gain * angle * np.exp(-decay * angle))


class DMPSteering(CoupledMotion):
    r"""DMP with steering, the avoidance term of Hoffmann et al. (2009).

    Let ``v_r = v - v_o`` be the velocity relative to the obstacle, ``n`` the outward normal at the obstacle's closest
    point, and ``theta`` the angle between ``v_r`` and ``-n``. The term ``Phi`` rotates the velocity away from the
    obstacle, in the plane of ``v_r`` and ``n``. ``Phi`` acts only while the tool approaches the obstacle::

        Phi = sum gamma theta exp(-beta theta) |v_r| u exp(-kappa d)      if theta < 90 degrees
        u = (n + cos(theta) v_r / |v_r|) / sin(theta)                     unit vector perpendicular to v_r

    **Changes.** In the paper, an obstacle is a point. Here, the obstacle's closest point takes its place. The term of
    the paper does not depend on the distance, so an obstacle 50 m away bends the path as much as a near obstacle. Here,
    the factor ``exp(-kappa d)`` reduces the term, where ``d`` is the distance from tool to obstacle, minus the required
    clearance.

    **Known failure.** The term is 0 for ``theta = 0``: the tool goes straight into an obstacle that it approaches head
    on. The term does not guarantee a clearance, because its rate of rotation is bounded, even very near the obstacle.

    Args:
        skill: skill to reproduce.
        gain: gamma, the factor of the rate.
        decay: beta, the decay of the rate with the angle [1/rad].
        distance_decay: kappa, the decay of the rate with the distance [1/m].
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "gain": (20.0, 1000.0),
        "decay": (0.5, 20.0),
        "distance_decay": (3.0, 50.0),
    }

    def __init__(
        self,
        skill: Skill,
        *,
        gain: float = 1000.0,
        decay: float = 20.0 / np.pi,
        distance_decay: float = 12.5,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        self.gain = finite_number(gain, "DMPSteering: gain", at_least=0.0)
        self.decay = finite_number(decay, "DMPSteering: decay", "1/rad", above=0.0)
        self.distance_decay = finite_number(distance_decay, "DMPSteering: distance_decay", "1/m", at_least=0.0)

    def term(self, state: MotionState) -> Array:
        """Return Phi, the sum over all obstacles that the tool approaches, shape (3,) [m]."""
        v, n = state.relative, state.normal
        speed = np.sqrt(np.einsum("nd,nd->n", v, v))
        cosine = -np.einsum("nd,nd->n", v, n) / np.maximum(speed, 1e-12)
        sine = np.sqrt(np.clip(1.0 - cosine * cosine, 0.0, 1.0))
        theta = np.arctan2(sine, cosine)
        size = steering_rate(theta, self.gain, self.decay) * np.exp(-self.distance_decay * state.distance)
        size = np.where((cosine > 0.0) & (sine > _HEAD_ON), size / np.maximum(sine, _HEAD_ON), 0.0)
        return np.asarray((size * speed) @ n + (size * cosine) @ v)
