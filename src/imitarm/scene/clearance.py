"""Inequalities for the inverse kinematics that keep an arm clear of obstacles, and its links clear of each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Rows
from imitarm.scene.braking import APPROACH_RATE, LONGEST_YIELD, shrink_rates
from imitarm.scene.distances import PackedObstacles, near_pairs
from imitarm.scene.meeting_links import meeting_links
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, instance, whole_number

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

_SEARCH, _SEARCH_AT_LATEST = 0.03, 0.05  # [s] after which near links are searched for when there is time, or is not
_INFLUENCE = 0.15  # [m] beyond the clearance: two links farther apart have no row
_NEAR = 0.06  # [m] beyond the clearance: every two spheres nearer than this have a row
_MOST = 64  # rows of such spheres at most, the nearest
_RETREAT_RATE = 25.0  # [1/s] how fast missing clearance is regained
_STEP = 0.05  # [m] steps in which the distance is extended within which obstacles have rows
_UNMOVED = 1e-6  # [m/rad] a joint that changes a distance by less does not change it


class NearRows(NamedTuple):
    """The rows of :class:`ClearanceLimit`, and the pair of a sphere and an obstacle to which each belongs.

    Attributes:
        rows: inequalities on the joint velocity.
        obstacle: index of the obstacle, shape (k,).
        sphere: index of the sphere of the arm, shape (k,).
        room: remaining distance h, shape (k,) [m].
    """

    rows: Rows
    obstacle: Indices
    sphere: Indices
    room: Array


class ClearanceLimit:
    r"""Inequalities on the joint velocity that keep a clearance between every link (and the tool) and every obstacle.

    Spheres cover the arm and its tool (``ArmModel.collision_spheres``). Let ``c`` and ``r`` be the centre and the
    radius of a sphere near an obstacle with the signed distance ``sd`` and the outward normal ``n``. The remaining
    distance is ``h = sd(c) - r - clearance``. Let ``v_o`` be the velocity of the obstacle's nearest point. The row for
    this sphere is the following inequality on :math:`\dot q`:

    .. math:: n^T J(q)\, \dot q \;\ge\; n^T v_o - k h, \qquad k = \min\Big(\xi,\; \frac1{T + t/2}\Big)

    The row lets h shrink at most exponentially, and only so fast that the arm can still brake, or yield to the
    obstacle, before h is used up: t is the time that the joints need for this, and T the delay of the commands
    (:func:`~imitarm.scene.braking.shrink_rates`). For obstacles at rest, k is nearly always :math:`\xi`. Before a fast
    obstacle, and for links that the joints accelerate only slowly, k is smaller, so the arm yields earlier. In theory h
    stays positive. In practice h can become negative, because links move on arcs and control steps are finite. While h
    is negative, ``retreat_rate`` replaces k, and h must grow.

    Every sphere within ``influence`` of an obstacle has a row; none is left out, except rows that no velocity within
    the limits of the joints can violate. The spheres contain the shapes they cover, so the true distance is never
    smaller than the distance of the spheres.

    Args:
        arm: arm with its tool.
        clearance: required distance of every link to every obstacle [m].
        rate: ``xi``; while h is positive, it may shrink by at most this fraction of itself per second [1/s].
        influence: value of h beyond which a sphere has no row [m]. It is extended by 0.75 s times the speed of the
            fastest obstacle.
        retreat_rate: while h is negative, it must grow by at least this fraction of its magnitude per second [1/s].
        delay: T, the control period plus the latency of the arm [s]; the age of each obstacle is added.
        deviations: number of standard deviations of each obstacle's position along the normal that are subtracted from
            its distance, from the obstacle's covariance.

    Raises:
        InputError: when ``arm`` is not an ArmModel, or a number is not finite or is negative.
    """

    def __init__(
        self,
        arm: ArmModel,
        clearance: float,
        *,
        rate: float = APPROACH_RATE,
        influence: float = 0.15,
        retreat_rate: float = 25.0,
        delay: float = 0.01,
        deviations: float = 0.0,
    ) -> None:
        self.arm = instance(arm, ArmModel, "ClearanceLimit: arm")
        self.clearance = finite_number(clearance, "ClearanceLimit: clearance", "m", at_least=0.0)
        self.rate = finite_number(rate, "ClearanceLimit: rate", "1/s", at_least=0.0)
        self.retreat_rate = finite_number(retreat_rate, "ClearanceLimit: retreat_rate", "1/s", at_least=0.0)
        self.influence = finite_number(influence, "ClearanceLimit: influence", "m", above=0.0)
        self.delay = finite_number(delay, "ClearanceLimit: delay", "s", above=0.0)
        self.deviations = finite_number(deviations, "ClearanceLimit: deviations", at_least=0.0)
        cover = arm.cover
        self._cover = cover
        self._reduced = cover.radii + self.clearance  # [m] what is taken off a distance
        self._reaches = {0: self._reduced + self.influence}  # by the speed of the fastest obstacle, in 0.1 m/s

    def rows(self, q: ArrayLike, scene: Scene, velocity: ArrayLike | None = None) -> Rows | None:
        """Return the inequalities for one posture.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            scene: obstacles predicted for the current time, with their velocities.
            velocity: joint velocity, shape (n_joints,) [rad/s]; None: at rest.

        Returns:
            One row for each pair of a sphere and an obstacle within ``influence``; None when there is no pair. A pair
            that is too close has no row if no joint can change its distance.

        Raises:
            InputError: when ``q`` is not n_joints finite numbers.
        """
        found = self.near(q, scene, velocity)
        return None if found is None else found.rows

    def near(
        self, q: ArrayLike, scene: Scene, velocity: ArrayLike | None = None, margins: Array | None = None
    ) -> NearRows | None:
        """Return the inequalities and the pairs to which they belong; same arguments and errors as :meth:`rows`.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            scene: obstacles predicted for the current time, with their velocities.
            velocity: joint velocity, shape (n_joints,) [rad/s]; None: at rest.
            margins: distance added to the clearance of each obstacle, shape (n_obstacles,) [m]; None: nothing.
        """
        packed = scene.packed
        if not len(packed):
            return None
        data = self.arm.at(q).data
        centers = self._cover.centers(data)
        pairs = near_pairs(packed, centers, self._reach(packed, margins))
        if pairs is None:
            return None
        obstacle, sphere, distance, normal = pairs
        points = centers.take(sphere, axis=0).T
        matrix = self._cover.speeds(data, sphere, points, normal)
        room = distance - self._reduced.take(sphere)
        if margins is not None:
            room -= margins.take(obstacle)
        if self.deviations and packed.covariances.any():
            spread = np.einsum("ik,kij,jk->k", normal, packed.covariances.take(obstacle, axis=0), normal)
            room -= self.deviations * np.sqrt(np.maximum(spread, 0.0))
        approach = _approach(packed, obstacle, points, normal)
        lower = self._lower(scene, matrix, obstacle, room, approach, velocity)
        return self._kept(matrix, lower, obstacle, sphere, room)

    def _reach(self, packed: PackedObstacles, margins: Array | None) -> Array:
        """Return the distance of each sphere's centre within which obstacles have rows; the same array if possible."""
        if packed.still and margins is None and not self.deviations:
            return self._reaches[0]
        fastest = math.sqrt(float(np.einsum("ij,ij->i", packed.velocities, packed.velocities).max()))
        more = 0.5 * LONGEST_YIELD * fastest + (0.0 if margins is None else max(float(margins.max()), 0.0))
        if self.deviations:
            more += self.deviations * math.sqrt(float(packed.covariances.trace(axis1=1, axis2=2).max()))
        steps = math.ceil(more / _STEP)
        if steps not in self._reaches:
            self._reaches[steps] = self._reaches[0] + _STEP * steps
        return self._reaches[steps]

    def _lower(
        self,
        scene: Scene,
        matrix: Array,
        obstacle: Indices,
        room: Array,
        approach: Array | None,
        velocity: ArrayLike | None,
    ) -> Array:
        """Return the lower bounds of the rows, shape (k,) [m/s]."""
        speed = None if velocity is None else np.asarray(velocity, dtype=float)
        packed = scene.packed
        delay: Array | float = self.delay
        if approach is not None:
            delay += np.maximum(scene.stamp - packed.stamps, 0.0).take(obstacle)
        rates = shrink_rates(self.arm, matrix, approach, speed, most=self.rate, delay=delay)
        lower = -rates * room
        lower -= (self.retreat_rate - rates) * np.minimum(room, 0.0)
        if approach is not None:
            lower += approach
        return lower

    def _kept(self, matrix: Array, lower: Array, obstacle: Indices, sphere: Indices, room: Array) -> NearRows | None:
        """Leave out rows that no velocity can violate, and links that are too close and that no joint moves away."""
        most = np.abs(matrix) @ self.arm.max_velocity
        kept = lower > -most
        if lower.max() > 0.0:  # a link that no joint moves away, such as one that turns in place above a table
            kept &= (lower <= 0.0) | (np.einsum("ij,ij->i", matrix, matrix) > _UNMOVED**2)
        if not kept.all():
            if not kept.any():
                return None
            matrix, lower = matrix[kept], lower[kept]
            obstacle, sphere, room = obstacle[kept], sphere[kept], room[kept]
        return NearRows(Rows(matrix, lower), obstacle, sphere, room)


