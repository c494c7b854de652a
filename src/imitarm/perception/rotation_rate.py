"""Angular velocities of tracked obstacles, estimated from the rotations of successive detections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply, rotate

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_ROUND = ("capsule", "cylinder", "cone")  # shapes with an axis z, whose rotation about it can't be seen
_BOTH_ENDS = ("capsule", "cylinder")  # of these, shapes with two equal ends
_HALF_TURNS = np.eye(4)  # identity, and rotations by 180 degrees about x, y and z, which a box does not show
_SMOOTHING = 0.03  # [s]
_JUMP = 0.7  # [rad] between two detections: another axis was measured
_DOUBT = 4.0  # a rate is reduced by so many of its own variances


class Rates(NamedTuple):
    r"""Smoothed angular velocities of n obstacles, and the noise of each of them.

    Let ``theta`` [rad] be the rotation vector between two successive detections of an obstacle, and ``dt`` [s] the time
    between them. The smoothed angular velocity ``omega`` and the mean square ``s^2`` of its residual ``r`` are updated
    by

    .. math::
        r = \theta / dt - \omega, \qquad \omega \leftarrow \omega + g\,r, \qquad
        s^2 \leftarrow s^2 + g\,(|r|^2 - s^2), \qquad g = dt / (dt + 0.03\,\mathrm{s})

    The variance of ``omega`` is about ``g / (2 - g) s^2``. The reported angular velocity is ``omega max(0, 1 - 4 g / (2
    - g) s^2 / |omega|^2)``. It is 0 if ``|omega|`` is at most twice the standard deviation of ``omega``.

    Attributes:
        omega: smoothed angular velocities, shape (n, 3) [rad/s].
        scatter: mean square s^2 of the residuals, shape (n,) [rad^2/s^2].
        share: weight g of the last detection, shape (n,).
    """

    omega: Array
    scatter: Array
    share: Array

    @classmethod
    def none(cls, n: int) -> Rates:
        """Return the rates of n obstacles that do not rotate."""
        return cls(np.zeros((n, 3)), np.zeros(n), np.zeros(n))

    def rows(self, rows: Indices) -> Rates:
        """Return the rates of the obstacles with the indices ``rows``."""
        return Rates(*(array[rows] for array in self))

    def joined(self, other: Rates) -> Rates:
        """Return these rates, followed by the rates ``other``."""
        return Rates(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def seen(self, rows: Indices, turns: Array, dt: Array) -> Rates:
        """Return the rates after the obstacles ``rows`` (k,) rotated by ``turns`` (k, 3) [rad] in ``dt`` (k,) [s]."""
        if not (turns.any() or self.omega[rows].any()):
            return self
        omega, scatter, share = (array.copy() for array in self)
        dt = np.maximum(dt, 1e-6)
        g = dt / (dt + _SMOOTHING)
        jumps = np.sum(turns * turns, axis=1) > _JUMP**2
        residual = np.where(jumps[:, None], 0.0, turns / dt[:, None] - omega[rows])
        omega[rows] += g[:, None] * residual
        squared = np.where(jumps, _JUMP**2 / dt**2, np.sum(residual * residual, axis=1))
        scatter[rows] += g * (squared - scatter[rows])
        share[rows] = g
        return Rates(omega, scatter, share)

    @property
    def reported(self) -> Array:
        """The angular velocities to report, see :class:`Rates`, shape (n, 3) [rad/s]."""
        if not self.omega.any():
            return self.omega
        squared = np.sum(self.omega * self.omega, axis=1)
        noise = _DOUBT * self.share / (2.0 - self.share) * self.scatter
        return np.asarray(self.omega * np.maximum(0.0, 1.0 - noise / np.maximum(squared, 1e-12))[:, None])


def turned(kinds: Sequence[str], before: Array, now: Array) -> Array:
    """Return the smallest rotation of each obstacle that leads from its first to its second measured rotation.

    No sensor sees a rotation that maps a shape onto itself: any rotation of a sphere, a rotation of a capsule about its
    axis, or a rotation of a box by 180 degrees. Such a rotation counts as no rotation.

    Args:
        kinds: kinds of the shapes, of length k.
        before: rotations measured first, quaternions wxyz, shape (k, 4).
        now: rotations measured later, quaternions wxyz, shape (k, 4).

    Returns:
        Rotation vectors in the base frame, shape (k, 3) [rad].
    """
    found = np.zeros((len(kinds), 3))
    for i in np.flatnonzero((before != now).any(axis=1)).tolist():
        if kinds[i] in _ROUND:
            found[i] = _of_axis(before[i], now[i], kinds[i] in _BOTH_ENDS)
        elif kinds[i] != "sphere":
            symmetric = _HALF_TURNS if kinds[i] in {"box", "ellipsoid"} else _HALF_TURNS[:1]
            same = quaternion_multiply(np.broadcast_to(now[i], symmetric.shape), symmetric)
            steps = quaternion_log(quaternion_multiply(same, quaternion_conjugate(before[i])))
            found[i] = steps[int(np.argmin(np.sum(steps * steps, axis=1)))]
    return found


def _of_axis(before: Array, now: Array, both_ends: bool) -> Array:
    """Return the smallest rotation vector that takes one direction of the local z axis to the other, shape (3,)."""
    first, second = rotate(before, np.array([0.0, 0.0, 1.0])), rotate(now, np.array([0.0, 0.0, 1.0]))
    cosine = float(first @ second)
    if both_ends and cosine < 0.0:
        second, cosine = -second, -cosine
    across = np.cross(first, second)
    sine = float(np.sqrt(across @ across))
    return across * (np.arctan2(sine, cosine) / sine) if sine > 1e-12 else np.zeros(3)


def turned_on(quaternions: Array, omega: Array, elapsed: Array) -> Array:
    """Return quaternions (n, 4) after a rotation with ``omega`` (n, 3) [rad/s] for ``elapsed`` (n,) [s]."""
    if not omega.any():
        return quaternions
    return quaternion_multiply(quaternion_exp(elapsed[:, None] * omega), quaternions)
