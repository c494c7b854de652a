r"""Proof that a whole arm keeps its clearance on a joint path, between the samples too.

Between two samples every joint moves linearly, and the centre c of a sphere of the arm moves on an arc. The distance of
this arc from the straight line between its two ends is at most :math:`e`:

.. math:: e = \tfrac18 \sum_{i,j} |\Delta q_i|\,|\Delta q_j|\,R_{\max(i,j)}

Here :math:`R_j` is the largest distance of the centre from the axis of joint j (1 for a prismatic joint). The bound
holds because the second derivative of c with respect to the joints i and j has at most the norm :math:`R_{\max(i,j)}`.
The signed distance to a convex obstacle is a convex function of the point, so the tangents at the two ends give a lower
bound of the distance on the line. On the arc, the distance is at most e smaller than on the line. Where the resulting
bound is too low, the segment is divided into halves, which makes e four times smaller.

The same proof holds for two links of the arm. In the frame of the inner link, only the joints between the two links
move the outer link, and the distance of a moving point from a fixed point is a convex function too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.certificate import crossing_of_tangents, without_rotation
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.edged import HalfSpace
from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

SELF = -1
"""Stands in place of an obstacle's index where a distance is between two links of the arm."""
_REACH = 0.1  # [m] beyond the clearance: pairs that are farther apart at both ends of a segment are not bounded
_MOST_HALVINGS = 8  # of a segment
_LONGER = 2.0  # times its largest distance from the first joint, no point of an arm is farther from any axis
_CONTACT = 1e-3  # [m] a part may come nearer to a fixture by this than it is where contact is meant
_TINY = 1e-9  # [m] a joint that moves a sphere has at least this distance from it


@dataclass(frozen=True)
class ArmClearance:
    """The smallest clearance of an arm on a joint path, and where it is.

    Attributes:
        room: distance minus required clearance [m]. A value of at least 0 is a guaranteed lower bound on the whole
            path. A negative value was measured at one point of the path; at other points, the value may be lower.
        obstacle: index of the obstacle; ``SELF`` for two links.
        sphere: index of the sphere of the arm; for two links, the sphere of the outer link.
        other: index of the sphere of the inner link; -1 for an obstacle.
        sample: index of the sample at or before the point with this clearance.
    """

    room: float
    obstacle: int
    sphere: int
    other: int
    sample: int


@dataclass(frozen=True, eq=False)
class Gaps:
    """Pairs of a sphere of the arm and an obstacle, or of two spheres of the arm, that are near each other.

    Attributes:
        path: the arm at the samples.
        obstacle: index of the obstacle; ``SELF`` for two spheres of the arm, shape (k,).
        sample: index of the sample of the path, shape (k,).
        sphere: index of the sphere; if the pair is two spheres, index of the sphere farther from the base, shape (k,).
        other: index of the sphere nearer to the base; -1 if the pair contains an obstacle, shape (k,).
        first: number of joints that move both spheres and therefore do not change their distance, shape (k,); 0 for an
            obstacle.
        room: distance minus required clearance, shape (k,) [m].
        normal: direction in which the sphere must move to make the distance grow fastest, a unit vector in the base
            frame, shape (k, 3).
        drift: change of the distance with time, caused by the motion of the obstacle, shape (k,) [m/s].
    """

    path: ArmPath
    obstacle: Index
    sample: Index
    sphere: Index
    other: Index
    first: Index
    room: Array
    normal: Array
    drift: Array

    @classmethod
    def joined(cls, path: ArmPath, parts: Sequence[Gaps]) -> Gaps:
        """Return the pairs of all ``parts`` as one object."""
        none, empty = np.zeros(0, dtype=np.intp), np.zeros(0)
        parts = [cls(path, none, none, none, none, none, empty, np.zeros((0, 3)), empty), *parts]
        names = [name for name in cls.__dataclass_fields__ if name != "path"]
        return cls(path, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.room)

    def rates(self, chosen: Index) -> Array:
        """Return the derivative of each chosen pair's distance with respect to each joint, (m, n_joints) [m/rad]."""
        rates = self.path.sphere_speeds(self.sample[chosen], self.sphere[chosen], self.normal[chosen])
        return rates * (np.arange(rates.shape[1]) >= self.first[chosen, None])


