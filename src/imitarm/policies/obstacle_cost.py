"""The cost of being near a moving obstacle (thesis Eqs 5.1 and 5.5, corrected)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.scene.distances import KINDS, PackedObstacles, distances, distances_and_gradients

Array = NDArray[np.float64]

_LARGEST_EXPONENT = 60.0  # deeper inside an obstacle the cost grows no more, so that it stays finite


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

    @property
    def centers(self) -> Array:
        """Predicted positions, shape (n, H, 3) [m]."""
        return self.packed.positions[:, None] + self.times[:, None] * self.packed.velocities[:, None]


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
    def values(self, obstacles: PredictedObstacles, points: Array) -> tuple[Array, Array]:
        """Return the cost of each obstacle, and what the cost depends on.

        Args:
            obstacles: n obstacles at H instants.
            points: centres of the tool's S spheres at the H instants, for C candidates, shape (H, C, S, 3) [m].

        Returns:
            Costs, shape (n, H, C), and distances between tool and obstacles, less the margin, shape (n, H, C) [m].
        """

    @abstractmethod
    def gradients(self, obstacles: PredictedObstacles, points: Array) -> Array:
        """Return the gradient of the costs with respect to a displacement of the tool, shape (n, H, C, 3) [1/m]."""


@dataclass(frozen=True, eq=False)
class DistanceCost(ObstacleCost):
    r"""Cost by the signed distance, for any convex shape.

    .. math:: b = \exp(-(gap - d_{safe}) / w), \qquad gap = \min_j (sd(\chi_j) - r_j) - margin

    The tool is made of spheres j with radii r_j. The cost is 1 at the required clearance ``d_safe`` and grows by the
    factor e for each width w towards the obstacle. At a distance of 0.3 m it is below 1e-12, which serves as cut-off.

    Attributes:
        width: w [m].
    """

    width: float = 0.01

    def values(self, obstacles: PredictedObstacles, points: Array) -> tuple[Array, Array]:
        """Return costs and gaps, see :class:`ObstacleCost`."""
        distance = distances(obstacles.packed, points, obstacles.times)
        gap = distance[..., 0] - self.radii[0] if len(self.radii) == 1 else (distance - self.radii).min(axis=-1)
        gap -= obstacles.margin[..., None]
        return self._cost(gap), gap

    def gradients(self, obstacles: PredictedObstacles, points: Array) -> Array:
        """Return gradients, see :class:`ObstacleCost`."""
        distance, normal = distances_and_gradients(obstacles.packed, points, obstacles.times)
        distance = distance - self.radii
        nearest = distance.argmin(axis=-1)[..., None]
        gap = np.take_along_axis(distance, nearest, axis=-1)[..., 0] - obstacles.margin[..., None]
        normal = np.take_along_axis(normal, nearest[..., None], axis=-2)[..., 0, :]
        return np.asarray(-(self._cost(gap) / self.width)[..., None] * normal)

    def _cost(self, gap: Array) -> Array:
        exponent = (self.clearance - gap) * (1.0 / self.width)
        np.minimum(exponent, _LARGEST_EXPONENT, out=exponent)
        return np.asarray(np.exp(exponent, out=exponent))


@dataclass(frozen=True, eq=False)
class GaussianCost(ObstacleCost):
    r"""Cost by a Gaussian about the obstacle's centre, as in the thesis, averaged over the tracker's uncertainty.

    .. math::
        b &= \alpha\,|L|^{1/2} |L + P|^{-1/2}
        \exp\left(-\tfrac12 (\chi - \hat y)^T (L + P)^{-1} (\chi - \hat y)\right)

        L &= R\,\mathrm{diag}(\ell_j^2)\,R^T, \qquad \ell_j = \tfrac12 (a_j + r + d_{safe})

    Here ``a_j`` are the obstacle's semi-axes, ``r`` is the radius of a sphere of the tool and ``P`` is the covariance
    of the predicted position. The mean over P is the closed form of the sample mean in thesis Eq 5.5, whose exponent
    lacks its minus sign. For a tool of several spheres, the largest of their costs counts.

    The height ``alpha = k l^2 e^2`` (with l the least of the lengths and k the stiffness of the task's cost) makes the
    push at the distance 2 l, which is the required clearance, hold a deviation of 2 l against the task's cost.

    Attributes:
        stiffness: k [1/m^2].
    """

    stiffness: float = 1.0

    def _parts(self, obstacles: PredictedObstacles, points: Array) -> tuple[Array, Array, Array]:
        """Return costs (n, H, C, S), offsets (n, H, C, S, 3) [m] and precisions (n, S, 3, 3) [1/m^2]."""
        packed = obstacles.packed
        lengths = 0.5 * (_semi_axes(packed)[:, None] + (self.radii + self.clearance)[:, None])  # (n, S, 3)
        rotation = quaternion_to_matrix(packed.quaternions)[:, None]
        shape = (rotation * (lengths**2)[..., None, :]) @ np.swapaxes(rotation, -1, -2)
        spread = shape + packed.covariances[:, None]
        precision = np.asarray(np.linalg.inv(spread), dtype=float)
        height = self.stiffness * lengths.min(axis=-1) ** 2 * np.e**2
        height = height * np.sqrt(np.prod(lengths**2, axis=-1) / np.linalg.det(spread))
        offset = points - obstacles.centers[:, :, None, None]
        square = np.einsum("nhcsi,nsij,nhcsj->nhcs", offset, precision, offset)
        costs: Array = height[:, None, None] * np.exp(-0.5 * square)
        return costs, offset, precision

    def values(self, obstacles: PredictedObstacles, points: Array) -> tuple[Array, Array]:
        """Return costs and gaps, see :class:`ObstacleCost`."""
        costs, _, _ = self._parts(obstacles, points)
        gap = (distances(obstacles.packed, points, obstacles.times) - self.radii).min(axis=-1)
        return costs.max(axis=-1), gap

    def gradients(self, obstacles: PredictedObstacles, points: Array) -> Array:
        """Return gradients, see :class:`ObstacleCost`."""
        costs, offset, precision = self._parts(obstacles, points)
        each = -costs[..., None] * np.einsum("nsij,nhcsj->nhcsi", precision, offset)
        highest = costs.argmax(axis=-1)[..., None, None]
        return np.take_along_axis(each, highest, axis=-2)[..., 0, :]


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
        elif name == "sphere":
            row[:] = a
        else:
            row[:] = a, b, c
    return axes
