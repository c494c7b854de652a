"""Obstacles: convex solids with an exact signed distance, its gradient, and a motion.

The distance formulas are in :mod:`~imitarm.scene.distances`; here are the shapes, their checks and their motion.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_exp, quaternion_multiply, rotate
from imitarm.scene.distances import (
    TINY,
    PackedObstacles,
    Solid,
    checked_points,
    lengths,
    single_distance,
)
from imitarm.validation import finite_array, finite_number, finite_vector, whole_number

Array = NDArray[np.float64]

MAX_SIZE = 10.0  # [m] nothing within reach of an arm is larger: a larger number is in the wrong unit
MAX_COORDINATE = 100.0  # [m] nor farther away
MAX_SPEED = 100.0  # [m/s] nor faster
MAX_RATE = 100.0  # [rad/s]
_FLAT = 1e-6  # [fraction of the longest extent] a thinner hull is refused as flat
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def _vector(value: object, what: str, *, limit: float, unit: str) -> Array:
    """Return three finite numbers of magnitude at most ``limit`` as a read-only array."""
    vector = np.array(finite_vector(value, 3, what, unit))
    if np.abs(vector).max() > limit:
        raise InputError(f"{what} {vector.tolist()} is beyond {limit:g} {unit}; give it in {unit}")
    vector.setflags(write=False)
    return vector


def _length(value: object, what: str) -> float:
    """Return one positive length [m]."""
    length = finite_number(value, what, "m", above=0.0)
    if length > MAX_SIZE:
        raise InputError(f"{what} {length:g} is beyond {MAX_SIZE:g} m; give it in metres")
    return length


def _lengths(value: object, what: str) -> Array:
    """Return three positive lengths [m] as a read-only array."""
    values = _vector(value, what, limit=np.inf, unit="m")
    if values.min() <= 0.0:
        raise InputError(f"{what} must be 3 positive numbers [m], got {value!r}")
    if values.max() > MAX_SIZE:
        raise InputError(f"{what} {values.tolist()} is beyond {MAX_SIZE:g} m; give it in metres")
    return values


@dataclass(frozen=True, eq=False, kw_only=True)
class Obstacle(ABC):
    """A convex solid in the base frame that must not be touched; it may move at a constant velocity.

    Every shape has an exact signed distance::

        sd(x) =  min |x - s| over the surface points s   when x is outside
        sd(x) = -min |x - s| over the surface points s   when x is inside

    and its gradient, a unit vector: outside it points from the nearest surface point to ``x``, inside from ``x`` to
    the nearest surface point, on the surface along the outward normal. Because the solids are convex, ``sd`` is convex,
    and it changes by at most one metre per metre. Where the nearest surface point is not unique (the centre of a
    sphere, the medial axis of a box), one of them is used, always the same for the same input. To keep a distance
    ``r`` from an obstacle, require ``sd(x) >= r``: no inflated copy is needed.

    Attributes:
        velocity: of the shape's centre, in the base frame, shape (3,) [m/s].
        name: used in messages; a :class:`~imitarm.scene.Scene` falls back on ``"box 1"``.
        angular_velocity: about the shape's centre, in the base frame, shape (3,) [rad/s].
        covariance: of the position, shape (3, 3) [m^2]; None when it is exact or unknown.
        track_id: number of the track that a tracker keeps of it; None without one.

    Raises:
        InputError: when a number is not finite, a size is not positive, or a number is so large that it can't be
            in SI units.
    """

    kind: ClassVar[str]  # the shape's name in scene files and messages

    velocity: Array = field(default_factory=lambda: np.zeros(3))
    name: str = ""
    angular_velocity: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array | None = None
    track_id: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isprintable():
            raise InputError(f"{type(self).__name__}: name must be one line of text, got {self.name!r}")
        for key, limit, unit in (("velocity", MAX_SPEED, "m/s"), ("angular_velocity", MAX_RATE, "rad/s")):
            given = getattr(self, key)
            given = np.zeros(3) if isinstance(given, int | float) and given == 0 else given
            self._set(**{key: _vector(given, f"{self._label}: {key}", limit=limit, unit=unit)})
        if self.covariance is not None:
            self._set(covariance=self._checked_covariance())
        if self.track_id is not None:
            self._set(track_id=whole_number(self.track_id, f"{self._label}: track_id", at_least=0))

    def _checked_covariance(self) -> Array:
        covariance = np.array(finite_array(self.covariance, (3, 3), f"{self._label}: covariance", "m^2"))
        scale = np.abs(covariance).max()
        if np.abs(covariance - covariance.T).max() > 1e-9 * scale or np.linalg.eigvalsh(covariance)[0] < -1e-9 * scale:
            raise InputError(f"{self._label}: covariance must be symmetric and positive semi-definite [m^2]")
        covariance.setflags(write=False)
        return covariance

    @property
    def _label(self) -> str:
        """The obstacle in an error message."""
        return f'{type(self).__name__} "{self.name}"' if self.name else type(self).__name__

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    @cached_property
    def packed(self) -> PackedObstacles:
        """The obstacle as a :class:`~imitarm.scene.distances.PackedObstacles` of one, at time 0."""
        return pack((self,), 0.0)

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the surface, negative inside.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (...) [m].

        Raises:
            InputError: when the last axis has not length 3 or a number is not finite.
        """
        return single_distance(self.packed, points, False)[0]

    def gradient(self, points: ArrayLike) -> Array:
        """Return the gradient of :meth:`signed_distance`: unit vectors, shape (..., 3).

        Args:
            points: in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis has not length 3 or a number is not finite.
        """
        return self.distance_and_gradient(points)[1]

    def distance_and_gradient(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return :meth:`signed_distance` and :meth:`gradient` in one call.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Distances (...) [m] and unit outward normals (..., 3).

        Raises:
            InputError: when the last axis has not length 3 or a number is not finite.
        """
        distance, gradient = single_distance(self.packed, points, True)
        assert gradient is not None
        return distance, gradient

    def support(self, directions: ArrayLike) -> Array:
        """Return the farthest point of the solid in each direction, the one query that GJK needs.

        Args:
            directions: of any length but zero, in the base frame, shape (..., 3).

        Returns:
            Points of the surface in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis has not length 3 or a number is not finite.
        """
        v = checked_points(directions)
        return self._support(v.reshape(-1, 3)).reshape(v.shape)

    def bounds(self) -> Array:
        """Return the lowest and the highest corner of the box along the base frame's axes, shape (2, 3) [m]."""
        axes = np.eye(3)
        return np.stack([np.diagonal(self.support(-axes)), np.diagonal(self.support(axes))])

    @property
    def moves(self) -> bool:
        """Whether it has a velocity or an angular velocity."""
        return bool(self.velocity.any() or self.angular_velocity.any())

    def after(self, dt: float) -> Self:
        """Return the obstacle ``dt`` seconds later.

        Its centre has moved by ``velocity * dt``, and it has rotated about its centre by ``angular_velocity * dt``.

        Args:
            dt: time ahead [s]; negative looks back.

        Raises:
            InputError: when ``dt`` is not a finite number.
        """
        dt = finite_number(dt, "after: dt", "s")
        if not self.moves or dt == 0.0:
            return self
        moved = copy.copy(self)  # keeps the checked fields and the faces of a hull, which motion does not change
        moved.__dict__.pop("packed", None)
        turn = quaternion_exp(dt * self.angular_velocity) if self.angular_velocity.any() else None
        moved._move(dt * self.velocity, turn)
        return moved

    def placed(self, position: Array, quaternion: Array, velocity: Array, angular_velocity: Array) -> Self:
        """Return the obstacle elsewhere; itself when it is there already. The arguments must be valid.

        Args:
            position: of the own frame's origin, see :class:`~imitarm.scene.distances.PackedObstacles`, shape (3,) [m].
            quaternion: own_to_base rotation wxyz, shape (4,).
            velocity: shape (3,) [m/s].
            angular_velocity: shape (3,) [rad/s].
        """
        before = self.solid()
        stays = (position == before.position).all() and (quaternion == before.quaternion).all()
        if stays and (velocity == self.velocity).all() and (angular_velocity == self.angular_velocity).all():
            return self
        placed = copy.copy(self)
        placed.__dict__.pop("packed", None)
        placed._set(velocity=velocity.copy(), angular_velocity=angular_velocity.copy())
        turns = (quaternion != before.quaternion).any()
        turn = quaternion_multiply(quaternion, quaternion_conjugate(before.quaternion)) if turns else None
        placed._move(position - before.position, turn)
        return placed

    @abstractmethod
    def solid(self) -> Solid:
        """Return the geometry as :mod:`~imitarm.scene.distances` needs it."""

    @abstractmethod
    def _support(self, directions: Array) -> Array:
        """Farthest points (n, 3) in ``directions`` (n, 3)."""

    @abstractmethod
    def _move(self, offset: Array, turn: Array | None) -> None:
        """Move this fresh copy by ``offset`` (3,) [m] and rotate it about its centre by ``turn`` (4,)."""


def pack(obstacles: tuple[Obstacle, ...], stamp: float) -> PackedObstacles:
    """Return obstacles as arrays; ``stamp`` [s] is the time for which they hold."""
    zero = np.zeros((3, 3))
    return PackedObstacles.of(
        [obstacle.solid() for obstacle in obstacles],
        [obstacle.velocity for obstacle in obstacles],
        [obstacle.angular_velocity for obstacle in obstacles],
        [zero if obstacle.covariance is None else obstacle.covariance for obstacle in obstacles],
        [stamp] * len(obstacles),
        [-1 if obstacle.track_id is None else obstacle.track_id for obstacle in obstacles],
    )


def _unit(vectors: Array) -> Array:
    """Return rows (n, 3) over their length; z where there is no direction."""
    length = lengths(vectors.T)[:, None]
    return np.where(length < TINY, [0.0, 0.0, 1.0], vectors / np.where(length < TINY, 1.0, length))


@dataclass(frozen=True, eq=False)
class Sphere(Obstacle):
    """All points within ``radius`` of ``center``: ``sd(x) = |x - c| - r``.

    Attributes:
        center: in the base frame, shape (3,) [m].
        radius: [m].
    """

    kind: ClassVar[str] = "sphere"

    center: Array
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        center = _vector(self.center, f"{self._label}: center", limit=MAX_COORDINATE, unit="m")
        self._set(center=center, radius=_length(self.radius, f"{self._label}: radius"))

    def solid(self) -> Solid:
        """Return the geometry: at the centre, not rotated."""
        return Solid(self.kind, self.center, _UPRIGHT, (self.radius, 0.0, 0.0))

    def _support(self, directions: Array) -> Array:
        return self.center + self.radius * _unit(directions)

    def _move(self, offset: Array, turn: Array | None) -> None:
        self._set(center=self.center + offset)


@dataclass(frozen=True, eq=False)
class Capsule(Obstacle):
    """All points within ``radius`` of the segment from ``start`` to ``end``: ``sd(x) = |x - s(x)| - r``.

    ``s(x) = a + clip((x - a).u, 0, L) u`` is the nearest point of the segment, with ``u`` its direction and
    ``L`` its length. The overall length is ``L + 2 r``. A segment of length zero makes a sphere.

    Attributes:
        start: one end of the segment, in the base frame, shape (3,) [m].
        end: the other end, shape (3,) [m].
        radius: [m].
    """

    kind: ClassVar[str] = "capsule"

    start: Array
    end: Array
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        start = _vector(self.start, f"{self._label}: start", limit=MAX_COORDINATE, unit="m")
        end = _vector(self.end, f"{self._label}: end", limit=MAX_COORDINATE, unit="m")
        self._set(start=start, end=end, radius=_length(self.radius, f"{self._label}: radius"))
        _length(float(np.linalg.norm(end - start)) + self.radius, f"{self._label}: length")

    def solid(self) -> Solid:
        """Return the geometry: at the middle of the segment, z along it."""
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        quaternion = rotation_from_z(axis) if length > TINY else _UPRIGHT
        return Solid(self.kind, 0.5 * (self.start + self.end), quaternion, (self.radius, length, 0.0))

    def _support(self, directions: Array) -> Array:
        ends = np.where((directions @ (self.end - self.start) > 0.0)[:, None], self.end, self.start)
        return ends + self.radius * _unit(directions)

    def _move(self, offset: Array, turn: Array | None) -> None:
        middle = 0.5 * (self.start + self.end)
        start, end = (p if turn is None else middle + rotate(turn, p - middle) for p in (self.start, self.end))
        self._set(start=start + offset, end=end + offset)


@dataclass(frozen=True, eq=False)
class PosedObstacle(Obstacle):
    """An obstacle that is described in its own frame, at its centre.

    Attributes:
        pose: obstacle_to_base: the centre and the rotation.
    """

    pose: Pose

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.pose, Pose):
            raise InputError(f"{self._label}: pose must be a Pose(position, quaternion), got {self.pose!r}")
        _vector(self.pose.position, f"{self._label}: position", limit=MAX_COORDINATE, unit="m")

    def _check(self, **checks: Any) -> None:
        """Replace fields by their checked values."""
        self._set(**{key: check(getattr(self, key), f"{self._label}: {key}") for key, check in checks.items()})

    def solid(self) -> Solid:
        """Return the geometry: at ``pose``."""
        return Solid(self.kind, self.pose.position, self.pose.quaternion, self._size())

    def _support(self, directions: Array) -> Array:
        rotation = self.pose.rotation
        return self._local_support((directions @ rotation).T).T @ rotation.T + self.pose.position

    def _move(self, offset: Array, turn: Array | None) -> None:
        quaternion = self.pose.quaternion if turn is None else quaternion_multiply(turn, self.pose.quaternion)
        self._set(pose=Pose.trusted(self.pose.position + offset, quaternion))

    @abstractmethod
    def _size(self) -> Array | tuple[float, float, float]:
        """The row of ``PackedObstacles.sizes``."""

    @abstractmethod
    def _local_support(self, v: Array) -> Array:
        """Farthest points (3, n), own coordinates, in directions ``v`` (3, n)."""


