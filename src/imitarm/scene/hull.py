"""ConvexHull: the smallest convex solid around some points, for everything that has flat faces."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene.obstacle import MAX_COORDINATE, MAX_SIZE, TINY, Array, Obstacle

_FLAT = 1e-6  # a hull thinner than this share of its longest extent is taken as flat
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
    """

    vertices: Array
    triangles: NDArray[np.intp]
    normals: Array
    offsets: Array
    cosines: Array
    starts: Array
    directions: Array
    lengths: Array

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
        return cls(
            vertices,
            triangles,
            normals,
            (vertices @ normals.T).max(axis=0),  # supporting planes to the last digit
            normals @ normals.T,
            np.ascontiguousarray(starts.T),
            np.ascontiguousarray(((ends - starts) / lengths[:, None]).T),
            lengths,
        )


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
        polytope = self._polytope
        q = points - self._centroid
        heights = q @ polytope.normals.T - polytope.offsets  # (n, m)
        face = heights.argmax(axis=1)
        distance = heights[np.arange(len(q)), face]
        normal = polytope.normals[face]
        above = np.flatnonzero(distance > TINY)
        if len(above):
            foot_heights = heights[above] - distance[above, None] * polytope.cosines[face[above]]
            beside = above[foot_heights.max(axis=1) > TINY]
            if len(beside):
                distance[beside], normal[beside] = self._to_edges(q[beside])
        return distance, normal

    def _to_edges(self, q: Array) -> tuple[Array, Array]:
        """Distances (n,) from the nearest edges to ``q`` (n, 3), relative to the centroid, and directions (n, 3)."""
        polytope = self._polytope
        x, y, z = q.T[:, :, None] - polytope.starts[:, None, :]  # (n, e) each
        u, v, w = polytope.directions
        along = np.minimum(np.maximum(x * u + y * v + z * w, 0.0), polytope.lengths)
        x -= along * u
        y -= along * v
        z -= along * w
        squared = x * x + y * y + z * z
        rows, nearest = np.arange(len(q)), squared.argmin(axis=1)
        distance = np.sqrt(squared[rows, nearest])
        away = np.stack([x[rows, nearest], y[rows, nearest], z[rows, nearest]], axis=1)
        return distance, away / distance[:, None]

    def _support(self, directions: Array) -> Array:
        vertices = self._polytope.vertices
        return vertices[(directions @ vertices.T).argmax(axis=1)] + self._centroid

    def _shift(self, offset: Array) -> None:
        self._set(points=self.points + offset, _centroid=self._centroid + offset)
