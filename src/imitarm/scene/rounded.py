"""Shapes without edges: Sphere, Capsule and Ellipsoid, with their distance formulas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from imitarm.kinematics.pose import rotate
from imitarm.scene.obstacle import (
    MAX_COORDINATE,
    ONES,
    TINY,
    UPRIGHT,
    Array,
    Family,
    Obstacle,
    Parameters,
    PosedObstacle,
    Solid,
    below,
    checked_length,
    checked_vector,
    lengths,
    rotation_from_z,
)
from imitarm.validation import finite_points

_FLOAT64 = np.dtype(np.float64)
_MAX_NEWTON = 100  # many more steps than any point needs
_NEWTON_TOLERANCE = 1e-3  # of the last step; the remaining error is its square, and enters the distance squared again
_FLOOR = 1e-12  # [fraction of the shortest semi-axis] changes a distance by less than that


def rounds(q: Array, gradient: bool, radius: Array, half: Array | None) -> tuple[Array, Array | None]:
    """Return distances to spheres and capsules: the distance to a segment along z, minus the radius.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        radius: radius of the shape, shape (...) [m].
        half: half of the segment's length, shape (...) [m], 0 for a sphere; None when all are spheres.
    """
    if half is not None:
        q[2] -= np.minimum(np.maximum(q[2], -half), half)
    core = lengths(q)
    distance = core - radius
    if not gradient:
        return distance, None
    if below(core, TINY):
        inside = core < TINY
        np.copyto(q, np.array([1.0, 0.0, 0.0]).reshape(3, *[1] * core.ndim), where=inside)
        core[inside] = 1.0
    q /= core
    return distance, q


def _prepare_rounds(kinds: Sequence[str], sizes: Array) -> Parameters:
    return sizes[:, 0].copy(), 0.5 * sizes[:, 1] if "capsule" in kinds else None


ROUNDS = Family(("sphere", "capsule"), rounds, _prepare_rounds)


@dataclass(frozen=True, eq=False)
class Sphere(Obstacle):
    """All points within ``radius`` of ``center``: ``sd(x) = |x - c| - r``.

    Attributes:
        center: centre in the base frame, shape (3,) [m].
        radius: radius of the sphere [m].
    """

    kind: ClassVar[str] = "sphere"
    family: ClassVar[Family] = ROUNDS

    center: Array
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        center = checked_vector(self.center, f"{self._label}: center", limit=MAX_COORDINATE, unit="m")
        self._set(center=center, radius=checked_length(self.radius, f"{self._label}: radius"))

    def solid(self) -> Solid:
        """Return the geometry; its frame is at the centre and not rotated."""
        return Solid(self.kind, self.center, UPRIGHT, (self.radius, 0.0, 0.0))

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the surface, negative inside.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Signed distances, shape (...) [m].

        Raises:
            InputError: when the last axis does not have length 3 or a number is not finite.
        """
        if type(points) is np.ndarray and points.dtype is _FLOAT64 and points.shape[1:] == (3,) and len(points) > 1:
            offsets: Array = np.subtract(points.T, self._single.center, order="C")
            offsets *= offsets
            squares: Array = ONES.dot(offsets)
            if math.isfinite(squares.dot(squares)):  # only if every coordinate is finite
                np.sqrt(squares, out=squares)
                squares -= self.radius
                return squares
        offsets = finite_points(points) - self.center
        return np.asarray(np.sqrt(np.dot(offsets * offsets, ONES)) - self.radius)

    def _support(self, directions: Array) -> Array:
        return self.center + self.radius * _unit(directions)

    def _move(self, offset: Array, turn: Array | None) -> None:
        self._set(center=self.center + offset)


@dataclass(frozen=True, eq=False)
class Capsule(Obstacle):
    """All points within ``radius`` of the segment from ``start`` to ``end``: ``sd(x) = |x - s(x)| - r``.

    ``s(x) = a + clip((x - a).u, 0, L) u`` is the nearest point of the segment. The segment has the start ``a``, the
    direction ``u`` and the length ``L``. The overall length is ``L + 2 r``. If the segment has length zero, the capsule
    is a sphere.

    Attributes:
        start: one end of the segment, in the base frame, shape (3,) [m].
        end: other end, shape (3,) [m].
        radius: radius of the capsule [m].
    """

    kind: ClassVar[str] = "capsule"
    family: ClassVar[Family] = ROUNDS

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