@dataclass(frozen=True, eq=False)
class Box(PosedObstacle):
    """A cuboid: with ``a = |R^T (x - c)| - size/2`` the distance is ``sd = |max(a, 0)| + min(max_j a_j, 0)``.

    Attributes:
        pose: obstacle_to_base, at the centre.
        size: full edge lengths along its own x, y and z, shape (3,) [m].
    """

    kind: ClassVar[str] = "box"

    size: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(size=_lengths)

    def _size(self) -> Array:
        return self.size

    def _local_support(self, v: Array) -> Array:
        return np.copysign(0.5 * self.size[:, None], v)


@dataclass(frozen=True, eq=False)
class Cylinder(PosedObstacle):
    """A flat-ended cylinder: the formula of :class:`Box` with ``a = (rho - radius, |z| - length/2)``.

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
        self._check(radius=_length, length=_length)

    def _size(self) -> tuple[float, float, float]:
        return self.radius, self.length, 0.0

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

    In the half-plane ``(rho, z)`` it is a triangle: the distance outside is that to the nearer one of two segments,
    the slant side and the base; inside it is the larger one of the signed distances to their lines.

    Attributes:
        pose: obstacle_to_base, on the axis at half the height (as for a cylinder): base at ``z = -height/2``, tip at
            ``z = +height/2``.
        radius: of the base [m].
        height: from base to tip [m].
    """

    kind: ClassVar[str] = "cone"

    radius: float
    height: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(radius=_length, height=_length)

    def _size(self) -> tuple[float, float, float]:
        return self.radius, self.height, 0.0

    def _local_support(self, v: Array) -> Array:
        at_tip = self.height * v[2] >= self.radius * np.hypot(v[0], v[1])
        half = 0.5 * self.height
        return np.stack([*np.where(at_tip, 0.0, _rim(v, self.radius)), np.where(at_tip, half, -half)])

    def hull(self, sides: int = 48) -> ConvexHull:
        """Return the pyramid inscribed in the cone, for programs that know no cones.

        Its surface is at most ``radius (1 - cos(pi / sides))`` inside the cone's.

        Args:
            sides: edges of its base, at least 3.

        Raises:
            InputError: when ``sides`` is below 3.
        """
        if whole_number(sides, f"{self._label}: sides") < 3:
            raise InputError(f"{self._label}: a hull needs at least 3 sides, got {sides}")
        angles = 2.0 * np.pi * np.arange(sides) / sides
        rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1) * self.radius
        points = np.vstack([rim - [0.0, 0.0, 0.5 * self.height], [0.0, 0.0, 0.5 * self.height]])
        return ConvexHull(self.pose.apply(points), velocity=self.velocity, name=self.name)