def _approach(packed: PackedObstacles, obstacle: Indices, points: Array, normal: Array) -> Array | None:
    """Return the speed of each obstacle's nearest point along the normal, shape (k,) [m/s]; None if none moves."""
    if packed.still:
        return None
    velocity = packed.velocities.take(obstacle, axis=0).T
    if packed.rotating:  # the nearest surface point p moves at v + w x (p - origin); c - p is along n
        arms = points - packed.positions.take(obstacle, axis=0).T
        velocity = velocity + np.cross(packed.angular_velocities.take(obstacle, axis=0).T, arms, axis=0)
    return np.asarray(np.einsum("ij,ij->j", velocity, normal))


class SelfClearance:
    r"""Keeps links that are not neighbours, and the tool, apart from each other.

    The arm is covered by spheres (``ArmModel.collision_spheres``). For the spheres i and j of two links, with centres
    c and radii r, the following formulas give the distance :math:`d` and its gradient:

    .. math:: d = |c_i - c_j| - r_i - r_j, \qquad \nabla d = n^T (J_i - J_j), \quad n = (c_i - c_j)/|c_i - c_j|

    A row :math:`\nabla d\, v \ge -\xi (d - d_{safe})` lets the distance shrink no faster than exponentially towards the
    required clearance :math:`d_{safe}`. If the distance is below the clearance, the distance must grow, and 25/s
    replaces :math:`\xi` in the row. Every pair of spheres whose distance is less than the clearance plus 6 cm has a row
    (at most the 64 nearest pairs). In addition, pairs of links that are less than 15 cm apart (at most the ``n_rows``
    nearest) have one row each, for their nearest pair of spheres.

    Three kinds of pairs are not checked: links that share a joint, links that can't touch within their joint limits
    (:func:`meeting_links`), and pairs of spheres that are nearer to each other than the clearance when the arm is in
    its home posture. The base is included in the check. The object on which the base stands is not part of the arm; add
    this object to the scene.

    Args:
        arm: the arm with its tool.
        clearance: least distance [m].
        n_rows: largest number of pairs of links that have a row.
        gain: xi [1/s].

    Raises:
        InputError: when a number can't be used.
    """

    def __init__(self, arm: ArmModel, clearance: float = 0.02, *, n_rows: int = 6, gain: float = 5.0) -> None:
        clearance = finite_number(clearance, "SelfClearance: clearance", "m", at_least=0.0)
        n_rows = whole_number(n_rows, "SelfClearance: n_rows", at_least=1)
        gain = finite_number(gain, "SelfClearance: gain", "1/s", above=0.0)
        instance(arm, ArmModel, "SelfClearance: arm")
        self.arm, self.clearance = arm, clearance
        self._n_rows, self._gain = n_rows, gain
        cover = arm.cover
        centers, radii = self._centers(arm.home), np.concatenate([cover.radii, cover.base_radii])
        links = self.links = np.concatenate([cover.links, np.zeros(len(cover.base_radii), dtype=int)])
        meet = meeting_links(arm)
        sums = radii[:, None] + radii
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) - sums
        # the sphere that is farther out comes first, so every pair occurs once
        outer, inner = np.nonzero(meet[links[:, None], links] & (apart >= clearance))
        pair_of_links = links[outer] * (arm.n_joints + 1) + links[inner]
        order = np.argsort(pair_of_links, kind="stable")
        self.outer, self.inner = outer[order], inner[order]
        self._flat = self.outer * len(radii) + self.inner  # in the matrix of all distances
        self.sums = sums[self.outer, self.inner]
        self._coarse_sums = self.sums.astype(np.float32)
        self._starts = np.flatnonzero(np.diff(pair_of_links[order], prepend=-1))
        ends = [*self._starts.tolist(), len(order)][1:]
        self._groups = [slice(a, b) for a, b in zip(self._starts.tolist(), ends, strict=True)]
        self._near, self._close = np.float32(clearance + _INFLUENCE), np.float32(clearance + _NEAR)

    def _centers(self, q: ArrayLike) -> Array:
        """Return the centres of all spheres, with the base's spheres last, shape (m, 3) [m]."""
        return np.concatenate([self.arm.collision_spheres(q)[0], self.arm.cover.base_centers])

    @property
    def n_pairs(self) -> int:
        """Number of pairs of spheres that are checked."""
        return len(self.sums)

    def distance(self, q: ArrayLike) -> float:
        """Return the smallest distance of all checked pairs of spheres [m]; negative when two overlap.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            inf when the arm has no two links that could touch.
        """
        if not self.n_pairs:
            return math.inf
        centers = self._centers(q)
        return float((np.linalg.norm(centers[self.outer] - centers[self.inner], axis=1) - self.sums).min())

    def nearest(self, q: ArrayLike) -> tuple[Indices, Array]:
        """Return the pairs of spheres that are near enough to have a row in :meth:`rows`, nearest pair first.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            indices of the two spheres (k, 2), and their distances (k,) [m].
        """
        outer, inner, _, _, distances = self._found(q)
        return np.stack((outer, inner), axis=1), distances

    def names_of(self, q: ArrayLike, row: int) -> tuple[str, str, float]:
        """Return the names of the two links of a row of :meth:`rows`, and their distance minus the clearance [m].

        Args:
            q: joint positions, shape (n_joints,) [rad].
            row: index of the row.
        """
        pairs, distances = self.nearest(q)
        bodies = self.arm.cover.bodies
        first, second = (bodies[i] if i < len(bodies) else "base" for i in pairs[row].tolist())
        return first, second, float(distances[row]) - self.clearance

    def rows(self, q: ArrayLike) -> Rows | None:
        """Return inequalities on the joint velocity for ``solve_ik(..., rows=...)``.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            None when nothing is near.
        """
        found = self.near(q)
        return None if found is None else Rows(found[0], self.lower(found[1]))

    def near(self, q: ArrayLike) -> tuple[Array, Array] | None:
        """Return gradients of the distances of near pairs (k, n_joints) [m/rad], and distance minus clearance (k,) [m].

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            None when nothing is near.
        """
        outer, inner, centers, normals, distances = self._found(q)
        if not len(outer):
            return None
        gradients = self.arm.cover.parting(self.arm.at(q).data, outer, inner, centers, normals)
        return gradients, distances - self.clearance

    def lower(self, room: Array) -> Array:
        """Return the least allowed rates (k,) [m/s] of distances; ``room`` (k,) [m] is distance minus clearance."""
        if min(room.tolist(), default=0.0) >= 0.0:  # nearly always
            return -self._gain * room
        return np.where(room < 0.0, -_RETREAT_RATE, -self._gain) * room

    def periodic(self, dt: float = 0.01) -> PeriodicSelfClearance:
        """Return a version of this check that takes a fifth of its time, for a control loop with period ``dt`` [s]."""
        return PeriodicSelfClearance(self, dt)

    def _found(self, q: ArrayLike) -> tuple[Indices, Indices, Array, Array, Array]:
        """Return the nearest pairs: outer and inner spheres, centres of the outer spheres, normals and distances."""
        centers = self._centers(q)
        chosen = np.zeros(0, dtype=np.intp)
        if self._groups:
            best: list[int] = []
            coarse = self._coarse_distances(centers)
            least = np.minimum.reduceat(coarse, self._starts)
            for group in least.argsort()[: self._n_rows].tolist():
                if least[group] < self._near:
                    part = self._groups[group]
                    best.append(part.start + int(coarse[part].argmin()))
            close = (coarse < self._close).nonzero()[0]
            if len(close) > _MOST:
                close = close[np.argpartition(coarse[close], _MOST)[:_MOST]]
            chosen = np.array(sorted({*close.tolist(), *best}), dtype=np.intp)
            chosen = chosen.take(coarse.take(chosen).argsort())
        outer, inner = self.outer.take(chosen), self.inner.take(chosen)
        outer_centers = centers.take(outer, axis=0)
        between = outer_centers - centers.take(inner, axis=0)
        lengths = np.sqrt((between * between).sum(axis=1))
        return outer, inner, outer_centers, between / lengths[:, None], lengths - self.sums.take(chosen)

    def _coarse_distances(self, centers: Array) -> NDArray[np.float32]:
        """Return the distances of all checked pairs in single precision, which suffices for finding near pairs."""
        points = centers.astype(np.float32)
        squares = (points * points).sum(axis=1)
        products = points @ (-2.0 * points).T
        products += squares
        products += squares[:, None]
        distances = products.ravel().take(self._flat)
        np.maximum(distances, 0.0, out=distances)
        np.sqrt(distances, out=distances)
        distances -= self._coarse_sums
        return distances