class ArmAmongObstacles:
    """An arm, the obstacles and fixtures that it must not approach, and its links, which must stay apart.

    Args:
        arm: the arm with its tool.
        obstacles: convex obstacles at time 0, which move at their velocities. A rotating obstacle is replaced by a
            sphere about its centre that contains it.
        clearance: required distance from every moving part of the arm to every obstacle [m].
        fixtures: objects on which the arm stands or works, such as a table. If a part of the arm is nearer to a fixture
            than ``clearance`` in one of the postures ``contacts`` or at home, this part may come as near as in that
            posture. All other parts keep the clearance.
        contacts: postures in which parts of the arm may be near fixtures, shape (k, n_joints) [rad].
        own: the links that must stay apart, and their required clearance; None: links are not checked.

    Attributes:
        n_obstacles: number of obstacles, which is also the index of the first fixture.
    """

    def __init__(
        self,
        arm: ArmModel,
        obstacles: Sequence[Obstacle],
        clearance: float,
        *,
        fixtures: Sequence[Obstacle] = (),
        contacts: Array | None = None,
        own: SelfClearance | None = None,
    ) -> None:
        self.arm, self.clearance, self.n_obstacles, self.own = arm, clearance, len(obstacles), own
        self._pairs: list[_Pairs] = [_ToObstacle(arm, i, o, clearance) for i, o in enumerate(obstacles)]
        if fixtures:
            postures = arm.home[None] if contacts is None else np.concatenate([arm.home[None], contacts])
            centers = ArmPath.of(arm, postures).centers
            for i, fixture in enumerate(fixtures, len(obstacles)):
                away = fixture.distances_at(centers, gradient=False)[0] - arm.cover.radii - _CONTACT
                self._pairs.append(_ToObstacle(arm, i, fixture, np.minimum(away.min(axis=0), clearance)))
        if own is not None and own.n_pairs:
            self._pairs.append(_ToLink(arm, own))

    def gaps(self, path: ArmPath, times: Array, reach: float) -> Gaps:
        """Return, for each sample, the pairs whose distance is below the required clearance plus ``reach``.

        Args:
            path: the arm at n samples.
            times: time of each sample [s], shape (n,).
            reach: pairs are returned if their ``room`` (distance minus required clearance) is less than this [m].
        """
        return Gaps.joined(path, [pairs.gaps(path, times, reach) for pairs in self._pairs])

    def clearance_at(self, path: ArmPath, times: Array, reach: float) -> ArmClearance:
        """Return the smallest clearance at the samples of a path; a ``room`` above ``reach`` is reported as ``reach``.

        Args:
            path: the arm at n samples.
            times: time of each sample [s], shape (n,).
            reach: upper bound of ``room``: if every pair has more room, the ``room`` of the result is ``reach`` [m].
        """
        gaps = self.gaps(path, times, reach)
        if not len(gaps):
            return ArmClearance(reach, 0, -1, -1, 0)
        i = int(np.argmin(gaps.room))
        place = (gaps.obstacle[i], gaps.sphere[i], gaps.other[i], gaps.sample[i])
        return ArmClearance(float(gaps.room[i]), *map(int, place))

    def clearance_of(self, path: ArmPath, times: Array) -> ArmClearance:
        """Bound the clearance on a whole joint path, on which the joints move linearly between the samples.

        Args:
            path: the arm at n samples.
            times: time of each sample [s], shape (n,).
        """
        fine, times, origin, travel = _finer(path, times)
        fastest = max((float(np.linalg.norm(pairs.velocity)) for pairs in self._pairs), default=0.0)
        # Pairs that are not near at the ends of a segment cannot come nearer on it than this.
        farthest = travel + fastest * float(np.diff(times).max(initial=0.0))
        lowest = ArmClearance(_REACH - 0.5 * farthest, 0, -1, -1, 0)
        for pairs in self._pairs:
            lowest = min(lowest, pairs.bound(fine, times), key=lambda found: found.room)
            if lowest.room < 0.0:
                break
        return replace(lowest, sample=int(origin[lowest.sample]))


