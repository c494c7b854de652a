"""What an obstacle is: a convex solid with an exact signed distance, its gradient and a velocity.

The shapes are in :mod:`~imitarm.scene.rounded` (Sphere, Capsule, Ellipsoid), :mod:`~imitarm.scene.edged`
(Box, Cylinder, Cone) and :mod:`~imitarm.scene.hull` (ConvexHull); all come with ``from imitarm.scene import Box``.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose

Array = NDArray[np.float64]

MAX_SIZE = 10.0  # [m] nothing in the reach of an arm is larger: such a number is in the wrong unit
MAX_COORDINATE = 100.0  # [m] nor farther away
MAX_SPEED = 100.0  # [m/s] nor faster
TINY = 1e-9  # [m] below this length a direction is mostly rounding noise and a fixed one is taken instead


def checked_vector(value: object, what: str, *, limit: float, unit: str) -> Array:
    """Return three finite numbers of magnitude at most ``limit`` as a read-only array, or say what is wrong.

    Args:
        value: what was given.
        what: how to name it in the error, for example ``"Sphere: center"``.
        limit: the largest magnitude that makes sense.
        unit: the unit that is expected.

    Raises:
        InputError: when it is not three finite numbers, or one is too large to be in ``unit``.
    """
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{what} must be 3 finite numbers [{unit}], got {value!r}")
    if np.abs(vector).max() > limit:
        raise InputError(f"{what} {vector.tolist()} is beyond {limit:g} {unit}; give it in {unit}")
    vector.setflags(write=False)
    return vector


def checked_length(value: object, what: str) -> float:
    """Return one positive length [m], or say what is wrong.

    Raises:
        InputError: when it is not one finite, positive number, or is too large to be in metres.
    """
    try:
        length = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        length = float("nan")
    if not length > 0.0 or not np.isfinite(length):
        raise InputError(f"{what} must be one positive, finite number [m], got {value!r}")
    if length > MAX_SIZE:
        raise InputError(f"{what} {length:g} is beyond {MAX_SIZE:g} m; give it in metres")
    return length


def checked_lengths(value: object, what: str) -> Array:
    """Return three positive lengths [m] as a read-only array, or say what is wrong.

    Raises:
        InputError: when they are not three finite, positive numbers, or one is too large to be in metres.
    """
    lengths = checked_vector(value, what, limit=np.inf, unit="m")
    if lengths.min() <= 0.0:
        raise InputError(f"{what} must be 3 positive numbers [m], got {value!r}")
    if lengths.max() > MAX_SIZE:
        raise InputError(f"{what} {lengths.tolist()} is beyond {MAX_SIZE:g} m; give it in metres")
    return lengths


@dataclass(frozen=True, eq=False, kw_only=True)
class Obstacle(ABC):
    """A convex solid in the base frame that must not be touched; it may move at a constant velocity.

    Every shape answers with its exact signed distance::

        sd(x) =  min |x - s| over the surface points s   when x is outside
        sd(x) = -min |x - s| over the surface points s   when x is inside

    and the gradient of it, a unit vector: outside it points from the nearest surface point to ``x``,
    inside from ``x`` to the nearest surface point, on the surface along the outward normal. Because the solids
    are convex, ``sd`` is convex and changes by at most one metre a metre (METHODS D.2.1). Where the nearest surface
    point is not unique (the centre of a sphere, the medial axis of a box) one of them is taken, always the same
    for the same input. To keep a distance ``r`` from an obstacle, ask for ``sd(x) >= r``: no inflated copy is needed.

    Points have any leading shape and one call treats them all. They must be finite: a nan gives a distance of nan.

    Attributes:
        velocity: of all its points, in the base frame, shape (3,) [m/s]; 0 for one that stands.
        name: how messages call it; a :class:`~imitarm.scene.Scene` falls back on ``"box 1"``.

    Raises:
        InputError: when a number is not finite, a size is not positive, or a number is so large that it can't be
            in SI units.
    """

    kind: ClassVar[str]  # the shape's name in scene files and messages

    velocity: Array = field(default_factory=lambda: np.zeros(3))
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isprintable():
            raise InputError(f"{type(self).__name__}: name must be one line of text, got {self.name!r}")
        velocity = np.zeros(3) if np.isscalar(self.velocity) and self.velocity == 0 else self.velocity
        self._set(velocity=checked_vector(velocity, f"{self._label}: velocity", limit=MAX_SPEED, unit="m/s"))

    @property
    def _label(self) -> str:
        """The obstacle in an error message."""
        return f'{type(self).__name__} "{self.name}"' if self.name else type(self).__name__

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the surface, negative inside.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (...) [m].

        Raises:
            InputError: when the last axis has not length 3.
        """
        p = np.asarray(points, dtype=float)
        if p.ndim == 2 and p.shape[1] == 3:
            return self._distance(p)
        return self._distance(_rows(p)).reshape(p.shape[:-1])

    def gradient(self, points: ArrayLike) -> Array:
        """Return the gradient of :meth:`signed_distance`: unit vectors, shape (..., 3).

        Args:
            points: in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis has not length 3.
        """
        return self.distance_and_gradient(points)[1]

    def distance_and_gradient(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return :meth:`signed_distance` and :meth:`gradient` for the price of about one.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Distances (...) [m] and unit outward normals (..., 3).

        Raises:
            InputError: when the last axis has not length 3.
        """
        p = np.asarray(points, dtype=float)
        if p.ndim == 2 and p.shape[1] == 3:
            return self._distance_and_gradient(p)
        distance, gradient = self._distance_and_gradient(_rows(p))
        return distance.reshape(p.shape[:-1]), gradient.reshape(p.shape)

    def support(self, directions: ArrayLike) -> Array:
        """Return the farthest point of the solid in each direction, the one query that GJK needs.

        Args:
            directions: of any length but zero, in the base frame, shape (..., 3).

        Returns:
            Points of the surface in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis has not length 3.
        """
        v = np.asarray(directions, dtype=float)
        return self._support(_rows(v)).reshape(v.shape)

    def bounds(self) -> Array:
        """Return the lowest and the highest corner of the box along the base frame's axes, shape (2, 3) [m]."""
        axes = np.eye(3)
        return np.stack([np.diagonal(self.support(-axes)), np.diagonal(self.support(axes))])

    def after(self, dt: float) -> Self:
        """Return the obstacle ``dt`` seconds later, moved by ``velocity * dt``.

        Args:
            dt: time ahead [s]; negative looks back.
        """
        if not self.velocity.any() or dt == 0.0:
            return self
        moved = copy.copy(self)  # keeps what construction worked out: motion changes no rotation and no hull
        moved._shift(self.velocity * dt)
        return moved

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """Signed distances (n,) of ``points`` (n, 3)."""

    @abstractmethod
    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Signed distances (n,) and unit gradients (n, 3) of ``points`` (n, 3)."""

    @abstractmethod
    def _support(self, directions: Array) -> Array:
        """Farthest points (n, 3) in ``directions`` (n, 3)."""

    @abstractmethod
    def _shift(self, offset: Array) -> None:
        """Move this fresh copy by ``offset`` (3,) [m]."""


def lengths(vectors: Array) -> Array:
    """Return the length (n,) of each column of ``vectors`` (k, n)."""
    return np.sqrt(np.add.reduce(vectors * vectors, axis=0))


def _rows(p: Array) -> Array:
    """Return points (..., 3) as (n, 3)."""
    if p.shape[-1:] != (3,):
        raise InputError(f"points must have shape (..., 3), got {p.shape}")
    return p.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class PosedObstacle(Obstacle):
    """An obstacle that is described in a frame of its own, at its centre.

    Attributes:
        pose: obstacle_to_base: the centre and the rotation.
    """

    pose: Pose
    _to_own: Array = field(init=False, repr=False)  # rotation of base vectors into the own frame
    _own_center: Array = field(init=False, repr=False)  # the base frame's centre of the obstacle, so rotated (3, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.pose, Pose):
            raise InputError(f"{self._label}: pose must be a Pose(position, quaternion), got {self.pose!r}")
        checked_vector(self.pose.position, f"{self._label}: position", limit=MAX_COORDINATE, unit="m")
        self._set(_to_own=np.ascontiguousarray(self.pose.rotation.T))
        self._place()

    def _place(self) -> None:
        self._set(_own_center=(self._to_own @ self.pose.position)[:, None])

    def _local(self, points: Array) -> Array:
        """Base coordinates (n, 3) to own coordinates (3, n): one contiguous row for each axis is the fast layout."""
        own: Array = np.dot(self._to_own, points.T)
        own -= self._own_center
        return own

    def _to_base(self, vectors: Array) -> Array:
        """Own vectors (3, n) to base vectors (n, 3)."""
        return np.dot(vectors.T, self._to_own)

    def _support(self, directions: Array) -> Array:
        return self._to_base(self._local_support(self._to_own @ directions.T)) + self.pose.position

    @abstractmethod
    def _local_support(self, v: Array) -> Array:
        """Farthest points (3, n), own coordinates, in directions ``v`` (3, n)."""

    def _shift(self, offset: Array) -> None:
        self._set(pose=Pose(self.pose.position + offset, self.pose.quaternion))
        self._place()
