"""Obstacles: convex solids with an exact signed distance, its gradient, and a motion.

This module contains the common part of all shapes: checks, motion, and the distances of one obstacle. The shapes and
their distance formulas are in :mod:`~imitarm.scene.rounded`, :mod:`~imitarm.scene.edged` and
:mod:`~imitarm.scene.convex_hull`.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    Pose,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_multiply,
    quaternion_to_matrix,
)
from imitarm.validation import finite_array, finite_number, finite_points, finite_vector, whole_number

if TYPE_CHECKING:
    from imitarm.scene.convex_hull import Polytope

Array = NDArray[np.float64]
Formula = Callable[..., tuple[Array, Any]]  # distances, and normals where requested
Parameters = tuple[Array | None, ...]

MAX_SIZE = 10.0  # [m] nothing within reach of an arm is larger: a larger number is in the wrong unit
MAX_COORDINATE = 100.0  # [m] nor farther away
MAX_SPEED = 100.0  # [m/s] nor faster
MAX_RATE = 100.0  # [rad/s]
TINY = 1e-9  # [m] a direction shorter than this is mostly rounding error; a fixed direction replaces it
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ONES = np.ones(3)


def checked_vector(value: object, what: str, *, limit: float, unit: str = "") -> Array:
    """Return three finite numbers of magnitude at most ``limit`` as a read-only array."""
    vector = np.array(finite_vector(value, 3, what, unit))
    if np.abs(vector).max() > limit:
        raise InputError(f"{what} {vector.tolist()} is beyond {limit:g} {unit}; give it in {unit}")
    vector.setflags(write=False)
    return vector


def checked_length(value: object, what: str) -> float:
    """Return one positive length [m]."""
    length = finite_number(value, what, "m", above=0.0)
    if length > MAX_SIZE:
        raise InputError(f"{what} {length:g} is beyond {MAX_SIZE:g} m; give it in metres")
    return length


def checked_lengths(value: object, what: str) -> Array:
    """Return three positive lengths [m] as a read-only array."""
    values = checked_vector(value, what, limit=np.inf, unit="m")
    if values.min() <= 0.0:
        raise InputError(f"{what} must be 3 positive numbers [m], got {value!r}")
    if values.max() > MAX_SIZE:
        raise InputError(f"{what} {values.tolist()} is beyond {MAX_SIZE:g} m; give it in metres")
    return values


def lengths(vectors: Array) -> Array:
    """Return the length (...) of each column of ``vectors`` (3, ...)."""
    squares = vectors * vectors
    if squares.ndim > 2:
        return np.sqrt(np.add.reduce(squares, axis=0))
    total: Array = ONES.dot(squares)  # takes a third of the time of a sum
    return np.sqrt(total, out=total)


def below(values: Array, bound: float) -> bool:
    """Return whether any of ``values`` (...) is below ``bound``; none of them may be nan."""
    return values.size > 0 and values.item(values.argmin()) < bound


def rotation_from_z(axis: Array) -> Array:
    """Return a quaternion wxyz (4,) that rotates z into the direction of ``axis`` (3,)."""
    x, y, z = axis.tolist()
    across = math.hypot(x, y)
    if across < 1e-12 * abs(z):
        return UPRIGHT if z >= 0.0 else np.array([0.0, 1.0, 0.0, 0.0])
    half = 0.5 * math.atan2(across, z)
    sine = math.sin(half) / across
    return np.array([math.cos(half), -sine * y, sine * x, 0.0])


class Solid(NamedTuple):
    """The shape, size and pose of one obstacle, in the form that the distance formulas need.

    Attributes:
        kind: one of :data:`~imitarm.scene.distances.KINDS`.
        position: origin of the obstacle's local frame in the base frame, shape (3,) [m].
        quaternion: local_to_base rotation wxyz, shape (4,).
        size: three lengths [m] whose meaning depends on ``kind``, see
            :class:`~imitarm.scene.distances.PackedObstacles`.
        polytope: faces and edges of a convex hull in its local frame; None for other kinds.
    """

    kind: str
    position: Array
    quaternion: Array
    size: Sequence[float] | Array
    polytope: Polytope | None = None


class Family(NamedTuple):
    """Shapes that share a distance formula.

    The formula works in the obstacle's local frame, for any number of obstacles and points. The formula takes points
    ``q`` (3, ...), a flag for normals, and the parameters of its shapes, which broadcast against ``q``. The formula
    returns signed distances (...) [m] and outward unit normals (3, ...); the normals are None if the flag is False. The
    formula may overwrite ``q``.

    Attributes:
        kinds: names of the shapes.
        formula: the distance formula.
        prepare: function that computes the parameters (..., n) from the kinds (n,) and sizes (n, 3) of n obstacles.
    """

    kinds: tuple[str, ...]
    formula: Formula
    prepare: Callable[[Sequence[str], Array], Parameters]


class _Single(NamedTuple):
    """One obstacle, prepared for distance queries."""

    formula: Formula
    to_local: Array | None  # rotation of base vectors into the local frame, shape (3, 3); None when there is none
    center: Array  # of the obstacle, in its own rotation, shape (3, 1) [m]
    parameters: list[Any]  # of the formula, numbers where they are not vectors

    @classmethod
    def of(cls, obstacle: Obstacle) -> _Single:
        """Prepare ``obstacle``."""
        solid, family = obstacle.solid(), obstacle.family
        to_local = quaternion_to_matrix(solid.quaternion).T if solid.quaternion[1:].any() else None
        center = np.array((solid.position if to_local is None else to_local @ solid.position)[:, None])
        center[2] -= obstacle.depth
        if family is None:
            assert solid.polytope is not None
            return cls(solid.polytope.formula, to_local, center, [])
        parameters = family.prepare([solid.kind], np.array([solid.size], dtype=float))
        return cls(family.formula, to_local, center, [p if p is None or p.ndim > 1 else p.item() for p in parameters])


def _distance(single: _Single, p: Array, gradient: bool) -> tuple[Array, Any]:
    """Return the distances (...) [m] of one obstacle and, if ``gradient``, their gradients (..., 3)."""
    formula, to_local, center, parameters = single
    flat = p.ndim == 2
    columns = p.T if flat else p.reshape(-1, 3).T
    if to_local is None:
        q = np.subtract(columns, center, order="C")
    else:
        q = np.dot(to_local, columns)
        q -= center
    distance, normal = formula(q, gradient, *parameters)
    if normal is not None:
        normal = normal.T if to_local is None else np.dot(normal.T, to_local)
        normal = normal if flat else normal.reshape(p.shape)
    return (distance if flat else distance.reshape(p.shape[:-1])), normal


@dataclass(frozen=True, eq=False, kw_only=True)
class Obstacle(ABC):
    """A convex solid in the base frame that must not be touched; it may move at a constant velocity.

    Every shape has an exact signed distance ``sd(x)``. The sign is positive if ``x`` is outside and negative if ``x``
    is inside. The magnitude is the distance from ``x`` to the nearest surface point ``s``::

        |sd(x)| = min_s |x - s|

    The gradient of this distance is a unit vector. Outside, the gradient points from the nearest surface point to
    ``x``. Inside, it points from ``x`` to the nearest surface point. On the surface, it is the outward normal. Because
    the solids are convex, ``sd`` is convex. Between two points, ``sd`` changes by at most the distance between the
    points. The nearest surface point may not be unique, for example at the centre of a sphere. The gradient then refers
    to one of the nearest points, always to the same one for the same ``x``. To keep a distance ``r`` from an obstacle,
    require ``sd(x) >= r``; no inflated copy of the obstacle is needed.

    Attributes:
        velocity: velocity of the shape's centre, in the base frame, shape (3,) [m/s].
        name: name in messages; an obstacle without a name is called, for example, ``"box 1"``.
        angular_velocity: angular velocity about the shape's centre, in the base frame, shape (3,) [rad/s].
        covariance: covariance of the position, shape (3, 3) [m^2]; None if the position is exact or the covariance is
            unknown.
        track_id: number of the obstacle's track in a tracker; None without a tracker.

    Raises:
        InputError: when a number is not finite, a size is not positive, or a number is too large to be in SI units.
    """

    kind: ClassVar[str]  # the shape's name in scene files and messages
    family: ClassVar[Family | None] = None  # None: the polytope of its solid has the formula
    depth: ClassVar[float] = 0.0  # [m] of the point to which the formula refers, below the frame's origin along its z

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
            self._set(**{key: checked_vector(given, f"{self._label}: {key}", limit=limit, unit=unit)})
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
        """Shape and name of the obstacle, for error messages."""
        return f'{type(self).__name__} "{self.name}"' if self.name else type(self).__name__

    def _forget(self) -> None:
        """Clear the cached values of a new copy, which were computed for the old pose."""
        for key in ("_single", "vertices"):
            self.__dict__.pop(key, None)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    @cached_property
    def _single(self) -> _Single:
        return _Single.of(self)

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the surface, negative inside.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Signed distances, shape (...) [m].

        Raises:
            InputError: when the last axis does not have length 3 or a number is not finite.
        """
        return _distance(self._single, finite_points(points), False)[0]

    def gradient(self, points: ArrayLike) -> Array:
        """Return the gradient of :meth:`signed_distance`: unit vectors, shape (..., 3).

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis does not have length 3 or a number is not finite.
        """
        return self.distance_and_gradient(points)[1]

    def distance_and_gradient(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return :meth:`signed_distance` and :meth:`gradient` in one call.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Distances (...) [m] and unit outward normals (..., 3).

        Raises:
            InputError: when the last axis does not have length 3 or a number is not finite.
        """
        return _distance(self._single, finite_points(points), True)

    def distances_at(self, points: Array, gradient: bool) -> tuple[Array, Any]:
        """Return distances and, if ``gradient`` is true, gradients; to save time, the points are not checked.

        Args:
            points: finite float64 points in the base frame, shape (..., 3) [m].
            gradient: whether to compute gradients.

        Returns:
            Distances (...) [m], and gradients (..., 3) or None.
        """
        return _distance(self._single, points, gradient)

    def support(self, directions: ArrayLike) -> Array:
        """Return the farthest point of the solid in each direction (its support mapping, as used by GJK).

        Args:
            directions: directions of any nonzero length, in the base frame, shape (..., 3).

        Returns:
            Points of the surface in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis does not have length 3 or a number is not finite.
        """
        v = finite_points(directions)
        return self._support(v.reshape(-1, 3)).reshape(v.shape)

    def bounds(self) -> Array:
        """Return the lowest and the highest corner of the bounding box along the base's axes, shape (2, 3) [m]."""
        axes = np.eye(3)
        return np.stack([np.diagonal(self.support(-axes)), np.diagonal(self.support(axes))])

    @property
    def moves(self) -> bool:
        """Whether the obstacle has a velocity or an angular velocity."""
        return bool(self.velocity.any() or self.angular_velocity.any())

    def after(self, dt: float) -> Self:
        """Return the obstacle ``dt`` seconds later.

        The obstacle's centre has moved by ``velocity * dt``, and the obstacle has rotated about its centre by
        ``angular_velocity * dt``.

        Args:
            dt: time ahead [s]; a negative value gives an earlier pose.

        Raises:
            InputError: when ``dt`` is not a finite number.
        """
        dt = finite_number(dt, "after: dt", "s")
        if not self.moves or dt == 0.0:
            return self
        moved = copy.copy(self)  # keeps the checked fields and the faces of a hull, which motion does not change
        moved._forget()
        turn = quaternion_exp(dt * self.angular_velocity) if self.angular_velocity.any() else None
        moved._move(dt * self.velocity, turn)
        return moved

    def placed(self, position: Array, quaternion: Array, velocity: Array, angular_velocity: Array) -> Self:
        """Return a copy of the obstacle with another pose and velocity, without checks of the arguments.

        Args:
            position: position of the local frame's origin, see :class:`~imitarm.scene.distances.PackedObstacles`, shape
                (3,) [m].
            quaternion: local_to_base rotation wxyz, shape (4,).
            velocity: velocity of the copy, shape (3,) [m/s].
            angular_velocity: angular velocity of the copy, shape (3,) [rad/s].
        """
        before = self.solid()
        stays = (position == before.position).all() and (quaternion == before.quaternion).all()
        if stays and (velocity == self.velocity).all() and (angular_velocity == self.angular_velocity).all():
            return self
        placed = copy.copy(self)
        placed._forget()
        placed._set(velocity=velocity.copy(), angular_velocity=angular_velocity.copy())
        turns = (quaternion != before.quaternion).any()
        turn = quaternion_multiply(quaternion, quaternion_conjugate(before.quaternion)) if turns else None
        placed._move(position - before.position, turn)
        return placed

    def with_covariance(self, covariance: Array) -> Self:
        """Return a copy of the obstacle with another covariance of its position, shape (3, 3) [m^2], without checks."""
        copied = copy.copy(self)
        copied._set(covariance=covariance.copy())
        return copied

    @abstractmethod
    def solid(self) -> Solid:
        """Return the shape, size and pose in the form that :mod:`~imitarm.scene.distances` needs."""

    @abstractmethod
    def _support(self, directions: Array) -> Array:
        """Farthest points (n, 3) in ``directions`` (n, 3)."""

    @abstractmethod
    def _move(self, offset: Array, turn: Array | None) -> None:
        """Move this new copy by ``offset`` (3,) [m] and rotate it about its centre by ``turn`` (4,)."""


@dataclass(frozen=True, eq=False)
class PosedObstacle(Obstacle):
    """An obstacle with a pose: its local frame is at the centre of its shape.

    Attributes:
        pose: obstacle_to_base: the centre and the rotation.
    """

    lengths: ClassVar[tuple[str, ...]]  # fields of its size: one of three lengths, or two of one length

    pose: Pose

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.pose, Pose):
            raise InputError(f"{self._label}: pose must be a Pose(position, quaternion), got {self.pose!r}")
        checked_vector(self.pose.position, f"{self._label}: position", limit=MAX_COORDINATE, unit="m")
        check: Callable[[object, str], object] = checked_lengths if len(self.lengths) == 1 else checked_length
        self._set(**{key: check(getattr(self, key), f"{self._label}: {key}") for key in self.lengths})

    def solid(self) -> Solid:
        """Return the geometry; its frame is ``pose``."""
        values = [getattr(self, key) for key in self.lengths]
        size = values[0] if len(values) == 1 else (*values, 0.0)
        return Solid(self.kind, self.pose.position, self.pose.quaternion, size)

    def _support(self, directions: Array) -> Array:
        rotation = self.pose.rotation
        return self._local_support((directions @ rotation).T).T @ rotation.T + self.pose.position

    def _move(self, offset: Array, turn: Array | None) -> None:
        quaternion = self.pose.quaternion if turn is None else quaternion_multiply(turn, self.pose.quaternion)
        self._set(pose=Pose.trusted(self.pose.position + offset, quaternion))

    @abstractmethod
    def _local_support(self, v: Array) -> Array:
        """Farthest points (3, n) in directions ``v`` (3, n), both in the local frame."""