class PeriodicSelfClearance:
    r"""Rows of a :class:`SelfClearance` for a fast control loop: near pairs are searched for only every 30 to 50 ms.

    Between two searches, the distances follow from the joints' motion, :math:`d(q) \approx d_0 + \nabla d\,(q - q_0)`.
    Within 50 ms the error of this approximation is less than 8 mm with every joint at 1 rad/s; it grows with the square
    of the speed.

    Args:
        own: self-clearance whose rows are approximated.
        dt: control period [s].
    """

    def __init__(self, own: SelfClearance, dt: float) -> None:
        self._own = own
        self._every, self._latest = max(round(_SEARCH / dt), 1), max(round(_SEARCH_AT_LATEST / dt), 1)
        self.reset()

    def reset(self) -> None:
        """Make the next step search for near pairs again."""
        self._age = self._latest
        self._found: tuple[Array, Array] | None = None
        self._at: Array = np.zeros(0)

    def rows(self, q: Array, *, may_search: bool = True) -> Rows | None:
        """Return inequalities on the joint velocity like ``SelfClearance.rows``; None when no pair is near.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            may_search: whether this step has time for a search; an overdue search takes place anyway.
        """
        self._age += 1
        if self._age > self._latest or (may_search and self._age > self._every):
            self._found, self._at, self._age = self._own.near(q), q.copy(), 1
        if self._found is None:
            return None
        matrix, room = self._found
        return Rows(matrix, self._own.lower(room + matrix.dot(q - self._at)))
