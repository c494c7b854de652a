"""What an arm with a joint to spare can do while its tool does something else."""

from __future__ import annotations

import math
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DAMPING = 1e-7  # squared singular values below this belong to directions that the arm can't move in
_LEAST = 1e-4  # squared: a quantity that changes less with the spare motion is not led by it


def spare_motion(jacobian: Array, gradient: Array) -> tuple[Array, float, Array] | None:
    r"""Return the motion of the joints that leaves the tool as it is and changes some quantity most.

    With J the tool's Jacobian and g the quantity's gradient, it is along :math:`(I - J^+ J)\,g`; what the tool's own
    motion e does to the quantity is :math:`g^T J^+ e`.

    Args:
        jacobian: of the tool, shape (6, n).
        gradient: of the quantity by the joints, shape (n,).

    Returns:
        the motion as a unit vector (n,), by how much it changes the quantity, and :math:`g^T J^+`, shape (6,); None
        when no such motion changes it.
    """
    gram = jacobian.dot(jacobian.T)
    gram += _damping(len(gram))
    by_tool = np.empty(len(gram))
    mujoco.mju_cholFactor(gram, 0.0)
    mujoco.mju_cholSolve(by_tool, gram, jacobian.dot(gradient))
    direction = gradient - by_tool.dot(jacobian)
    square = float(direction.dot(direction))
    if square < _LEAST:
        return None
    length = math.sqrt(square)
    return direction / length, length, by_tool


@cache
def _damping(n: int) -> Array:
    return _DAMPING * np.eye(n)
