"""Signed distances from points to obstacles: packed arrays, one formula for each family of shapes, one entry point.

Everything that asks how far something is from an obstacle ends here: ``Obstacle.signed_distance``, ``Scene.clearance``,
:class:`~imitarm.scene.clearance_limit.ClearanceLimit`. Each formula is written once, in the obstacle's own frame, for
any number of obstacles and points at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply, quaternion_to_matrix
from imitarm.validation import finite_array

if TYPE_CHECKING:
    from imitarm.scene.hull import Polytope

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Kernel = Callable[..., tuple[Array, Any]]  # distances, and normals where they were asked for

KINDS = ("sphere", "box", "capsule", "cylinder", "cone", "ellipsoid", "convex_hull", "half_space")
TINY = 1e-9  # [m] a direction shorter than this is mostly rounding error; a fixed direction replaces it
DEPTH = 1e3  # [m] a half-space is a box of this half height without ends: same distance wherever an arm can be

_MAX_NEWTON = 100  # many more steps than any point needs
_NEWTON_TOLERANCE = 1e-3  # of the last step; the remaining error is its square, and enters the distance squared again
_FLOOR = 1e-12  # [fraction of the shortest semi-axis] changes a distance by less than that


class Solid(NamedTuple):
    """The geometry of one obstacle, in the form that :class:`PackedObstacles` stacks.

    Attributes:
        kind: one of :data:`KINDS`.
        position: origin of the obstacle's own frame in the base frame, shape (3,) [m].
        quaternion: own_to_base rotation wxyz, shape (4,).
        size: see ``PackedObstacles.sizes``, shape (3,) [m].
        polytope: faces and edges of a convex hull in its own frame; None for other kinds.
    """

    kind: str
    position: Array
    quaternion: Array
    size: Sequence[float] | Array
    polytope: Polytope | None = None


class _Family(NamedTuple):
    """Obstacles that share one distance formula."""

    kernel: Kernel
    members: slice  # their places in ``PackedObstacles._order``
    parameters: tuple[Array | None, ...]  # of the formula, each of shape (..., number of members)


class _Frames(NamedTuple):
    """The own frames of obstacles, family by family, in the order of ``PackedObstacles._order``."""

    to_own: Array  # rotation of base vectors into each own frame, shape (n, 3, 3)
    rows: Array  # the same, stacked for one product with many points: axis first, shape (3 n, 3)
    center: Array  # of each obstacle, in its own rotation, shape (3, n, 1) [m]
    velocity: Array  # of each obstacle, in its own rotation, shape (3, n, 1) [m/s]


@dataclass(frozen=True, eq=False)
class PackedObstacles:
    """Obstacles as arrays with one row each, at one time. :attr:`Scene.packed` builds them.

    Attributes:
        kinds: index of each shape in :data:`KINDS`, shape (n,).
        positions: origin of the own frame in the base frame, shape (n, 3) [m].
        quaternions: own_to_base rotations wxyz, shape (n, 4).
        sizes: shape (n, 3) [m]. Sphere: radius; box: full edge lengths; capsule and cylinder: radius, length of the
            axis; cone: radius, height; ellipsoid: semi-axes; convex hull: half extents; half-space: nothing.
            Unused entries are 0.
        velocities: of the own frame's origin, shape (n, 3) [m/s].
        angular_velocities: about that origin, in the base frame, shape (n, 3) [rad/s].
        covariances: of the positions, shape (n, 3, 3) [m^2]; 0 when unknown.
        stamps: when each obstacle was seen, shape (n,) [s].
        track_ids: the number of its track, shape (n,); -1 without one.
        polytopes: faces and edges of each convex hull; None for other kinds.
        radii: of the sphere around ``positions`` that holds the solid, shape (n,) [m]; inf for a half-space.
    """

    kinds: NDArray[np.int8]
    positions: Array
    quaternions: Array
    sizes: Array
    velocities: Array
    angular_velocities: Array
    covariances: Array
    stamps: Array
    track_ids: NDArray[np.int64]
    polytopes: tuple[Polytope | None, ...]
    radii: Array

    @classmethod
    def of(
        cls,
        solids: Sequence[Solid],
        velocities: ArrayLike,
        angular_velocities: ArrayLike,
        covariances: ArrayLike,
        stamps: ArrayLike,
        track_ids: ArrayLike,
    ) -> PackedObstacles:
        """Stack ``solids``; the other arguments are the attributes of these names."""
        n = len(solids)
        kinds = np.array([KINDS.index(solid.kind) for solid in solids], dtype=np.int8)
        sizes = np.array([solid.size for solid in solids], dtype=float).reshape(n, 3)
        return cls(
            kinds,
            np.array([solid.position for solid in solids], dtype=float).reshape(n, 3),
            np.array([solid.quaternion for solid in solids], dtype=float).reshape(n, 4),
            sizes,
            np.array(velocities, dtype=float).reshape(n, 3),
            np.array(angular_velocities, dtype=float).reshape(n, 3),
            np.array(covariances, dtype=float).reshape(n, 3, 3),
            np.array(stamps, dtype=float).reshape(n),
            np.array(track_ids, dtype=np.int64).reshape(n),
            tuple(solid.polytope for solid in solids),
            np.array([_bounding_radius(solid) for solid in solids], dtype=float),
        )

    def __len__(self) -> int:
        return len(self.kinds)

    def after(self, dt: float) -> PackedObstacles:
        """Return the obstacles ``dt`` seconds later, each moved with its velocity and angular velocity [s]."""
        if self.still or dt == 0.0:
            return self
        positions = self.positions + dt * self.velocities
        if self.rotating:
            turned = quaternion_multiply(quaternion_exp(dt * self.angular_velocities), self.quaternions)
            return self._copy(positions=positions, quaternions=turned)
        frames = self._frames
        return self._copy(positions=positions, _frames=frames._replace(center=frames.center + dt * frames.velocity))

    def placed(
        self, positions: Array, quaternions: Array, velocities: Array, angular_velocities: Array, stamp: float
    ) -> PackedObstacles:
        """Return the same shapes elsewhere and seen at ``stamp`` [s]; the other arguments are the attributes."""
        moved = self._copy(
            positions=positions,
            quaternions=quaternions,
            velocities=velocities,
            angular_velocities=angular_velocities,
            stamps=np.full(len(self), stamp),
        )
        for name in ("_still", "rotating"):
            moved.__dict__.pop(name, None)
        return moved

    def _copy(self, **changes: object) -> PackedObstacles:
        """Return a copy with other poses, which keeps what was worked out for the shapes."""
        moved = object.__new__(PackedObstacles)
        values = moved.__dict__
        values.update(self.__dict__)
        values.pop("_frames", None)
        values.pop("_single", None)
        values.update(changes)
        return moved

    @cached_property
    def still(self) -> bool:
        """Whether no obstacle moves."""
        return not (self.velocities.any() or self.angular_velocities.any())

    @cached_property
    def rotating(self) -> bool:
        """Whether any obstacle has an angular velocity."""
        return bool(self.angular_velocities.any())

    @cached_property
    def _order(self) -> Indices:
        """The obstacles, family by family."""
        return np.concatenate([np.empty(0, dtype=np.intp), *(members for _, members, _ in self._sorted)])

    @cached_property
    def _families(self) -> tuple[_Family, ...]:
        ends = np.cumsum([0, *(len(members) for _, members, _ in self._sorted)]).tolist()
        return tuple(
            _Family(kernel, slice(start, end), parameters)
            for (kernel, _, parameters), start, end in zip(self._sorted, ends, ends[1:], strict=False)
        )

    @cached_property
    def _sorted(self) -> list[tuple[Kernel, Indices, tuple[Array | None, ...]]]:
        """For each family its formula, its obstacles and the formula's parameters; every hull is its own family."""
        names = np.array([KINDS[kind] for kind in self.kinds], dtype=str)
        slabs = np.isin(names, _SLABS)
        if slabs.any():
            slabs |= np.isin(names, _ROUND)  # rounded boxes too: fewer and longer calls
        families = []
        for kernel, kinds, prepare in _FAMILIES:
            members = np.flatnonzero(slabs if kernel is _slabs else np.isin(names, kinds) & ~slabs)
            if len(members):
                families.append((kernel, members, prepare(names[members], self.sizes[members])))
        hulls = [(_hull(hull), np.array([i]), ()) for i, hull in enumerate(self.polytopes) if hull is not None]
        return families + hulls

    @cached_property
    def _frames(self) -> _Frames:
        order = self._order
        to_own = np.ascontiguousarray(quaternion_to_matrix(self.quaternions[order]).transpose(0, 2, 1))
        rows = np.ascontiguousarray(to_own.transpose(1, 0, 2)).reshape(-1, 3)
        center, velocity = (np.einsum("nij,nj->in", to_own, v[order]) for v in (self.positions, self.velocities))
        center[2, self.kinds[order] == KINDS.index("half_space")] -= DEPTH
        return _Frames(to_own, rows, center[..., None], velocity[..., None])

    def _limits(self, reach: Array) -> Array:
        """Return the squared distance from each obstacle's origin (n, m) within which a point may be in ``reach``."""
        kept: list[Array] = self.__dict__.setdefault("_kept_limits", [])
        if not kept or kept[0] is not reach:
            limit = reach + self.radii[self._order, None]
            kept[:] = [reach, limit * limit]
        return kept[1]

    @cached_property
    def _single(self) -> tuple[Kernel, Array | None, Array, list[Array | None]]:
        """For a pack of one: the formula, the rotation into the own frame, its centre (3, 1), the parameters.

        The rotation is None where there is none.
        """
        frames = self._frames
        to_own = frames.to_own[0] if self.quaternions[0, 1:].any() else None
        family = self._families[0]
        return family.kernel, to_own, frames.center[:, 0], _every(family.parameters, 0)


