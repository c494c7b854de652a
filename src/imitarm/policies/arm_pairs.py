"""Pairs of a sphere of the arm and an obstacle, or of two spheres of the arm, and the search for the near pairs.

Spheres cover the arm. An arm has thousands of pairs, but usually only few of them are near each other at one point of a
path. Two bounds that take little time exclude most of the distant pairs. First, ``ArmPath.travel`` bounds how far the
spheres of a link move between two postures. The distances are therefore measured at few postures of the path; at the
postures in between, only the pairs that could be near are measured. Second, each obstacle is inside a bounding sphere.
The distance to this sphere takes less time to compute than the distance to the obstacle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.certificate import without_rotation
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.edged import HalfSpace
from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

SELF = -1
"""Value used instead of an obstacle's index if a distance is between two links of the arm."""
_BLOCK_TRAVEL = 0.3  # [m] the first blocks are so short that the arm moves at most about this far in one
_ROUNDING = 1e-4  # [m] of the distances between links, which are first measured in single precision


class Pairs(ABC):
    """Pairs whose distance is checked: each sphere of the arm with one obstacle, or spheres of different links.

    Attributes:
        arm: the arm.
        obstacle: index of the obstacle, or ``SELF``.
        sphere: index of the sphere of each pair, shape (n_pairs,); in a pair of two spheres, the sphere of the link
            farther from the base.
        other: index of the second sphere of each pair, shape (n_pairs,); -1 for a pair with an obstacle.
        first: index of the first joint that can change the distance of each pair, shape (n_pairs,).
        moves: whether each joint changes the distance of each pair, shape (n_pairs, n_joints).
        group: index of the group of each pair, shape (n_pairs,); the pairs of one group have the same links.
        velocity: velocity of the obstacle, shape (3,) [m/s].
        margin: margin of the obstacle, which is subtracted from the distance; None: no margin.
    """

    velocity: Array = np.zeros(3)
    margin: PredictionMargin | None = None
    arm: ArmModel
    obstacle: int
    sphere: Index
    other: Index
    first: Index
    moves: Mask
    group: Index
    _of_groups: tuple[Index, Index]  # link of the sphere, and number of joints that do not change the distance

    @property
    def n_groups(self) -> int:
        """Number of groups of pairs with the same links."""
        return len(self._of_groups[0])

    @abstractmethod
    def _perhaps(self, path: ArmPath, times: Array, samples: Index, limit: Array) -> tuple[Index, Index]:
        """Return all pairs with less room than a limit at some samples, and perhaps others.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
            samples: indices of k samples.
            limit: limit of each of these samples and each group, shape (k, n_groups) [m].

        Returns:
            For each pair, the row of ``samples`` and the index of the pair.
        """

    @abstractmethod
    def _points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        """Return the spheres' centres relative to the obstacle, or to the inner sphere in its frame, (k, 3) [m]."""

    @abstractmethod
    def _room(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        """Return distance minus required clearance, shape (k,) [m]."""

    @abstractmethod
    def _measured(self, points: Array, pair: Index, times: Array) -> tuple[Array, Array]:
        """Return distance minus required clearance (k,) [m], and its gradient (k, 3), at the results of ``_points``."""

    def _in_base(self, path: ArmPath, sample: Index, pair: Index, normals: Array) -> Array:
        """Return the gradients ``normals``, converted to the base frame."""
        return normals

    def without_margin(self) -> Pairs:
        """Return the same pairs without the margin of the obstacle."""
        if self.margin is None:
            return self
        other = copy(self)
        other.margin = None
        return other

    def travel(self, path: ArmPath, times: Array) -> Array:
        """Return upper bounds of the change of distance between neighbouring samples, shape (n - 1, n_groups) [m]."""
        way = path.travel[:, self._of_groups[0], self._of_groups[1]]
        if self.velocity.any():
            way = way + (float(np.linalg.norm(self.velocity)) * np.diff(times))[:, None]
        if self.margin is not None:
            way = way + np.diff(self.margin.at(times))[:, None]
        return way

    def closing_speeds(self, path: ArmPath, velocity: Array) -> Array:
        """Return upper bounds of the rate at which the distances of each group shrink, shape (n, n_groups) [m/s].

        Args:
            path: postures of the arm at n samples.
            velocity: joint velocities, shape (n, n_joints) [rad/s].
        """
        speeds = path.speeds(velocity)[:, self._of_groups[0], self._of_groups[1]]
        return np.asarray(speeds + float(np.linalg.norm(self.velocity)))

    def near(self, path: ArmPath, times: Array, reach: Array, travel: Array | None) -> tuple[Index, Index, Array]:
        """Return all pairs with less room (distance minus required clearance minus margin) than ``reach``.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
            reach: limit of the room at each sample for each group, shape (n, n_groups) [m].
            travel: the result of :meth:`travel`; None if the samples do not form a path.

        Returns:
            Three arrays with one entry for each near pair at a sample: the index of the sample, the index of the pair,
                and the pair's room [m].
        """
        n, block = len(path), 1
        if travel is not None and n > 1:
            typical = float(travel.max(axis=1, initial=0.0).mean())
            while 4 * block < n and 4 * block * typical < _BLOCK_TRAVEL:
                block *= 4
        middles, wide = _blocks(block, reach, travel)
        row, pair = self._perhaps(path, times, middles, wide)
        begin = block * row
        while True:
            at = middles[begin // block]
            room = self._room(path, at, pair, times[at])
            kept = np.flatnonzero(room < wide[begin // block, self.group[pair]])
            begin, pair = begin[kept], pair[kept]
            if block == 1:
                return begin, pair, room[kept]
            block //= 4
            begin = (begin[:, None] + block * np.arange(4)).ravel()
            inside = np.flatnonzero(begin < n)
            begin, pair = begin[inside], np.repeat(pair, 4)[inside]
            middles, wide = _blocks(block, reach, travel)

    def looked_at(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> tuple[Array, Array, Array]:
        """Return, for k given pairs, the centre of the sphere, the room, and the gradient of the room.

        The room of a pair is its distance minus the required clearance and the margin.

        Args:
            path: postures of the arm at n samples.
            sample: index of the sample of each pair, shape (k,).
            pair: index of the pair, shape (k,).
            times: time of each of the k samples [s].

        Returns:
            Three arrays. The first contains the centres of the pairs' spheres, shape (k, 3) [m], relative to the
            obstacle, or relative to the other sphere in the frame of the other sphere's link. The second contains the
            room of each pair, shape (k,) [m]. The third contains the gradients of the room with respect to the centre,
            shape (k, 3).
        """
        points = self._points(path, sample, pair, times)
        return points, *self._measured(points, pair, times)

    def normals(self, path: ArmPath, times: Array, sample: Index, pair: Index) -> Array:
        """Return the directions in which the distances of pairs grow fastest, in the base frame, shape (k, 3)."""
        normals = self._measured(self._points(path, sample, pair, times[sample]), pair, times[sample])[1]
        return self._in_base(path, sample, pair, normals)


def _blocks(size: int, reach: Array, travel: Array | None) -> tuple[Index, Array]:
    """Divide n samples into blocks.

    Returns:
        The middle sample of each block, and the limit of the room there (n_blocks, n_groups) [m], below which a pair
        may be below ``reach`` at a sample of the block.
    """
    n = len(reach)
    starts = np.arange(0, n, size)
    if size == 1 or travel is None:
        return starts, reach
    middles = np.minimum(starts + size // 2, n - 1)
    gone = np.concatenate([np.zeros((1, travel.shape[1])), np.cumsum(travel, axis=0)])
    away = np.abs(gone - gone[np.repeat(middles, size)[:n]])
    return middles, np.maximum.reduceat(reach + away, starts, axis=0)


class PairsWithObstacle(Pairs):
    """The pairs of one obstacle with every sphere of the arm."""

    def __init__(
        self,
        arm: ArmModel,
        index: int,
        obstacle: Obstacle,
        clearance: Array | float,
        margin: PredictionMargin | None = None,
    ) -> None:
        self.arm, self.obstacle, self.margin, n = arm, index, margin, len(arm.cover.radii)
        self._solid = without_rotation(obstacle)
        self.velocity = self._solid.velocity
        self.sphere, self.other, self.first = np.arange(n), np.full(n, -1), np.zeros(n, dtype=np.intp)
        self.moves = arm.cover.moves > 0.0
        self.group = arm.cover.links - 1
        self._of_groups = np.arange(arm.n_joints), np.zeros(arm.n_joints, dtype=np.intp)
        self._kept_off = arm.cover.radii + clearance  # [m] least distance of a centre
        self._flat = isinstance(self._solid, HalfSpace)
        if not self._flat:
            low, high = self._solid.bounds()
            self._middle, self._size = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))

    def _perhaps(self, path: ArmPath, times: Array, samples: Index, limit: Array) -> tuple[Index, Index]:
        centers = path.centers[samples]
        if self.velocity.any():
            centers = centers - times[samples, None, None] * self.velocity
        farthest = self._kept_off + limit[:, self.group]
        if self.margin is not None:
            farthest = farthest + self.margin.at(times[samples])[:, None]
        if self._flat:
            row, pair = np.nonzero(self._solid.distances_at(centers, gradient=False)[0] < farthest)
            return row, pair
        away = centers - self._middle
        farthest = np.maximum(farthest + self._size, 0.0)
        row, pair = np.nonzero(np.einsum("nmi,nmi->nm", away, away) < farthest * farthest)
        return row, pair

    def _points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        points = path.centers[sample, pair]
        return points - times[:, None] * self.velocity if self.velocity.any() else points

    def _room(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        points = self._points(path, sample, pair, times)
        return np.asarray(self._solid.distances_at(points, gradient=False)[0] - self._distances_kept(pair, times))

    def _measured(self, points: Array, pair: Index, times: Array) -> tuple[Array, Array]:
        distance, normal = self._solid.distances_at(points, gradient=True)
        return distance - self._distances_kept(pair, times), normal

    def _distances_kept(self, pair: Index, times: Array) -> Array:
        """Return the required distance of the spheres' centres of pairs at times (k,) [s], shape (k,) [m]."""
        kept = self._kept_off[pair]
        return np.asarray(kept if self.margin is None else kept + self.margin.at(times))


class PairsOfLinks(Pairs):
    """The pairs of spheres of two links of the arm that :class:`SelfClearance` checks."""

    def __init__(self, arm: ArmModel, own: SelfClearance) -> None:
        self.arm, self.obstacle = arm, SELF
        self.sphere, self.other = own.pairs.outer, own.pairs.inner
        self.first = own.links[own.pairs.inner]
        self.moves = (arm.cover.moves[own.pairs.outer] > 0.0) & (np.arange(arm.n_joints) >= self.first[:, None])
        self._kept_off = own.pairs.sums + own.clearance
        self._coarsely = (self._kept_off + _ROUNDING).astype(np.float32)
        kinds, group = np.unique(arm.cover.links[own.pairs.outer] * 64 + self.first, return_inverse=True)
        self.group = group.reshape(-1)
        self._of_groups = kinds // 64 - 1, kinds % 64

    def _perhaps(self, path: ArmPath, times: Array, samples: Index, limit: Array) -> tuple[Index, Index]:
        base = np.broadcast_to(self.arm.cover.base_centers, (len(samples), *self.arm.cover.base_centers.shape))
        columns = np.moveaxis(np.concatenate([path.centers[samples], base], axis=1), 2, 0).astype(np.float32)
        away = np.take(columns, self.sphere, axis=2)
        away -= np.take(columns, self.other, axis=2)
        farthest = np.take(limit.astype(np.float32), self.group, axis=1)
        farthest += self._coarsely
        np.maximum(farthest, 0.0, out=farthest)
        farthest *= farthest
        away *= away
        squares = away[0]
        squares += away[1]
        squares += away[2]
        row, pair = np.nonzero(squares < farthest)
        return row, pair

    def _away(self, path: ArmPath, sample: Index, pair: Index) -> Array:
        """Return the vectors from the inner to the outer sphere, in the base frame, shape (k, 3) [m]."""
        centers = path.centers
        inner, m = self.other[pair], centers.shape[1]
        centers = centers.reshape(-1, 3)
        of_base = inner >= m
        origin = centers.take(sample * m + np.where(of_base, 0, inner), axis=0)
        if of_base.any():
            origin[of_base] = self.arm.cover.base_centers[inner[of_base] - m]
        return np.asarray(centers.take(sample * m + self.sphere[pair], axis=0) - origin)

    def _points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        away = self._away(path, sample, pair)
        return np.einsum("kji,kj->ki", path.placed.rotations[sample, self.first[pair]], away)

    def _room(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        away = self._away(path, sample, pair)
        return np.sqrt(np.einsum("ki,ki->k", away, away)) - self._kept_off[pair]

    def _measured(self, points: Array, pair: Index, times: Array) -> tuple[Array, Array]:
        length = np.sqrt(np.einsum("ki,ki->k", points, points))
        normal = points / np.maximum(length, 1e-12)[:, None]
        return length - self._kept_off[pair], normal

    def _in_base(self, path: ArmPath, sample: Index, pair: Index, normals: Array) -> Array:
        return np.einsum("kij,kj->ki", path.placed.rotations[sample, self.first[pair]], normals)


@dataclass(frozen=True, eq=False)
class Gaps:
    """The near pairs at the samples of a path, each a sphere of the arm and an obstacle, or two spheres of the arm.

    Attributes:
        path: postures of the arm at the samples.
        times: time of each sample [s].
        sources: all pairs: one object for each obstacle and one for the links of the arm.
        source: index in ``sources`` of the object with each near pair, shape (k,).
        pair: index of each near pair in this object, shape (k,).
        sample: index of the sample at which the pair is near, shape (k,).
        room: distance minus required clearance minus margin, shape (k,) [m].
        obstacle: index of the obstacle; ``SELF`` for two spheres of the arm, shape (k,).
        sphere: index of the sphere, shape (k,); in a pair of two spheres, the sphere of the link farther from the base.
        other: index of the second sphere, shape (k,); -1 for a pair with an obstacle.
        first: index of the first joint that can change the distance of the pair, shape (k,); 0 for an obstacle.
    """

    path: ArmPath
    times: Array
    sources: Sequence[Pairs]
    source: Index
    pair: Index
    sample: Index
    room: Array
    obstacle: Index
    sphere: Index
    other: Index
    first: Index

    @classmethod
    def of(cls, path: ArmPath, times: Array, found: Sequence[tuple[Pairs, tuple[Index, Index, Array]]]) -> Gaps:
        """Return the near pairs of several sources together; ``found`` contains the results of :meth:`Pairs.near`."""
        columns: list[tuple[Array | Index, ...]] = [(*[np.zeros(0, dtype=np.intp)] * 3, np.zeros(0))]
        columns[0] += (np.zeros(0, dtype=np.intp),) * 4
        for i, (pairs, (sample, pair, room)) in enumerate(found):
            source, obstacle = np.full(len(pair), i), np.full(len(pair), pairs.obstacle)
            own = pairs.sphere[pair], pairs.other[pair], pairs.first[pair]
            columns.append((source, pair, sample, room, obstacle, *own))
        joined = (np.concatenate(parts) for parts in zip(*columns, strict=True))
        return cls(path, times, [pairs for pairs, _ in found], *joined)

    def __len__(self) -> int:
        return len(self.room)

    def normals(self, chosen: Index) -> Array:
        """Return unit vectors (base frame) along which the distances of chosen pairs grow fastest, shape (m, 3)."""
        normals = np.empty((len(chosen), 3))
        for i, pairs in enumerate(self.sources):
            of = np.flatnonzero(self.source[chosen] == i)
            if len(of):
                at = chosen[of]
                normals[of] = pairs.normals(self.path, self.times, self.sample[at], self.pair[at])
        return normals

    def rates(self, chosen: Index) -> tuple[Array, Array]:
        """Return how fast the distances of chosen pairs change.

        Returns:
            The derivatives of the distances with respect to the joints, shape (m, n_joints) [m/rad], and the rates of
            change that result from the motion of the obstacles, shape (m,) [m/s].
        """
        normals = self.normals(chosen)
        rates = self.path.sphere_speeds(self.sample[chosen], self.sphere[chosen], normals)
        velocities = np.array([pairs.velocity for pairs in self.sources]).reshape(-1, 3)
        drift = -np.einsum("ki,ki->k", normals, velocities[self.source[chosen]])
        return rates * (np.arange(rates.shape[1]) >= self.first[chosen, None]), drift
