"""Shapes without edges: Sphere, Capsule and Ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from imitarm.scene.obstacle import (
    MAX_COORDINATE,
    TINY,
    Array,
    Obstacle,
    PosedObstacle,
    checked_length,
    checked_lengths,
    checked_vector,
    lengths,
)

_UP = np.array([0.0, 0.0, 1.0])
_FLOOR = 1e-12  # of the shortest semi-axis: changes no distance by more
_MAX_NEWTON = 100  # far more than any point needs
_NEWTON_TOLERANCE = 1e-5  # of the last step; the error left is its square, and enters the distance squared again


def _unit(vectors: Array, length: Array, instead: Array) -> Array:
    """Return columns (3, n) over their length (n,) as rows (n, 3), and ``instead`` (3,) where there is no direction."""
    unit = np.empty((len(length), 3))
    if np.minimum.reduce(length, initial=1.0) < TINY:
        at_core = length < TINY
        np.divide(vectors, np.where(at_core, 1.0, length), out=unit.T)
        unit[at_core] = instead
    else:
        np.divide(vectors, length, out=unit.T)
    return unit


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
    _column: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        center = checked_vector(self.center, f"{self._label}: center", limit=MAX_COORDINATE, unit="m")
        self._set(center=center, _column=center[:, None], radius=checked_length(self.radius, f"{self._label}: radius"))

    def _distance(self, points: Array) -> Array:
        return lengths(np.subtract(points.T, self._column, order="C")) - self.radius

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        v = np.subtract(points.T, self._column, order="C")
        length = lengths(v)
        return length - self.radius, _unit(v, length, _UP)

    def _support(self, directions: Array) -> Array:
        return self.center + self.radius * _unit(directions.T, lengths(directions.T), _UP)

    def _shift(self, offset: Array) -> None:
        center = self.center + offset
        self._set(center=center, _column=center[:, None])


@dataclass(frozen=True, eq=False)
class Capsule(Obstacle):
    """All points within ``radius`` of the segment from ``start`` to ``end``: ``sd(x) = |x - s(x)| - r``.

    ``s(x) = a + clip((x - a)·u, 0, L) u`` is the nearest point of the segment, with ``u`` its direction and
    ``L`` its length. Its overall length is ``L + 2 r``. A segment of length zero makes a sphere.

    Attributes:
        start: one end of the segment, in the base frame, shape (3,) [m].
        end: the other end, shape (3,) [m].
        radius: [m].
    """

    kind: ClassVar[str] = "capsule"

    start: Array
    end: Array
    radius: float
    _column: Array = field(init=False, repr=False)
    _axis: Array = field(init=False, repr=False)
    _length: float = field(init=False, repr=False)
    _across: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        start = checked_vector(self.start, f"{self._label}: start", limit=MAX_COORDINATE, unit="m")
        end = checked_vector(self.end, f"{self._label}: end", limit=MAX_COORDINATE, unit="m")
        length = float(np.linalg.norm(end - start))
        axis = (end - start) / length if length > TINY else _UP
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])  # the axis least along: never parallel
        self._set(
            start=start, end=end, _column=start[:, None], radius=checked_length(self.radius, f"{self._label}: radius")
        )
        checked_length(length + self.radius, f"{self._label}: length")
        self._set(_axis=axis, _length=length, _across=across / np.linalg.norm(across))

    def _from_segment(self, points: Array) -> Array:
        v = np.subtract(points.T, self._column, order="C")
        along = np.minimum(np.maximum(self._axis @ v, 0.0), self._length)
        v -= self._axis[:, None] * along
        return v

    def _distance(self, points: Array) -> Array:
        return lengths(self._from_segment(points)) - self.radius

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        v = self._from_segment(points)
        length = lengths(v)
        return length - self.radius, _unit(v, length, self._across)

    def _support(self, directions: Array) -> Array:
        ends = np.where((directions @ self._axis > 0.0)[:, None], self.end, self.start)
        return ends + self.radius * _unit(directions.T, lengths(directions.T), _UP)

    def _shift(self, offset: Array) -> None:
        start = self.start + offset
        self._set(start=start, end=self.end + offset, _column=start[:, None])


@dataclass(frozen=True, eq=False)
class Ellipsoid(PosedObstacle):
    """All points with ``Σ (y_j / γ_j)² <= 1`` in its own frame; ``γ`` are the semi-axes.

    The surface point nearest to ``y`` is ``e_j = γ_j² y_j / (t + γ_j²)``, where ``t`` is the largest root of
    ``F(t) = Σ (γ_j y_j / (t + γ_j²))² - 1`` (METHODS D.2.1). With ``s = t + min γ²`` the function
    ``h(s) = 1 / √(F + 1)`` is concave and rises, so Newton's method on ``h = 1`` from the left never steps over the
    root and needs no bracket. The normal ``n`` at ``e`` then gives the distance as that to a supporting plane,
    ``sd = n·y - √(Σ γ_j² n_j²)``: an error in ``n`` enters squared, and never makes the distance too large.

    Attributes:
        pose: obstacle_to_base, at the centre; the semi-axes are along its x, y and z.
        semi_axes: half of each diameter, shape (3,) [m].
    """

    kind: ClassVar[str] = "ellipsoid"

    semi_axes: Array
    _shortest: int = field(init=False, repr=False)
    _beyond: Array = field(init=False, repr=False)  # γ_j² - min γ²

    def __post_init__(self) -> None:
        super().__post_init__()
        semi_axes = checked_lengths(self.semi_axes, f"{self._label}: semi_axes")
        shortest = int(np.argmin(semi_axes))
        beyond = (semi_axes - semi_axes[shortest]) * (semi_axes + semi_axes[shortest])
        self._set(semi_axes=semi_axes, _shortest=shortest, _beyond=beyond[:, None])

    def _distance(self, points: Array) -> Array:
        return self._solve(np.abs(self._local(points)))[0]

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        q = self._local(points)
        distance, normal = self._solve(np.abs(q))
        return distance, self._to_base(np.copysign(normal, q))

    def _solve(self, y: Array) -> tuple[Array, Array]:
        """Distances (n,) and unit normals (3, n) of points (3, n) with no negative coordinate."""
        semi_axes = self.semi_axes[:, None]
        floor = _FLOOR * self.semi_axes[self._shortest]  # off the plane of symmetry, where s and y vanish together
        y[self._shortest] = np.maximum(y[self._shortest], floor)
        scaled = semi_axes * y
        s = np.maximum.reduce(scaled - self._beyond, axis=0)  # each term alone says F >= 0 here
        for _ in range(_MAX_NEWTON):
            shifted = s + self._beyond
            terms = scaled / shifted
            terms *= terms
            total = np.add.reduce(terms, axis=0)  # F + 1
            terms /= shifted
            step = total * (np.sqrt(total) - 1.0) / np.add.reduce(terms, axis=0)
            s += step
            if np.maximum.reduce(step / s, initial=0.0) < _NEWTON_TOLERANCE:
                break
        normal = y / (s + self._beyond)
        normal /= lengths(normal)
        reach = semi_axes * normal
        return np.add.reduce(normal * y, axis=0) - lengths(reach), normal

    def _local_support(self, v: Array) -> Array:
        reach = self.semi_axes[:, None] * v
        return self.semi_axes[:, None] * reach / lengths(reach)