def checked_points(points: ArrayLike) -> Array:
    """Return finite points as an array of shape (..., 3).

    Raises:
        InputError: when they are not numbers, the last axis has not length 3, or a number is not finite.
    """
    ready = type(points) is np.ndarray and points.dtype == np.float64 and points.shape[-1:] == (3,)
    if ready and math.isfinite(np.add.reduce(points, axis=None)):  # a sum is finite only if every number is
        return np.asarray(points)
    return finite_array(points, (..., 3), "points", "m")


def distances(packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None = None) -> Array:
    """Return the signed distance of every point to every obstacle, at one time or at several.

    Args:
        packed: n obstacles, at their time 0.
        points: in the base frame, shape (..., 3) [m]. With ``times``, shape (k, ..., 3): the points of each time,
            or (1, ..., 3) for points that stand.
        times: seconds after the obstacles' time, shape (k,) [s]; None for that time itself.

    Returns:
        Shape (n, ...) [m], or (n, k, ...) with ``times``; negative inside.

    Raises:
        InputError: when a shape is wrong or a number is not finite.
    """
    return _evaluate(packed, points, times, False)[0]


def distances_and_gradients(
    packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return :func:`distances` and their gradients with respect to the points.

    Args:
        packed: as for :func:`distances`.
        points: as for :func:`distances`.
        times: as for :func:`distances`.

    Returns:
        Distances (n, ...) [m] and unit vectors (n, ..., 3) in the base frame.

    Raises:
        InputError: when a shape is wrong or a number is not finite.
    """
    distance, gradient = _evaluate(packed, points, times, True)
    assert gradient is not None
    return distance, gradient


def single_distance(packed: PackedObstacles, points: ArrayLike, gradient: bool) -> tuple[Array, Array | None]:
    """Return what :func:`distances_and_gradients` does for a pack of one, without the first axis, and quicker.

    Args:
        packed: one obstacle.
        points: in the base frame, shape (..., 3) [m].
        gradient: whether to return the gradients too.

    Returns:
        Distances (...) [m] and unit vectors (..., 3), or None.

    Raises:
        InputError: when the last axis of ``points`` has not length 3 or a number is not finite.
    """
    p = checked_points(points)
    kernel, to_own, center, parameters = packed._single
    columns = (p if p.ndim == 2 else p.reshape(-1, 3)).T
    if to_own is None:
        q = np.subtract(columns, center, order="C")
    else:
        q = np.dot(to_own, columns)
        q -= center
    distance, normal = kernel(q, gradient, *parameters)
    if normal is not None:
        normal = normal.T if to_own is None else np.dot(normal.T, to_own)
        normal = normal if p.ndim == 2 else normal.reshape(p.shape)
    return (distance if p.ndim == 2 else distance.reshape(p.shape[:-1])), normal


class NearPairs(NamedTuple):
    """Points that are near obstacles.

    Attributes:
        obstacle: index of the obstacle, shape (k,).
        point: index of the point, shape (k,).
        distance: signed distance of the two, shape (k,) [m].
        normal: its gradient with respect to the point, in the base frame, one row for each axis, shape (3, k).
    """

    obstacle: Indices
    point: Indices
    distance: Array
    normal: Array


def near_pairs(packed: PackedObstacles, points: Array, reach: Array) -> NearPairs | None:
    """Return all pairs of a point and an obstacle that are at most ``reach`` apart, for control loops; None if none.

    Bounding spheres come first; the exact distance is computed only for the pairs that they leave.

    Args:
        packed: n obstacles.
        points: finite, in the base frame, shape (m, 3) [m].
        reach: of each point, shape (m,) [m]; the same array in every call saves time.
    """
    frames, m = packed._frames, len(points)
    every = np.dot(frames.rows, points.T).reshape(3, -1, m)
    every -= frames.center
    flat = (np.add.reduce(every * every, axis=0) <= packed._limits(reach)).ravel().nonzero()[0]
    if not len(flat):
        return None
    place, point = np.divmod(flat, m)
    q = every.reshape(3, -1).take(flat, axis=1)
    if len(packed._families) == 1:
        kernel, _, parameters = packed._families[0]
        distance, normal = kernel(q, True, *_take(parameters, place))
    else:
        distance, normal = np.empty(len(flat)), np.empty((3, len(flat)))
        starts = np.searchsorted(place, [family.members.start for family in packed._families]).tolist()
        for (kernel, members, parameters), a, b in zip(packed._families, starts, [*starts[1:], len(flat)], strict=True):
            if a < b:
                column = place[a:b] - members.start
                distance[a:b], normal[:, a:b] = kernel(q[:, a:b], True, *_take(parameters, column))
    near = (distance <= reach.take(point)).nonzero()[0]
    if not len(near):
        return None
    if len(near) < len(flat):
        place, point, distance, normal = place[near], point[near], distance[near], normal[:, near]
    base = np.einsum("jk,kji->ik", normal, frames.to_own.take(place, axis=0))
    return NearPairs(packed._order[place], point, distance, base)


def _evaluate(
    packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None, gradient: bool
) -> tuple[Array, Array | None]:
    p = checked_points(points)
    if times is None and len(packed) == 1:
        single, normal = single_distance(packed, p, gradient)
        return single[None], None if normal is None else normal[None]
    if times is None:
        shape = p.shape[:-1]
        distance, normals = _at_once(packed, p.reshape(-1, 3), None, gradient)
    else:
        t = finite_array(times, (None,), "times", "s")
        if p.ndim < 2 or p.shape[0] not in {1, len(t)}:
            raise InputError(
                f"points must have shape ({len(t)}, ..., 3) or (1, ..., 3) for {len(t)} times, got {p.shape}"
            )
        p = np.broadcast_to(p, (len(t), *p.shape[1:]))
        shape = p.shape[:-1]
        if packed.rotating:
            parts = [
                _at_once(packed.after(float(dt)), q.reshape(-1, 3), None, gradient) for dt, q in zip(t, p, strict=True)
            ]
            distance = np.stack([part[0] for part in parts], axis=1)
            normals = np.stack([part[1] for part in parts if part[1] is not None], axis=1) if gradient else None
        else:
            distance, normals = _at_once(packed, p.reshape(-1, 3), t, gradient)
    n = len(packed)
    return distance.reshape(n, *shape), None if normals is None else normals.reshape(n, *shape, 3)


def _at_once(packed: PackedObstacles, points: Array, times: Array | None, gradient: bool) -> tuple[Array, Array | None]:
    """Return distances (n, m) and gradients (n, m, 3) of points (m, 3); with ``times`` (k,) m is k times as many."""
    frames, n, m = packed._frames, len(packed), len(points)
    q = np.dot(frames.rows, points.T).reshape(3, n, m)
    if times is None:
        q -= frames.center
    else:
        q.reshape(3, n, len(times), -1)[...] -= (frames.center + frames.velocity * times)[..., None]
    distance, gradients = np.empty((n, m)), np.empty((n, m, 3)) if gradient else None
    for kernel, members, parameters in packed._families:
        part, normal = kernel(q[:, members], gradient, *_every(parameters, slice(None)))
        distance[packed._order[members]] = part
        if gradients is not None and normal is not None:
            for i, place in enumerate(range(members.start, members.stop)):
                np.dot(normal[:, i].T, frames.to_own[place], out=gradients[packed._order[place]])
    return distance, gradients


def _every(parameters: tuple[Array | None, ...], members: int | slice) -> list[Array | None]:
    """Return the parameters of chosen members with a last axis for the points."""
    return [None if p is None else p[..., members, None] for p in parameters]


def _take(parameters: tuple[Array | None, ...], members: Indices) -> list[Array | None]:
    """Return the parameters of one member for each point."""
    return [None if p is None else p.take(members, axis=-1) for p in parameters]


def lengths(vectors: Array) -> Array:
    """Return the length (...) of each column of ``vectors`` (k, ...)."""
    return np.sqrt(np.add.reduce(vectors * vectors, axis=0))


def _rounds(q: Array, gradient: bool, radius: Array, half: Array | None) -> tuple[Array, Array | None]:
    """Spheres and capsules: the distance to the nearest point of a segment along z, less the radius.

    Args:
        q: points in the own frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        radius: shape (...) [m].
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


def _prepare_rounds(kinds: NDArray[np.str_], sizes: Array) -> tuple[Array | None, ...]:
    return sizes[:, 0].copy(), 0.5 * sizes[:, 1] if (kinds == "capsule").any() else None


def _slabs(
    q: Array, gradient: bool, half: Array, rounding: Array | None, turned: Array | None
) -> tuple[Array, Array | None]:
    """Boxes, cylinders and half-spaces: a box of half size ``half``, rounded by ``rounding``.

    With ``a = |q| - half`` the distance is ``|max(a, 0)| + min(max_j a_j, 0) - rounding``. A half-space is a
    box without ends. A cylinder (``turned``) is a box in ``(rho, z)`` with ``rho^2 = x^2 + y^2``. Beside them a sphere
    is a rounded point and a capsule a rounded segment.

    Args:
        q: points in the own frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        half: shape (3, ...) [m].
        rounding: shape (...) [m]; None for 0.
        turned: which ones are cylinders, shape (...); None for none.
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


def _prepare_slabs(kinds: NDArray[np.str_], sizes: Array) -> tuple[Array | None, ...]:
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
    turned = kinds == "cylinder"
    return half, rounding if rounding.any() else None, turned if turned.any() else None


def _ellipsoids(q: Array, gradient: bool, semi_axes: Array, beyond: Array, floor: Array) -> tuple[Array, Array | None]:
    """Ellipsoids: the supporting plane at the nearest surface point, found by Newton's method.

    The surface point nearest to ``y`` is ``e_j = g_j^2 y_j / (t + g_j^2)`` with semi-axes ``g``, where ``t`` is the
    largest root of ``F(t) = sum_j (g_j y_j / (t + g_j^2))^2 - 1``. With ``s = t + min g^2`` the function
    ``h(s) = 1 / sqrt(F + 1)`` is concave and rises, so Newton's method on ``h = 1`` from the left never steps over the
    root and needs no bracket. With the unit normal ``n`` at ``e`` the distance is ``n.y - sqrt(sum_j g_j^2 n_j^2)``: an
    error in ``n`` enters squared and never makes the distance too large.

    Args:
        q: points in the own frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        semi_axes: shape (3, ...) [m].
        beyond: ``g_j^2 - min g^2``, shape (3, ...) [m^2].
        floor: least value of the coordinate along the shortest axis, 0 along the others, shape (3, ...) [m].
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


def _prepare_ellipsoids(_kinds: NDArray[np.str_], sizes: Array) -> tuple[Array | None, ...]:
    semi_axes = np.ascontiguousarray(sizes.T)
    shortest = semi_axes.min(axis=0)
    floor = np.zeros_like(semi_axes)
    floor[semi_axes.argmin(axis=0), np.arange(len(sizes))] = _FLOOR * shortest
    return semi_axes, (semi_axes - shortest) * (semi_axes + shortest), floor


def _cones(
    q: Array, gradient: bool, radius: Array, height: Array, slant: Array, side: Array
) -> tuple[Array, Array | None]:
    """Cones: in the half-plane ``(rho, z)`` a triangle with the base at ``-height/2`` and the tip at ``+height/2``.

    The distance outside is that to the nearer one of two segments, the slant side and the base; inside it is the larger
    one of the signed distances to their lines.

    Args:
        q: points in the own frames, shape (3, ...) [m].
        gradient: whether to return the normals too.
        radius: of the base, shape (...) [m].
        height: shape (...) [m].
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


def _hull(polytope: Polytope) -> Kernel:
    """Return the formula of one convex hull."""

    def kernel(q: Array, gradient: bool) -> tuple[Array, Array | None]:
        distance, rows = polytope.distance_and_normal(np.ascontiguousarray(q.reshape(3, -1).T))
        return distance.reshape(q.shape[1:]), rows.T.reshape(q.shape) if gradient else None

    return kernel


def _prepare_cones(_kinds: NDArray[np.str_], sizes: Array) -> tuple[Array | None, ...]:
    radius, height, _ = np.ascontiguousarray(sizes.T)
    slant = np.hypot(radius, height)
    return radius, height, slant, np.stack([height, radius]) / slant


_ROUND, _SLABS = ("sphere", "capsule"), ("box", "cylinder", "half_space")
_FAMILIES: tuple[tuple[Kernel, tuple[str, ...], Callable[[NDArray[np.str_], Array], tuple[Array | None, ...]]], ...] = (
    (_rounds, _ROUND, _prepare_rounds),
    (_slabs, _SLABS, _prepare_slabs),
    (_ellipsoids, ("ellipsoid",), _prepare_ellipsoids),
    (_cones, ("cone",), _prepare_cones),
)


def _bounding_radius(solid: Solid) -> float:
    a, b, c = (float(x) for x in solid.size)
    return {
        "sphere": a,
        "box": 0.5 * math.hypot(a, b, c),
        "capsule": a + 0.5 * b,
        "cylinder": math.hypot(a, 0.5 * b),
        "cone": math.hypot(a, 0.5 * b),
        "ellipsoid": max(a, b, c),
        "convex_hull": math.inf if solid.polytope is None else solid.polytope.radius,
        "half_space": math.inf,
    }[solid.kind]
