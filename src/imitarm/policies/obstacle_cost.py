"""The cost of being near a moving obstacle (thesis Eqs 5.1 and 5.5, corrected)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.scene.distances import KINDS, PackedObstacles, distances_and_gradients, group_distances

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_LARGEST_EXPONENT = 60.0  # deeper inside an obstacle the cost grows no more, so that it stays finite
_NEGLIGIBLE = 14.0  # exp(-14) is 1e-6: a smaller cost has no effect


class PredictedObstacles(NamedTuple):
    """Obstacles, predicted at the instants of the horizon.

    Attributes:
        packed: n obstacles as observed.
        times: instants, after the time of the observation, shape (H,) [s].
        margin: additional distance to each obstacle at each instant, shape (n, H) [m].
    """

    packed: PackedObstacles
    times: Array
    margin: Array


class Groups(NamedTuple):
    """Pairs of an obstacle and a sphere of the tool, each at one instant; candidates are compared within a pair.

    Attributes:
        obstacle: index of the obstacle, shape (k,).
        instant: index of the instant, shape (k,).
        sphere: index of the sphere of the tool, shape (k,).
    """

    obstacle: Indices
    instant: Indices
    sphere: Indices


@dataclass(frozen=True, eq=False)
class ObstacleCost(ABC):
    """Cost of a tool, made of spheres, near obstacles.

    Attributes:
        clearance: required distance of the tool to every obstacle [m].
        radii: radii of the tool's spheres, shape (S,) [m].
    """

    clearance: float
    radii: Array

    @abstractmethod
    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distances between tool and obstacles beyond which the cost is negligible, shape (n,) [m]."""

    def gaps(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the distances between the spheres and the obstacles, less the margin, shape (k, C) [m].

        Args:
            obstacles: n obstacles at H instants.
            groups: k pairs.
            points: centre of the sphere of each pair for C candidates, one row for each axis, shape (3, k, C) [m].
        """
        less = self.radii[groups.sphere] + obstacles.margin[groups.obstacle, groups.instant]
        times = obstacles.times[groups.instant]
        return group_distances(obstacles.packed, groups.obstacle, points, times) - less[:, None]

    @abstractmethod
    def values(self, obstacles: PredictedObstacles, groups: Groups, points: Array, gaps: Array) -> Array:
        """Return the cost of each pair, shape (k, C).

        The cost of a tool of several spheres is the largest cost of its spheres.

        Args:
            obstacles: n obstacles at H instants.
            groups: k pairs.
            points: see :meth:`gaps`.
            gaps: result of :meth:`gaps`; the method may overwrite it.
        """

    @abstractmethod
    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of :meth:`values` with respect to the points, shape (3, k, C) [1/m]."""


@dataclass(frozen=True, eq=False)
class DistanceCost(ObstacleCost):
    r"""Cost by the signed distance, for any convex shape.

    .. math:: b = \exp(-(gap - d_{safe}) / w), \qquad gap = sd(\chi) - r - margin

    Here ``sd`` is the signed distance of the predicted obstacle at the centre of a sphere of the tool, and ``r`` is the
    sphere's radius. The cost is 1 at the required clearance ``d_safe`` and grows by the factor e for each width ``w``
    towards the obstacle. At 14 widths from the required clearance it is 1e-6; this serves as the cut-off.

    Attributes:
        width: w [m].
    """

    width: float = 0.01

    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distances beyond which the cost is negligible, shape (n,) [m]."""
        return np.full(len(packed), self.clearance + _NEGLIGIBLE * self.width)

    def values(self, obstacles: PredictedObstacles, groups: Groups, points: Array, gaps: Array) -> Array:
        """Return the cost of each pair, shape (k, C); see :class:`ObstacleCost`."""
        del obstacles, groups, points
        return self._cost(gaps)

    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of the costs, shape (3, k, C) [1/m]; see :class:`ObstacleCost`."""
        cost = self._cost(self.gaps(obstacles, groups, points))
        normals = np.empty_like(points)
        for k, (obstacle, instant) in enumerate(zip(groups.obstacle, groups.instant, strict=True)):
            times = obstacles.times[instant : instant + 1]
            normals[:, k] = distances_and_gradients(obstacles.packed, points[None, :, k].transpose(0, 2, 1), times)[1][
                obstacle, 0
            ].T
        return np.asarray(-cost / self.width * normals)

    def _cost(self, gaps: Array) -> Array:
        gaps -= self.clearance
        gaps *= -1.0 / self.width
        np.minimum(gaps, _LARGEST_EXPONENT, out=gaps)
        return np.asarray(np.exp(gaps, out=gaps))


@dataclass(frozen=True, eq=False)
class GaussianCost(ObstacleCost):
    r"""Cost by a Gaussian about the obstacle's centre, as in the thesis, averaged over the tracker's uncertainty.

    .. math::
        b &= \alpha\,|L|^{1/2} |L + P|^{-1/2}
        \exp\left(-\tfrac12 (\chi - \hat y)^T (L + P)^{-1} (\chi - \hat y)\right)

        L &= R\,\mathrm{diag}(\ell_j^2)\,R^T, \qquad \ell_j = \tfrac12 (a_j + r + d_{safe})

    Here ``a_j`` are the obstacle's semi-axes, ``r`` is the radius of a sphere of the tool and ``P`` is the covariance
    of the predicted position. The mean over P is the closed form of the sample mean in thesis Eq 5.5, whose exponent
    lacks its minus sign.

    The height ``alpha = k l^2 e^2`` (with l the least of the lengths and k the stiffness of the task's cost) makes the
    push at the distance 2 l, which is the required clearance, hold a deviation of 2 l against the task's cost.

    Attributes:
        stiffness: k [1/m^2].
    """

    stiffness: float = 1.0

    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distances beyond which the cost is negligible, shape (n,) [m]."""
        reach = np.sqrt(2.0 * _NEGLIGIBLE)
        axes = _semi_axes(packed).max(axis=1)
        longest = 0.5 * (axes + float(self.radii.max()) + self.clearance)
        spread = np.sqrt(longest**2 + np.trace(packed.covariances, axis1=1, axis2=2))
        return np.asarray(reach * spread)

    def _shapes(self, obstacles: PredictedObstacles, groups: Groups) -> tuple[Array, Array]:
        """Return the heights (k,) and the precisions (L + P)^-1 (k, 3, 3) [1/m^2] of the pairs."""
        packed, i = obstacles.packed, groups.obstacle
        lengths = 0.5 * (_semi_axes(packed)[i] + (self.radii[groups.sphere] + self.clearance)[:, None])
        rotation = quaternion_to_matrix(packed.quaternions[i])
        shape = (rotation * (lengths**2)[:, None, :]) @ np.swapaxes(rotation, -1, -2)
        spread = shape + packed.covariances[i]
        height = self.stiffness * lengths.min(axis=1) ** 2 * np.e**2
        height = height * np.prod(lengths, axis=1) / np.sqrt(np.linalg.det(spread))
        return height, np.asarray(np.linalg.inv(spread), dtype=float)

    def _offsets(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the vectors from the obstacles' centres to the points, shape (3, k, C) [m]."""
        packed, i = obstacles.packed, groups.obstacle
        centers = packed.positions[i] + obstacles.times[groups.instant, None] * packed.velocities[i]
        return np.asarray(points - centers.T[:, :, None])

    def values(self, obstacles: PredictedObstacles, groups: Groups, points: Array, gaps: Array) -> Array:
        """Return the cost of each pair, shape (k, C); see :class:`ObstacleCost`."""
        del gaps
        height, precision = self._shapes(obstacles, groups)
        offset = self._offsets(obstacles, groups, points)
        square = np.einsum("ikc,kij,jkc->kc", offset, precision, offset, optimize=True)
        return np.asarray(height[:, None] * np.exp(-0.5 * square))

    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of the costs, shape (3, k, C) [1/m]; see :class:`ObstacleCost`."""
        height, precision = self._shapes(obstacles, groups)
        offset = self._offsets(obstacles, groups, points)
        pull = np.einsum("kij,jkc->ikc", precision, offset)
        return np.asarray(-height[:, None] * np.exp(-0.5 * np.sum(offset * pull, axis=0)) * pull)


def _semi_axes(packed: PackedObstacles) -> Array:
    """Return half of the extent of each shape along its own axes, shape (n, 3) [m]."""
    axes = np.empty((len(packed), 3))
    for row, kind, (a, b, c) in zip(axes, packed.kinds.tolist(), packed.sizes.tolist(), strict=True):
        name = KINDS[kind]
        if name == "half_space":
            raise InputError(
                "the Gaussian cost needs obstacles with bounds: a half-space has none; use cost='distance'"
            )
        if name == "box":
            row[:] = 0.5 * a, 0.5 * b, 0.5 * c
        elif name == "capsule":
            row[:] = a, a, a + 0.5 * b
        elif name in {"cylinder", "cone"}:
            row[:] = a, a, 0.5 * b
        else:
            row[:] = (a, a, a) if name == "sphere" else (a, b, c)
    return axes
