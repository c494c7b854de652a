"""RotationCurve: rotations along a smooth curve, fitted to what a camera saw (METHODS A.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    mean_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
)
from imitarm.retarget.baselines.nurbs import NURBS
from imitarm.retarget.baselines.nurbs_fit import Smoothing, fit_nurbs

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RotationCurve:
    r"""Rotations along a curve: :math:`R(t) = R_0 \exp(c(t))` with c a :class:`NURBS` of rotation vectors.

    Angles of roll, pitch and yaw would wrap and lock (METHODS A.3); rotation vectors about a middle rotation do neither
    within a turn.

    Attributes:
        reference: :math:`R_0`, quaternion wxyz, shape (4,).
        vectors: c [rad] over time [s].
    """

    reference: Array
    vectors: NURBS

    def evaluate(self, t: ArrayLike) -> Array:
        """Return the quaternions wxyz at times (k,), shape (k, 4); of a single number, shape (4,)."""
        return quaternion_multiply(self.reference, quaternion_exp(self.vectors.evaluate(t)))


def fit_rotations(
    times: ArrayLike,
    quaternions: ArrayLike,
    confidence: ArrayLike | None = None,
    *,
    degree: int = 3,
    n_control: int | None = None,
    smoothing: Smoothing = "gcv",
    sigma: float | None = None,
    robust: bool = True,
) -> RotationCurve:
    """Fit a curve to rotations: :func:`fit_nurbs` of their rotation vectors about the middle one.

    Args:
        times: strictly increasing, shape (k,) [s].
        quaternions: unit, wxyz, shape (k, 4); signs do not matter.
        confidence: 0 to 1, shape (k,); None: all 1.
        degree: as in :func:`fit_nurbs`, and so are the others.
        n_control: number of control points.
        smoothing: a number, ``"gcv"`` or ``"morozov"``.
        sigma: standard deviation of a rotation vector on each axis [rad].
        robust: samples far off count for less.

    Raises:
        InputError: as :func:`fit_nurbs`.
    """
    q = np.asarray(quaternions, dtype=float)
    if q.ndim != 2 or q.shape[1] != 4:
        raise InputError(f"fit_rotations: quaternions must have shape (k, 4), got {q.shape}")
    reference = mean_quaternion(q[np.isfinite(q).all(axis=1)])
    vectors = _continuous(quaternion_log(quaternion_multiply(quaternion_conjugate(reference), q)))
    curve = fit_nurbs(
        times,
        vectors,
        confidence,
        degree=degree,
        n_control=n_control,
        smoothing=smoothing,
        sigma=sigma,
        robust=robust,
    )
    return RotationCurve(reference, curve)


def _continuous(vectors: Array) -> Array:
    """Return rotation vectors (k, 3) of which none jumps by a turn where the angle passes pi, from the least one on."""
    length = np.sqrt(np.sum(vectors * vectors, axis=1))
    if not length.max() > 0.5 * math.pi:  # two such can't be half a turn apart
        return vectors
    result, middle = vectors.copy(), int(np.argmin(length))
    for k, beside in [(k, k - 1) for k in range(middle + 1, len(length))] + [(k, k + 1) for k in range(middle)[::-1]]:
        if length[k] > 1e-9:
            turns = np.round((result[beside] @ vectors[k] / length[k] - length[k]) / (2.0 * math.pi))
            result[k] = vectors[k] * (1.0 + turns * 2.0 * math.pi / length[k])
    return result
