"""Shapes with faces and edges that have a closed form: Box, Cylinder and Cone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from imitarm.errors import InputError
from imitarm.scene.hull import ConvexHull
from imitarm.scene.obstacle import TINY, Array, PosedObstacle, checked_length, checked_lengths, lengths


def _slabs(excess: Array) -> tuple[Array, Array]:
    """Return what is outside of each slab (k, n) and the signed distance (n,) to their intersection.

    Args:
        excess: signed distance to each of k perpendicular slabs, shape (k, n) [m].
    """
    out = np.maximum(excess, 0.0)
    return out, lengths(out) + np.minimum(np.maximum.reduce(excess, axis=0), 0.0)


def _slab_normals(excess: Array, out: Array, distance: Array) -> Array:
    """Return the unit gradient (k, n) of :func:`_slabs`, away from the nearest face, edge or corner; reuses ``out``."""
    if np.minimum.reduce(distance, initial=1.0) >= TINY:
        out /= distance
        return out
    inside = distance < TINY  # or on the surface: the face with the largest excess, the first one of equals
    out /= np.where(inside, 1.0, distance)
    largest = np.maximum.reduce(excess, axis=0)
    for row, own in zip(out, excess, strict=True):
        nearest = inside & (own == largest)
        np.copyto(row, 1.0, where=nearest)
        inside ^= nearest
    return out


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
        return _slabs(self._excess(self._local(points)))[1]

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        q = self._local(points)
        excess = self._excess(q)
        out, distance = _slabs(excess)
        return distance, self._to_base(np.copysign(_slab_normals(excess, out, distance), q))

    def _excess(self, q: Array) -> Array:
        excess = np.abs(q)
        excess -= self._half
        return excess

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
    turned = np.empty_like(q)
    if np.minimum.reduce(rho, initial=1.0) < TINY:
        on_axis = rho < TINY
        np.multiply(q[:2], radial / np.where(on_axis, 1.0, rho), out=turned[:2])
        turned[0, on_axis], turned[1, on_axis] = radial[on_axis], 0.0
    else:
        np.multiply(q[:2], radial / rho, out=turned[:2])
    turned[2] = axial
    return turned


@dataclass(frozen=True, eq=False)
class Cone(PosedObstacle):
    """A circular cone with its tip up its own z.

    In the half-plane ``(ρ, z)`` it is a triangle: the distance outside is that to the nearer one of two segments,
    the slant side and the base; inside it is the larger one of the signed distances to their lines.

    Attributes:
        pose: obstacle_to_base, on the axis half way up (as for a cylinder): base at ``z = -height/2``, tip at
            ``z = +height/2``.
        radius: of the base [m].
        height: from base to tip [m].
    """

    kind: ClassVar[str] = "cone"

    radius: float
    height: float
    _slant: float = field(init=False, repr=False)  # length of the side
    _side_normal: Array = field(init=False, repr=False)  # in (ρ, z), shape (2,)

    def __post_init__(self) -> None:
        super().__post_init__()
        radius = checked_length(self.radius, f"{self._label}: radius")
        height = checked_length(self.height, f"{self._label}: height")
        slant = float(np.hypot(radius, height))
        self._set(radius=radius, height=height, _slant=slant, _side_normal=np.array([height, radius]) / slant)

    def _profile(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Return ρ (n,), heights over the two lines (2, n), vectors from the side and from the base (2, n)."""
        rho = np.hypot(q[0], q[1])
        from_rim = np.stack([rho - self.radius, q[2] + 0.5 * self.height])
        n_rho, n_z = self._side_normal
        heights = np.stack([n_rho * from_rim[0] + n_z * from_rim[1], -from_rim[1]])
        along = np.minimum(np.maximum(n_rho * from_rim[1] - n_z * from_rim[0], 0.0), self._slant)
        from_side = from_rim + np.array([[n_z], [-n_rho]]) * along
        np.maximum(from_rim[0], 0.0, out=from_rim[0])  # the base reaches from the axis to the rim
        return rho, heights, from_side, from_rim

    def _distance(self, points: Array) -> Array:
        _, heights, from_side, from_base = self._profile(self._local(points))
        inside = np.maximum(heights[0], heights[1])
        return np.where(inside > 0.0, np.minimum(lengths(from_side), lengths(from_base)), inside)

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        q = self._local(points)
        rho, heights, from_side, from_base = self._profile(q)
        inside = np.maximum(heights[0], heights[1])
        to_side, to_base = lengths(from_side), lengths(from_base)
        distance = np.minimum(to_side, to_base)
        normal = np.where(to_side <= to_base, from_side, from_base)
        within = (inside <= 0.0) | (distance < TINY)
        normal /= np.where(within, 1.0, distance)
        faces = np.where(heights[0] >= heights[1], self._side_normal[:, None], np.array([[0.0], [-1.0]]))
        normal = np.where(within, faces, normal)
        return np.where(inside > 0.0, distance, inside), self._to_base(_revolved(q, rho, normal[0], normal[1]))

    def _local_support(self, v: Array) -> Array:
        rho = np.hypot(v[0], v[1])
        at_tip = self.height * v[2] >= self.radius * rho
        half = np.full(rho.shape, 0.5 * self.height)
        return _revolved(v, rho, np.where(at_tip, 0.0, self.radius), np.where(at_tip, half, -half))

    def hull(self, sides: int = 48) -> ConvexHull:
        """Return the pyramid inscribed in the cone, for programs that know no cones.

        Its surface is at most ``radius (1 - cos(π / sides))`` inside the cone's.

        Args:
            sides: edges of its base, at least 3.

        Raises:
            InputError: when ``sides`` is below 3.
        """
        if sides < 3:
            raise InputError(f"{self._label}: a hull needs at least 3 sides, got {sides}")
        angles = 2.0 * np.pi * np.arange(sides) / sides
        rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1) * self.radius
        points = np.vstack([rim - [0.0, 0.0, 0.5 * self.height], [0.0, 0.0, 0.5 * self.height]])
        return ConvexHull(self.pose.apply(points), velocity=self.velocity, name=self.name)