@dataclass(frozen=True, eq=False)
class Ellipsoid(PosedObstacle):
    """All points with ``sum_j (y_j / g_j)^2 <= 1`` in its own frame; ``g`` are the semi-axes.

    Attributes:
        pose: obstacle_to_base, at the centre; the semi-axes are along its x, y and z.
        semi_axes: half of each diameter, shape (3,) [m].
    """

    kind: ClassVar[str] = "ellipsoid"

    semi_axes: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(semi_axes=_lengths)

    def _size(self) -> Array:
        return self.semi_axes

    def _local_support(self, v: Array) -> Array:
        reach = self.semi_axes[:, None] * v
        return self.semi_axes[:, None] * reach / lengths(reach)


@dataclass(frozen=True, eq=False)
class HalfSpace(Obstacle):
    """Everything below a plane, such as a floor or a large table: ``sd(x) = n.(x - p)``.

    Attributes:
        point: any point ``p`` of the plane, in the base frame, shape (3,) [m].
        normal: direction ``n`` out of the solid, of any length but zero, shape (3,); it is scaled to length one.
    """

    kind: ClassVar[str] = "half_space"

    point: Array
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        super().__post_init__()
        point = _vector(self.point, f"{self._label}: point", limit=MAX_COORDINATE, unit="m")
        normal = _vector(self.normal, f"{self._label}: normal", limit=np.inf, unit="m")
        length = np.linalg.norm(normal)
        if length < TINY:
            raise InputError(f"{self._label}: normal must have a direction, got {self.normal!r}")
        self._set(point=point, normal=normal / length)

    def solid(self) -> Solid:
        """Return the geometry: at ``point``, z along ``normal``."""
        return Solid(self.kind, self.point, rotation_from_z(self.normal), (0.0, 0.0, 0.0))

    def _support(self, directions: Array) -> Array:
        raise InputError(f"{self._label}: a half-space has no farthest point; it has no end")

    def bounds(self) -> Array:
        """Return infinite bounds, shape (2, 3) [m], finite only where the plane is across an axis of the base frame."""
        low, high = np.full(3, -np.inf), np.full(3, np.inf)
        for axis in np.flatnonzero(np.abs(self.normal) > 1.0 - 1e-12):
            (high if self.normal[axis] > 0.0 else low)[axis] = self.point[axis]
        return np.stack([low, high])

    def _move(self, offset: Array, turn: Array | None) -> None:
        normal = self.normal if turn is None else rotate(turn, self.normal)
        self._set(point=self.point + offset, normal=normal)