def _finer(path: ArmPath, times: Array) -> tuple[ArmPath, Array, Index, float]:
    """Divide segments on which a sphere could move farther than ``_REACH``.

    Returns:
        The divided path; for each of its samples, the time and the index of the last sample of ``path`` that is not
        later; and the longest distance that a sphere moves on one segment of the divided path [m].
    """
    away = np.linalg.norm(path.centers[:, :, None] - path.anchors[:, None], axis=3).max(axis=1, initial=0.0)
    away[:, path.arm.cover.slides] = 1.0
    steps = np.abs(np.diff(path.joints, axis=0))
    whole = np.maximum(away[:-1], away[1:])
    whole += 0.5 * (steps * whole).sum(axis=1, keepdims=True)  # an axis may come closer or move away meanwhile
    travel = (steps * whole).sum(axis=1)
    parts = np.maximum(np.ceil(travel / _REACH), 1.0)
    n = len(path)
    if parts.max(initial=1.0) == 1.0:
        return path, times, np.arange(n), float(travel.max(initial=0.0))
    places = np.concatenate([i + np.arange(k) / k for i, k in enumerate(parts.astype(int).tolist())] + [[n - 1.0]])
    joints = np.stack([np.interp(places, np.arange(n), column) for column in path.joints.T], axis=1)
    finer = ArmPath.of(path.arm, joints)
    return finer, np.interp(places, np.arange(n), times), places.astype(np.intp), float((travel / parts).max())


class _Pairs(ABC):
    """Pairs whose distance is checked: spheres of the arm with one obstacle, or with spheres of other links.

    Attributes:
        arm: the arm.
        obstacle: index of the obstacle, or ``SELF``.
        sphere: index of the sphere of each pair; if the pair is two spheres, index of the sphere farther from the base,
            shape (n_pairs,).
        other: index of the sphere nearer to the base; -1 if the pair contains an obstacle, shape (n_pairs,).
        first: number of joints, counted from the base, that do not change the distance of each pair, shape (n_pairs,).
        moves: whether each joint changes the distance of each pair, shape (n_pairs, n_joints).
        velocity: velocity of the obstacle, shape (3,) [m/s].
    """

    velocity: Array = np.zeros(3)
    arm: ArmModel
    obstacle: int
    sphere: Index
    other: Index
    first: Index
    moves: Mask

    @abstractmethod
    def near(self, path: ArmPath, times: Array, reach: float) -> Mask:
        """Return which pairs may be nearer than the clearance plus ``reach`` at each sample, shape (n, n_pairs)."""

    @abstractmethod
    def points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        """Return the spheres' centres relative to the obstacle, or to the inner sphere in its frame, (k, 3) [m]."""

    @abstractmethod
    def measured(self, points: Array, pair: Index) -> tuple[Array, Array]:
        """Return distance minus required clearance (k,) [m], and its gradient (k, 3), at the results of ``points``."""

    def gaps(self, path: ArmPath, times: Array, reach: float) -> Gaps:
        sample, pair = np.nonzero(self.near(path, times, reach))
        room, normal = self.measured(self.points(path, sample, pair, times[sample]), pair)
        kept = np.flatnonzero(room < reach)
        sample, pair, room, normal = sample[kept], pair[kept], room[kept], normal[kept]
        normals = self.in_base(path, sample, pair, normal)
        obstacle, drift = np.full(len(kept), self.obstacle), -(normal @ self.velocity)
        return Gaps(path, obstacle, sample, self.sphere[pair], self.other[pair], self.first[pair], room, normals, drift)

    def in_base(self, path: ArmPath, sample: Index, pair: Index, normals: Array) -> Array:
        """Return the gradients ``normals``, converted to the base frame."""
        return normals

    def bound(self, path: ArmPath, times: Array) -> ArmClearance:
        """Bound the clearance of these pairs on the whole path."""
        near = self.near(path, times, _REACH)
        segment, pair = np.nonzero(near[:-1] | near[1:])
        if not len(segment):
            return ArmClearance(_REACH, self.obstacle, -1, -1, 0)
        room, where = _lowest(self, path, times, segment, pair)
        place = pair[where]
        return ArmClearance(room, self.obstacle, int(self.sphere[place]), int(self.other[place]), int(segment[where]))


