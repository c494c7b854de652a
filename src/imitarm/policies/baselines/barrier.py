"""Barrier: follow the learned path, with a velocity filter that is a control barrier function (Ames et al. 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.velocity_field import NearObstacles, VelocityField
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_UNBOUNDED = 1e30  # daqp's infinity
_SOLVED = 1  # daqp's exit flag of an optimal solution
_SOFT = 1e6  # weight of the squared violation, if no velocity meets all inequalities


def nearest_velocity(desired: Array, rows: Array, lower: Array) -> Array:
    """Return the velocity ``v`` nearest to ``desired`` among those with ``rows @ v >= lower``.

    If one row alone determines the result, the function uses the closed form ``v = u + a (b - a . u) / |a|^2``.
    Otherwise, it solves a quadratic program. If no velocity meets all inequalities, the result is nearly the velocity
    with the smallest sum of squared violations.

    Args:
        desired: desired velocity u, shape (d,) [m/s].
        rows: vectors a of the n inequalities ``a . v >= b``, shape (n, d).
        lower: lower bounds b, shape (n,) [m/s].
    """
    missing = lower - rows @ desired
    if not len(missing) or missing.max() <= 0.0:
        return desired
    worst = int(np.argmax(missing))
    a = rows[worst]
    v = desired + a * missing[worst] / max(float(a @ a), 1e-12)
    if np.all(rows @ v >= lower - 1e-9):
        return v
    n, d = rows.shape
    upper = np.full(n, _UNBOUNDED)
    sense = np.zeros(n, dtype=np.intc)
    v, _, flag, _ = daqp.solve(np.eye(d), -desired, np.ascontiguousarray(rows), upper, lower.copy(), sense)
    if flag == _SOLVED:
        return np.asarray(v)
    soft = np.ascontiguousarray(np.hstack([rows, np.eye(n)]))
    weights = np.diag(np.concatenate([np.ones(d), np.full(n, _SOFT)]))
    linear = np.concatenate([-desired, np.zeros(n)])
    sense[:] = 0
    v, _, flag, _ = daqp.solve(weights, linear, soft, upper, lower.copy(), sense)
    return np.asarray(v)[:d] if flag == _SOLVED else np.zeros(d)


class Barrier(VelocityField):
    r"""Follow the learned path with the velocity nearest to the desired one that keeps the clearance.

    Let ``u`` be the desired velocity, and ``h_o`` the gap: the distance to obstacle ``o`` minus the required clearance.
    Let ``n_o`` be the outward normal and ``v_o`` the velocity of the obstacle's closest point. The velocity ``v`` of
    the tool solves::

        min |v - u|^2   s.t.   n_o . (v - v_o) >= -gamma h_o   for every obstacle o

    If ``h_o >= 0`` at the start, then ``h_o >= 0`` at all times, because ``dh_o/dt = n_o . (v - v_o) >= -gamma h_o``.
    With time steps of up to ``1 / gamma``, ``h_o`` also stays positive, because the gap to a convex obstacle is a
    convex function of the position. The filter looks only one step ahead: if the desired velocity points straight at an
    obstacle, the tool stops in front of this obstacle.

    Args:
        skill: skill to reproduce.
        gamma: factor [1/s]; the gap ``h_o`` [m] may shrink by at most ``gamma h_o`` [m/s].
        options: arguments of :class:`~imitarm.policies.baselines.velocity_field.VelocityField`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {**VelocityField.search_space, "gamma": (0.5, 30.0)}

    def __init__(self, skill: Skill, *, gamma: float = 5.0, **options: Any) -> None:
        super().__init__(skill, **options)
        self.gamma = finite_number(gamma, "Barrier: gamma", "1/s", above=0.0)

    def velocity(self, desired: Array, around: NearObstacles, limits: Array) -> Array:
        """Return the velocity nearest to ``desired`` that meets all inequalities and has no forbidden direction."""
        rows = np.concatenate([around.normal, -self.one_sided])
        approach = np.sum(around.normal * around.velocity, axis=1) - around.drift - self.gamma * around.gap
        return nearest_velocity(desired, rows, np.concatenate([approach, -limits]))
