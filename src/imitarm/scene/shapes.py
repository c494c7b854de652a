"""The shapes of obstacles: their fields, checks and motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_multiply, rotate
from imitarm.scene.distances import Solid
from imitarm.scene.formulas import TINY, Polytope, lengths
from imitarm.scene.obstacle import (
    MAX_COORDINATE,
    MAX_SIZE,
    UPRIGHT,
    Array,
    Obstacle,
    PosedObstacle,
    checked_length,
    checked_vector,
)
from imitarm.validation import finite_array

_FLAT = 1e-6  # [fraction of the longest extent] a thinner hull is refused as flat


def _unit(vectors: Array) -> Array:
    """Return rows (n, 3) scaled to length one; z for rows of length zero."""
    length = lengths(vectors.T)[:, None]
    return np.where(length < TINY, [0.0, 0.0, 1.0], vectors / np.where(length < TINY, 1.0, length))


@dataclass(frozen=True, eq=False)
class Sphere(Obstacle):
    """All points within ``radius`` of ``center``: ``sd(x) = |x - c| - r``.

    Attributes:
        center: centre in the base frame, shape (3,) [m].
        radius: [m].
    """

    kind: ClassVar[str] = "sphere"

    center: Array
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        center = checked_vector(self.center, f"{self._label}: center", limit=MAX_COORDINATE, unit="m")
        self._set(center=center, radius=checked_length(self.radius, f"{self._label}: radius"))

    def solid(self) -> Solid:
        """Return the geometry; its frame is at the centre and not rotated."""
        return Solid(self.kind, self.center, UPRIGHT, (self.radius, 0.0, 0.0))

    def _support(self, directions: Array) -> Array:
        return self.center + self.radius * _unit(directions)

    def _move(self, offset: Array, turn: Array | None) -> None:
        self._set(center=self.center + offset)


@dataclass(frozen=True, eq=False)
class Capsule(Obstacle):
    """All points within ``radius`` of the segment from ``start`` to ``end``: ``sd(x) = |x - s(x)| - r``.

    ``s(x) = a + clip((x - a).u, 0, L) u`` is the nearest point of the segment, with ``u`` its direction and
    ``L`` its length. The overall length is ``L + 2 r``. If the segment has length zero, the capsule is a sphere.

    Attributes:
        start: one end of the segment, in the base frame, shape (3,) [m].
        end: other end, shape (3,) [m].
        radius: [m].
    """

    kind: ClassVar[str] = "capsule"

    start: Array
    end: Array
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        start = checked_vector(self.start, f"{self._label}: start", limit=MAX_COORDINATE, unit="m")
        end = checked_vector(self.end, f"{self._label}: end", limit=MAX_COORDINATE, unit="m")
        self._set(start=start, end=end, radius=checked_length(self.radius, f"{self._label}: radius"))
        checked_length(float(np.linalg.norm(end - start)) + self.radius, f"{self._label}: length")

    def solid(self) -> Solid:
        """Return the geometry; its frame is at the middle of the segment, with z along it."""
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        quaternion = rotation_from_z(axis) if length > TINY else UPRIGHT
        return Solid(self.kind, 0.5 * (self.start + self.end), quaternion, (self.radius, length, 0.0))

    def _support(self, directions: Array) -> Array:
        ends = np.where((directions @ (self.end - self.start) > 0.0)[:, None], self.end, self.start)
        return ends + self.radius * _unit(directions)

    def _move(self, offset: Array, turn: Array | None) -> None:
        middle = 0.5 * (self.start + self.end)
        start, end = (p if turn is None else middle + rotate(turn, p - middle) for p in (self.start, self.end))
        self._set(start=start + offset, end=end + offset)


@dataclass(frozen=True, eq=False)
class Box(PosedObstacle):
    """A cuboid: with ``a = |R^T (x - c)| - size/2`` the distance is ``sd = |max(a, 0)| + min(max_j a_j, 0)``.

    Attributes:
        pose: obstacle_to_base, at the centre.
        size: full edge lengths along its own x, y and z, shape (3,) [m].
    """

    kind: ClassVar[str] = "box"
    lengths: ClassVar[tuple[str, ...]] = ("size",)

    size: Array

    def _local_support(self, v: Array) -> Array:
        return np.copysign(0.5 * self.size[:, None], v)


@dataclass(frozen=True, eq=False)
class Cylinder(PosedObstacle):
    """A flat-ended cylinder: the formula of :class:`Box` with ``a = (rho - radius, |z| - length/2)``.

    Attributes:
        pose: obstacle_to_base, at the middle of the axis; the axis is its z.
        radius: [m].
        length: length from end to end [m].
    """

    kind: ClassVar[str] = "cylinder"
    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")

    radius: float
    length: float

    def _local_support(self, v: Array) -> Array:
        return np.stack([*_rim(v, self.radius), np.copysign(0.5 * self.length, v[2])])


def _rim(v: Array, radius: float) -> Array:
    """Return the points x y (2, n) of a circle in the directions ``v`` (3, n); along x on the axis."""
    rho = np.hypot(v[0], v[1])
    on_axis = rho < TINY
    rim = radius * v[:2] / np.where(on_axis, 1.0, rho)
    rim[:, on_axis] = [[radius], [0.0]]
    return rim


@dataclass(frozen=True, eq=False)
class Cone(PosedObstacle):
    """A circular cone with its tip up its own z.

    In the half-plane ``(rho, z)`` the cone is a triangle. Outside, the distance is the smaller distance to two
    segments, the slant side and the base; inside, it is the larger signed distance to their lines.

    Attributes:
        pose: obstacle_to_base, on the axis at half the height (as for a cylinder): base at ``z = -height/2``, tip at
            ``z = +height/2``.
        radius: radius of the base [m].
        height: height from base to tip [m].
    """

    kind: ClassVar[str] = "cone"
    lengths: ClassVar[tuple[str, ...]] = ("radius", "height")

    radius: float
    height: float

    def _local_support(self, v: Array) -> Array:
        at_tip = self.height * v[2] >= self.radius * np.hypot(v[0], v[1])
        half = 0.5 * self.height
        return np.stack([*np.where(at_tip, 0.0, _rim(v, self.radius)), np.where(at_tip, half, -half)])


@dataclass(frozen=True, eq=False)
class Ellipsoid(PosedObstacle):
    """All points with ``sum_j (y_j / g_j)^2 <= 1`` in its local frame; ``g`` are the semi-axes.

    Attributes:
        pose: obstacle_to_base, at the centre; the semi-axes are along its x, y and z.
        semi_axes: half of each diameter, shape (3,) [m].
    """

    kind: ClassVar[str] = "ellipsoid"
    lengths: ClassVar[tuple[str, ...]] = ("semi_axes",)

    semi_axes: Array

    def _local_support(self, v: Array) -> Array:
        reach = self.semi_axes[:, None] * v
        return self.semi_axes[:, None] * reach / lengths(reach)


@dataclass(frozen=True, eq=False)
class HalfSpace(Obstacle):
    """Everything below a plane, such as a floor or a large table: ``sd(x) = n.(x - p)``.

    Attributes:
        point: any point ``p`` of the plane, in the base frame, shape (3,) [m].
        normal: direction ``n`` out of the solid, of any nonzero length, shape (3,); it is scaled to length one.
    """

    kind: ClassVar[str] = "half_space"

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
        """Return bounds (2, 3) [m], infinite unless the plane is perpendicular to an axis of the base frame."""
        low, high = np.full(3, -np.inf), np.full(3, np.inf)
        for axis in np.flatnonzero(np.abs(self.normal) > 1.0 - 1e-12):
            (high if self.normal[axis] > 0.0 else low)[axis] = self.point[axis]
        return np.stack([low, high])

    def _move(self, offset: Array, turn: Array | None) -> None:
        normal = self.normal if turn is None else rotate(turn, self.normal)
        self._set(point=self.point + offset, normal=normal)


@dataclass(frozen=True, eq=False)
class ConvexHull(Obstacle):
    """The smallest convex solid around ``points``; see :class:`~imitarm.scene.formulas.Polytope` for its distance.

    Attributes:
        points: at least 4 that are not all in one plane, in the base frame, shape (n, 3) [m].
    """

    kind: ClassVar[str] = "convex_hull"

    points: Array
    _center: Array = field(init=False, repr=False)
    _quaternion: Array = field(init=False, repr=False)
    _polytope: Polytope = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        points = self._checked_points()
        center = points.mean(axis=0)
        spread = np.linalg.svd(points - center, compute_uv=False)
        if spread[-1] <= _FLAT * spread[0]:
            raise InputError(
                f"{self._label}: the {len(points)} points lie in one plane; a hull needs points that span a volume "
                "(a thin Box does for a plate)"
            )
        polytope = Polytope.around(points - center)
        self._set(points=points, _center=center, _quaternion=UPRIGHT.copy(), _polytope=polytope)

    def _checked_points(self) -> Array:
        points = np.array(finite_array(self.points, (None, 3), f"{self._label}: points", "m"))
        if len(points) < 4:
            raise InputError(f"{self._label}: points must be at least 4 to span a volume, got {len(points)}")
        if np.abs(points).max() > MAX_COORDINATE or np.ptp(points, axis=0).max() > MAX_SIZE:
            raise InputError(
                f"{self._label}: points reach from {points.min(axis=0).tolist()} to {points.max(axis=0).tolist()}, "
                f"beyond {MAX_SIZE:g} m in size or {MAX_COORDINATE:g} m in place; give them in metres"
            )
        points.setflags(write=False)
        return points

    def solid(self) -> Solid:
        """Return the geometry; its frame is at the mean of the points."""
        half = 0.5 * np.ptp(self._polytope.vertices, axis=0)
        return Solid(self.kind, self._center, self._quaternion, half, self._polytope)

    @cached_property
    def vertices(self) -> Array:
        """The corners of the hull, a subset of ``points``, shape (v, 3) [m]."""
        return rotate(self._quaternion, self._polytope.vertices) + self._center

    @property
    def triangles(self) -> NDArray[np.intp]:
        """Surface as rows of ``vertices``, counter-clockwise seen from outside, shape (k, 3)."""
        return self._polytope.triangles.copy()

    def _support(self, directions: Array) -> Array:
        vertices = self.vertices
        return vertices[(directions @ vertices.T).argmax(axis=1)]

    def _move(self, offset: Array, turn: Array | None) -> None:
        if turn is not None:
            points = rotate(turn, self.points - self._center) + self._center
            self._set(points=points, _quaternion=quaternion_multiply(turn, self._quaternion))
        self._set(points=self.points + offset, _center=self._center + offset)


def rotation_from_z(axis: Array) -> Array:
    """Return a quaternion wxyz (4,) that rotates z into the direction of ``axis`` (3,)."""
    x, y, z = axis.tolist()
    across = math.hypot(x, y)
    if across < 1e-12 * abs(z):
        return UPRIGHT if z >= 0.0 else np.array([0.0, 1.0, 0.0, 0.0])
    half = 0.5 * math.atan2(across, z)
    sine = math.sin(half) / across
    return np.array([math.cos(half), -sine * y, sine * x, 0.0])
