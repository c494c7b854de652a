"""NURBS: curves of rational splines (thesis Eq 3.6 and 3.7, METHODS A.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def basis_functions(knots: Array, degree: int, u: ArrayLike) -> tuple[Indices, Array]:
    r"""Return the basis functions that are not zero (thesis Eq 3.7, corrected).

    .. math::
        N_{i,0}(u) = \begin{cases} 1 & u_i \le u < u_{i+1} \\ 0 & \text{else} \end{cases} \qquad
        N_{i,p}(u) = \frac{u - u_i}{u_{i+p} - u_i} N_{i,p-1}(u)
        + \frac{u_{i+p+1} - u}{u_{i+p+1} - u_{i+1}} N_{i+1,p-1}(u)

    with 0/0 = 0, and with the last span closed at the right, so that the last function is 1 at the end. At every ``u``
    only p + 1 of them differ from zero; the recursion is run over these, where no divisor is zero.

    Args:
        knots: never falling, the first and the last repeated degree + 1 times, shape (m,).
        degree: p.
        u: shape (k,); cut to the knots' range.

    Returns:
        indices of the first function that is not zero, shape (k,), and the values of it and the next ones,
        shape (k, degree + 1).
    """
    at = np.minimum(np.maximum(np.asarray(u, dtype=float), knots[degree]), knots[-degree - 1])
    span = np.searchsorted(knots[degree + 1 : -degree - 1], at, side="right") + degree
    values = np.zeros((len(at), degree + 1))
    values[:, 0] = 1.0
    for p in range(1, degree + 1):
        carried: Array = np.zeros(len(at))
        for j in range(p):
            right, left = knots[span + j + 1], knots[span + j + 1 - p]
            part = values[:, j] / (right - left)
            values[:, j] = carried + (right - at) * part
            carried = (at - left) * part
        values[:, p] = carried
    return span - degree, values


@dataclass(frozen=True, eq=False)
class NURBS:
    r"""A non-uniform rational B-spline curve (thesis Eq 3.6, METHODS A.6).

    .. math:: C(u) = \frac{\sum_i N_{i,p}(u)\, w_i P_i}{\sum_i N_{i,p}(u)\, w_i}

    with the functions of :func:`basis_functions` over knots
    :math:`\{a, \dots, a, u_{p+1}, \dots, u_{m-p-1}, b, \dots, b\}`, a and b repeated p + 1 times. The parameter is a
    time [s] where a curve was fitted to a motion.

    Attributes:
        knots: shape (n + degree + 1,).
        control_points: P, shape (n, d).
        weights: w, positive, shape (n,).
        degree: p, at least 1.

    Raises:
        InputError: when shapes do not fit, knots fall, are not repeated at both ends or are repeated too often within,
            or a weight is not positive.
    """

    knots: Array
    control_points: Array
    weights: Array
    degree: int = 3

    def __post_init__(self) -> None:
        knots, points, weights = (np.array(x, dtype=float) for x in (self.knots, self.control_points, self.weights))
        p, n = self.degree, len(points)
        if p < 1 or points.ndim != 2 or n < p + 1 or weights.shape != (n,) or knots.shape != (n + p + 1,):
            raise InputError(
                f"NURBS: degree {p} with control points {points.shape} needs at least {p + 1} of them, weights ({n},) "
                f"and knots ({n + p + 1},); got {weights.shape} and {knots.shape}"
            )
        if not (np.isfinite(knots).all() and np.isfinite(points).all()):
            raise InputError("NURBS: knots and control points must be finite numbers")
        if not (np.diff(knots) >= 0.0).all() or knots[p] != knots[0] or knots[-p - 1] != knots[-1]:
            raise InputError(f"NURBS: knots must not fall, and the first and the last must be repeated {p + 1} times")
        if not (knots[p + 1 :] > knots[: -p - 1]).all():
            raise InputError(f"NURBS: a knot is repeated more than {p} times inside the curve, which breaks it apart")
        if not (np.isfinite(weights) & (weights > 0.0)).all():
            raise InputError("NURBS: weights must be positive")
        for name, value in (("knots", knots), ("control_points", points), ("weights", weights)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def domain(self) -> tuple[float, float]:
        """The least and the largest parameter."""
        return float(self.knots[0]), float(self.knots[-1])

    def evaluate(self, u: ArrayLike) -> Array:
        """Return the points of the curve at ``u`` (k,), shape (k, d); beyond its ends the curve stands still.

        A single number gives one point, shape (d,).
        """
        at = np.asarray(u, dtype=float)
        first, values = basis_functions(self.knots, self.degree, at.reshape(-1))
        near = first[:, None] + np.arange(self.degree + 1)
        share = values * self.weights[near]
        points = (share[:, None, :] @ self.control_points[near])[:, 0] / share.sum(axis=1, keepdims=True)
        return np.asarray(points.reshape(*at.shape, points.shape[1]))

    def derivative(self, u: ArrayLike, order: int = 1) -> Array:
        r"""Return a derivative by the parameter at ``u`` (k,), shape (k, d).

        With :math:`A = \sum N_i w_i P_i` and :math:`W = \sum N_i w_i`:
        :math:`C^{(r)} = \frac1W \bigl(A^{(r)} - \sum_{j=1}^r \binom rj W^{(j)} C^{(r-j)}\bigr)`.

        Args:
            u: where; a single number gives shape (d,). Beyond the ends it is the derivative at the end.
            order: 0 (the point itself) to ``degree``.

        Raises:
            InputError: when the order is not one of these.
        """
        if not 0 <= order <= self.degree:
            raise InputError(f"NURBS.derivative: order must be 0 to {self.degree}, got {order!r}")
        at = np.asarray(u, dtype=float)
        flat = at.reshape(-1)
        table = np.column_stack([self.control_points * self.weights[:, None], self.weights])
        knots, parts = self.knots, []
        found: list[Array] = []
        for r in range(order + 1):
            first, values = basis_functions(knots, self.degree - r, flat)
            parts.append(np.einsum("ka,kad->kd", values, table[first[:, None] + np.arange(self.degree - r + 1)]))
            if r < order:
                wide = knots[self.degree - r + 1 : -1] - knots[1 : -(self.degree - r) - 1]
                slope = np.divide(self.degree - r, wide, out=np.zeros_like(wide), where=wide > 0.0)  # 0/0 = 0
                table = slope[:, None] * np.diff(table, axis=0)
                knots = knots[1:-1]
        bottom = parts[0][:, -1:]
        for r in range(order + 1):
            top = parts[r][:, :-1]
            for j in range(1, r + 1):
                top = top - math.comb(r, j) * parts[j][:, -1:] * found[r - j]
            found.append(top / bottom)
        return found[order].reshape(*at.shape, self.control_points.shape[1])
