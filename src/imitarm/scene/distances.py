"""Distances of points to all obstacles of a scene, which are stored as packed arrays.

For a single obstacle, use ``Obstacle.signed_distance``. The distance formulas are in the modules of the shapes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply, quaternion_to_matrix
from imitarm.scene.convex_hull import ConvexHull, Polytope
from imitarm.scene.edged import CONES, DEPTH, SLABS
from imitarm.scene.obstacle import Formula, Obstacle, Parameters, PosedObstacle
from imitarm.scene.rounded import ELLIPSOIDS, ROUNDS, Capsule, Sphere
from imitarm.validation import finite_array, finite_points

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

KINDS = ("sphere", "box", "capsule", "cylinder", "cone", "ellipsoid", "convex_hull", "half_space")
FAMILIES = (ROUNDS, SLABS, ELLIPSOIDS, CONES)
_ROWS = (
    "kinds",
    "positions",
    "quaternions",
    "sizes",
    "velocities",
    "angular_velocities",
    "covariances",
    "stamps",
    "track_ids",
)
OF_THE_SIZE = "radii", "_sorted", "_place_of", "_kept"
"""Attributes of packed obstacles that depend on their sizes."""
_OF_THE_POSE = frozenset(("positions", "_frames", "_ahead", "_shapes", "_record"))


class Members(NamedTuple):
    """The obstacles of a ``PackedObstacles`` that have the same distance formula."""

    formula: Formula
    places: slice  # in the order of ``PackedObstacles._sorted``
    parameters: Parameters  # of the formula, each of shape (..., number of members)


class _Frames(NamedTuple):
    """The local frames of the obstacles, grouped by family, in the order of ``PackedObstacles._sorted``."""

    to_local: Array  # rotation of base vectors into each local frame, shape (n, 3, 3)
    rows: Array  # the same, axis first, for one product with many points, shape (3 n, 3)
    center: Array  # of each obstacle, in its own rotation, shape (3, n, 1) [m]
    velocity: Array  # of each obstacle, in its own rotation, shape (3, n, 1) [m/s]
    upright: bool  # whether no local frame is rotated


@dataclass(frozen=True, eq=False)
class PackedObstacles:
    """Obstacles of a scene as arrays, one row for each obstacle; :attr:`Scene.packed` builds them.

    Attributes:
        kinds: index of each shape in :data:`KINDS`, shape (n,).
        positions: origin of the local frame in the base frame, shape (n, 3) [m].
        quaternions: local_to_base rotations wxyz, shape (n, 4).
        sizes: sizes of the shapes, shape (n, 3) [m]. Sphere: radius; box: full edge lengths; capsule and cylinder:
            radius, length of the axis; cone: radius, height; ellipsoid: semi-axes; convex hull: half extents;
            half-space: not used. Unused entries are 0.
        velocities: velocities of the local frame's origin, shape (n, 3) [m/s].
        angular_velocities: angular velocities about the local frame's origin, in the base frame, shape (n, 3) [rad/s].
        covariances: covariances of the positions, shape (n, 3, 3) [m^2]; 0 when unknown.
        stamps: time at which each obstacle was seen, shape (n,) [s].
        track_ids: track number of each obstacle, shape (n,); -1 without a track.
        polytopes: faces and edges of each convex hull; None for other kinds.
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

    @classmethod
    def of(cls, obstacles: Sequence[Obstacle], stamp: float) -> PackedObstacles:
        """Store ``obstacles`` as arrays; ``stamp`` [s] is the time at which the obstacles have their poses."""
        n, zero = len(obstacles), np.zeros((3, 3))
        solids = [obstacle.solid() for obstacle in obstacles]
        return cls(
            np.array([KINDS.index(solid.kind) for solid in solids], dtype=np.int8),
            np.array([solid.position for solid in solids]).reshape(n, 3),
            np.array([solid.quaternion for solid in solids]).reshape(n, 4),
            np.array([solid.size for solid in solids], dtype=float).reshape(n, 3),
            np.array([obstacle.velocity for obstacle in obstacles]).reshape(n, 3),
            np.array([obstacle.angular_velocity for obstacle in obstacles]).reshape(n, 3),
            np.array([zero if o.covariance is None else o.covariance for o in obstacles]).reshape(n, 3, 3),
            np.full(n, stamp),
            np.array([-1 if o.track_id is None else o.track_id for o in obstacles], dtype=np.int64),
            tuple(solid.polytope for solid in solids),
        )

    def __len__(self) -> int:
        return len(self.kinds)

    def after(self, dt: float) -> PackedObstacles:
        """Return the obstacles ``dt`` seconds later, each moved with its velocity and angular velocity."""
        if self.still or dt == 0.0:
            return self
        if self.rotating:
            turned = quaternion_multiply(quaternion_exp(dt * self.angular_velocities), self.quaternions)
            return self.copy(positions=self.positions + dt * self.velocities, quaternions=turned)
        return self.copy(_ahead=(self, dt))  # positions and frames are computed when they are first used

    def placed(
        self,
        positions: Array,
        quaternions: Array,
        velocities: Array,
        angular_velocities: Array,
        stamp: float | Array,
        covariances: Array | None = None,
        sizes: Array | None = None,
    ) -> PackedObstacles:
        """Return the same obstacles at other poses.

        ``stamp`` [s] is the time at which the obstacles were seen: one number, or one for each obstacle, shape (n,).
        The other arguments replace the attributes of the same names. If ``covariances`` or ``sizes`` is None, the
        covariances or the sizes are kept.
        """
        moved = self.copy(
            positions=positions,
            quaternions=quaternions,
            velocities=velocities,
            angular_velocities=angular_velocities,
            stamps=np.full(len(self), stamp),
            covariances=self.covariances if covariances is None else covariances,
        )
        stale: tuple[str, ...] = ("still", "rotating", "fastest")
        if sizes is not None:
            moved.__dict__["sizes"] = sizes
            stale += OF_THE_SIZE
        for name in stale:
            moved.__dict__.pop(name, None)
        return moved

    def take(self, indices: Indices) -> PackedObstacles:
        """Return the obstacles with the given ``indices`` (k,)."""
        rows = {name: getattr(self, name)[indices] for name in _ROWS}
        return PackedObstacles(**rows, polytopes=tuple(self.polytopes[i] for i in indices.tolist()))

    def copy(self, **changes: object) -> PackedObstacles:
        """Return a copy with other poses; the copy shares the values that were computed for the shapes."""
        moved = object.__new__(PackedObstacles)
        moved.__dict__.update(self._shapes, **changes)
        return moved

    def __getstate__(self) -> dict[str, object]:
        return {key: value for key, value in self.__dict__.items() if key != "_record"}  # it contains addresses

    def __getattr__(self, name: str) -> Array:
        """Compute ``positions`` when they are first read from a result of :meth:`after`; reject unknown attributes."""
        ahead: tuple[PackedObstacles, float] | None = self.__dict__.get("_ahead")
        if name != "positions" or ahead is None:
            raise AttributeError(f"PackedObstacles has no attribute {name!r}")
        earlier, dt = ahead
        positions = earlier.positions + dt * earlier.velocities
        object.__setattr__(self, "positions", positions)
        return positions

    @cached_property
    def _shapes(self) -> dict[str, object]:
        """Return all values that do not depend on the poses, for use in copies."""
        self._sorted, self._place_of, self._kept, self.radii  # noqa: B018  worked out once, for all copies
        return {key: value for key, value in self.__dict__.items() if key not in _OF_THE_POSE}

    @cached_property
    def still(self) -> bool:
        """Whether no obstacle moves."""
        return not (self.velocities.any() or self.angular_velocities.any())

    @cached_property
    def fastest(self) -> float:
        """Speed of the fastest obstacle [m/s]; 0 without obstacles."""
        return math.sqrt(float(np.einsum("ij,ij->i", self.velocities, self.velocities).max(initial=0.0)))

    @cached_property
    def rotating(self) -> bool:
        """Whether any obstacle has an angular velocity."""
        return bool(self.angular_velocities.any())

    @cached_property
    def radii(self) -> Array:
        """Radius of the sphere around ``positions`` that contains each solid, shape (n,) [m]; inf for a half-space."""
        rows = zip(self.kinds.tolist(), self.sizes.tolist(), self.polytopes, strict=True)
        return np.array([_bounding_radius(KINDS[kind], size, polytope) for kind, size, polytope in rows])

    @cached_property
    def _sorted(self) -> tuple[Indices, list[Members]]:
        """The order of the obstacles when grouped by family, and the families; every hull is a separate family."""
        names = [KINDS[kind] for kind in self.kinds.tolist()]
        merged = any(name in SLABS.kinds for name in names)  # then spheres and capsules are taken as rounded boxes
        order: list[int] = []
        families: list[Members] = []
        for family in FAMILIES:
            kinds = family.kinds + (ROUNDS.kinds if merged and family is SLABS else ())
            members = [] if merged and family is ROUNDS else [i for i, name in enumerate(names) if name in kinds]
            if members:
                places = slice(len(order), len(order) + len(members))
                parameters = family.prepare([names[i] for i in members], self.sizes[members])
                families.append(Members(family.formula, places, parameters))
                order += members
        for i, polytope in enumerate(self.polytopes):
            if polytope is not None:
                families.append(Members(polytope.formula, slice(len(order), len(order) + 1), ()))
                order.append(i)
        return np.array(order, dtype=np.intp), families

    @cached_property
    def _place_of(self) -> Indices:
        """The place of each obstacle in the order of ``_sorted``, shape (n,)."""
        return np.argsort(self._sorted[0])

    @cached_property
    def _frames(self) -> _Frames:
        if "_ahead" in self.__dict__:
            earlier, dt = self.__dict__["_ahead"]
            frames: _Frames = earlier._frames
            return frames._replace(center=frames.center + dt * frames.velocity)
        order = self._sorted[0]
        to_local = np.ascontiguousarray(quaternion_to_matrix(self.quaternions[order]).transpose(0, 2, 1))
        rows = np.ascontiguousarray(to_local.transpose(1, 0, 2)).reshape(-1, 3)
        center, velocity = (np.einsum("nij,nj->in", to_local, v[order]) for v in (self.positions, self.velocities))
        center[2, self.kinds[order] == KINDS.index("half_space")] -= DEPTH
        upright = not self.quaternions[:, 1:].any()
        return _Frames(to_local, rows, center[..., None], velocity[..., None], upright)

    @cached_property
    def _kept(self) -> list[tuple[Array, Array]]:
        """The last result of :meth:`_limits`; all copies share it."""
        return []

    def _limits(self, reach: Array) -> Array:
        """Return limits of the squared distance between the origin of each solid and each point, shape (n, m).

        A point beyond its limit is farther than ``reach`` from the solid.
        """
        if not self._kept or self._kept[0][0] is not reach:
            limit = reach + self.radii[self._sorted[0], None]
            self._kept[:] = [(reach, limit * limit)]
        return self._kept[0][1]


