"""Shapes with edges or flat faces: Box, Cylinder, HalfSpace and Cone, with their distance formulas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, rotate
from imitarm.scene.obstacle import (
    MAX_COORDINATE,
    TINY,
    Array,
    Family,
    Obstacle,
    Parameters,
    PosedObstacle,
    Solid,
    below,
    checked_vector,
    lengths,
    rotation_from_z,
)
from imitarm.validation import finite_number

DEPTH = 1e3  # [m] a half-space is a box of this half height without ends: same distance wherever an arm can be


def slabs(
    q: Array, gradient: bool, half: Array, rounding: Array | None, turned: Array | None
) -> tuple[Array, Array | None]:
    """Return distances to boxes, cylinders and half-spaces, all as rounded boxes of half size ``half``.

    With ``a = |q| - half`` the distance is ``|max(a, 0)| + min(max_j a_j, 0) - rounding``. A half-space is a very large
    box. A cylinder (``turned``) is a box in the coordinates ``(rho, z)`` with ``rho^2 = x^2 + y^2``. If a scene
    contains boxes, cylinders or half-spaces, this function also handles the scene's spheres (as rounded points) and
    capsules (as rounded segments).

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        half: half edge lengths, shape (3, ...) [m].
        rounding: radius of the rounding, shape (...) [m]; None: 0.
        turned: whether each shape is a cylinder, shape (...); None if there are no cylinders.
    """
    a = np.abs(q)
    if turned is not None:
        rho = np.hypot(q[0], q[1])
        np.copyto(a[0], rho, where=turned)
    a -= half
    out = np.maximum(a, 0.0)
    core = distance = lengths(out)
    some_inside = below(core, TINY)  # or on the surface
    if some_inside:
        largest = np.maximum.reduce(a, axis=0)
        distance = core + np.minimum(largest, 0.0)
    if rounding is not None:
        distance = distance - rounding
    if not gradient:
        return distance, None
    if not some_inside:
        out /= core
    else:
        inside = core < TINY  # the normal of the nearest face, the first of equals
        out /= np.where(inside, 1.0, core)
        for row, own in zip(out, a, strict=True):
            nearest = inside & (own == largest)
            np.copyto(row, 1.0, where=nearest)
            inside ^= nearest
    radial = None if turned is None else out[0] / np.maximum(rho, TINY)
    np.copysign(out, q, out=out)
    if radial is not None:
        off_axis = turned & (rho >= TINY)
        np.multiply(q[:2], radial, out=out[:2], where=off_axis)
    return distance, out


def _prepare_slabs(kinds: Sequence[str], sizes: Array) -> Parameters:
    half, rounding = np.zeros((3, len(kinds))), np.zeros(len(kinds))
    for i, (kind, size) in enumerate(zip(kinds, sizes, strict=True)):
        if kind == "box":
            half[:, i] = 0.5 * size
        elif kind == "cylinder":
            half[:, i] = size[0], np.inf, 0.5 * size[1]
        elif kind == "half_space":
            half[:, i] = np.inf, np.inf, DEPTH
        else:  # a sphere or a capsule
            rounding[i] = size[0]
            half[2, i] = 0.5 * size[1]
    turned = np.array([kind == "cylinder" for kind in kinds])
    return half, rounding if rounding.any() else None, turned if "cylinder" in kinds else None


SLABS = Family(("box", "cylinder", "half_space"), slabs, _prepare_slabs)


@dataclass(frozen=True, eq=False)
class Box(PosedObstacle):
    """A cuboid.

    Let R be the rotation and c the position of ``pose``. With ``a = |R^T (x - c)| - size/2``, the distance of a point x
    is ``sd = |max(a, 0)| + min(max_j a_j, 0)``.

    Attributes:
        pose: obstacle_to_base, at the centre.
        size: full edge lengths along the box's own x, y and z, shape (3,) [m].
    """

    kind: ClassVar[str] = "box"
    family: ClassVar[Family] = SLABS
    lengths: ClassVar[tuple[str, ...]] = ("size",)

    size: Array

    def _local_support(self, v: Array) -> Array:
        return np.copysign(0.5 * self.size[:, None], v)


@dataclass(frozen=True, eq=False)
class Cylinder(PosedObstacle):
    """A cylinder with flat ends.

    Let rho be the distance of a point from the axis, and z its coordinate along the axis. The signed distance is that
    of :class:`Box` with ``a = (rho - radius, |z| - length/2)``.

    Attributes:
        pose: obstacle_to_base, at the middle of the cylinder's axis, with z along this axis.
        radius: radius of the cylinder [m].
        length: length from end to end [m].
    """

    kind: ClassVar[str] = "cylinder"
    family: ClassVar[Family] = SLABS
    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")

    radius: float
    length: float

    def _local_support(self, v: Array) -> Array:
        return np.stack([*_rim(v, self.radius), np.copysign(0.5 * self.length, v[2])])


def _rim(v: Array, radius: float) -> Array:
    """Return the points (2, n) of a circle in the directions of vectors ``v`` (3, n), projected along z.

    For a vector along z, it is the point on the x axis.
    """
    rho = np.hypot(v[0], v[1])
    on_axis = rho < TINY
    rim = radius * v[:2] / np.where(on_axis, 1.0, rho)
    rim[:, on_axis] = [[radius], [0.0]]
    return rim


@dataclass(frozen=True, eq=False)
class HalfSpace(Obstacle):
    """Everything on one side of a plane, such as a floor or a large table: ``sd(x) = n.(x - p)``.

    Attributes:
        point: any point ``p`` of the plane, in the base frame, shape (3,) [m].
        normal: direction ``n`` out of the solid, of any nonzero length, shape (3,); it is scaled to length one.
    """

    kind: ClassVar[str] = "half_space"
    family: ClassVar[Family] = SLABS
    depth: ClassVar[float] = DEPTH

    point: Array
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        super().__post_init__()
        point = checked_vector(self.point, f"{self._label}: point", limit=MAX_COORDINATE, unit="m")
        normal = checked_vector(self.normal, f"{self._label}: normal", limit=np.inf)
        length = np.linalg.norm(normal)
        if length < TINY:
            raise InputError(f"{self._label}: normal must have a direction, got {self.normal!r}")
        self._set(point=point, normal=normal / length)

    def solid(self) -> Solid:
        """Return the geometry; its frame is at ``point``, with z along ``normal``."""
        return Solid(self.kind, self.point, rotation_from_z(self.normal), (0.0, 0.0, 0.0))

    def _support(self, directions: Array) -> Array:
        raise InputError(f"{self._label}: a half-space is infinite and has no farthest point")

    def bounds(self) -> Array:
        """Return bounds (2, 3) [m].

        A bound is finite only if the plane is perpendicular to an axis of the base frame.
        """
        low, high = np.full(3, -np.inf), np.full(3, np.inf)
        for axis in np.flatnonzero(np.abs(self.normal) > 1.0 - 1e-12):
            (high if self.normal[axis] > 0.0 else low)[axis] = self.point[axis]
        return np.stack([low, high])

    def _move(self, offset: Array, turn: Array | None) -> None:
        normal = self.normal if turn is None else rotate(turn, self.normal)
        self._set(point=self.point + offset, normal=normal)


def cones(
    q: Array, gradient: bool, radius: Array, height: Array, slant: Array, side: Array
) -> tuple[Array, Array | None]:
    """Return distances to cones: triangles in the half-plane ``(rho, z)``, base at ``-height/2``, tip at ``+height/2``.

    Outside, the distance is the smaller of the distances to two segments: the slant side and the base. Inside, the
    distance is the larger of the signed distances to the lines through these segments.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        radius: radius of the base, shape (...) [m].
        height: height of the cone, shape (...) [m].
        slant: length of the side, shape (...) [m].
        side: outward normal of the side in ``(rho, z)``, shape (2, ...).
    """
    rho = np.hypot(q[0], q[1])
    out, up = rho - radius, q[2] + 0.5 * height  # from the rim
    n_rho, n_z = side
    over_side = n_rho * out + n_z * up
    along = np.minimum(np.maximum(n_rho * up - n_z * out, 0.0), slant)
    from_side = out + n_z * along, up - n_rho * along
    out = np.maximum(out, 0.0)  # the base reaches from the axis to the rim
    to_side = np.sqrt(from_side[0] * from_side[0] + from_side[1] * from_side[1])
    to_base = np.sqrt(out * out + up * up)
    inside, outside = np.maximum(over_side, -up), np.minimum(to_side, to_base)
    distance = np.where(inside > 0.0, outside, inside)
    if not gradient:
        return distance, None
    within = (inside <= 0.0) | (outside < TINY)
    normal = np.where(to_side <= to_base, from_side, (out, up)) / np.where(within, 1.0, outside)
    on_side = within & (over_side >= -up)
    for row, face, down in zip(normal, side, (0.0, -1.0), strict=True):
        np.copyto(row, down, where=within)
        np.copyto(row, face, where=on_side)
    on_axis = rho < TINY
    radial = normal[0] / np.where(on_axis, 1.0, rho)
    full = np.stack([q[0] * radial, q[1] * radial, normal[1]])
    np.copyto(full[0], normal[0], where=on_axis)
    np.copyto(full[1], 0.0, where=on_axis)
    return distance, full


def _prepare_cones(_kinds: Sequence[str], sizes: Array) -> Parameters:
    radius, height, _ = np.ascontiguousarray(sizes.T)
    slant = np.hypot(radius, height)
    return radius, height, slant, np.stack([height, radius]) / slant


CONES = Family(("cone",), cones, _prepare_cones)


@dataclass(frozen=True, eq=False)
class Cone(PosedObstacle):
    """A circular cone whose tip points along its local z axis.

    Let rho be the distance of a point from the axis. In the half-plane ``(rho, z)``, the cone is a triangle. Outside,
    the distance is the smaller of the distances to two segments: the slant side and the base. Inside, the distance is
    the larger of the signed distances to the lines through these segments.

    Attributes:
        pose: obstacle_to_base. The origin is on the axis at half the height, so the base is at ``z = -height/2`` and
            the tip at ``z = +height/2``.
        radius: radius of the base [m].
        height: height from base to tip [m].
    """

    kind: ClassVar[str] = "cone"
    family: ClassVar[Family] = CONES
    lengths: ClassVar[tuple[str, ...]] = ("radius", "height")

    radius: float
    height: float

    def _local_support(self, v: Array) -> Array:
        at_tip = self.height * v[2] >= self.radius * np.hypot(v[0], v[1])
        half = 0.5 * self.height
        return np.stack([*np.where(at_tip, 0.0, _rim(v, self.radius)), np.where(at_tip, half, -half)])


def standard_fixtures(*, floor: float = -0.75, pedestal_radius: float = 0.12) -> tuple[Obstacle, ...]:
    """Return the standard fixtures under an arm: a floor, and a pedestal below the base.

    Args:
        floor: height of the floor in the base frame [m]; if this height is 0 or more, there is no pedestal.
        pedestal_radius: radius of the pedestal [m].

    Raises:
        InputError: when a number is not finite, or the radius is not positive.
    """
    height = finite_number(floor, "floor", "m")
    ground = HalfSpace(np.array([0.0, 0.0, height]), name="floor")
    if height >= 0.0:
        return (ground,)
    pose = Pose(np.array([0.0, 0.0, 0.5 * height]), np.array([1.0, 0.0, 0.0, 0.0]))
    return ground, Cylinder(pose, pedestal_radius, -height, name="pedestal")
