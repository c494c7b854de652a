"""SelfFilter: finds the measured points that belong to the robot itself."""

from __future__ import annotations

from bisect import bisect_right, insort

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.validation import finite_number, finite_vector, instance

Array = NDArray[np.float64]


class SelfFilter:
    r"""Finds the measured points on the arm or its tool, so that a robot doesn't avoid itself.

    Spheres cover the arm (``ArmModel.collision_spheres``). At the time at which the points were measured, let ``c`` be
    the centre of a sphere, ``r`` its radius, and ``v`` the velocity of its centre. The point ``p`` belongs to the arm
    if, for any sphere,

    .. math:: |p - c| \le r + d + |v|\,\delta

    The padding :math:`d` covers errors of the calibration and of the measurement. The time :math:`\delta` is the
    uncertainty of the time stamps: if a stamp is wrong by 33 ms, a link that moves at 1 m/s appears 33 mm away from its
    true position. The filter also removes the points of an obstacle that is closer to the arm than the padding.
    Therefore, the padding should be small.

    Args:
        arm: arm with its tool.
        padding: padding ``d`` of each sphere [m].
        stamp_uncertainty: uncertainty ``delta`` of the time stamps [s].
        history: time for which recorded joint positions are kept [s].

    Raises:
        InputError: when ``arm`` is not an ArmModel, or a number is negative or not finite.
    """

    def __init__(
        self, arm: ArmModel, *, padding: float = 0.03, stamp_uncertainty: float = 0.04, history: float = 2.0
    ) -> None:
        self.arm = instance(arm, ArmModel, "SelfFilter: arm")
        self.padding = finite_number(padding, "SelfFilter: padding", "m", at_least=0.0)
        self.stamp_uncertainty = finite_number(
            stamp_uncertainty, "SelfFilter: stamp_uncertainty", "s", at_least=0.0, at_most=1.0
        )
        self.history = finite_number(history, "SelfFilter: history", "s", above=0.0)
        self._stamps: list[float] = []
        self._postures: dict[float, Array] = {}

    def record(self, stamp: float, q: ArrayLike) -> None:
        """Store the joint positions of the arm at one time.

        Joint positions may arrive in any order. Of two records with the same stamp, the second replaces the first.

        Args:
            stamp: time of the joint positions [s].
            q: joint positions, shape (n_joints,) [rad].

        Raises:
            InputError: when ``stamp`` is not a finite number, or ``q`` is not n_joints finite numbers.
        """
        stamp = finite_number(stamp, "SelfFilter.record: stamp", "s")
        q = finite_vector(q, self.arm.n_joints, "SelfFilter.record: q", "rad")
        if stamp not in self._postures:
            insort(self._stamps, stamp)
        self._postures[stamp] = np.array(q, dtype=float)
        while self._stamps[0] < self._stamps[-1] - self.history:
            del self._postures[self._stamps.pop(0)]

    def reset(self) -> None:
        """Forget all recorded joint positions."""
        self._stamps.clear()
        self._postures.clear()

    @property
    def ready(self) -> bool:
        """Whether any joint positions were recorded."""
        return bool(self._stamps)

    def posture(self, time: float) -> Array:
        """Return the joint positions at ``time`` [s], interpolated between recorded positions, shape (n_joints,) [rad].

        Before the first record, the first joint positions are returned. After the last record, the joint positions are
        extrapolated with the last velocity for at most ``stamp_uncertainty`` seconds, and then stay constant.
        """
        stamps = self._stamps
        if not stamps:
            return self.arm.home.copy()
        after = bisect_right(stamps, time)
        if after == 0 or len(stamps) == 1:
            return self._postures[stamps[0 if after == 0 else -1]]
        after = min(after, len(stamps) - 1)
        start, end = stamps[after - 1], stamps[after]
        fraction = (min(time, stamps[-1] + self.stamp_uncertainty) - start) / (end - start)
        first, last = self._postures[start], self._postures[end]
        return np.asarray(first + fraction * (last - first))

    def spheres(self, time: float) -> tuple[Array, Array]:
        """Return centres (m, 3) [m] and padded radii (m,) [m] of the spheres that cover the robot at ``time`` [s]."""
        delta = max(self.stamp_uncertainty, 1e-3)
        before, now, after = (
            self.arm.collision_spheres(self.posture(time + shift))[0].copy() for shift in (-delta, 0.0, delta)
        )
        moved = np.maximum(np.linalg.norm(now - before, axis=1), np.linalg.norm(after - now, axis=1))
        cover = self.arm.cover
        padded = cover.radii + self.padding + moved * (self.stamp_uncertainty / delta)
        centers = np.concatenate([now, cover.base_centers])
        return centers, np.concatenate([padded, cover.base_radii + self.padding])

    def on_arm(self, points: Array, time: float, margin: Array | float = 0.0) -> NDArray[np.bool_]:
        """Return whether each point belongs to the arm, shape (n,).

        Args:
            points: points in the base frame, shape (n, 3) [m].
            time: time at which the points were measured [s].
            margin: additional padding of each point, for example for its noise, shape (n,) or a number [m].
        """
        found = np.zeros(len(points), dtype=bool)
        if not len(points):
            return found
        centers, radii = self.spheres(time)
        most = float(np.max(margin))
        low, high = (centers - radii[:, None]).min(axis=0) - most, (centers + radii[:, None]).max(axis=0) + most
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        if len(near):
            p = points[near]
            squares = (p * p).sum(axis=1)[:, None] + (centers * centers).sum(axis=1) - 2.0 * p @ centers.T
            distance = np.sqrt(np.maximum(squares, 0.0)) - radii
            extra = np.broadcast_to(margin, len(points))[near]
            found[near] = distance.min(axis=1) <= extra
        return found
