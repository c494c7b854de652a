"""A movement primitive with a dynamic potential field (Park et al. 2008); one form of the thesis's DMP+AT."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]


def dynamic_potential(velocity: Array, normal: Array, distance: Array, gain: float, exponent: float) -> Array:
    """Return ``U = lambda (-cos theta)^beta |v| / p`` if ``cos theta < 0``, else 0, shape (n,).

    Args:
        velocity: v, velocity of the tool relative to each obstacle, times the duration, shape (n, 3) [m].
        normal: n, unit vector from the closest point of each obstacle to the tool, shape (n, 3); theta is the angle
            between v and n.
        distance: p, distance of the tool to each obstacle, above 0, shape (n,) [m].
        gain: lambda, the factor of the potential [m^2].
        exponent: beta, the exponent of the cosine.
    """
    speed = np.sqrt(np.einsum("nd,nd->n", velocity, velocity))
    cosine = np.einsum("nd,nd->n", velocity, normal) / np.maximum(speed, 1e-12)
    return np.asarray(gain * np.maximum(-cosine, 0.0) ** exponent * speed / distance)


def dynamic_force(velocity: Array, normal: Array, distance: Array, reach: Array, gain: float, exponent: float) -> Array:
    r"""Return minus the gradient of :func:`dynamic_potential` with respect to the tool's position, shape (n, 3).

    The closest point of the obstacle is at the distance ``reach`` in the direction ``-n``. The gradient treats this
    point as fixed::

        -grad U = lambda (-cos)^(beta - 1) |v| / p (beta grad(cos) - cos / p n),   grad(cos) = (v / |v| - cos n) / reach

    Args:
        velocity: v, as for :func:`dynamic_potential`, shape (n, 3) [m].
        normal: n, as for :func:`dynamic_potential`, shape (n, 3).
        distance: p, distance of the tool to each obstacle, above 0, shape (n,) [m].
        reach: distance from the tool's tip to the closest point, above 0, shape (n,) [m].
        gain: lambda, the factor of the potential [m^2].
        exponent: beta, the exponent of the cosine.
    """
    speed = np.maximum(np.sqrt(np.einsum("nd,nd->n", velocity, velocity)), 1e-12)
    cosine = np.einsum("nd,nd->n", velocity, normal) / speed
    approach = np.maximum(-cosine, 0.0)
    size = np.where(approach > 0.0, gain * approach ** (exponent - 1.0) * speed / distance, 0.0)
    along_velocity = size * exponent / reach
    along_normal = size * (exponent / reach + 1.0 / distance) * approach
    return np.asarray((along_velocity / speed)[:, None] * velocity + along_normal[:, None] * normal)


class DMPPotential(CoupledMotion):
    r"""DMP with a dynamic potential field, the avoidance term of Park et al. (2008).

    The potential U depends on the direction and the speed of the motion. U is 0 while the tool moves away from the
    obstacle. While the tool approaches the obstacle, U increases with the speed and with decreasing distance::

        U = lambda (-cos theta)^beta |v_r| / p    if cos theta < 0, else 0;      Phi = -sum grad U

    Here, ``v_r = v - v_o`` is the velocity of the tool relative to the obstacle. ``theta`` is the angle between ``v_r``
    and the direction from the closest point of the obstacle to the tool. ``p`` is the distance between tool and
    obstacle, minus the required clearance.

    **Changes.** The paper places a field around every point of the obstacle. Here, only the closest point has a field,
    and the gradient treats this point as fixed. The paper uses the velocity of the tool instead of the relative
    velocity ``v_r``. Here, distances below 5 mm count as 5 mm.

    **Known failure.** If the tool moves straight at an obstacle, the gradient is parallel to the motion. The field then
    only slows the tool down and does not deflect it. The tool arrives late, or stays in front of the obstacle.

    Args:
        skill: skill to reproduce.
        gain: lambda, the factor of the potential [m^2].
        exponent: beta, the exponent of the cosine, at least 1.
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"gain": (1e-3, 3.0), "exponent": (1.0, 6.0)}

    def __init__(self, skill: Skill, *, gain: float = 0.1, exponent: float = 2.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.gain = finite_number(gain, "DMPPotential: gain", "m^2", at_least=0.0)
        self.exponent = finite_number(exponent, "DMPPotential: exponent", at_least=1.0)

    def term(self, state: MotionState) -> Array:
        """Return Phi, the sum over all obstacles that the tool approaches, shape (3,) [m]."""
        force = dynamic_force(state.relative, state.normal, state.distance, state.reach, self.gain, self.exponent)
        return np.asarray(force.sum(axis=0))
