"""ObstacleCost: the cost of a tool position near obstacles (thesis Eqs 5.1 and 5.5, corrected)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.scene.displacements import displaced_distances
from imitarm.scene.distances import KINDS, PackedObstacles, distances_and_gradients

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_LARGEST_EXPONENT = 60.0  # deeper inside an obstacle the cost grows no more, so that it stays finite
_NEGLIGIBLE = 14.0  # exp(-14) is 1e-6: a smaller cost has no effect


class PredictedObstacles(NamedTuple):
    """Obstacles, predicted for H times of a horizon.

    Attributes:
        packed: the n observed obstacles.
        times: times since the observation for which the obstacles are predicted, shape (H,) [s].
        margin: distance that is required in addition to the clearance, for each obstacle and time, shape (n, H) [m].
    """

    packed: PackedObstacles
    times: Array
    margin: Array


class Groups(NamedTuple):
    """Pairs of an obstacle and a sphere of the tool, each pair at one time of the horizon.

    Attributes:
        obstacle: index of the obstacle of each pair, shape (k,).
        instant: index of the time of each pair, shape (k,).
        sphere: index of the tool's sphere of each pair, shape (k,).
    """

    obstacle: Indices
    instant: Indices
    sphere: Indices


@dataclass(frozen=True, eq=False)
class ObstacleCost(ABC):
    """Base class: a cost for each position of the tool, which increases near obstacles. Spheres represent the tool.

    Attributes:
        clearance: required distance of the tool to every obstacle [m].
        radii: radii of the tool's spheres, shape (S,) [m].
    """

    clearance: float
    radii: Array

    @abstractmethod
    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distance from each obstacle beyond which the cost is negligible, shape (n,) [m]."""

    def gaps(self, obstacles: PredictedObstacles, groups: Groups, origins: Array, scales: Array, moves: Array) -> Array:
        """Return the distances between spheres and obstacles, minus the margin, for C candidates, shape (k, C) [m].

        In candidate c, the centre of the sphere of pair k is ``origins[k] + scales[k] moves[c]``.

        Args:
            obstacles: n obstacles, predicted for H times.
            groups: k pairs of an obstacle and a sphere, each at one time.
            origins: centres of the spheres, shape (k, 3) [m].
            scales: factor of the candidates' ``moves`` for each pair, shape (k,) [m].
            moves: direction and relative size of each candidate's displacement, shape (C, 3).
        """
        times = obstacles.times[groups.instant]
        gaps = displaced_distances(obstacles.packed, groups.obstacle, times, origins, scales, moves)
        gaps -= (self.radii[groups.sphere] + obstacles.margin[groups.obstacle, groups.instant])[:, None]
        return gaps

    @abstractmethod
    def values(
        self,
        obstacles: PredictedObstacles,
        groups: Groups,
        origins: Array,
        scales: Array,
        moves: Array,
        gaps: Array,
    ) -> Array:
        """Return the cost of each pair for each candidate, shape (k, C).

        For a tool with several spheres, the largest of their costs counts.

        Args:
            obstacles: n obstacles, predicted for H times.
            groups: k pairs of an obstacle and a sphere, each at one time.
            origins: see :meth:`gaps`.
            scales: see :meth:`gaps`.
            moves: see :meth:`gaps`.
            gaps: result of :meth:`gaps`.
        """

    @abstractmethod
    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of the cost of each pair at ``points`` (k, 3) [m], shape (k, 3) [1/m]."""


@dataclass(frozen=True, eq=False)
class DistanceCost(ObstacleCost):
    r"""Cost that depends on the signed distance, for any convex shape.

    .. math:: b = \exp(-(gap - d_{safe}) / w), \qquad gap = sd(\chi) - r - margin

    Here, ``sd`` is the signed distance from the predicted obstacle to the centre ``chi`` of a sphere of the tool, and
    ``r`` is the radius of the sphere. The cost is 1 at the required clearance ``d_safe``. It increases by the factor e
    whenever the gap decreases by the width ``w``. Beyond ``d_safe + 14 w``, the cost is below 1e-6 and counts as 0.

    Attributes:
        width: width w [m].
    """

    width: float = 0.01

    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distance from each obstacle beyond which the cost is negligible, shape (n,) [m]."""
        return np.full(len(packed), self.influence_distance)

    @property
    def influence_distance(self) -> float:
        """Distance beyond which the cost is negligible [m]."""
        return self.clearance + _NEGLIGIBLE * self.width

    def values(
        self,
        obstacles: PredictedObstacles,
        groups: Groups,
        origins: Array,
        scales: Array,
        moves: Array,
        gaps: Array,
    ) -> Array:
        """Return the cost of each pair, shape (k, C); see :class:`ObstacleCost`."""
        del obstacles, groups, origins, scales, moves
        exponent = gaps - self.clearance
        exponent *= -1.0 / self.width
        np.minimum(exponent, _LARGEST_EXPONENT, out=exponent)
        return np.asarray(np.exp(exponent, out=exponent))

    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of the cost of each pair, shape (k, 3) [1/m]; see :class:`ObstacleCost`."""
        still = np.zeros(len(points)), np.zeros((1, 3))
        gaps = self.gaps(obstacles, groups, points, *still)
        cost = self.values(obstacles, groups, points, *still, gaps)
        times = obstacles.times[groups.instant]
        normals = distances_and_gradients(obstacles.packed, points[:, None], times)[1][:, :, 0]
        return np.asarray(-cost / self.width * normals[groups.obstacle, np.arange(len(points))])


@dataclass(frozen=True, eq=False)
class GaussianCost(ObstacleCost):
    r"""Gaussian cost about the obstacle's centre, as in the thesis, averaged over the uncertainty of the tracker.

    .. math::
        b &= \alpha\,|L|^{1/2} |L + P|^{-1/2}
        \exp\left(-\tfrac12 (\chi - \hat y)^T (L + P)^{-1} (\chi - \hat y)\right)

        L &= R\,\mathrm{diag}(\ell_j^2)\,R^T, \qquad \ell_j = \tfrac12 (a_j + r + d_{safe})

    Here, ``a_j`` are the obstacle's semi-axes, and R is its rotation. ``r`` is the radius of a sphere of the tool, and
    ``chi`` its centre. ``P`` is the covariance of the obstacle's predicted position :math:`\hat y`. The thesis computes
    a mean over samples (Eq 5.5, whose exponent lacks its minus sign). The formula above is the exact mean.

    The height of the Gaussian is ``alpha = 2 k l^2 exp(2)``, where l is the smallest of the three lengths ``l_j``. The
    reason is as follows. At the distance 2 l from the obstacle's centre, the tool has exactly the required clearance.
    If the tool deviates by 2 l during the whole horizon, it gets around the obstacle, at the task cost ``k (2 l)^2 /
    2``. With this alpha, the obstacle's cost at the distance 2 l is equal to this task cost.

    Attributes:
        stiffness: k, twice the task cost of a deviation of 1 m during the whole horizon [1/m^2].
    """

    stiffness: float = 1.0

    def influence(self, packed: PackedObstacles) -> Array:
        """Return the distance from each obstacle beyond which the cost is negligible, shape (n,) [m]."""
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
        height = 2.0 * self.stiffness * lengths.min(axis=1) ** 2 * np.e**2
        height = height * np.prod(lengths, axis=1) / np.sqrt(np.linalg.det(spread))
        return height, np.asarray(np.linalg.inv(spread), dtype=float)

    def _centers(self, obstacles: PredictedObstacles, groups: Groups) -> Array:
        """Return the predicted centres of the obstacles, shape (k, 3) [m]."""
        packed, i = obstacles.packed, groups.obstacle
        return packed.positions[i] + obstacles.times[groups.instant, None] * packed.velocities[i]

    def values(
        self,
        obstacles: PredictedObstacles,
        groups: Groups,
        origins: Array,
        scales: Array,
        moves: Array,
        gaps: Array,
    ) -> Array:
        """Return the cost of each pair, shape (k, C); see :class:`ObstacleCost`."""
        del gaps
        height, precision = self._shapes(obstacles, groups)
        offset = (origins - self._centers(obstacles, groups))[:, None] + scales[:, None, None] * moves
        square = np.sum(np.matmul(offset, precision) * offset, axis=2)
        return np.asarray(height[:, None] * np.exp(-0.5 * square))

    def gradients(self, obstacles: PredictedObstacles, groups: Groups, points: Array) -> Array:
        """Return the gradient of the cost of each pair, shape (k, 3) [1/m]; see :class:`ObstacleCost`."""
        height, precision = self._shapes(obstacles, groups)
        offset = points - self._centers(obstacles, groups)
        pull = np.matmul(precision, offset[:, :, None])[..., 0]
        cost = height * np.exp(-0.5 * np.sum(offset * pull, axis=1))
        return np.asarray(-cost[:, None] * pull)


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