def _unit(vectors: Array) -> Array:
    """Return rows (n, 3) scaled to length one; z for rows of length zero."""
    length = lengths(vectors.T)[:, None]
    return np.where(length < TINY, [0.0, 0.0, 1.0], vectors / np.where(length < TINY, 1.0, length))


def ellipsoids(q: Array, gradient: bool, semi_axes: Array, beyond: Array, floor: Array) -> tuple[Array, Array | None]:
    """Return distances to ellipsoids; Newton's method finds the nearest surface point and its normal.

    Let ``g`` be the semi-axes. The surface point nearest to ``y`` is ``e_j = g_j^2 y_j / (t + g_j^2)``. Here, ``t`` is
    the largest root of ``F(t) = sum_j (g_j y_j / (t + g_j^2))^2 - 1``. With ``s = t + min g^2`` the function ``h(s) = 1
    / sqrt(F + 1)`` is concave and increasing. Therefore, if Newton's method for ``h = 1`` starts to the left of the
    root, it never steps over the root. With the unit normal ``n`` at the surface point ``e``, the distance is ``n.y -
    sqrt(sum_j g_j^2 n_j^2)``. An error in ``n`` has only a quadratic effect on the distance and never makes it too
    large.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        semi_axes: lengths of the semi-axes, shape (3, ...) [m].
        beyond: ``g_j^2 - min g^2``, shape (3, ...) [m^2].
        floor: lower bound for the absolute values of the coordinates, shape (3, ...) [m]; positive along the shortest
            axis, 0 along the other axes.
    """
    y = np.maximum(np.abs(q), floor)  # off the plane of symmetry, where s and y vanish together
    scaled = semi_axes * y
    s = np.maximum.reduce(scaled - beyond, axis=0)  # each term alone says F >= 0 here
    for _ in range(_MAX_NEWTON):
        shifted = s + beyond
        terms = scaled / shifted
        terms *= terms
        total = np.add.reduce(terms, axis=0)  # F + 1
        terms /= shifted
        step = (np.sqrt(total) - 1.0) * total
        step /= np.add.reduce(terms, axis=0)
        s += step
        if np.maximum.reduce(step / s, axis=None, initial=0.0) < _NEWTON_TOLERANCE:
            break
    normal = y / (s + beyond)
    normal /= lengths(normal)
    distance = np.add.reduce(normal * y, axis=0)
    distance -= lengths(semi_axes * normal)
    return distance, np.copysign(normal, q, out=normal) if gradient else None


def _prepare_ellipsoids(_kinds: Sequence[str], sizes: Array) -> Parameters:
    semi_axes = np.ascontiguousarray(sizes.T)
    shortest = semi_axes.min(axis=0)
    floor = np.zeros_like(semi_axes)
    floor[semi_axes.argmin(axis=0), np.arange(len(sizes))] = _FLOOR * shortest
    return semi_axes, (semi_axes - shortest) * (semi_axes + shortest), floor


ELLIPSOIDS = Family(("ellipsoid",), ellipsoids, _prepare_ellipsoids)


@dataclass(frozen=True, eq=False)
class Ellipsoid(PosedObstacle):
    """All points with ``sum_j (y_j / g_j)^2 <= 1`` in its local frame; ``g`` are the semi-axes.

    Attributes:
        pose: obstacle_to_base, at the centre; the semi-axes are along its x, y and z.
        semi_axes: half of each diameter, shape (3,) [m].
    """

    kind: ClassVar[str] = "ellipsoid"
    family: ClassVar[Family] = ELLIPSOIDS
    lengths: ClassVar[tuple[str, ...]] = ("semi_axes",)

    semi_axes: Array

    def _local_support(self, v: Array) -> Array:
        reach = self.semi_axes[:, None] * v
        return self.semi_axes[:, None] * reach / lengths(reach)
