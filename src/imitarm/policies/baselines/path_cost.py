r"""The cost of a path in the baseline ``gmm-irl``, with its derivatives and the search for its local minima.

A path is the nominal path ``x_i`` plus a deviation ``d_i``, at n = 100 equal time steps. The first and the last three
deviations are 0. Let ``Sigma_i`` be the covariance of the demonstrations at sample ``i``, and ``g_oi`` the gap of this
sample to obstacle ``o``. The cost is ``J = sum_k w_k phi_k`` with the following features ``phi_k``::

    deviation       mean_i d_i^T (Sigma_i + (5 mm)^2 I)^-1 d_i
    jerk            n^5 sum_i |third difference of d at i|^2                     [m^2], as for a duration of 1
    obstacles       mean_i sum_o exp(-max(g_oi, 0)^2 / (2 l^2))                  for l = 2, 5 and 10 cm
    contact         mean_i sum_o max(-g_oi, 0)^2 / (2 (1 cm)^2)

The Hessian of ``J`` is a band matrix: third differences couple each sample only with the next three, and the other
features do not couple samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solve_banded
from scipy.optimize import minimize

from imitarm.policies.baselines.baseline_policy import ToolGaps

Array = NDArray[np.float64]

N_SAMPLES = 100
FIXED = 3  # samples at each end that do not move
N_FREE = N_SAMPLES - 2 * FIXED
RANGES = (0.02, 0.05, 0.10)  # [m] of the obstacle features
FEATURES = ("deviation", "jerk", *(f"obstacles {100 * r:.0f} cm" for r in RANGES), "contact")
PRECISION = 0.005  # [m] nobody demonstrates more precisely
_DEPTH_SCALE = 0.01  # [m]
_STEP = 1e-5  # [m] of the finite differences of normals
_ITERATIONS = 300
_free = slice(FIXED, -FIXED)


@dataclass(frozen=True, eq=False)
class PathCost:
    """The cost of paths in one scene. A deviation has shape (94, k) [m]: 94 samples in k allowed directions.

    Attributes:
        nominal: nominal path at equal time steps, shape (100, 3) [m].
        covariances: covariances of the demonstrations at the samples, shape (100, 3, 3) [m^2].
        times: times of the samples since the motion began, shape (100,) [s].
        gaps: distances to the obstacles; a moving obstacle is at its predicted position at the time of each sample.
        margin: distance that is subtracted from each gap [m].
        axes: orthonormal basis of the allowed directions, as columns, shape (3, k).
        one_sided: directions in which the path should not be displaced, in the basis ``axes``, shape (m, k). A
            displacement in such a direction costs as much as an equal overlap with an obstacle.
    """

    nominal: Array
    covariances: Array
    times: Array
    gaps: ToolGaps
    margin: float
    axes: Array
    one_sided: Array

    def path(self, deviation: Array) -> Array:
        """Return the positions (100, 3) for a deviation (94, k)."""
        path = self.nominal.copy()
        path[_free] += deviation @ self.axes.T
        return path

    def deviation(self, path: Array) -> Array:
        """Return the deviation (94, k) of positions (100, 3)."""
        return (path - self.nominal)[_free] @ self.axes

    @cached_property
    def precisions(self) -> Array:
        """Inverses of ``Sigma_i + (5 mm)^2 I`` in the allowed directions, shape (94, k, k) [1/m^2]."""
        inverse = np.linalg.inv(self.covariances[_free] + PRECISION**2 * np.eye(3))
        return np.asarray(self.axes.T @ inverse @ self.axes)

    @cached_property
    def smoothness(self) -> Array:
        """Matrix A of the feature "jerk", which is ``d^T A d`` for a deviation d in one direction, shape (94, 94)."""
        third = np.diff(np.eye(N_SAMPLES), 3, axis=0)[:, _free]
        return np.asarray(float(N_SAMPLES - 1) ** 5 * third.T @ third)

    def features(self, deviation: Array) -> Array:
        """Return the six features ``phi_k`` of a deviation, shape (6,)."""
        gap = self._gaps(deviation)[0]
        quadratic = np.einsum("ij,ijk,ik->", deviation, self.precisions, deviation) / N_FREE
        jerk = np.sum(deviation * (self.smoothness @ deviation))
        near = [np.sum(bump(gap, r)[0]) / N_FREE for r in RANGES]
        deep = np.sum(depth(-gap)[0]) + np.sum(depth(deviation @ self.one_sided.T)[0])
        return np.array([quadratic, jerk, *near, deep / N_FREE])

    def gradients(self, deviation: Array) -> Array:
        """Return the gradients of the six features with respect to the deviation, shape (6, 94, k)."""
        gap, normal = self._gaps(deviation)
        slopes = [bump(gap, r)[1] for r in RANGES]
        slopes.append(-depth(-gap)[1])
        rows = [np.einsum("oi,oik->ik", slope, normal) / N_FREE for slope in slopes]
        rows[-1] = rows[-1] + depth(deviation @ self.one_sided.T)[1] @ self.one_sided / N_FREE
        quadratic = 2.0 * np.einsum("ijk,ik->ij", self.precisions, deviation) / N_FREE
        return np.stack([quadratic, 2.0 * self.smoothness @ deviation, *rows])

    def blocks(self, deviation: Array) -> Array:
        """Return the second derivatives of the features with respect to each single sample, shape (6, 94, k, k).

        The entries of the feature "jerk" are 0 here, because its Hessian couples different samples. This Hessian is ``2
        smoothness`` for each direction.
        """
        gap, normal = self._gaps(deviation)
        curvature = self._curvatures(deviation)
        outer = normal[..., :, None] * normal[..., None, :]
        parts = [bump(gap, r) for r in RANGES]
        deep = depth(-gap)
        parts.append((deep[0], -deep[1], deep[2]))
        rows = [np.einsum("oi,oijk->ijk", p[2], outer) + np.einsum("oi,oijk->ijk", p[1], curvature) for p in parts]
        sided = depth(deviation @ self.one_sided.T)[2]
        rows[-1] = rows[-1] + np.einsum("im,mj,mk->ijk", sided, self.one_sided, self.one_sided)
        return np.stack([2.0 * self.precisions, np.zeros_like(self.precisions), *rows]) / N_FREE

    def _gaps(self, deviation: Array) -> tuple[Array, Array]:
        """Return gaps less the margin (n_obstacles, 94) and normals (n_obstacles, 94, k)."""
        points = self.nominal[_free] + deviation @ self.axes.T
        gap, normal = self.gaps.gaps_and_normals(points[:, None], self.times[_free])
        return gap[:, :, 0] - self.margin, normal[:, :, 0] @ self.axes

    def _curvatures(self, deviation: Array) -> Array:
        """Return the second derivatives of the gaps by differences of normals, shape (n_obstacles, 94, k, k)."""
        points = self.nominal[_free] + deviation @ self.axes.T
        steps = _STEP * np.concatenate([self.axes.T, -self.axes.T])
        _, normal = self.gaps.gaps_and_normals(points[:, None] + steps, self.times[_free])
        k = self.axes.shape[1]
        slope = (normal[:, :, :k] - normal[:, :, k:]) @ self.axes / (2.0 * _STEP)
        return 0.5 * (slope + np.swapaxes(slope, 2, 3))

    def hessian(self, weights: Array, blocks: Array) -> Array:
        """Return the upper band of J's Hessian, shape (3 k + 1, 94 k), for :func:`scipy.linalg.cholesky_banded`.

        Args:
            weights: weights w of the features, shape (6,).
            blocks: the result of :meth:`blocks`.
        """
        within = np.tensordot(weights, blocks, axes=1)
        k = within.shape[1]
        band = np.zeros((3 * k + 1, N_FREE * k))
        for row in range(k):
            for column in range(row, k):
                band[3 * k - (column - row), column::k] = within[:, row, column]
        for offset in range(FIXED + 1):
            coupling = 2.0 * weights[1] * np.diagonal(self.smoothness, offset)
            band[3 * k - offset * k, offset * k :] += np.repeat(coupling, k)
        return band

    def minimised(self, weights: Array, start: Array) -> Array:
        """Return the local minimum of J that L-BFGS reaches from a start deviation, both of shape (94, k) [m].

        Let U be the Cholesky factor of the Hessian of the two quadratic features, deviation and jerk. The optimiser
        uses ``y = U d`` instead of the deviation d. The cost of these two features is then ``|y|^2 / 2``, so L-BFGS
        converges in few iterations.
        """
        quadratic = np.zeros_like(weights)
        quadratic[:2] = weights[:2]
        only = np.stack([2.0 * self.precisions / N_FREE] + [np.zeros_like(self.precisions)] * (len(weights) - 1))
        factor = cholesky_banded(self.hessian(quadratic, only))
        n, k = start.shape
        to_deviation = solve_banded((0, 3 * k), factor, np.eye(n * k))

        def cost(y: Array) -> tuple[float, Array]:
            deviation = (to_deviation @ y).reshape(n, k)
            value, slope = self._avoidance(weights, deviation)
            return 0.5 * float(y @ y) + value, y + slope.ravel() @ to_deviation

        y = np.linalg.solve(to_deviation, start.ravel()) if start.any() else np.zeros(n * k)
        options = {"maxiter": _ITERATIONS, "maxcor": 20, "ftol": 1e-10, "gtol": 1e-6}
        found = minimize(cost, y, jac=True, method="L-BFGS-B", options=options)
        return (to_deviation @ found.x).reshape(n, k)

    def _avoidance(self, weights: Array, deviation: Array) -> tuple[float, Array]:
        """Return the cost of the features about obstacles, and its gradient (94, k)."""
        gap, normal = self._gaps(deviation)
        value, slope = np.zeros(()), np.zeros_like(gap)
        for w, r in zip(weights[2:-1], RANGES, strict=True):
            near = bump(gap, r)
            value, slope = value + w * near[0].sum(), slope + w * near[1]
        deep, sided = depth(-gap), depth(deviation @ self.one_sided.T)
        value, slope = value + weights[-1] * (deep[0].sum() + sided[0].sum()), slope - weights[-1] * deep[1]
        gradient = np.einsum("oi,oik->ik", slope, normal) + weights[-1] * sided[1] @ self.one_sided
        return float(value) / N_FREE, gradient / N_FREE


def bump(gap: Array, reach: float) -> tuple[Array, Array, Array]:
    """Return ``exp(-max(g, 0)^2 / (2 l^2))`` for the gaps g and ``l = reach``, and its first two derivatives."""
    u = np.maximum(gap, 0.0) / reach
    value = np.exp(-0.5 * u * u)
    outside = gap > 0.0
    return value, -u / reach * value, np.where(outside, (u * u - 1.0) / reach**2 * value, 0.0)


def depth(depth: Array) -> tuple[Array, Array, Array]:
    """Return ``max(m, 0)^2 / (2 (1 cm)^2)`` for the depths m [m], and its first two derivatives."""
    m = np.maximum(depth, 0.0) / _DEPTH_SCALE
    return 0.5 * m * m, m / _DEPTH_SCALE, np.where(depth > 0.0, 1.0, 0.0) / _DEPTH_SCALE**2
