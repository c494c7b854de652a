"""Distances of an arm's spheres to obstacles and to each other, with their gradients, for the safety filter.

Compiled code computes them where it has been built (:mod:`imitarm.compiled`), and NumPy otherwise. Both return the same
numbers up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled import library
from imitarm.compiled.kernels import Record, address
from imitarm.kinematics.arm_kinematics import ArmMemory
from imitarm.kinematics.spheres import SphereCover
from imitarm.scene.convex_hull import Polytope
from imitarm.scene.distances import PackedObstacles, near_pairs

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class ObstacleRows(NamedTuple):
    """Pairs of a sphere of the arm and an obstacle that are near each other.

    Attributes:
        obstacle: index of the obstacle, shape (k,).
        sphere: index of the sphere, shape (k,).
        distance: signed distance of the sphere's centre to the obstacle, shape (k,) [m].
        approach: speed of the obstacle's nearest point along the normal, shape (k,) [m/s].
        variance: variance of the obstacle's position along the normal, shape (k,) [m^2].
        gradient: derivatives of the distance with respect to the joints, shape (k, n_joints) [m/rad].
    """

    obstacle: Indices
    sphere: Indices
    distance: Array
    approach: Array
    variance: Array
    gradient: Array


def obstacle_rows(
    cover: SphereCover, memory: ArmMemory, packed: PackedObstacles, centers: Array, reach: Array
) -> ObstacleRows:
    """Return all pairs of a sphere and an obstacle that are at most ``reach`` apart.

    Args:
        cover: spheres that cover the arm.
        memory: the kinematics of the posture.
        packed: n obstacles.
        centers: centres of the spheres in the base frame, shape (m, 3) [m].
        reach: largest distance for each sphere, shape (m,) [m]; passing the same array in every call saves time.
    """
    kernel = library()
    if kernel is None:
        return _obstacle_rows_by_numpy(cover, memory, packed, centers, reach)
    record, dt = _record_of(packed)
    room = _room(memory, "obstacle_rows", len(packed) * len(reach))
    places = record.address, dt, _arm_record(cover, memory).address, address(centers), address(reach)
    k = kernel.obstacle_rows(*places, *room.addresses)
    obstacle, sphere = room.indices[:k].T.copy()
    distance, approach, variance = room.values[:k].T.copy()
    return ObstacleRows(obstacle, sphere, distance, approach, variance, room.rows[:k].copy())


def _obstacle_rows_by_numpy(
    cover: SphereCover, memory: ArmMemory, packed: PackedObstacles, centers: Array, reach: Array
) -> ObstacleRows:
    pairs = near_pairs(packed, centers, reach)
    if pairs is None:
        whole, empty = np.zeros(0, dtype=np.intp), np.zeros(0)
        return ObstacleRows(whole, whole, empty, empty, empty, np.zeros((0, memory.n_joints)))
    obstacle, sphere, distance, normal = pairs
    points = centers.take(sphere, axis=0).T
    approach = variance = np.zeros(len(obstacle))
    if not packed.still:
        velocity = packed.velocities.take(obstacle, axis=0).T
        if packed.rotating:  # the nearest surface point p moves at v + w x (p - origin); c - p is along n
            arms = points - packed.positions.take(obstacle, axis=0).T
            velocity = velocity + np.cross(packed.angular_velocities.take(obstacle, axis=0).T, arms, axis=0)
        approach = np.einsum("ij,ij->j", velocity, normal)
    if packed.covariances.any():
        variance = np.einsum("ik,kij,jk->k", normal, packed.covariances.take(obstacle, axis=0), normal)
    return ObstacleRows(
        obstacle, sphere, distance, approach, variance, cover.speeds(memory.data, sphere, points, normal)
    )


class OwnRows(NamedTuple):
    """Pairs of two spheres of an arm that are near each other, nearest pair first.

    Attributes:
        pair: index of the pair, shape (k,).
        distance: distance of the two spheres, shape (k,) [m].
        gradient: derivatives of the distance with respect to the joints, shape (k, n_joints) [m/rad].
    """

    pair: Indices
    distance: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class SpherePairs:
    """Pairs of spheres of an arm, grouped by the two links to which the spheres belong.

    Attributes:
        outer: index of the sphere that is farther from the base, shape (k,).
        inner: index of the other sphere; those of the base follow those of the arm, shape (k,).
        sums: sum of the two radii, shape (k,) [m].
        starts: first pair of each group, shape (g,).
    """

    outer: NDArray[np.int64]
    inner: NDArray[np.int64]
    sums: Array
    starts: NDArray[np.int64]

    @cached_property
    def record(self) -> Record:
        """The C structure of the same name."""
        return Record(len(self.sums), len(self.starts), self.outer, self.inner, self.sums, self.starts)

    def distances(self, centers: Array) -> Array:
        """Return the distances of all pairs, shape (k,) [m]; ``centers`` (m, 3) [m] are those of all spheres."""
        between = centers.take(self.outer, axis=0) - centers.take(self.inner, axis=0)
        between *= between
        squares = between[:, 0] + between[:, 1]
        squares += between[:, 2]
        return np.asarray(np.sqrt(squares, out=squares) - self.sums)

    def rows(
        self, cover: SphereCover, memory: ArmMemory, centers: Array, n_groups: int, near: float, close: float, most: int
    ) -> OwnRows:
        """Return the near pairs.

        Every pair closer than ``close`` is near, but at most the ``most`` closest ones. So is the closest pair of each
        of the ``n_groups`` closest groups, if this pair is closer than ``near``.

        Args:
            cover: spheres that cover the arm.
            memory: the kinematics of the posture.
            centers: centres of all spheres, with those of the base last, shape (m, 3) [m].
            n_groups: see above.
            near: see above [m].
            close: see above [m].
            most: see above.
        """
        kernel = library()
        if kernel is None:
            return self._rows_by_numpy(cover, memory, centers, n_groups, near, close, most)
        room = _room(memory, "own_rows", most + n_groups)
        scratch = memory.kept.get("pairs")
        if scratch is None or len(scratch) < len(self.sums) + len(self.starts):
            scratch = memory.kept["pairs"] = np.empty((len(self.sums) + len(self.starts), 2))
        places = self.record.address, _arm_record(cover, memory).address, address(centers)
        indices, distances, rows = room.addresses
        k = kernel.self_rows(*places, n_groups, near, close, most, address(scratch), indices, distances, rows)
        return OwnRows(room.indices.ravel()[:k].copy(), room.values.ravel()[:k].copy(), room.rows[:k].copy())

    def _rows_by_numpy(
        self, cover: SphereCover, memory: ArmMemory, centers: Array, n_groups: int, near: float, close: float, most: int
    ) -> OwnRows:
        distances, starts = self.distances(centers), self.starts
        chosen: set[int] = set()
        if len(starts):
            ends = [*starts.tolist(), len(distances)][1:]
            least = np.minimum.reduceat(distances, starts)
            for group in least.argsort(kind="stable")[:n_groups].tolist():
                if least[group] < near:
                    start = int(starts[group])
                    chosen.add(start + int(distances[start : ends[group]].argmin()))
            within = (distances < close).nonzero()[0]
            chosen.update(within.take(distances.take(within).argsort(kind="stable")[:most]).tolist())
        pairs = np.array(sorted(chosen), dtype=np.int64)
        pairs = pairs.take(distances.take(pairs).argsort(kind="stable"))
        outer, inner, distance = self.outer.take(pairs), self.inner.take(pairs), distances.take(pairs)
        points = centers.take(outer, axis=0)
        normals = (points - centers.take(inner, axis=0)) / (distance + self.sums.take(pairs))[:, None]
        return OwnRows(pairs, distance, cover.parting(memory.data, outer, inner, points, normals))


class _Room:
    """Memory for the results of compiled code, used again in every step."""

    def __init__(self, size: int, n_joints: int) -> None:
        self.size = size
        self.indices = np.empty((size, 2), dtype=np.int64)
        self.values, self.rows = np.empty((size, 3)), np.empty((size, n_joints))
        self.addresses = address(self.indices), address(self.values), address(self.rows)


def _room(memory: ArmMemory, name: str, size: int) -> _Room:
    """Return memory for at least ``size`` rows, of this arm in this thread."""
    room: _Room | None = memory.kept.get(name)
    if room is None or room.size < size:
        room = memory.kept[name] = _Room(size, memory.n_joints)
    return room


def _arm_record(cover: SphereCover, memory: ArmMemory) -> Record:
    """Return the C structure ``Arm``; MuJoCo's arrays stay where they are."""
    record: Record | None = memory.kept.get("arm")
    if record is None:
        moves = np.ascontiguousarray(cover.moves)
        dofs = np.ascontiguousarray(cover.dofs, dtype=np.int64)
        com = memory.data.subtree_com[cover.root]
        record = Record(memory.n_joints, len(moves), moves, dofs, memory.data.cdof, com)
        memory.kept["arm"] = record
    return record


