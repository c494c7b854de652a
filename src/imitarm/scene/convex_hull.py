"""ConvexHull: the smallest convex solid around points, and the faces and edges that give its distance."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_multiply, rotate
from imitarm.scene.obstacle import MAX_COORDINATE, MAX_SIZE, TINY, UPRIGHT, Array, Obstacle, Solid
from imitarm.validation import finite_array

_FLAT = 1e-6  # [fraction of the longest extent] a thinner hull is refused as flat
_BLOCK = 512  # points at a time: tables of points times edges stay in the processor's cache
_CLOSE = 1e-5  # [m] nearer than this the edges are compared without cancellation
_ON_PLANE = 1e-12  # [m] rounding of a height over a face
_SAME_PLANE = 1e-12  # neighbouring triangles belong to one face when the cosine of their normals is this near to one


@dataclass(frozen=True)
class Polytope:
    """Faces and edges of a convex hull in its local frame, which moves with the hull.

    If ``n_i.x = b_i`` are the planes of the faces, the distance inside is ``sd = max_i (n_i.x - b_i)``. Outside, this
    maximum is a lower bound of the distance. The bound is exact if the foot point ``x - sd n_i`` is on the face.
    Otherwise, the distance is the smallest distance to an edge.

    Attributes:
        vertices: corners of the hull, shape (v, 3) [m].
        triangles: indices of each triangle's corners in ``vertices``, counter-clockwise seen from outside, shape (k,
            3).
        normals: outward unit normal of each face, shape (m, 3).
        offsets: distance of each face's plane from the centroid, shape (m,) [m].
        cosines: cosines of the angles between the faces' normals, shape (m, m).
        starts: one end of each edge between two faces, shape (3, e) [m].
        directions: unit vectors along the edges, shape (3, e).
        lengths: lengths of the edges, shape (e,) [m].
        starts_along: scalar product of each edge's start and direction, shape (e,) [m].
        starts_twice: ``-2 starts``, shape (3, e) [m].
        starts_squared: ``|starts|²``, shape (e,) [m²].
    """

    vertices: Array
    triangles: NDArray[np.intp]
    normals: Array
    offsets: Array
    cosines: Array
    starts: Array
    directions: Array
    lengths: Array
    starts_along: Array
    starts_twice: Array
    starts_squared: Array

    @cached_property
    def radius(self) -> float:
        """Largest distance of a corner from the origin of the local frame [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @classmethod
    def around(cls, points: Array) -> Polytope:
        """Build the hull of points (n, 3) [m]. Their mean must be the origin, and they must not lie in one plane."""
        from scipy.spatial import ConvexHull as Qhull  # noqa: PLC0415  slow to import, and few scenes need it

        hull = Qhull(points)
        corners = np.sort(hull.vertices)
        vertices = points[corners]
        triangles = np.searchsorted(corners, hull.simplices)
        facing = hull.equations[:, :3]
        a, b, c = np.moveaxis(vertices[triangles], 1, 0)
        inward = np.sum(np.cross(b - a, c - a) * facing, axis=1) < 0.0
        triangles[inward] = triangles[inward][:, ::-1]
        faces = np.unique(np.round(hull.equations, 9), axis=0, return_index=True)[1]
        normals = facing[faces]
        starts, ends = _edges(vertices, triangles, facing)
        lengths = np.linalg.norm(ends - starts, axis=1)
        directions = (ends - starts) / lengths[:, None]
        return cls(
            vertices,
            triangles,
            normals,
            (vertices @ normals.T).max(axis=0),  # supporting planes to the last digit
            normals @ normals.T,
            np.ascontiguousarray(starts.T),
            np.ascontiguousarray(directions.T),
            lengths,
            np.einsum("ij,ij->i", starts, directions),
            np.ascontiguousarray(-2.0 * starts.T),
            np.einsum("ij,ij->i", starts, starts),
        )

    def formula(self, q: Array, gradient: bool) -> tuple[Array, Array | None]:
        """Compute the formula of a :class:`~imitarm.scene.obstacle.Family` for this hull: distances and normals."""
        distance, rows = self.distance_and_normal(np.ascontiguousarray(q.reshape(3, -1).T))
        return distance.reshape(q.shape[1:]), rows.T.reshape(q.shape) if gradient else None

    def distance_and_normal(self, q: Array) -> tuple[Array, Array]:
        """Return signed distances (n,) and unit gradients (n, 3) at ``q`` (n, 3), both in the local frame."""
        if len(q) > _BLOCK:
            parts = [self.distance_and_normal(q[i : i + _BLOCK]) for i in range(0, len(q), _BLOCK)]
            return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
        heights = q @ self.normals.T - self.offsets  # (n, m)
        face = heights.argmax(axis=1)
        distance = heights[np.arange(len(q)), face]
        normal = self.normals[face]
        above = (distance > _ON_PLANE).nonzero()[0]
        if len(above):
            foot_heights = heights[above] - distance[above, None] * self.cosines[face[above]]
            beside = above[foot_heights.max(axis=1) > _ON_PLANE]
            if len(beside):
                away = self._from_edges(q[beside])
                distance[beside] = np.sqrt(np.einsum("ij,ij->i", away, away))
                clear = distance[beside] > TINY  # nearer, the face's normal is the better one
                normal[beside[clear]] = away[clear] / distance[beside[clear], None]
        return distance, normal

    def _from_edges(self, q: Array) -> Array:
        """Return the vectors (n, 3) from the nearest point of any edge to ``q`` (n, 3)."""
        along = q @ self.directions - self.starts_along  # (n, e), as all below
        clipped = np.minimum(np.maximum(along, 0.0), self.lengths)
        along *= -2.0
        along += clipped
        along *= clipped
        along += q @ self.starts_twice
        along += self.starts_squared  # squared distance less |q|²: enough to compare, but rounded at 1e-16 m²
        away = self._from_edge(q, along.argmin(axis=1))
        close = (np.einsum("ij,ij->i", away, away) < _CLOSE**2).nonzero()[0]
        if len(close):
            edges = np.arange(len(self.lengths))
            every = self._from_edge(q[close, None, :], edges)
            away[close] = every[np.arange(len(close)), np.einsum("ijk,ijk->ij", every, every).argmin(axis=1)]
        return away

    def _from_edge(self, q: Array, edge: NDArray[np.intp]) -> Array:
        """Return the vectors (..., 3) from the nearest point of ``edge`` (...) to ``q`` (..., 3)."""
        v, direction = q - self.starts.T[edge], self.directions.T[edge]
        along = np.minimum(np.maximum(np.einsum("...j,...j->...", v, direction), 0.0), self.lengths[edge])
        return v - along[..., None] * direction


def _edges(vertices: Array, triangles: NDArray[np.intp], facing: Array) -> tuple[Array, Array]:
    """Return both ends (e, 3) of every edge where two faces meet; diagonals within a flat face are left out."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(pairs.T)
    pairs, owner = pairs[order], owner[order]
    twin = np.flatnonzero((pairs[1:] == pairs[:-1]).all(axis=1))
    flat = np.einsum("ij,ij->i", facing[owner[twin]], facing[owner[twin + 1]]) > 1.0 - _SAME_PLANE
    keep = np.ones(len(pairs), dtype=bool)
    keep[twin + 1] = False
    keep[twin[flat]] = False
    return vertices[pairs[keep, 0]], vertices[pairs[keep, 1]]


@dataclass(frozen=True, eq=False)
class ConvexHull(Obstacle):
    """The smallest convex solid around ``points``; see :class:`Polytope` for its distance.

    Attributes:
        points: at least 4 points that are not all in one plane, in the base frame, shape (n, 3) [m].
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
                "(for a plate, use a thin Box)"
            )
        polytope = Polytope.around(points - center)
        self._set(points=points, _center=center, _quaternion=UPRIGHT.copy(), _polytope=polytope)

    def _checked_points(self) -> Array:
        points = np.array(finite_array(self.points, (None, 3), f"{self._label}: points", "m"))
        if len(points) < 4:
            raise InputError(f"{self._label}: points must be at least 4 to span a volume, got {len(points)}")
        if np.abs(points).max() > MAX_COORDINATE or np.ptp(points, axis=0).max() > MAX_SIZE:
            raise InputError(
                f"{self._label}: the points reach from {points.min(axis=0).tolist()} to {points.max(axis=0).tolist()}, "
                f"but must span at most {MAX_SIZE:g} m and lie within {MAX_COORDINATE:g} m of the base; give them in "
                "metres"
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
        """Triangles of the surface as indices into ``vertices``, counter-clockwise seen from outside, shape (k, 3)."""
        return self._polytope.triangles.copy()

    def _support(self, directions: Array) -> Array:
        vertices = self.vertices
        return vertices[(directions @ vertices.T).argmax(axis=1)]

    def _move(self, offset: Array, turn: Array | None) -> None:
        if turn is not None:
            points = rotate(turn, self.points - self._center) + self._center
            self._set(points=points, _quaternion=quaternion_multiply(turn, self._quaternion))
        self._set(points=self.points + offset, _center=self._center + offset)
