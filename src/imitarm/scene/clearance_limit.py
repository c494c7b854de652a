"""Inequalities for the inverse kinematics that keep an arm clear of obstacles."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.compiled.kernels import Record
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Box, Rows, violable
from imitarm.scene.arm_rows import NearRows, compiled_near_rows, has_kernels, numbers
from imitarm.scene.braking import APPROACH_RATE, LONGEST_YIELD, SHARE, shrink_rates
from imitarm.scene.distances import PackedObstacles, near_pairs
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, instance

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

_STEP = 0.05  # [m] steps in which the distance is extended within which obstacles have rows
_UNMOVED = 1e-6  # [m/rad] a joint that changes a distance by less does not change it


class ClearanceLimit:
    r"""Inequalities on the joint velocity that keep a clearance between every link (and the tool) and every obstacle.

    Spheres cover the arm and its tool (``ArmModel.collision_spheres``). Let ``c`` be the centre and ``r`` the radius of
    a sphere near an obstacle. The obstacle has the signed distance ``sd(c)`` from the centre, and its outward normal is
    ``n``. The remaining distance is ``h = sd(c) - r - clearance``. Let ``v_o`` be the velocity of the obstacle's
    nearest point. The row for this sphere is the following inequality on :math:`\dot q`:

    .. math:: n^T J(q)\, \dot q \;\ge\; n^T v_o - k h, \qquad k = \min\Big(\xi,\; \frac1{T + t/2}\Big)

    J is the Jacobian of the centre. The row lets h shrink at most exponentially, and so slowly that the arm can brake
    or yield to the obstacle before h is 0. Braking or yielding takes the time t, and commands take effect after the
    delay T (:func:`~imitarm.scene.braking.shrink_rates`). For obstacles at rest, k is nearly always :math:`\xi`. If an
    obstacle is fast, or if the joints can accelerate a link only slowly, k is smaller, so the arm yields earlier.
    Because links move on arcs and control steps are finite, h can become slightly negative. Then ``retreat_rate``
    replaces k, and h must grow.

    Every sphere whose h is at most ``influence`` has a row. Rows that no permitted joint velocity can violate are left
    out. The spheres contain the shapes that they cover, so the true distance is never smaller than the distance of the
    spheres.

    Args:
        arm: arm with its tool.
        clearance: required distance of every link to every obstacle [m].
        rate: :math:`\xi`, the largest rate at which a positive h may shrink, divided by h [1/s].
        influence: a sphere has no row if its h is larger than this [m]. If obstacles move, the influence is extended by
            0.75 s times the speed of the fastest obstacle.
        retreat_rate: smallest rate at which a negative h must grow, divided by the magnitude of h [1/s].
        delay: T, the control period plus the latency of the arm [s]. For each obstacle, the time since it was seen is
            added to T.
        deviations: additional margin for obstacles with a covariance, as a number of standard deviations of the
            position along the normal.

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
        self._free = Box(-arm.max_velocity, arm.max_velocity)
        self._reaches = {0: self._reduced + self.influence}  # by the speed of the fastest obstacle, in 0.1 m/s

    def rows(self, q: ArrayLike, scene: Scene, velocity: ArrayLike | None = None) -> Rows | None:
        """Return the inequalities for one posture.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            scene: obstacles predicted for the current time, with their velocities.
            velocity: joint velocity, shape (n_joints,) [rad/s]; None: the arm is at rest.

        Returns:
            One row for each pair of a sphere and an obstacle within ``influence``; None when there is no pair. A pair
            with a negative h has no row if no joint can change its distance.

        Raises:
            InputError: when ``q`` is not n_joints finite numbers, or ``velocity`` is not n_joints numbers.
        """
        found = self.near(q, scene, velocity)
        return None if found is None else found.rows

    def near(
        self,
        q: ArrayLike,
        scene: Scene,
        velocity: ArrayLike | None = None,
        margins: Array | None = None,
        box: Box | None = None,
    ) -> NearRows | None:
        """Return the inequalities and the pairs to which they belong; raise the same errors as :meth:`rows`.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            scene: obstacles predicted for the current time, with their velocities.
            velocity: joint velocity, shape (n_joints,) [rad/s]; None: the arm is at rest.
            margins: distance added to the clearance of each obstacle, shape (n_obstacles,) [m]; None: nothing is added.
            box: bounds of the joint velocity; rows that no velocity within these bounds violates are left out. None:
                the velocity limits of the arm.
        """
        packed = scene.packed
        if not len(packed):
            return None
        n = self.arm.n_joints
        speed = None if velocity is None else numbers(velocity, n, "velocity")
        margins = None if margins is None else numbers(margins, len(packed), "margins")
        within = self._free if box is None else Box(*(numbers(bound, n, "box") for bound in box))
        if not has_kernels(self.arm):
            return self._near_by_numpy(q, scene, speed, margins, within)
        reach = self._reach(packed, margins)
        return compiled_near_rows(self._record, self._cover, self.arm.at(q), scene, reach, margins, speed, within)

    @cached_property
    def _record(self) -> Record:
        """The C structure ``Limit``."""
        arrays = self._reduced, self.arm.max_acceleration, self.arm.max_velocity
        factors = self.delay, self.rate, self.retreat_rate, self.deviations, SHARE, LONGEST_YIELD, _UNMOVED
        return Record(*arrays, *(float(factor) for factor in factors))

    def _near_by_numpy(
        self, q: ArrayLike, scene: Scene, velocity: Array | None, margins: Array | None, box: Box
    ) -> NearRows | None:
        packed, data, centers = scene.packed, self.arm.at(q).data, self.arm.sphere_centers(q)
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
        return self._rows(scene, matrix, _Pairs(obstacle, sphere, room, approach), velocity, box)

    def _reach(self, packed: PackedObstacles, margins: Array | None) -> Array:
        """Return the distance of each sphere's centre within which obstacles have rows; the same array if possible."""
        if packed.still and margins is None and not self.deviations:
            return self._reaches[0]
        more = 0.5 * LONGEST_YIELD * packed.fastest + (0.0 if margins is None else max(float(margins.max()), 0.0))
        if self.deviations:
            more += self.deviations * math.sqrt(float(packed.covariances.trace(axis1=1, axis2=2).max()))
        steps = math.ceil(more / _STEP)
        if steps not in self._reaches:
            self._reaches[steps] = self._reaches[0] + _STEP * steps
        return self._reaches[steps]

    def _rows(self, scene: Scene, matrix: Array, pairs: _Pairs, velocity: Array | None, box: Box) -> NearRows | None:
        """Return the rows of pairs, without those that no velocity in the box violates."""
        delay: Array | float = self.delay
        if pairs.approach is not None:
            ages = np.maximum(scene.stamp - scene.packed.stamps, 0.0)
            kept = violable(matrix, self._lower(pairs, self._slowest(float(ages.max()), velocity)), box)
            if not kept.any():
                return None
            matrix, pairs = matrix[kept], pairs.of(kept)
            delay += ages.take(pairs.obstacle)
        rates = shrink_rates(self.arm, matrix, pairs.approach, velocity, most=self.rate, delay=delay)
        lower = self._lower(pairs, rates)
        kept = violable(matrix, lower, box)
        if lower.max() > 0.0:  # a link that no joint moves away, such as one that turns in place above a table
            kept &= (lower <= 0.0) | (np.einsum("ij,ij->i", matrix, matrix) > _UNMOVED**2)
        if not kept.any():
            return None
        found = pairs.of(kept)
        return NearRows(Rows(matrix[kept], lower[kept]), found.obstacle, found.sphere, found.room)

    def _slowest(self, age: float, velocity: Array | None) -> float:
        """Return a lower bound of all rates at which distances may shrink [1/s]."""
        time = 0.0 if velocity is None else float((np.abs(velocity) / self.arm.max_acceleration).max())
        return min(self.rate, 1.0 / (self.delay + age + 0.5 * max(time, LONGEST_YIELD)))

    def _lower(self, pairs: _Pairs, rates: Array | float) -> Array:
        """Return the lower bounds of the rows, shape (k,) [m/s]."""
        lower = -rates * pairs.room
        lower -= (self.retreat_rate - rates) * np.minimum(pairs.room, 0.0)
        if pairs.approach is not None:
            lower += pairs.approach
        return lower


class _Pairs(NamedTuple):
    """Pairs of a sphere and an obstacle, each of shape (k,)."""

    obstacle: Indices
    sphere: Indices
    room: Array
    approach: Array | None  # speed of the obstacle along the normal [m/s]; None if no obstacle moves

    def of(self, kept: NDArray[np.bool_]) -> _Pairs:
        """Return some of the pairs."""
        approach = None if self.approach is None else self.approach[kept]
        return _Pairs(self.obstacle[kept], self.sphere[kept], self.room[kept], approach)


def _approach(packed: PackedObstacles, obstacle: Indices, points: Array, normal: Array) -> Array | None:
    """Return the speed of each obstacle's nearest point along the normal, shape (k,) [m/s]; None if none moves."""
    if packed.still:
        return None
    velocity = packed.velocities.take(obstacle, axis=0).T
    if packed.rotating:  # the nearest surface point p moves at v + w x (p - origin); c - p is along n
        arms = points - packed.positions.take(obstacle, axis=0).T
        velocity = velocity + np.cross(packed.angular_velocities.take(obstacle, axis=0).T, arms, axis=0)
    return np.asarray(np.einsum("ij,ij->j", velocity, normal))
