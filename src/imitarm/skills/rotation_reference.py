"""Rotations as vectors near a reference rotation, so that a Gaussian can describe them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    checked_unit_quaternions,
    continuous_signs,
    mean_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    slerp,
)

Array = NDArray[np.float64]

_FARTHEST = np.deg2rad(120.0)  # from the reference: beyond 180 degrees the logarithm takes the other way round
_KEYS = (1, 5, 9, 17, 33)


@dataclass(frozen=True, eq=False)
class RotationReference:
    """A rotation, or one that moves with time, in whose tangent space other rotations are vectors.

    A rotation ``R`` near the reference ``R_ref(t)`` is the rotation vector ``r = log(R R_ref(t)^T)`` [rad], given in
    the base frame. One fixed reference serves as long as every rotation is well within 180 degrees of it; a longer
    turn needs a reference that turns along. It is a cubic spline through a few key quaternions, scaled to length one.

    Attributes:
        times: of the keys [s], strictly increasing, shape (m,); one key is a fixed reference.
        quaternions: keys wxyz with continuous signs, shape (m, 4).
    """

    times: Array
    quaternions: Array

    def __post_init__(self) -> None:
        times = np.array(self.times, dtype=float)
        quaternions = checked_unit_quaternions(self.quaternions, "RotationReference")
        if np.allclose(quaternions, self.quaternions, rtol=0.0, atol=1e-12):
            quaternions = np.array(self.quaternions, dtype=float)  # scaling again would change the last bit
        quaternions = continuous_signs(quaternions)
        if times.ndim != 1 or quaternions.shape != (len(times), 4) or len(times) < 1 or np.any(np.diff(times) <= 0.0):
            raise InputError(
                "RotationReference: needs increasing times (m,) and quaternions (m, 4), got "
                f"{times.shape} and {quaternions.shape}"
            )
        times.setflags(write=False)
        quaternions.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "quaternions", quaternions)

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.quaternions)

    def at(self, times: ArrayLike) -> Array:
        """Return the reference (n, 4) wxyz at ``times`` (n,) [s]; beyond the keys the last one is held."""
        t = np.atleast_1d(np.asarray(times, dtype=float))
        if len(self.times) == 1:
            return np.repeat(self.quaternions, len(t), axis=0)
        q = self._spline(np.clip(t, self.times[0], self.times[-1]))
        return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))

    def to_vectors(self, times: ArrayLike, quaternions: ArrayLike) -> Array:
        """Return rotation vectors (n, 3) [rad] of rotations (n, 4) wxyz at ``times`` (n,); signs don't matter."""
        return quaternion_log(quaternion_multiply(quaternions, quaternion_conjugate(self.at(times))))

    def to_quaternions(self, times: ArrayLike, vectors: ArrayLike) -> Array:
        """Return rotations (n, 4) wxyz, signs continuous, of rotation vectors (n, 3) [rad] at ``times`` (n,)."""
        return continuous_signs(quaternion_multiply(quaternion_exp(vectors), self.at(times)))

    @classmethod
    def among(cls, demonstrations: Sequence[tuple[Array, Array]]) -> RotationReference:
        """Choose the simplest reference that has all demonstrated rotations within 120 degrees.

        It is the mean rotation if that serves, else a spline through the mean rotations at 5, 9, 17 or 33 instants.

        Args:
            demonstrations: times (n,) [s] from a common zero, and quaternions (n, 4) wxyz, of each demonstration.

        Raises:
            InputError: when demonstrations differ so much at the same instant that no reference serves.
        """
        end = min(float(times[-1]) for times, _ in demonstrations)
        farthest = np.inf
        for m in _KEYS:
            keys = np.linspace(0.0, end, m) if m > 1 else np.zeros(1)
            if m == 1:
                quaternions = mean_quaternion(np.concatenate([q for _, q in demonstrations]))[None]
            else:
                at_keys = np.stack([slerp(keys, times, q) for times, q in demonstrations])
                quaternions = np.stack([mean_quaternion(at_keys[:, k]) for k in range(m)])
            reference = cls(keys, quaternions)
            angles = [np.linalg.norm(reference.to_vectors(t, q), axis=1).max() for t, q in demonstrations]
            if max(angles) <= _FARTHEST:
                return reference
            farthest = min(farthest, float(max(angles)))
        worst = int(np.argmax(angles))
        raise InputError(
            f"orientations differ by up to {np.rad2deg(farthest):.0f} degrees at the same instant, most in "
            f"demonstration {worst}: the demonstrations don't turn the same way. Align them first, "
            "learn them as separate skills, or show them with a tool that keeps its turn (imitarm retarget "
            "--orientation fixed)"
        )


def left_jacobian(vectors: Array) -> Array:
    """Return ``J`` (n, 3, 3) with ``exp(r + d) = exp(J d) exp(r)`` to first order, for rotation vectors (n, 3) [rad].

    It carries a covariance of rotation vectors to one of small turns in the base frame, ``J Sigma J^T``.
    """
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross))
