"""The joint velocity that violates contradictory inequalities as little as possible."""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.ik_problem import Box

Array = NDArray[np.float64]

_EFFORT = 1e-5  # weight of the squared joint velocity beside a squared violation of weight 1
_FREE = 1e30


def least_violation(box: Box, matrix: Array, least: Array, floor: Array | None = None) -> Array:
    r"""Return the velocity v in a box with the least sum of squared violations of the rows ``matrix @ v >= least``.

    A row is an inequality :math:`a^T v \ge b`. A row that no velocity in the box violates has no effect. A row that
    every velocity in the box violates adds the square :math:`(b - a^T v)^2` to the cost. Each of the other rows gets a
    slack variable. (The solver daqp has soft constraints of its own, which need no slack variables. With daqp 0.11,
    their solutions at active bounds violate rows that could be kept.)

    Args:
        box: bounds of each joint velocity.
        matrix: coefficients of the rows, shape (m, n_joints).
        least: lower bounds of the rows, shape (m,).
        floor: hard lower bounds of the rows, shape (m,); at least one velocity in the box must satisfy all of them.
            None: no hard bounds.

    Returns:
        The velocity v, shape (n_joints,) [rad/s]. If several velocities are optimal, v is the one with the smallest
        norm.
    """
    n = matrix.shape[1]
    middle, half = 0.5 * (box.upper + box.lower), 0.5 * (box.upper - box.lower)
    center, reach = matrix @ middle, np.abs(matrix) @ half
    lost = least >= center + reach
    open_ = np.flatnonzero((least > center - reach) & ~lost)
    m = len(open_)
    hessian = np.diag(np.append(np.full(n, _EFFORT), np.ones(m)))
    hessian[:n, :n] += matrix[lost].T @ matrix[lost]
    linear = np.append(-(least[lost] @ matrix[lost]), np.zeros(m))
    firm = np.zeros(0, dtype=int) if floor is None else np.flatnonzero(floor > center - reach)
    rows = np.zeros((m + len(firm), n + m))
    rows[:m, :n], rows[:m, n:], rows[m:, :n] = matrix[open_], np.eye(m), matrix[firm]
    lower = np.concatenate([box.lower, np.zeros(m), least[open_], np.zeros(0) if floor is None else floor[firm]])
    upper = np.concatenate([box.upper, np.full(len(lower) - n, _FREE)])
    solution, _, status, _ = daqp.solve(hessian, linear, rows, upper, lower, np.zeros(len(lower), dtype=np.intc))
    return np.clip(solution[:n] if status > 0 else np.zeros(n), box.lower, box.upper)
