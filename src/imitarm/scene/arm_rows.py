"""Distances of an arm's spheres to obstacles and to each other, with their gradients, for the safety filter.

Compiled code (:mod:`imitarm.compiled`) computes these distances; if it has not been built, NumPy does. The results
agree up to rounding errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.compiled import library
from imitarm.compiled.kernels import Record, address
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ArmMemory
from imitarm.kinematics.ik_problem import Box, Rows, violable
from imitarm.kinematics.spheres import SphereCover
from imitarm.scene.packed_record import record_of
from imitarm.scene.scene import Scene

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


_MOST_JOINTS = 64  # MAX_JOINTS in arm_rows.c


def has_kernels(arm: ArmModel) -> bool:
    """Return whether compiled code has been built and supports the number of joints of the arm."""
    return library() is not None and arm.n_joints <= _MOST_JOINTS


def numbers(values: ArrayLike, n: int, name: str) -> Array:
    """Return ``n`` numbers as a contiguous array of doubles, which compiled code can read.

    Raises:
        InputError: when there are more or fewer numbers.
    """
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != (n,):
        raise InputError(f"{name} must have shape ({n},), got {array.shape}")
    return array


class NearRows(NamedTuple):
    """Inequalities of a clearance limit. Each row belongs to one pair of a sphere of the arm and an obstacle.

    Attributes:
        rows: inequalities on the joint velocity.
        obstacle: index of the obstacle, shape (k,).
        sphere: index of the sphere of the arm, shape (k,).
        room: distance of each pair minus its required clearance, shape (k,) [m].
    """

    rows: Rows
    obstacle: Indices
    sphere: Indices
    room: Array


def compiled_near_rows(
    limit: Record,
    cover: SphereCover,
    memory: ArmMemory,
    scene: Scene,
    reach: Array,
    margins: Array | None,
    velocity: Array | None,
    box: Box,
) -> NearRows | None:
    """Return the rows of ``ClearanceLimit``, computed by compiled code; None if there is no row.

    The compiled code must have been built. Convert the arrays with :func:`numbers` before the call.

    Args:
        limit: the C structure ``Limit``.
        cover: spheres that cover the arm.
        memory: kinematics of the arm, computed for its current posture.
        scene: obstacles predicted for the current time, with their velocities.
        reach: distance from each sphere's centre up to which an obstacle gets a row, shape (m,) [m].
        margins: distance added to the clearance of each obstacle, shape (n,) [m]; None: nothing is added.
        velocity: joint velocity, shape (n_joints,) [rad/s]; None: the arm is at rest.
        box: bounds of the joint velocity; rows that no velocity within these bounds violates are left out.
    """
    packed = scene.packed
    record, dt = record_of(packed)
    room = _room(memory, len(packed) * len(reach), (3 * memory.n_joints + 1) * len(reach))
    places = *_arm_of(cover, memory), address(reach), limit.address
    more = [None if array is None else array.tobytes() for array in (margins, velocity, *box)]
    k = library().obstacle_rows(record.address, dt, scene.stamp, *places, *more, *room.addresses)
    if not k:
        return None
    obstacle, sphere = room.indices[:k].T.copy()
    remaining, lower = room.values[:k].T.copy()
    return NearRows(Rows(room.rows[:k].copy(), lower), obstacle, sphere, remaining)


class OwnRows(NamedTuple):
    """Pairs of spheres of an arm that are near each other, with the nearest pair first.

    Attributes:
        pair: index of the pair in :class:`SpherePairs`, shape (k,).
        distance: distance of the two spheres, shape (k,) [m].
        gradient: derivatives of the distance with respect to the joints, shape (k, n_joints) [m/rad].
    """

    pair: Indices
    distance: Array
    gradient: Array


class Nearness(NamedTuple):
    """Defines which pairs of spheres are near.

    A pair is near if its distance is less than ``close``. If there are more than ``most`` such pairs, only the closest
    ``most`` of them count as near. A group contains the pairs of the same two links. In addition, the closest pair of
    each of the ``n_groups`` closest groups is near if its distance is less than ``within``.

    Attributes:
        n_groups: number of groups whose closest pair may be near.
        within: distance below which the closest pair of a group is near [m].
        close: distance below which any pair is near [m].
        most: largest number of near pairs.
    """

    n_groups: int
    within: float
    close: float
    most: int


class Demand(NamedTuple):
    """Limit of the rate at which the distance of each pair may shrink: ``gain * (distance - clearance)`` [m/s].

    Attributes:
        clearance: required distance of each pair [m].
        gain: factor of the limit [1/s].
        retreat: factor that replaces ``gain`` while the distance is below the clearance [1/s].
    """

    clearance: float
    gain: float
    retreat: float


@dataclass(frozen=True, eq=False)
class SpherePairs:
    """Pairs of spheres of an arm, grouped by the two links to which the spheres belong.

    Attributes:
        cover: the spheres.
        outer: index of the sphere that is farther from the base, shape (k,).
        inner: index of the sphere nearer to the base, shape (k,); the spheres of the base are numbered after the
            spheres of the arm.
        sums: sum of the two radii, shape (k,) [m].
        starts: index of the first pair of each of the g groups, shape (g,).
    """

    cover: SphereCover
    outer: NDArray[np.int64]
    inner: NDArray[np.int64]
    sums: Array
    starts: NDArray[np.int64]

    @cached_property
    def _record(self) -> Record:
        """The C structure of the same name."""
        outer, inner = self.outer.astype(np.uint16), self.inner.astype(np.uint16)
        radii = np.concatenate([self.cover.radii, self.cover.base_radii])
        arrays = outer, inner, radii, self.starts, self.cover.base_centers
        return Record(len(self.sums), len(self.starts), *arrays)

    def distances(self, centers: Array) -> Array:
        """Return the distances of all pairs, shape (k,) [m], for the centres (m, 3) [m] of the arm's spheres."""
        every = np.concatenate([centers, self.cover.base_centers])
        between = every.take(self.outer, axis=0) - every.take(self.inner, axis=0)
        between *= between
        squares = between[:, 0] + between[:, 1]
        squares += between[:, 2]
        return np.asarray(np.sqrt(squares, out=squares) - self.sums)

    def rows(
        self, arm: ArmModel, q: ArrayLike, nearness: Nearness, demand: Demand, box: Box | None = None
    ) -> OwnRows | None:
        """Return the near pairs; None if there is none.

        Args:
            arm: the arm.
            q: joint positions, shape (n_joints,) [rad].
            nearness: definition of the near pairs.
            demand: limit of the rate at which each distance may shrink.
            box: bounds of the joint velocity; if no velocity within these bounds violates an inequality, the result is
                None.
        """
        if not has_kernels(arm):
            found = self._rows_by_numpy(arm, q, nearness)
            return None if found is None or not _has_effect(found, demand, box) else found
        memory = arm.at(q)
        n_groups, _, _, most = nearness
        room = _room(memory, most + n_groups, 2 * (len(self.sums) + len(self.starts)))
        within = () if box is None else [numbers(bound, arm.n_joints, "box") for bound in box]
        bounds = tuple(bound.tobytes() for bound in within) or (None, None)
        places = self._record.address, *_arm_of(self.cover, memory)
        k = library().self_rows(*places, *nearness, *demand, *bounds, *room.addresses)
        if not k:
            return None
        return OwnRows(room.indices.ravel()[:k].copy(), room.values.ravel()[:k].copy(), room.rows[:k].copy())

    def _rows_by_numpy(self, arm: ArmModel, q: ArrayLike, nearness: Nearness) -> OwnRows | None:
        centers = arm.sphere_centers(q)
        distances, starts = self.distances(centers), self.starts
        chosen: set[int] = set()
        if len(starts):
            ends = [*starts.tolist(), len(distances)][1:]
            least = np.minimum.reduceat(distances, starts)
            for group in least.argsort(kind="stable")[: nearness.n_groups].tolist():
                if least[group] < nearness.within:
                    start = int(starts[group])
                    chosen.add(start + int(distances[start : ends[group]].argmin()))
            close = (distances < nearness.close).nonzero()[0]
            chosen.update(close.take(distances.take(close).argsort(kind="stable")[: nearness.most]).tolist())
        if not chosen:
            return None
        pairs = np.array(sorted(chosen), dtype=np.int64)
        pairs = pairs.take(distances.take(pairs).argsort(kind="stable"))
        outer, inner, distance = self.outer.take(pairs), self.inner.take(pairs), distances.take(pairs)
        every = np.concatenate([centers, self.cover.base_centers])
        points = every.take(outer, axis=0)
        normals = (points - every.take(inner, axis=0)) / (distance + self.sums.take(pairs))[:, None]
        return OwnRows(pairs, distance, self.cover.parting(arm.at(q).data, outer, inner, points, normals))


