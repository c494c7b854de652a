"""Shapes with faces and edges that have a closed form: Box, Cylinder and Cone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from imitarm.scene.obstacle import TINY, Array, PosedObstacle, checked_length, checked_lengths


def _slabs(excess: Array) -> tuple[Array, Array]:
    """Return what is outside of each slab (k, n) and the signed distance (n,) to their intersection.

    Args:
        excess: signed distance to each of k perpendicular slabs, shape (k, n) [m].
    """
    out = np.maximum(excess, 0.0)
    distance = np.sqrt(np.einsum("in,in->n", out, out))
    return out, distance + np.minimum(excess.max(axis=0), 0.0)


def _slab_normals(excess: Array, out: Array, distance: Array) -> Array:
    """Return the unit gradient (k, n) of :func:`_slabs`: towards the nearest face, edge or corner."""
    inside = distance < TINY  # or on the surface: the face with the largest excess
    if not inside.any():
        return out / distance
    normal = out / np.where(inside, 1.0, distance)
    columns = np.flatnonzero(inside)
    normal[:, columns] = 0.0
    normal[excess[:, columns].argmax(axis=0), columns] = 1.0
    return normal


@dataclass(frozen=True, eq=False)
class Box(PosedObstacle):
    """A cuboid: with ``a = |Rᵀ(x - c)| - size/2`` the distance is ``sd = |max(a, 0)| + min(max_j a_j, 0)``.

    (METHODS D.2.1)

    Attributes:
        pose: obstacle_to_base, at the centre.
        size: full edge lengths along its own x, y and z, shape (3,) [m].
    """

    kind: ClassVar[str] = "box"

    size: Array
    _half: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        size = checked_lengths(self.size, f"{self._label}: size")
        self._set(size=size, _half=0.5 * size[:, None])

    def _distance(self, points: Array) -> Array:
        return _slabs(np.abs(self._local(points)) - self._half)[1]

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        q = self._local(points)
        excess = np.abs(q) - self._half
        out, distance = _slabs(excess)
        return distance, self._to_base(np.copysign(_slab_normals(excess, out, distance), q))

    def _local_support(self, v: Array) -> Array:
        return np.copysign(self._half, v)


@dataclass(frozen=True, eq=False)
class Cylinder(PosedObstacle):
    """A flat-ended cylinder: the formula of :class:`Box` with ``a = (ρ - radius, |z| - length/2)``, ``ρ² = x² + y²``.

    Attributes:
        pose: obstacle_to_base, at the middle of the axis; the axis is its z.
        radius: [m].
        length: from end to end [m].
    """

    kind: ClassVar[str] = "cylinder"

    radius: float
    length: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(
            radius=checked_length(self.radius, f"{self._label}: radius"),
            length=checked_length(self.length, f"{self._label}: length"),
        )

    def _excess(self, rho: Array, z: Array) -> Array:
        excess = np.empty((2, len(z)))
        np.subtract(rho, self.radius, out=excess[0])
        np.subtract(np.abs(z), 0.5 * self.length, out=excess[1])
        return excess

    def _distance(self, points: Array) -> Array:
        x, y, z = self._local(points)
        return _slabs(self._excess(np.hypot(x, y), z))[1]

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        q = self._local(points)
        rho = np.hypot(q[0], q[1])
        excess = self._excess(rho, q[2])
        out, distance = _slabs(excess)
        normal = _slab_normals(excess, out, distance)
        return distance, self._to_base(_revolved(q, rho, normal[0], np.copysign(normal[1], q[2])))

    def _local_support(self, v: Array) -> Array:
        rho = np.hypot(v[0], v[1])
        ring = _revolved(v, rho, np.full(rho.shape, self.radius), np.zeros_like(rho))
        ring[2] = np.copysign(0.5 * self.length, v[2])
        return ring


def _revolved(q: Array, rho: Array, radial: Array, axial: Array) -> Array:
    """Return vectors (3, n) from radial and axial parts (n,) at the angle of ``q`` (3, n); along x on the axis."""
    on_axis = rho < TINY
    turned = np.empty_like(q)
    if on_axis.any():
        safe = np.where(on_axis, 1.0, rho)
        turned[0] = radial * np.where(on_axis, 1.0, q[0] / safe)
        turned[1] = radial * np.where(on_axis, 0.0, q[1] / safe)
    else:
        np.multiply(q[:2], radial / rho, out=turned[:2])
    turned[2] = axial
    return turned
