"""ClearanceLimit: bounds the speed at which every part of the arm approaches an obstacle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Rows
from imitarm.scene.distances import near_pairs
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, instance

Array = NDArray[np.float64]

_UNMOVED = 1e-6  # [m/rad] a joint that changes a distance by less does not change it


class ClearanceLimit:
    r"""Inequalities on the joint velocity that keep a clearance between every link (and the tool) and every obstacle.

    Spheres cover the arm and its tool (``ArmModel.collision_spheres``). For the sphere with centre ``c`` and radius
    ``r`` near an obstacle with signed distance ``sd`` and outward normal ``n``, the remaining distance is ``h = sd(c) -
    r - clearance``. If ``v_o`` is the velocity of the obstacle's nearest point, the row

    .. math:: n^T J(q)\, \dot q \;\ge\; n^T v_o - \xi h

    lets this distance shrink at most exponentially, so that it stays positive. h can still become negative, because
    links move on arcs and control steps are finite. In this case it must grow, with ``retreat_rate`` instead of
    :math:`\xi`. Every sphere within ``influence`` of an obstacle has a row; none is left out. The spheres contain the
    shapes they cover, so the true distance is never smaller than the distance of the spheres.

    Args:
        arm: arm with its tool.
        clearance: required distance of every link to every obstacle [m].
        rate: ``xi``, the fraction of h by which h may shrink per second [1/s].
        influence: value of h beyond which a sphere has no row [m].
        retreat_rate: fraction of a negative h that is regained per second [1/s].

    Raises:
        InputError: when ``arm`` is not an ArmModel, or a number is not finite or is negative.
    """

    def __init__(
        self,
        arm: ArmModel,
        clearance: float,
        *,
        rate: float = 6.0,
        influence: float = 0.15,
        retreat_rate: float = 25.0,
    ) -> None:
        self.arm = instance(arm, ArmModel, "ClearanceLimit: arm")
        self.clearance = finite_number(clearance, "ClearanceLimit: clearance", "m", at_least=0.0)
        self.rate = finite_number(rate, "ClearanceLimit: rate", "1/s", at_least=0.0)
        self.retreat_rate = finite_number(retreat_rate, "ClearanceLimit: retreat_rate", "1/s", at_least=0.0)
        self.influence = finite_number(influence, "ClearanceLimit: influence", "m", above=0.0)
        cover = arm.cover
        self._cover = cover
        self._reduced = cover.radii + self.clearance  # [m] what is taken off a distance
        self._reach = self._reduced + self.influence

    def rows(self, q: ArrayLike, scene: Scene) -> Rows | None:
        """Return the inequalities for one posture.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            scene: obstacles predicted for the current time, with their velocities.

        Returns:
            One row for each pair of a sphere and an obstacle within ``influence``, except pairs that are too close and
            whose distance no joint can change; None when there is no pair.

        Raises:
            InputError: when ``q`` is not n_joints finite numbers.
        """
        packed = scene.packed
        if not len(packed):
            return None
        data = self.arm.at(q).data
        centers = self._cover.centers(data)
        pairs = near_pairs(packed, centers, self._reach)
        if pairs is None:
            return None
        obstacle, sphere, distance, normal = pairs
        points = centers.take(sphere, axis=0).T
        room = distance - self._reduced.take(sphere)
        lower = -self.rate * room
        lower -= (self.retreat_rate - self.rate) * np.minimum(room, 0.0)
        if not packed.still:
            velocity = packed.velocities.take(obstacle, axis=0).T
            if packed.rotating:  # the nearest surface point p moves at v + w x (p - origin); c - p is along n
                arms = points - packed.positions.take(obstacle, axis=0).T
                velocity = velocity + np.cross(packed.angular_velocities.take(obstacle, axis=0).T, arms, axis=0)
            lower += np.einsum("ij,ij->j", velocity, normal)
        matrix = self._cover.speeds(data, sphere, points, normal)
        if lower.max() > 0.0:  # a link that no joint moves away, such as one that turns in place above a table
            pressed = (lower > 0.0).nonzero()[0]
            own = matrix.take(pressed, axis=0)
            stuck = pressed[np.einsum("ij,ij->i", own, own) <= _UNMOVED**2]
            if len(stuck):
                kept = np.ones(len(lower), dtype=bool)
                kept[stuck] = False
                matrix, lower = matrix[kept], lower[kept]
        return Rows(matrix, lower)
