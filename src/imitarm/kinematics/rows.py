"""Rows: linear inequalities on the joint velocity, which limits return and the inverse kinematics keeps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Rows(NamedTuple):
    """Inequalities ``matrix @ qd >= lower`` on the joint velocity ``qd``.

    Attributes:
        matrix: shape (m, n_joints).
        lower: shape (m,).
    """

    matrix: NDArray[np.float64]
    lower: NDArray[np.float64]