def distances(packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None = None) -> Array:
    """Return the signed distance of every point to every obstacle, at one time or at several times.

    Args:
        packed: n obstacles at their reference time.
        points: points in the base frame, shape (..., 3) [m]. If ``times`` is given, the shape is (k, ..., 3) for points
            that move, or (1, ..., 3) for points at rest.
        times: times counted from the obstacles' reference time, shape (k,) [s]; None: only the reference time.

    Returns:
        Distances, shape (n, ...) [m], or shape (n, k, ...) if ``times`` is given; negative inside.

    Raises:
        InputError: when a shape is wrong or a number is not finite.
    """
    return _evaluate(packed, points, times, False)[0]


def distances_and_gradients(
    packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return :func:`distances` and their gradients with respect to the points.

    The arguments and errors are the same as in :func:`distances`.

    Returns:
        Distances (n, ...) [m] and unit vectors (n, ..., 3) in the base frame.
    """
    distance, gradient = _evaluate(packed, points, times, True)
    assert gradient is not None
    return distance, gradient


class NearPairs(NamedTuple):
    """Pairs of a point and an obstacle that are close to each other.

    Attributes:
        obstacle: index of the obstacle, shape (k,).
        point: index of the point, shape (k,).
        distance: signed distance of the point from the obstacle, shape (k,) [m].
        normal: gradient of the distance with respect to the point, in the base frame, one row for each axis, shape
            (3, k).
    """

    obstacle: Indices
    point: Indices
    distance: Array
    normal: Array


def near_pairs(packed: PackedObstacles, points: Array, reach: Array) -> NearPairs | None:
    """Return all pairs of a point and an obstacle that are at most ``reach`` apart; None if there is no such pair.

    Bounding spheres first exclude most pairs; the exact distance is computed only for the remaining pairs.

    Args:
        packed: n obstacles.
        points: finite points in the base frame, shape (m, 3) [m].
        reach: largest distance up to which a point forms a pair, shape (m,) [m]. If successive calls pass the same
            array object, they take less time.
    """
    frames, m = packed._frames, len(points)
    if frames.upright:
        every = np.subtract(points.T[:, None], frames.center, order="C")
    else:
        every = np.dot(frames.rows, points.T).reshape(3, -1, m)
        every -= frames.center
    flat = (np.add.reduce(every * every, axis=0) <= packed._limits(reach)).ravel().nonzero()[0]
    if not len(flat):
        return None
    place, point = np.divmod(flat, m)
    q = every.reshape(3, -1).take(flat, axis=1)
    if len(packed._sorted[1]) == 1:
        formula, _, parameters = packed._sorted[1][0]
        distance, normal = formula(q, True, *take(parameters, place))
    else:
        distance, normal = np.empty(len(flat)), np.empty((3, len(flat)))
        starts = np.searchsorted(place, [family.places.start for family in packed._sorted[1]]).tolist()
        for (formula, places, parameters), a, b in zip(
            packed._sorted[1], starts, [*starts[1:], len(flat)], strict=True
        ):
            if a < b:
                column = place[a:b] - places.start
                distance[a:b], normal[:, a:b] = formula(q[:, a:b], True, *take(parameters, column))
    near = (distance <= reach.take(point)).nonzero()[0]
    if not len(near):
        return None
    if len(near) < len(flat):
        place, point, distance = place.take(near), point.take(near), distance.take(near)
        normal = normal.take(near, axis=1)
    if not frames.upright:
        normal = np.einsum("jk,kji->ik", normal, frames.to_local.take(place, axis=0))
    return NearPairs(packed._sorted[0][place], point, distance, normal)


def _evaluate(
    packed: PackedObstacles, points: ArrayLike, times: ArrayLike | None, gradient: bool
) -> tuple[Array, Array | None]:
    p = finite_points(points)
    if times is None:
        shape = p.shape[:-1]
        distance, normals = _at_once(packed, p.reshape(-1, 3), None, gradient)
    else:
        t = finite_array(times, (None,), "times", "s")
        if not len(t):
            raise InputError("times must contain at least one number")
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
    """Return the distances (n, m) and gradients (n, m, 3) of points (m, 3) to all obstacles.

    With ``times`` (k,), the points are k groups of equal size, one group for each time.
    """
    frames, n, m = packed._frames, len(packed), len(points)
    q = np.dot(frames.rows, points.T).reshape(3, n, m)
    if times is None:
        q -= frames.center
    else:
        q.reshape(3, n, len(times), m // len(times))[...] -= (frames.center + frames.velocity * times)[..., None]
    families = packed._sorted[1]
    if len(families) == 1 and not gradient:  # in their own order
        formula, _, parameters = families[0]
        return formula(q, False, *every(parameters))
    distance, gradients = np.empty((n, m)), np.empty((n, m, 3)) if gradient else None
    for formula, places, parameters in packed._sorted[1]:
        part, normal = formula(q[:, places], gradient, *every(parameters))
        distance[packed._sorted[0][places]] = part
        if gradients is not None and normal is not None:
            for i, place in enumerate(range(places.start, places.stop)):
                np.dot(normal[:, i].T, frames.to_local[place], out=gradients[packed._sorted[0][place]])
    return distance, gradients


def every(parameters: Parameters | list[Array | None]) -> list[Array | None]:
    """Append an axis of length 1 to each parameter of a family, so that the parameters broadcast against points."""
    return [None if p is None else p[..., None] for p in parameters]


def take(parameters: Parameters, members: Indices) -> list[Array | None]:
    """Return the family's parameters for each point, where ``members`` are the points' obstacles in the family."""
    return [None if p is None else p.take(members, axis=-1) for p in parameters]


def _bounding_radius(kind: str, size: list[float], polytope: Polytope | None) -> float:
    a, b, c = size
    if polytope is not None:
        return polytope.radius
    if kind == "half_space":
        return math.inf
    if kind == "box":
        return 0.5 * math.hypot(a, b, c)
    if kind == "capsule":
        return a + 0.5 * b
    return max(a, b, c) if kind in {"sphere", "ellipsoid"} else math.hypot(a, 0.5 * b)  # else a cylinder or a cone


def resized(obstacle: Obstacle, size: Array) -> Obstacle:
    """Return ``obstacle`` with a new size, at the same pose.

    Args:
        obstacle: obstacle to resize; a convex hull is returned unchanged, because it has no size parameters.
        size: new size, as :class:`PackedObstacles` defines it for this shape, shape (3,) [m].
    """
    if isinstance(obstacle, Sphere):
        return replace(obstacle, radius=float(size[0]))
    if isinstance(obstacle, Capsule):
        middle, axis = 0.5 * (obstacle.start + obstacle.end), obstacle.end - obstacle.start
        length = float(np.linalg.norm(axis))
        half = 0.5 * float(size[1]) / length * axis if length > 0.0 else 0.5 * axis
        return replace(obstacle, start=middle - half, end=middle + half, radius=float(size[0]))
    if isinstance(obstacle, ConvexHull) or not isinstance(obstacle, PosedObstacle):
        return obstacle
    names = obstacle.lengths
    values = [np.array(size)] if len(names) == 1 else [float(value) for value in size]
    changes: dict[str, Any] = dict(zip(names, values, strict=False))
    return replace(obstacle, **changes)
