"""The distance formula of each family of shapes, in the obstacle's local frame, for any number of obstacles and points.

A formula takes points ``q`` (3, ...), a flag for normals, and the parameters of its shapes, which broadcast against
``q``. It returns signed distances (...) [m] and outward unit normals (3, ...), or None.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Formula = Callable[..., tuple[Array, Any]]  # distances, and normals where requested
Parameters = tuple[Array | None, ...]

TINY = 1e-9  # [m] a direction shorter than this is mostly rounding error; a fixed direction replaces it
DEPTH = 1e3  # [m] a half-space is a box of this half height without ends: same distance wherever an arm can be

_MAX_NEWTON = 100  # many more steps than any point needs
_NEWTON_TOLERANCE = 1e-3  # of the last step; the remaining error is its square, and enters the distance squared again
_FLOOR = 1e-12  # [fraction of the shortest semi-axis] changes a distance by less than that
_BLOCK = 512  # points at a time: tables of points times edges stay in the processor's cache
_CLOSE = 1e-5  # [m] nearer than this the edges are compared without cancellation
_ON_PLANE = 1e-12  # [m] rounding of a height over a face
_SAME_PLANE = 1e-12  # neighbouring triangles belong to one face when the cosine of their normals is this near to one


def lengths(vectors: Array) -> Array:
    """Return the length (...) of each column of ``vectors`` (k, ...)."""
    return np.sqrt(np.add.reduce(vectors * vectors, axis=0))


def rounds(q: Array, gradient: bool, radius: Array, half: Array | None) -> tuple[Array, Array | None]:
    """Spheres and capsules: the distance to the nearest point of a segment along z, less the radius.

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
    if np.minimum.reduce(core, axis=None, initial=1.0) < TINY:
        inside = core < TINY
        np.copyto(q, np.array([1.0, 0.0, 0.0]).reshape(3, *[1] * core.ndim), where=inside)
        core[inside] = 1.0
    q /= core
    return distance, q


def _prepare_rounds(kinds: Sequence[str], sizes: Array) -> Parameters:
    return sizes[:, 0].copy(), 0.5 * sizes[:, 1] if "capsule" in kinds else None


def slabs(
    q: Array, gradient: bool, half: Array, rounding: Array | None, turned: Array | None
) -> tuple[Array, Array | None]:
    """Boxes, cylinders and half-spaces are boxes of half size ``half``, rounded by ``rounding``.

    With ``a = |q| - half`` the distance is ``|max(a, 0)| + min(max_j a_j, 0) - rounding``. A half-space is a box of
    infinite size. A cylinder (``turned``) is a box in ``(rho, z)`` with ``rho^2 = x^2 + y^2``. If a scene also contains
    such shapes, a sphere is computed as a rounded point and a capsule as a rounded segment.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        half: half edge lengths, shape (3, ...) [m].
        rounding: radius of the rounding, shape (...) [m]; None: 0.
        turned: whether each shape is a cylinder, shape (...); None: no cylinders.
    """
    a = np.abs(q)
    if turned is not None:
        rho = np.hypot(q[0], q[1])
        np.copyto(a[0], rho, where=turned)
    a -= half
    out = np.maximum(a, 0.0)
    core = lengths(out)
    largest = np.maximum.reduce(a, axis=0)
    distance = core + np.minimum(largest, 0.0)
    if rounding is not None:
        distance -= rounding
    if not gradient:
        return distance, None
    if np.minimum.reduce(core, axis=None, initial=1.0) >= TINY:
        out /= core
    else:
        inside = core < TINY  # or on the surface: the normal of the nearest face, the first of equals
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


