"""Tilts: smooth functions of time for the rotation of the tool away from its learned rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_KNOTS = 8


@dataclass(frozen=True, eq=False)
class Tilts:
    r"""The rotations away from the learned rotation (tilts) that a plan can choose.

    A tilt is a rotation vector in the base frame that depends on time: :math:`\tau(t) = \tau_0(t) + \sum_k
    B_k(t)\,c_k`. The functions :math:`B_k` are splines, and the planner chooses their coefficients :math:`c_k`. The
    rotation vector is applied to the learned rotation of the tool.

    Attributes:
        basis: the functions B_k at the samples, shape (n, n_tilts).
        fixed: the part tau_0 at the samples, which the planner can't change, shape (n, 3) [rad].
    """

    basis: Array
    fixed: Array

    @classmethod
    def between_ends(cls, times: Array, *, tilted_goal: bool, window: Array | None = None) -> Tilts:
        """Return tilts that are zero at the start and, if ``tilted_goal`` is False, at the goal.

        Args:
            times: n increasing times [s].
            tilted_goal: whether the tool may be tilted at the goal.
            window: factor of all tilts at each sample, shape (n,); None: 1.
        """
        basis = splines(times, _KNOTS, first=False, last=tilted_goal)
        return cls(basis if window is None else window[:, None] * basis, np.zeros((len(times), 3)))

    @property
    def n_tilts(self) -> int:
        """Number of functions B_k, which is also the number of rows of the coefficients."""
        return self.basis.shape[1]

    def vectors(self, coefficients: Array, samples: Index | slice = slice(None)) -> Array:
        """Return the rotation vectors (k, 3) [rad] at samples for coefficients (n_tilts, 3) [rad]."""
        return np.asarray(self.fixed[samples] + self.basis[samples] @ coefficients)

    def turned(self, quaternions: Array, coefficients: Array, samples: Index) -> Array:
        """Return the tilted rotations of the tool at samples, tool_to_base, shape (k, 4).

        Args:
            quaternions: learned rotations at all samples of the path, tool_to_base, shape (n, 4).
            coefficients: coefficients of the tilt, shape (n_tilts, 3) [rad].
            samples: indices of k samples.
        """
        return quaternion_multiply(quaternion_exp(self.vectors(coefficients, samples)), quaternions[samples])


def splines(times: Array, n_knots: int, *, first: bool, last: bool) -> Array:
    """Return cubic B-splines in time, shape (n, n_splines).

    Args:
        times: n increasing times [s].
        n_knots: number of evenly spaced knots from the first to the last time.
        first: whether to include the first spline; without it, all splines are 0 at the start.
        last: whether to include the last spline; without it, all splines are 0 at the end.
    """
    inner = np.linspace(times[0], times[-1], n_knots)
    knots = np.concatenate([[times[0]] * 3, inner, [times[-1]] * 3])
    basis = BSpline.design_matrix(times, knots, 3).toarray()
    return np.asarray(basis[:, 0 if first else 1 : None if last else -1])
