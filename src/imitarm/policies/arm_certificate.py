r"""Proof that a whole arm keeps its clearance on a joint path, at the samples and between them.

Spheres cover the arm. Between two samples, every joint moves linearly, and the centre c of a sphere moves on an arc.
While the joints move by :math:`\Delta q`, the distance of c from the straight line between its two ends is at most

.. math:: e = \tfrac18 \sum_{i,j} |\Delta q_i|\,|\Delta q_j|\,R_{\max(i,j)}

Here, :math:`R_j` is the largest distance of c from the axis of joint j (1 for a prismatic joint). The bound e holds
because the norm of the second derivative of c with respect to the joints i and j is at most :math:`R_{\max(i,j)}`. The
signed distance of a point from a convex obstacle is a convex function of the point. Its tangents at the two ends
therefore give a lower bound of the distance on the line. The distance on the arc is at least this bound minus e. Where
the result is too low, the segment is divided into halves, which makes e four times smaller.

For an obstacle with a constant velocity, the proof is the same in coordinates that move with the obstacle. A margin
that grows with time can be subtracted from the distance (:mod:`~imitarm.policies.prediction_margin`).

The proof also applies to the distance between two links of the arm. Let the inner link be the link nearer to the base.
In the frame of the inner link, only the joints between the two links move the outer link. The distance of a moving
point from a point of the inner link is a convex function of the moving point.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.arm_pairs import SELF, Gaps, Pairs, PairsOfLinks, PairsWithObstacle
from imitarm.policies.certificate import crossing_of_tangents
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_REACHES = 0.02, 0.1  # [m] beyond the clearance: pairs are searched for up to here; the second if there are none nearer
_MOST_HALVINGS = 8  # of a segment
_CONTACT = 1e-3  # [m] a part may come nearer to a fixture by this than it is where contact is meant
_TINY = 1e-9  # [m] a joint that moves a sphere has at least this distance from it


@dataclass(frozen=True)
class ArmClearance:
    """The smallest clearance of an arm on a joint path, and where on the path it occurs.

    Attributes:
        room: distance minus required clearance minus margin [m]. If the value is at least 0, it is a guaranteed lower
            bound on the whole path. A negative value was measured at one point of the path; it is no bound for the rest
            of the path.
        obstacle: index of the nearest obstacle; ``SELF`` if two links of the arm are nearest to each other.
        sphere: index of the sphere of the arm; for two links, the sphere of the outer link.
        other: index of the sphere of the inner link; -1 for an obstacle.
        sample: index of the sample at or before the point with this clearance.
    """

    room: float
    obstacle: int
    sphere: int
    other: int
    sample: int


class ArmAmongObstacles:
    """An arm with the obstacles and fixtures from which it keeps a distance, and with links that must stay apart.

    Args:
        arm: the arm with its tool.
        obstacles: convex obstacles at time 0, which move at their velocities. A rotating obstacle is replaced by a
            sphere about its centre that contains it.
        clearance: required distance from every moving part of the arm to every obstacle [m].
        fixtures: objects on which the arm stands or works, such as a table. In the home posture and in the postures
            ``contacts``, parts of the arm may be nearer to a fixture than ``clearance``. On the path, such a part may
            come as near as in these postures. All other parts keep the clearance.
        contacts: postures in which parts of the arm are meant to be near fixtures, shape (k, n_joints) [rad].
        own: the pairs of links that must stay apart, and their required clearance; None: these distances are not
            checked.
        margins: the margin of each obstacle, or None for an obstacle without a margin; None: there are no margins.

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
        margins: Sequence[PredictionMargin | None] | None = None,
    ) -> None:
        self.arm, self.clearance, self.n_obstacles, self.own = arm, clearance, len(obstacles), own
        given = (None,) * len(obstacles) if margins is None else margins
        self._pairs: list[Pairs] = [
            PairsWithObstacle(arm, i, obstacle, clearance, margin)
            for i, (obstacle, margin) in enumerate(zip(obstacles, given, strict=True))
        ]
        if fixtures:
            postures = arm.home[None] if contacts is None else np.concatenate([arm.home[None], contacts])
            centers = ArmPath.of(arm, postures).centers
            for i, fixture in enumerate(fixtures, len(obstacles)):
                away = fixture.distances_at(centers, gradient=False)[0] - arm.cover.radii - _CONTACT
                self._pairs.append(PairsWithObstacle(arm, i, fixture, np.minimum(away.min(axis=0), clearance)))
        if own is not None and own.n_pairs:
            self._pairs.append(PairsOfLinks(arm, own))

    @cached_property
    def without_margins(self) -> ArmAmongObstacles:
        """The same arm, obstacles and fixtures, without the margins of the obstacles."""
        if all(pairs.margin is None for pairs in self._pairs):
            return self
        other = copy(self)
        other._pairs = [pairs.without_margin() for pairs in self._pairs]
        return other

    @property
    def fastest_obstacle(self) -> float:
        """Speed of the fastest obstacle [m/s]; 0 if none moves."""
        return max((float(np.linalg.norm(pairs.velocity)) for pairs in self._pairs), default=0.0)

    def gaps(self, path: ArmPath, times: Array, reach: float, *, connected: bool = True) -> Gaps:
        """Return the pairs (sphere and obstacle, or two spheres) that have less room than ``reach`` at each sample.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
            reach: limit of the room, which is the distance minus the required clearance minus the margin [m].
            connected: True: the samples form a path; False: they are unrelated postures.
        """
        found = []
        for pairs in self._pairs:
            limit = np.full((len(path), pairs.n_groups), reach)
            found.append(
                (
                    pairs,
                    pairs.near(path, times, limit, pairs.travel(path, times) if connected and len(path) > 1 else None),
                )
            )
        return Gaps.of(path, times, found)

    def closing(self, path: ArmPath, times: Array, velocity: Array, obstacles: Shrinking, links: Shrinking) -> Gaps:
        """Return the pairs whose distance may shrink faster than allowed during a motion.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
            velocity: joint velocities, shape (n, n_joints) [rad/s].
            obstacles: limit of the rate at which distances to obstacles shrink.
            links: limit of the rate at which distances between links shrink.
        """
        found = []
        for pairs in self._pairs:
            rate, margin, most = links if pairs.obstacle == SELF else obstacles
            limit = np.minimum(pairs.closing_speeds(path, velocity) / rate - margin, most)
            found.append((pairs, pairs.near(path, times, limit, pairs.travel(path, times))))
        return Gaps.of(path, times, found)

    def clearance_at(self, path: ArmPath, times: Array, reach: float) -> ArmClearance:
        """Return the smallest clearance at the samples of a path; the room of the result is at most ``reach``.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
            reach: largest room that is searched for [m]. If every pair has more room, the result has this room.
        """
        return lowest_of(self.gaps(path, times, reach), reach)

    def rooms_at(self, joints: Array, clocks: Array) -> Array:
        """Return the smallest room of given postures, but at most 0, for each of m clocks, shape (m,) [m].

        Args:
            joints: unrelated postures, shape (n, n_joints) [rad].
            clocks: for each clock, the times at which the arm has the n postures, shape (m, n) [s].
        """
        (m, n), lowest = clocks.shape, np.zeros(len(clocks))
        once, often = ArmPath.of(self.arm, joints), ArmPath.of(self.arm, np.tile(joints, (m, 1)))
        for pairs in self._pairs:
            moves = pairs.margin is not None or bool(np.any(pairs.velocity))
            path, times = (often, clocks.ravel()) if moves else (once, clocks[0])
            sample, _, room = pairs.near(path, times, np.zeros((len(path), pairs.n_groups)), None)
            if moves:
                np.minimum.at(lowest, sample // n, room)
            else:
                lowest = np.minimum(lowest, room.min(initial=0.0))
        return lowest

    def clearance_of(self, path: ArmPath, times: Array) -> ArmClearance:
        """Bound the clearance on a whole joint path, on which the joints move linearly between the samples.

        Let f and g be the room of a pair at the two ends of a segment, and let T be the largest change of the pair's
        distance along the segment. The room is at least (f + g - T) / 2 on the whole segment. For most pairs, this
        bound is high enough, and the method computes no tangents.

        Args:
            path: postures of the arm at n samples.
            times: time of each sample [s], shape (n,).
        """
        travels = [pairs.travel(path, times) for pairs in self._pairs]
        lowest = ArmClearance(_REACHES[-1], 0, -1, -1, 0)
        found: list[tuple[Index, Index]] = []
        for reach in _REACHES:
            lowest, found = ArmClearance(reach, 0, -1, -1, 0), []
            for pairs, travel in zip(self._pairs, travels, strict=True):
                around = np.zeros((len(path), travel.shape[1]))
                around[:-1], around[1:] = travel, np.maximum(around[1:], travel)
                sample, pair, room = pairs.near(path, times, lowest.room + 0.5 * around, travel)
                found.append((sample, pair))
                i = int(np.argmin(room)) if len(room) else -1
                if i >= 0 and room[i] < lowest.room:
                    place = pairs.obstacle, pairs.sphere[pair[i]], pairs.other[pair[i]], sample[i]
                    lowest = ArmClearance(float(room[i]), *map(int, place))
                    if lowest.room < 0.0:
                        return lowest
            if lowest.sphere >= 0:
                break
        for pairs, travel, (sample, pair) in zip(self._pairs, travels, found, strict=True):
            lowest = min(lowest, _bound(pairs, path, times, travel, sample, pair, lowest.room), key=lambda x: x.room)
            if lowest.room < 0.0:
                break
        return lowest


def lowest_of(gaps: Gaps, reach: float) -> ArmClearance:
    """Return the smallest clearance of several pairs; if there is no pair, its room is ``reach`` [m]."""
    if not len(gaps):
        return ArmClearance(reach, 0, -1, -1, 0)
    i = int(np.argmin(gaps.room))
    place = (gaps.obstacle[i], gaps.sphere[i], gaps.other[i], gaps.sample[i])
    return ArmClearance(float(gaps.room[i]), *map(int, place))


class Shrinking(NamedTuple):
    """Limit of the rate at which a distance may shrink [m/s]: ``rate * (room + margin)``.

    Attributes:
        rate: factor of the limit [1/s].
        margin: length that is added to the room [m].
        most: room above which there is no limit [m].
    """

    rate: float
    margin: float
    most: float


@dataclass(eq=False)
class _Ends:
    """One end of each of k segments: joints, times, points, room, gradients, and distances from the joints' axes.

    The rates are those at which the margin of the obstacle grows just before and just after this time [m/s].
    """

    joints: Array
    times: Array
    points: Array
    room: Array
    normal: Array
    radii: Array
    before: Array
    after: Array

    @classmethod
    def of(cls, pairs: Pairs, path: ArmPath, times: Array, sample: Index, pair: Index) -> _Ends:
        points, room, normal = pairs.looked_at(path, sample, pair, times)
        radii = np.maximum(path.sphere_radii(sample, pairs.sphere[pair]), _TINY) * pairs.moves[pair]
        before = after = np.zeros(len(times))
        if pairs.margin is not None:
            before, after = pairs.margin.slopes_before(times), pairs.margin.slopes_after(times)
        return cls(path.joints[sample], times, points, room, normal, radii, before, after)

    def take(self, chosen: Index) -> _Ends:
        return _Ends(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def __add__(self, other: _Ends) -> _Ends:
        names = self.__dataclass_fields__
        return _Ends(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


def _bound(
    pairs: Pairs, path: ArmPath, times: Array, travel: Array, sample: Index, pair: Index, most: float
) -> ArmClearance:
    """Bound the room of pairs on the segments that begin or end at given samples, as far as it is less than ``most``.

    If a negative value is measured at a point, that value and its segment are returned instead.
    """
    n, n_pairs = len(path), len(pairs.sphere)
    keys = np.unique(
        np.concatenate([(sample * n_pairs + pair)[sample < n - 1], ((sample - 1) * n_pairs + pair)[sample > 0]])
    )
    segment, pair = np.divmod(keys, n_pairs)
    nothing = ArmClearance(most, pairs.obstacle, -1, -1, 0)
    if not len(segment):
        return nothing
    start = _Ends.of(pairs, path, times[segment], segment, pair)
    end = _Ends.of(pairs, path, times[segment + 1], segment + 1, pair)
    needed = np.flatnonzero(0.5 * (start.room + end.room - travel[segment, pairs.group[pair]]) < most)
    segment, pair, start, end = segment[needed], pair[needed], start.take(needed), end.take(needed)
    of, lowest, where = np.arange(len(segment)), most, -1
    for halvings in range(_MOST_HALVINGS + 1):
        if not len(of):
            break
        bounds = _bounds(start, end)
        rest = np.flatnonzero(bounds < 0.0) if halvings < _MOST_HALVINGS else np.zeros(0, dtype=np.intp)
        settled = bounds.copy()
        settled[rest] = np.inf
        at = int(np.argmin(settled))
        if settled[at] < lowest:
            lowest, where = float(settled[at]), int(of[at])
        start, end, of = start.take(rest), end.take(rest), of[rest]
        if not len(rest):
            break
        postures, row = np.unique(0.5 * (start.joints + end.joints), axis=0, return_inverse=True)
        middle = _Ends.of(
            pairs, ArmPath.of(pairs.arm, postures), 0.5 * (start.times + end.times), row.reshape(-1), pair[of]
        )
        at = int(np.argmin(middle.room))
        if middle.room[at] < 0.0:
            lowest, where = float(middle.room[at]), int(of[at])
            break
        start, end, of = start + middle, middle + end, np.tile(of, 2)
    if where < 0:
        return nothing
    place = pairs.sphere[pair[where]], pairs.other[pair[where]], segment[where]
    return ArmClearance(lowest, pairs.obstacle, *map(int, place))


def _bounds(start: _Ends, end: _Ends) -> Array:
    """Return a lower bound of the distance minus the required clearance on each segment, shape (k,) [m]."""
    step = end.points - start.points
    dt = end.times - start.times
    a = np.einsum("kd,kd->k", start.normal, step) - start.after * dt
    b = np.einsum("kd,kd->k", end.normal, step) - end.before * dt
    low = crossing_of_tangents(start.room, a, end.room, b, 1.0)[0]
    return low - bows(np.abs(end.joints - start.joints), np.maximum(start.radii, end.radii))


def bows(steps: Array, radii: Array) -> Array:
    """Return an upper bound of each arc's distance from the straight line between its ends, shape (k,) [m].

    Args:
        steps: absolute motion of each joint, shape (k, n_joints) [rad].
        radii: the larger of the point's distances from the axis of each joint at the two ends of the arc, shape (k,
            n_joints) [m]; 0 for joints that do not move the point.
    """
    steps = np.where(radii > 0.0, steps, 0.0)
    whole, farther = radii.copy(), np.zeros(len(steps))
    for j in range(steps.shape[1] - 1, -1, -1):  # between the ends the distance may be larger by half of the motion
        whole[:, j] += 0.5 * farther
        farther += steps[:, j] * whole[:, j]
    before = np.cumsum(steps, axis=1) - steps
    return np.asarray(0.125 * np.einsum("kj,kj->k", whole * steps, steps + 2.0 * before))