class _ToObstacle(_Pairs):
    """The pairs of one obstacle with every sphere of the arm."""

    def __init__(self, arm: ArmModel, index: int, obstacle: Obstacle, clearance: Array | float) -> None:
        self.arm, self.obstacle, n = arm, index, len(arm.cover.radii)
        self._solid = without_rotation(obstacle)
        self.velocity = self._solid.velocity
        self.sphere, self.other, self.first = np.arange(n), np.full(n, -1), np.zeros(n, dtype=np.intp)
        self.moves = arm.cover.moves > 0.0
        self._kept_off = arm.cover.radii + clearance  # [m] least distance of a centre
        self._flat = isinstance(self._solid, HalfSpace)
        if not self._flat:
            low, high = self._solid.bounds()
            self._middle, self._size = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))

    def near(self, path: ArmPath, times: Array, reach: float) -> Mask:
        centers = path.centers - times[:, None, None] * self.velocity
        limit = self._kept_off + reach
        if self._flat:
            return np.asarray(self._solid.distances_at(centers, gradient=False)[0] < limit)
        away = centers - self._middle
        return np.asarray(np.einsum("nmi,nmi->nm", away, away) < np.maximum(limit + self._size, 0.0) ** 2)

    def points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        return np.asarray(path.centers[sample, self.sphere[pair]] - times[:, None] * self.velocity)

    def measured(self, points: Array, pair: Index) -> tuple[Array, Array]:
        distance, normal = self._solid.distances_at(points, gradient=True)
        return distance - self._kept_off[pair], normal


class _ToLink(_Pairs):
    """The pairs of spheres of two links of the arm that :class:`SelfClearance` checks."""

    def __init__(self, arm: ArmModel, own: SelfClearance) -> None:
        self.arm, self.obstacle, self._own = arm, SELF, own
        self.sphere, self.other = own.outer, own.inner
        self.first = own.links[own.inner]
        self.moves = (arm.cover.moves[own.outer] > 0.0) & (np.arange(arm.n_joints) >= self.first[:, None])

    def near(self, path: ArmPath, times: Array, reach: float) -> Mask:
        base = np.broadcast_to(self.arm.cover.base_centers, (len(path), *self.arm.cover.base_centers.shape))
        columns = np.moveaxis(np.concatenate([path.centers, base], axis=1), 2, 0).astype(np.float32)
        away = np.take(columns, self.sphere, axis=2)
        away -= np.take(columns, self.other, axis=2)
        limit = (self._own.sums + self._own.clearance + reach).astype(np.float32) + np.float32(1e-4)
        return np.asarray(np.einsum("inp,inp->np", away, away) < limit * limit)

    def points(self, path: ArmPath, sample: Index, pair: Index, times: Array) -> Array:
        inner, m = self.other[pair], path.centers.shape[1]
        of_base = inner >= m
        origin = path.centers[sample, np.where(of_base, 0, inner)]
        if of_base.any():
            origin[of_base] = self.arm.cover.base_centers[inner[of_base] - m]
        away = path.centers[sample, self.sphere[pair]] - origin
        return np.einsum("kji,kj->ki", path.rotations[sample, self.first[pair]], away)

    def measured(self, points: Array, pair: Index) -> tuple[Array, Array]:
        length = np.sqrt(np.einsum("ki,ki->k", points, points))
        normal = points / np.maximum(length, 1e-12)[:, None]
        return length - self._own.sums[pair] - self._own.clearance, normal

    def in_base(self, path: ArmPath, sample: Index, pair: Index, normals: Array) -> Array:
        return np.einsum("kij,kj->ki", path.rotations[sample, self.first[pair]], normals)