def ellipsoids(q: Array, gradient: bool, semi_axes: Array, beyond: Array, floor: Array) -> tuple[Array, Array | None]:
    """Ellipsoids: the supporting plane at the nearest surface point, found by Newton's method.

    The surface point nearest to ``y`` is ``e_j = g_j^2 y_j / (t + g_j^2)`` with semi-axes ``g``, where ``t`` is the
    largest root of ``F(t) = sum_j (g_j y_j / (t + g_j^2))^2 - 1``. With ``s = t + min g^2`` the function
    ``h(s) = 1 / sqrt(F + 1)`` is concave and rises, so Newton's method on ``h = 1`` from the left never steps over the
    root and needs no bracket. With the unit normal ``n`` at ``e`` the distance is ``n.y - sqrt(sum_j g_j^2 n_j^2)``: an
    error in ``n`` has a quadratic effect and never makes the distance too large.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        semi_axes: lengths of the semi-axes, shape (3, ...) [m].
        beyond: ``g_j^2 - min g^2``, shape (3, ...) [m^2].
        floor: smallest value of the coordinate along the shortest axis, 0 along the other axes, shape (3, ...) [m].
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


def cones(
    q: Array, gradient: bool, radius: Array, height: Array, slant: Array, side: Array
) -> tuple[Array, Array | None]:
    """Cones, which are triangles in the half-plane ``(rho, z)``: base at ``-height/2``, tip at ``+height/2``.

    Outside, the distance is the smaller distance to two segments, the slant side and the base; inside, it is the larger
    signed distance to their lines.

    Args:
        q: points in the local frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        radius: radius of the base, shape (...) [m].
        height: height of the cone, shape (...) [m].
        slant: length of the side, shape (...) [m].
        side: outward normal of the side in ``(rho, z)``, shape (2, ...).
    """
    rho = np.hypot(q[0], q[1])
    base = np.stack([rho - radius, q[2] + 0.5 * height])  # from the rim
    n_rho, n_z = side
    over_side, over_base = n_rho * base[0] + n_z * base[1], -base[1]
    along = np.minimum(np.maximum(n_rho * base[1] - n_z * base[0], 0.0), slant)
    from_side = np.stack([base[0] + n_z * along, base[1] - n_rho * along])
    np.maximum(base[0], 0.0, out=base[0])  # the base reaches from the axis to the rim
    to_side, to_base, inside = lengths(from_side), lengths(base), np.maximum(over_side, over_base)
    outside = np.minimum(to_side, to_base)
    distance = np.where(inside > 0.0, outside, inside)
    if not gradient:
        return distance, None
    within = (inside <= 0.0) | (outside < TINY)
    normal = np.where(to_side <= to_base, from_side, base) / np.where(within, 1.0, outside)
    on_side = within & (over_side >= over_base)
    for row, face, below in zip(normal, side, (0.0, -1.0), strict=True):
        np.copyto(row, below, where=within)
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


class Family(NamedTuple):
    """Shapes that share a formula.

    Attributes:
        kinds: names of the shapes.
        formula: formula as described in the module's docstring.
        prepare: function that computes the parameters (..., n) from the kinds (n,) and sizes (n, 3) of n obstacles.
    """

    kinds: tuple[str, ...]
    formula: Formula
    prepare: Callable[[Sequence[str], Array], Parameters]


ROUNDS = Family(("sphere", "capsule"), rounds, _prepare_rounds)
SLABS = Family(("box", "cylinder", "half_space"), slabs, _prepare_slabs)
FAMILIES = (
    ROUNDS,
    SLABS,
    Family(("ellipsoid",), ellipsoids, _prepare_ellipsoids),
    Family(("cone",), cones, _prepare_cones),
)


@dataclass(frozen=True)
class Polytope:
    """Faces and edges of a hull in its local frame, so that they stay valid when the hull moves.

    If ``n_i.x = b_i`` are the planes of its faces, the distance inside is ``sd = max_i (n_i.x - b_i)``. Outside, this
    maximum is a lower bound of the distance. The bound is exact if the foot point ``x - sd n_i`` is on the face;
    otherwise the nearest point is on an edge or at a corner, and the distance is the smallest distance to an edge.

    Attributes:
        vertices: corners of the hull, shape (v, 3) [m].
        triangles: rows of ``vertices``, counter-clockwise seen from outside, shape (k, 3).
        normals: outward unit normal of each face, shape (m, 3).
        offsets: distance of each face's plane from the centroid, shape (m,) [m].
        cosines: cosines of the angles between the faces' normals, shape (m, m).
        starts: one end of each edge between two faces, shape (3, e) [m].
        directions: unit vectors along the edges, shape (3, e).
        lengths: lengths of the edges, shape (e,) [m].
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

    @cached_property
    def radius(self) -> float:
        """Largest distance of a corner from the origin of the local frame [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @classmethod
    def around(cls, points: Array) -> Polytope:
        """Build from centred points (n, 3) that span space."""
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
        """Return distances and normals in the form of all formulas of this module."""
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