def _record_of(packed: PackedObstacles) -> tuple[Record, float]:
    """Return the C structure ``Obstacles``, and the time [s] from its poses to those of ``packed``."""
    known: tuple[Record, float] | None = packed.__dict__.get("_record")
    if known is None:
        if "_ahead" in packed.__dict__:
            earlier, dt = packed.__dict__["_ahead"]
            record, before = _record_of(earlier)
            known = record, before + dt
        else:
            known = _built(packed), 0.0
        packed.__dict__["_record"] = known
    return known


def _built(packed: PackedObstacles) -> Record:
    rows = (
        packed.positions,
        packed.quaternions,
        packed.sizes,
        packed.velocities,
        packed.angular_velocities,
        packed.covariances,
        packed.radii,
    )
    kinds = np.ascontiguousarray(packed.kinds, dtype=np.int8)
    hulls = [None if polytope is None else _hull_record(polytope) for polytope in packed.polytopes]
    return Record(len(packed), kinds, *[_plain(row) for row in rows], hulls)


def _hull_record(polytope: Polytope) -> Record:
    """Return the C structure ``Hull``; the polytope keeps it."""
    record: Record | None = polytope.__dict__.get("_record")
    if record is None:
        arrays = "normals", "offsets", "cosines", "starts", "directions", "lengths"
        sizes = len(polytope.offsets), len(polytope.lengths)
        record = polytope.__dict__["_record"] = Record(*sizes, *[_plain(getattr(polytope, name)) for name in arrays])
    return record


def _plain(array: Any) -> Array:
    return np.ascontiguousarray(array, dtype=float)
