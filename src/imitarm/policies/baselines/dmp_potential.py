"""DMP+AT (b): a primitive with a dynamic potential field around obstacles (Park et al. 2008)."""

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
        velocity: v, relative to each obstacle, shape (n, 3).
        normal: direction from the closest point of each obstacle to the tool, shape (n, 3); theta is the angle between
            the two.
        distance: p, above 0, shape (n,) [m].
        gain: lambda.
        exponent: beta.
    """
    speed = np.sqrt(np.einsum("nd,nd->n", velocity, velocity))
    cosine = np.einsum("nd,nd->n", velocity, normal) / np.maximum(speed, 1e-12)
    return np.asarray(gain * np.maximum(-cosine, 0.0) ** exponent * speed / distance)


def dynamic_force(velocity: Array, normal: Array, distance: Array, reach: Array, gain: float, exponent: float) -> Array:
    r"""Return minus the gradient of :func:`dynamic_potential` with respect to the tool's position, shape (n, 3).

    The closest point of the obstacle is at the distance ``reach`` in the direction ``-n``; it is held fixed::

        -grad U = lambda (-cos)^(beta - 1) |v| / p (beta grad(cos) - cos / p n),   grad(cos) = (v / |v| - cos n) / reach

    Args:
        velocity: v, shape (n, 3).
        normal: n, shape (n, 3).
        distance: p, above 0, shape (n,) [m].
        reach: distance from the tool's tip to the closest point, above 0, shape (n,) [m].
        gain: lambda.
        exponent: beta.
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

    The potential depends on the direction and the speed of the motion: it is 0 while the tool moves away from the
    obstacle, and it grows with the speed of the approach and with nearness::

        U = lambda (-cos theta)^beta |v_r| / p    if cos theta < 0, else 0;      Phi = -sum grad U

    Here, ``v_r = v - v_o`` is the velocity relative to the obstacle, ``theta`` the angle between ``v_r`` and the
    direction from the closest point of the obstacle to the tool, and ``p`` the distance of the tool, minus the
    required clearance.

    **Changes.** The published field surrounds points of the obstacle. Here, it surrounds the closest point, which is
    held fixed in the gradient. The published relative velocity does not include a motion of the obstacle. Distances
    below 5 mm count as 5 mm.

    **Known failure.** A motion straight at an obstacle is only slowed down, because its gradient is parallel to the
    motion. The tool then arrives late, or stays in front of the obstacle.

    Args:
        skill: skill to reproduce.
        gain: lambda [m].
        exponent: beta, at least 1.
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"gain": (1e-3, 3.0), "exponent": (1.0, 6.0)}

    def __init__(self, skill: Skill, *, gain: float = 0.1, exponent: float = 2.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.gain = finite_number(gain, "DMPPotential: gain", "m", at_least=0.0)
        self.exponent = finite_number(exponent, "DMPPotential: exponent", at_least=1.0)

    def term(self, state: MotionState) -> Array:
        """Return Phi, the sum over all obstacles that the tool approaches, shape (3,) [m]."""
        force = dynamic_force(state.relative, state.normal, state.distance, state.reach, self.gain, self.exponent)
        return np.asarray(force.sum(axis=0))
