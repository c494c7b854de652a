r"""The classical artificial potential field: attraction to the goal, repulsion from obstacles (thesis Eqs 2.15-2.22).

Let ``rho = |x - g|`` be the distance from the position x to the goal g. Let ``d`` be the distance to the closest point
of an obstacle, and ``n`` the gradient of d. Each force F is the negative gradient of a potential U::

    U_a = 1/2 eta rho^2                         F_a = -eta (x - g)                         if rho <= rho_c
    U_a = eta rho_c (rho - rho_c / 2)           F_a = -eta rho_c (x - g) / rho             otherwise
    U_r = 1/2 k (1/d - 1/d_0)^2                 F_r = k (1/d - 1/d_0) d^-2 n               if d <= d_0, else 0

The distance ``rho_c`` limits the attraction far from the goal. The factor of the repulsion grows without bound at the
surface of an obstacle. For all d below ``d_f`` = 5 mm, this implementation therefore uses the force at ``d_f``. There,
the potential is a linear function of d, so the force is its negative gradient everywhere, even inside an obstacle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DISTANCE_FLOOR = 0.005  # [m] d_f: below this distance the repulsion is constant


def attractive_potential(position: Array, goal: Array, stiffness: float, cap: float) -> float:
    """Return the attractive potential U_a (Eq 2.15, with the limit ``rho_c``).

    Args:
        position: position x, shape (3,) [m].
        goal: goal g, shape (3,) [m].
        stiffness: factor eta of the attraction.
        cap: rho_c, the distance beyond which the attraction is constant [m].
    """
    rho = float(np.linalg.norm(position - goal))
    return 0.5 * stiffness * rho**2 if rho <= cap else stiffness * cap * (rho - 0.5 * cap)


def attractive_force(position: Array, goal: Array, stiffness: float, cap: float) -> Array:
    """Return the attractive force F_a towards the goal, shape (3,) (Eq 2.17, with the limit ``rho_c``).

    The arguments have the same meaning as in :func:`attractive_potential`.
    """
    away = position - goal
    rho = float(np.linalg.norm(away))
    return np.asarray(away * (-stiffness * min(1.0, cap / max(rho, 1e-12))))


def repulsive_potential(distance: Array, gain: float, influence: float) -> float:
    """Return the sum of the repulsive potentials U_r of all obstacles (Eqs 2.18 and 2.21).

    Args:
        distance: d, distance to the closest point of each obstacle, negative inside, shape (n,) [m].
        gain: factor k of the repulsion.
        influence: d_0, the distance beyond which an obstacle does not repel [m].
    """
    d = np.clip(distance, DISTANCE_FLOOR, influence)
    step = 1.0 / d - 1.0 / influence
    slope = step / d**2
    return float(gain * np.sum(0.5 * step**2 + slope * (d - np.minimum(distance, influence))))


def repulsive_force(distance: Array, normal: Array, gain: float, influence: float) -> Array:
    """Return the sum of the repulsive forces F_r of all obstacles, shape (3,) (Eqs 2.19 and 2.22).

    Args:
        distance: distance d to each obstacle, shape (n,) [m].
        normal: gradients n of the distances, shape (n, 3).
        gain: factor k of the repulsion.
        influence: d_0, the distance beyond which an obstacle does not repel [m].
    """
    d = np.clip(distance, DISTANCE_FLOOR, influence)
    return np.asarray((gain * (1.0 / d - 1.0 / influence) / d**2) @ normal)