@dataclass(eq=False)
class _Ends:
    """One end of each of k segments: joints, times, points, room, gradients, and distances from the joints' axes."""

    joints: Array
    times: Array
    points: Array
    room: Array
    normal: Array
    radii: Array

    @classmethod
    def of(cls, pairs: _Pairs, path: ArmPath, times: Array, sample: Index, pair: Index) -> _Ends:
        points = pairs.points(path, sample, pair, times)
        radii = np.maximum(path.sphere_radii(sample, pairs.sphere[pair]), _TINY) * pairs.moves[pair]
        return cls(path.joints[sample], times, points, *pairs.measured(points, pair), radii)

    def take(self, chosen: Index) -> _Ends:
        return _Ends(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def __add__(self, other: _Ends) -> _Ends:
        names = self.__dataclass_fields__
        return _Ends(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


def _lowest(pairs: _Pairs, path: ArmPath, times: Array, segment: Index, pair: Index) -> tuple[float, int]:
    """Return the lowest bound of all segments, and the index of its segment.

    If a negative value is measured at a point, that value and its segment are returned instead.
    """
    chosen, room = _decisive(pairs, path, times, segment, pair)
    if room < 0.0:
        return room, int(chosen[0])
    whole, segment, pair = chosen, segment[chosen], pair[chosen]
    start = _Ends.of(pairs, path, times[segment], segment, pair)
    end = _Ends.of(pairs, path, times[segment + 1], segment + 1, pair)
    of, lowest, where = np.arange(len(segment)), np.inf, 0
    for halvings in range(_MOST_HALVINGS + 1):
        bounds = _bounds(start, end)
        rest = np.flatnonzero(bounds < 0.0) if halvings < _MOST_HALVINGS else np.zeros(0, dtype=np.intp)
        settled = bounds.copy()
        settled[rest] = np.inf
        at = int(np.argmin(settled))
        if settled[at] < lowest:
            lowest, where = float(settled[at]), int(of[at])
        if not len(rest):
            break
        start, end, of = start.take(rest), end.take(rest), of[rest]
        postures, row = np.unique(0.5 * (start.joints + end.joints), axis=0, return_inverse=True)
        middle = _Ends.of(
            pairs, ArmPath.of(pairs.arm, postures), 0.5 * (start.times + end.times), row.reshape(-1), pair[of]
        )
        at = int(np.argmin(middle.room))
        if middle.room[at] < 0.0:
            return float(middle.room[at]), int(whole[of[at]])
        start, end, of = start + middle, middle + end, np.tile(of, 2)
    return lowest, int(whole[where])


def _decisive(pairs: _Pairs, path: ArmPath, times: Array, segment: Index, pair: Index) -> tuple[Index, float]:
    """Return the segments that need an exact bound, and 0.

    These segments may have the lowest bound, or a negative bound. They are found from the tangents, which are cheap to
    compute, and from one coarse bound of all arcs. If an arm is too close at a sample, the function returns only the
    segment of the closest sample, and the negative room at this sample.
    """
    needed = np.zeros((len(path), len(pairs.sphere)), dtype=bool)
    needed[segment, pair] = needed[segment + 1, pair] = True
    sample, which = np.nonzero(needed)
    points = pairs.points(path, sample, which, times[sample])
    room, normal = pairs.measured(points, which)
    number = np.zeros(needed.shape, dtype=np.intp)
    number[sample, which] = np.arange(len(sample))
    first, last = number[segment, pair], number[segment + 1, pair]
    ends = np.minimum(room[first], room[last])
    at = int(np.argmin(ends))
    if ends[at] < 0.0:
        return np.array([at]), float(ends[at])
    step = points[last] - points[first]
    a, b = np.einsum("kd,kd->k", normal[first], step), np.einsum("kd,kd->k", normal[last], step)
    low = crossing_of_tangents(room[first], a, room[last], b, 1.0)[0]
    turn = np.abs(np.diff(path.joints, axis=0)).sum(axis=1)
    farthest = np.linalg.norm(path.centers[:, :, None] - path.anchors[:, None, :1], axis=3).max(initial=1.0)
    coarse = (0.125 * turn**2 * farthest * _LONGER * (1.0 + 0.5 * turn))[segment]
    return np.flatnonzero(low - coarse <= max(float(low.min()), 0.0)), 0.0


def _bounds(start: _Ends, end: _Ends) -> Array:
    """Return a lower bound of the distance minus the required clearance on each segment, shape (k,) [m]."""
    step = end.points - start.points
    a = np.einsum("kd,kd->k", start.normal, step)
    b = np.einsum("kd,kd->k", end.normal, step)
    low = crossing_of_tangents(start.room, a, end.room, b, 1.0)[0]
    return low - bows(np.abs(end.joints - start.joints), np.maximum(start.radii, end.radii))


def bows(steps: Array, radii: Array) -> Array:
    """Return an upper bound of each arc's distance from the straight line between its ends, shape (k,) [m].

    Args:
        steps: absolute motion of each joint, shape (k, n_joints) [rad].
        radii: distance of the point from the axis of each joint: the larger of the distances at the two ends of the
            arc; 0 for joints that do not move the point, shape (k, n_joints) [m].
    """
    steps = np.where(radii > 0.0, steps, 0.0)
    whole, farther = radii.copy(), np.zeros(len(steps))
    for j in range(steps.shape[1] - 1, -1, -1):  # between the ends the distance may be larger by half of the motion
        whole[:, j] += 0.5 * farther
        farther += steps[:, j] * whole[:, j]
    before = np.cumsum(steps, axis=1) - steps
    return np.asarray(0.125 * np.einsum("kj,kj->k", whole * steps, steps + 2.0 * before))
