"""Rotations as rotation vectors from a reference rotation, so that a Gaussian can describe them."""

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
from imitarm.validation import finite_array, finite_numbers

Array = NDArray[np.float64]

_FARTHEST = np.deg2rad(120.0)  # from the reference; beyond 180 degrees the logarithm goes the other way round
_KEYS = (1, 5, 9, 17, 33)  # numbers of key rotations that are tried


@dataclass(frozen=True, eq=False)
class RotationReference:
    """A reference rotation, fixed or moving with time, in whose tangent space other rotations are vectors.

    A rotation ``R`` near the reference ``R_ref(t)`` has the rotation vector ``r = log(R R_ref(t)^T)`` [rad] in the base
    frame. A fixed reference suffices while every rotation is well within 180 degrees of it. A longer rotation needs a
    reference that moves: a cubic spline through a few key quaternions, normalised.

    Attributes:
        times: of the keys [s], strictly increasing, shape (m,); a single key is a fixed reference.
        quaternions: keys wxyz with continuous signs, shape (m, 4).

    Raises:
        InputError: when shapes disagree, a number is not finite, a quaternion is not of length one, or the times do not
            increase.
    """

    times: Array
    quaternions: Array

    def __post_init__(self) -> None:
        times = finite_array(self.times, (None,), "RotationReference: times", "s").copy()
        given = finite_array(self.quaternions, (len(times), 4), "RotationReference: quaternions")
        quaternions = checked_unit_quaternions(given, "RotationReference: quaternions")
        if np.allclose(quaternions, given, rtol=0.0, atol=1e-12):
            quaternions = given.copy()  # normalising again would change the last bit
        quaternions = continuous_signs(quaternions)
        if len(times) < 1 or np.any(np.diff(times) <= 0.0):
            raise InputError("RotationReference: times must be at least one number, each later than the one before [s]")
        times.setflags(write=False)
        quaternions.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "quaternions", quaternions)

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.quaternions)

    def at(self, times: ArrayLike) -> Array:
        """Return the reference (n, 4) wxyz at ``times`` (n,) [s]; outside the keys, the nearest one is held."""
        t = finite_numbers(times, "RotationReference: times", "s")
        if len(self.times) == 1:
            return np.repeat(self.quaternions, len(t), axis=0)
        q = self._spline(np.clip(t, self.times[0], self.times[-1]))
        return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))

    def to_vectors(self, times: ArrayLike, quaternions: ArrayLike) -> Array:
        """Return rotation vectors (n, 3) [rad] of rotations (n, 4) wxyz at ``times`` (n,); signs do not matter."""
        reference = self.at(times)
        q = finite_array(quaternions, (len(reference), 4), "RotationReference: quaternions")
        return quaternion_log(quaternion_multiply(q, quaternion_conjugate(reference)))

    def to_quaternions(self, times: ArrayLike, vectors: ArrayLike) -> Array:
        """Return rotations (n, 4) wxyz, with continuous signs, of rotation vectors (n, 3) [rad] at ``times`` (n,)."""
        reference = self.at(times)
        r = finite_array(vectors, (len(reference), 3), "RotationReference: vectors", "rad")
        return continuous_signs(quaternion_multiply(quaternion_exp(r), reference))

    @classmethod
    def among(cls, demonstrations: Sequence[tuple[Array, Array]]) -> RotationReference:
        """Return the simplest reference that has all demonstrated rotations within 120 degrees.

        That is the mean rotation, or else a spline through the mean rotations at 5, 9, 17 or 33 times.

        Args:
            demonstrations: times (n,) [s] from a common zero, and quaternions (n, 4) wxyz, of each demonstration.

        Raises:
            InputError: when demonstrations differ so much at the same time that there is no such reference.
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
            f"orientations differ by up to {np.rad2deg(farthest):.0f} degrees at the same time, most in demonstration "
            f"{worst}: the demonstrations do not rotate in the same way. Align them first, learn them as separate "
            "skills, or show them with a tool that keeps its orientation (imitarm retarget --orientation fixed)"
        )


def left_jacobian(vectors: Array) -> Array:
    """Return ``J`` (n, 3, 3) with ``exp(r + d) = exp(J d) exp(r)`` to first order, for rotation vectors (n, 3) [rad].

    It transforms a covariance of rotation vectors to one of small rotations in the base frame, ``J Sigma J^T``.
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