def _has_effect(found: OwnRows, demand: Demand, box: Box | None) -> bool:
    """Return whether some velocity in a box violates an inequality; True without a box."""
    if box is None:
        return True
    room = found.distance - demand.clearance
    lower = np.where(room < 0.0, -demand.retreat, -demand.gain) * room
    return bool(violable(found.gradient, lower, box).any())


class _Room:
    """Memory for compiled code, used again in every step.

    Attributes:
        indices: shape (size, 2).
        values: shape (size, 2).
        rows: shape (size, n_joints).
        scratch: shape (n_scratch,).
        addresses: the addresses of these four, beginning with ``scratch``.
    """

    def __init__(self, size: int, n_joints: int, n_scratch: int) -> None:
        self.indices = np.empty((size, 2), dtype=np.int64)
        self.values, self.rows, self.scratch = np.empty((size, 2)), np.empty((size, n_joints)), np.empty(n_scratch)
        self.addresses = [address(array) for array in (self.scratch, self.indices, self.values, self.rows)]


def _room(memory: ArmMemory, size: int, n_scratch: int) -> _Room:
    """Return memory for at least ``size`` rows, of this arm in this thread; it grows to what its largest user needs."""
    room: _Room | None = memory.kept.get("room")
    if room is None or len(room.rows) < size or len(room.scratch) < n_scratch:
        if room is not None:
            size, n_scratch = max(size, len(room.rows)), max(n_scratch, len(room.scratch))
        room = memory.kept["room"] = _Room(size, memory.n_joints, n_scratch)
    return room


class _Arm:
    """The C structure ``Arm`` of an arm in one thread, and the centres of its spheres."""

    def __init__(self, cover: SphereCover, memory: ArmMemory) -> None:
        data, m = memory.data, len(cover.radii)
        dofs, owners = (np.ascontiguousarray(x, dtype=np.int64) for x in (cover.dofs, cover.owners))
        moves, local = np.ascontiguousarray(cover.moves), np.ascontiguousarray(cover.local)
        com = data.subtree_com[cover.root]
        self.record = Record(memory.n_joints, m, moves, dofs, data.cdof, com, owners, local, data.xmat, data.xpos)
        self.centers, self.posture = np.empty((m, 3)), b""
        self.places = self.record.address, address(self.centers)


def _arm_of(cover: SphereCover, memory: ArmMemory) -> tuple[int, int]:
    """Return the addresses of the C structure ``Arm`` and of the centres of the spheres in the posture."""
    arm: _Arm | None = memory.kept.get("arm")
    if arm is None:
        arm = memory.kept["arm"] = _Arm(cover, memory)
    if arm.posture is not memory.posture:
        library().sphere_centers(*arm.places)
        arm.posture = memory.posture
    return arm.places
