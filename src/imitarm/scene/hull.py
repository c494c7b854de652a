"""ConvexHull: the smallest convex solid around some points, for everything that has flat faces."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene.obstacle import MAX_COORDINATE, MAX_SIZE, TINY, Array, Obstacle

_FLAT = 1e-6  # a hull thinner than this share of its longest extent is taken as flat
_BLOCK = 512  # points at a time: tables of points times edges stay in the processor's cache
_CLOSE = 1e-5  # [m] nearer than this the edges are compared without cancellation
_ON_PLANE = 1e-12  # [m] rounding of a height over a face
_SAME_PLANE = 1e-12  # neighbouring triangles whose normals' cosine is this near to one share a face


@dataclass(frozen=True)
class _Polytope:
    """Faces and edges of a hull, relative to its centroid, so that a moved hull keeps them.

    Attributes:
        vertices: corners of the hull, shape (v, 3) [m].
        triangles: rows of ``vertices``, counter-clockwise seen from outside, shape (k, 3).
        normals: outward unit normal of each face, shape (m, 3).
        offsets: distance of each face's plane from the centroid, shape (m,) [m].
        cosines: between the faces' normals, shape (m, m).
        starts: one end of each edge between two faces, shape (3, e) [m].
        directions: unit vectors along the edges, shape (3, e).
        lengths: of the edges, shape (e,) [m].
        starts_along: ``starts·directions`` of each edge, shape (e,) [m].
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

    @classmethod
    def around(cls, points: Array) -> _Polytope:
        """Build from centred points (n, 3) that span space."""
        from scipy.spatial import ConvexHull as Qhull  # noqa: PLC0415  takes long to import, and few scenes need it

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

    def distance_and_normal(self, q: Array) -> tuple[Array, Array]:
        """Return signed distances (n,) and unit gradients (n, 3) at ``q`` (n, 3), relative to the centroid."""
        heights = q @ self.normals.T - self.offsets  # (n, m)
        face = heights.argmax(axis=1)
        distance = heights[np.arange(len(q)), face]
        normal = self.normals[face]
        above = np.flatnonzero(distance > _ON_PLANE)
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
        close = np.flatnonzero(np.einsum("ij,ij->i", away, away) < _CLOSE**2)
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
    """The smallest convex solid around ``points``.

    With the planes ``n_i·x = b_i`` of its faces, inside ``sd = max_i (n_i·x - b_i)``. Outside that maximum is a lower
    bound, and it is the distance when its foot ``x - sd n_i`` is on the face; otherwise the nearest point is on an
    edge or at a corner, and the distance is the smallest one to an edge.

    Attributes:
        points: at least 4 that are not all in one plane, in the base frame, shape (n, 3) [m].
    """

    kind: ClassVar[str] = "convex_hull"

    points: Array
    _centroid: Array = field(init=False, repr=False)
    _polytope: _Polytope = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        points = self._checked_points()
        centroid = points.mean(axis=0)
        spread = np.linalg.svd(points - centroid, compute_uv=False)
        if spread[-1] <= _FLAT * spread[0]:
            raise InputError(
                f"{self._label}: the {len(points)} points lie in one plane; a hull needs points that span a volume "
                "(a thin Box does for a plate)"
            )
        self._set(points=points, _centroid=centroid, _polytope=_Polytope.around(points - centroid))

    def _checked_points(self) -> Array:
        try:
            points = np.array(self.points, dtype=float)
        except (TypeError, ValueError):
            points = np.empty(0)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{self._label}: points must be a table of numbers with 3 columns [m]")
        if len(points) < 4:
            raise InputError(f"{self._label}: points must be at least 4 to span a volume, got {len(points)}")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise InputError(f"{self._label}: points[{bad[0]}] is not finite: {points[bad[0]].tolist()}")
        if np.abs(points).max() > MAX_COORDINATE or np.ptp(points, axis=0).max() > MAX_SIZE:
            raise InputError(
                f"{self._label}: points reach from {points.min(axis=0).tolist()} to {points.max(axis=0).tolist()}, "
                f"beyond {MAX_SIZE:g} m in size or {MAX_COORDINATE:g} m in place; give them in metres"
            )
        points.setflags(write=False)
        return points

    @property
    def vertices(self) -> Array:
        """Those of ``points`` that are corners of the hull, shape (v, 3) [m]."""
        return self._polytope.vertices + self._centroid

    @property
    def triangles(self) -> NDArray[np.intp]:
        """Surface as rows of ``vertices``, counter-clockwise seen from outside, shape (k, 3)."""
        return self._polytope.triangles.copy()

    def _distance(self, points: Array) -> Array:
        return self._distance_and_gradient(points)[0]

    def _distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        for i in range(0, len(points), _BLOCK):
            part = slice(i, i + _BLOCK)
            distance[part], normal[part] = self._polytope.distance_and_normal(points[part] - self._centroid)
        return distance, normal

    def _support(self, directions: Array) -> Array:
        vertices = self._polytope.vertices
        return vertices[(directions @ vertices.T).argmax(axis=1)] + self._centroid

    def _shift(self, offset: Array) -> None:
        self._set(points=self.points + offset, _centroid=self._centroid + offset)
