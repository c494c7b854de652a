"""Modulation of a dynamical system (Khansari-Zadeh and Billard 2012; Huber, Billard and Slotine 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.velocity_field import NearObstacles, VelocityField
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_LEAST_SLOPE = 0.3  # of the reference direction along the normal: a flatter one divides by nearly nothing
_DEEPEST = -0.5  # sizes: a deeper gap counts as this one
_TINY = 1e-12


def modulated(desired: Array, around: NearObstacles, *, reactivity: float = 1.0, reach: float = 1.0) -> Array:
    r"""Return the modulated velocity.

    Let ``v_o`` be the velocity of an obstacle, ``n`` its outward normal, and ``r`` the direction from its centre to the
    tool. Let ``gap`` be the distance between obstacle and tool, minus the required clearance. Let ``size`` be the sum
    of the obstacle's radius, the tool's radius and the required clearance. The modulation multiplies the velocity
    relative to the obstacle by a matrix M::

        v = M (u - v_o) + v_o,   M = E diag(1 - q, 1 + q, 1 + q) E^-1,   E = [r, e_1, e_2],   e_i . n = 0
        q = Gamma^(-1 / reactivity),   Gamma = (1 + gap / (reach size))^2

    Where the gap is 0, ``Gamma`` is 1, so the tool does not approach the obstacle there. For a sphere with ``reach =
    reactivity = 1``, ``Gamma`` is the squared distance from the centre divided by the squared radius. The velocity
    field is then the potential flow about a circle, in every plane through the centre. If the gap is negative, ``q`` is
    above 1, and the modulation moves the tool away from the obstacle. A velocity away from the obstacle is not reduced.

    For several obstacles, each obstacle o gives one velocity. The function averages the norms and the directions of
    these velocities, with weights proportional to ``w_o = prod_(i != o) (Gamma_i - 1)``. It computes the mean direction
    from the angles between each velocity and ``u``. If some gaps are negative, only the obstacles with negative gaps
    count. Their velocities are then averaged as vectors, with weights proportional to ``1 - Gamma_o``.

    Args:
        desired: desired velocity u, shape (d,) [m/s].
        around: the obstacles near the tool.
        reactivity: with a larger value, an obstacle acts from farther away.
        reach: factor of the obstacles' sizes; with a larger value, an obstacle acts from farther away.

    Returns:
        Shape (d,) [m/s].
    """
    if not len(around.gap):
        return desired
    gamma = (1.0 + np.maximum(around.gap / (reach * around.size), _DEEPEST)) ** 2
    q = gamma ** (-1.0 / reactivity)
    normal, reference = _unit(around.normal), _unit(around.outward)
    short = np.sum(reference * normal, axis=1) < _LEAST_SLOPE
    reference = np.where(short[:, None], normal, reference)
    relative = desired - around.velocity
    along = np.sum(relative * normal, axis=1) / np.maximum(np.sum(reference * normal, axis=1), _TINY)
    leaving = (around.gap <= 0.0) & (along > 0.0)
    tangential = relative - along[:, None] * reference
    stretched = np.where(leaving, 1.0, 1.0 - q)[:, None] * along[:, None] * reference + (1.0 + q)[:, None] * tangential
    velocities, depth = stretched + around.velocity, np.maximum(1.0 - gamma, 0.0)
    if depth.any():
        return np.asarray(depth @ velocities / depth.sum())
    return _weighted(desired, velocities, 1.0 / np.maximum(gamma - 1.0, _TINY))


def _weighted(desired: Array, velocities: Array, weights: Array) -> Array:
    """Return the mean of velocities (n, d): of their norms, and of their angles from the desired velocity."""
    if len(velocities) == 1:
        return velocities[0]
    weights = weights / weights.sum()
    speeds = np.linalg.norm(velocities, axis=1)
    ahead = _unit(desired[None])[0]
    directions = _unit(velocities)
    cosine = directions @ ahead
    angles = np.arccos(np.clip(cosine, -1.0, 1.0))
    angle = (weights * angles) @ _unit(directions - cosine[:, None] * ahead)
    size = float(np.linalg.norm(angle))
    turned = np.cos(size) * ahead + np.sinc(size / np.pi) * angle
    return float(weights @ speeds) * turned


def _unit(vectors: Array) -> Array:
    """Return vectors (n, d) scaled to length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _TINY)


class Modulation(VelocityField):
    """Follow the learned path by a velocity that flows around obstacles, see :func:`modulated`.

    Args:
        skill: skill to reproduce.
        reactivity: with a larger value, an obstacle acts from farther away.
        reach: factor of the obstacles' sizes; with a larger value, an obstacle acts from farther away.
        options: arguments of :class:`~imitarm.policies.baselines.velocity_field.VelocityField`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {
        **VelocityField.search_space,
        "reactivity": (0.3, 5.0),
        "reach": (0.1, 3.0),
    }

    def __init__(self, skill: Skill, *, reactivity: float = 1.0, reach: float = 1.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.reactivity = finite_number(reactivity, "Modulation: reactivity", above=0.0)
        self.reach = finite_number(reach, "Modulation: reach", above=0.0)

    def velocity(self, desired: Array, around: NearObstacles, limits: Array) -> Array:
        """Return the modulated velocity."""
        del limits
        return modulated(desired, around, reactivity=self.reactivity, reach=self.reach)