@dataclass(frozen=True, eq=False)
class ConvexHull(Obstacle):
    """The smallest convex solid around ``points``; see :class:`~imitarm.scene.hull.Polytope` for its distance.

    Attributes:
        points: at least 4 that are not all in one plane, in the base frame, shape (n, 3) [m].
    """

    kind: ClassVar[str] = "convex_hull"

    points: Array
    _center: Array = field(init=False, repr=False)
    _quaternion: Array = field(init=False, repr=False)
    _polytope: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from imitarm.scene.hull import Polytope  # noqa: PLC0415  few scenes need it

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
        self._set(points=points, _center=center, _quaternion=_UPRIGHT.copy(), _polytope=polytope)

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
        """Return the geometry: at the mean of the points."""
        half = 0.5 * np.ptp(self._polytope.vertices, axis=0)
        return Solid(self.kind, self._center, self._quaternion, half, self._polytope)

    @property
    def vertices(self) -> Array:
        """Those of ``points`` that are corners of the hull, shape (v, 3) [m]."""
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
    """Return a quaternion wxyz (4,) that turns z into the direction of ``axis`` (3,)."""
    across = np.cross([0.0, 0.0, 1.0], axis)
    sine = float(np.linalg.norm(across))
    if sine < 1e-12 * float(np.linalg.norm(axis)):
        return _UPRIGHT if axis[2] >= 0.0 else np.array([0.0, 1.0, 0.0, 0.0])
    return quaternion_exp(np.arctan2(sine, axis[2]) / sine * across)


__all__ = ["Box", "Capsule", "Cone", "ConvexHull", "Cylinder", "Ellipsoid", "HalfSpace", "Obstacle", "Sphere"]
