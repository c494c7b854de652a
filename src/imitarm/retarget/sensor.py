"""The pose of the sensor, fitted to points whose positions are known both to the sensor and to the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, matrix_to_quaternion

Array = NDArray[np.float64]

LEAST_PAIRS = 4
GOOD = 0.02  # [m] RMS residual of a good calibration; the noise of a skeleton camera is 1 to 2 cm
_USABLE = 0.10  # [m] with a larger RMS residual a unit, the order or an axis is wrong
_NEAR = 0.05  # [m] points within this distance of their mean are one point for a skeleton camera
_THIN = 0.03  # [m] the same for the distance from a line
_FLAT = 0.02  # [m] the same for the distance from a plane
_MISTAKEN = 3.0  # a pair is suspect when the RMS residual without it is smaller by this factor
_WORTH = 0.005  # [m] RMS residual below which no pair is suspect


@dataclass(frozen=True, eq=False)
class SensorFit:
    """The pose of the sensor and its uncertainty.

    Attributes:
        sensor_to_base: pose of the sensor in the robot's base frame.
        residuals: remaining distance of each pair of points, shape (n,) [m].
        condition: first over second singular value of the points' cross-covariance H: 1 for points spread equally in
            all directions, large for points almost on a line.
        angle_error: standard error of the rotation about its least certain axis [rad].
        flat: whether the points lie in a plane; a mirrored axis is then not detected.
        suspect: index of the pair that does not fit the others, from 0; None: all fit.
    """

    sensor_to_base: Pose
    residuals: Array
    condition: float
    angle_error: float
    flat: bool
    suspect: int | None = None

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def accepted(self) -> bool:
        """Whether the fit is good enough for teleoperation: 2 cm, and every pair fits."""
        return self.rms <= GOOD and self.suspect is None

    def notes(self) -> list[str]:
        """Return remarks for the user, one line each."""
        lines = []
        if self.flat:
            lines.append(
                "the points lie in a plane, so a mirrored axis would not be detected; add a point well outside that "
                "plane"
            )
        if self.suspect is not None:
            lines.append(
                f"point {self.suspect + 1} does not fit the others (by {100 * self.residuals[self.suspect]:.1f} cm); "
                "touch it again, or leave it out"
            )
        elif self.rms > GOOD:
            lines.append(
                f"the average error is {100 * self.rms:.1f} cm, {100 * GOOD:.0f} cm or less is good; hold the "
                "hand still and in view while it is measured"
            )
        return lines


def fit_sensor_to_base(sensor: ArrayLike, base: ArrayLike, weights: ArrayLike | None = None) -> SensorFit:
    r"""Fit the pose of the sensor to points given in both frames (Kabsch 1976, Umeyama 1991).

    .. math::
        H = \sum_i c_i (k_i - \bar k)(b_i - \bar b)^T = U S V^T, \quad
        R = V\,\mathrm{diag}(1, 1, \det V U^T)\,U^T, \quad t = \bar b - R \bar k

    No scale is fitted: both frames are in metres, and a scale would only hide a wrong unit.

    Args:
        sensor: the points as the sensor saw them, shape (n, 3) [m].
        base: the same points in the robot's base frame, shape (n, 3) [m].
        weights: of the pairs, shape (n,); None: equal.

    Raises:
        InputError: when there are fewer than four pairs, they are not finite, lie on a line or too close together, or
            no rigid motion maps one set to the other; the message says what to do.
    """
    k, b, c = _checked(sensor, base, weights)
    pose, singular = _kabsch(k, b, c)
    residuals = np.linalg.norm(pose.apply(k) - b, axis=1)
    spread = _spread(b)
    rms = float(np.sqrt(np.mean(residuals**2)))
    if rms > _USABLE:
        raise InputError(_misfit(k, b, c, rms))
    sigma = math.sqrt(float(np.sum(residuals**2)) / max(3 * len(k) - 6, 1))
    lever = math.sqrt(len(k) * float(spread[1] ** 2 + spread[2] ** 2))
    return SensorFit(
        pose,
        residuals,
        float(singular[0] / max(singular[1], 1e-12)),
        sigma / lever,
        bool(spread[2] < _FLAT),
        _suspect(k, b, c, rms),
    )


def _checked(sensor: ArrayLike, base: ArrayLike, weights: ArrayLike | None) -> tuple[Array, Array, Array]:
    k, b = np.asarray(sensor, dtype=float), np.asarray(base, dtype=float)
    if k.ndim != 2 or k.shape[1:] != (3,) or k.shape != b.shape:
        raise InputError(f"sensor calibration: needs two sets of n points (n, 3), got shapes {k.shape} and {b.shape}")
    if len(k) < LEAST_PAIRS:
        raise InputError(f"sensor calibration: {len(k)} pairs of points, at least {LEAST_PAIRS} are needed; touch more")
    bad = ~np.isfinite(k).all(axis=1) | ~np.isfinite(b).all(axis=1)
    if bad.any():
        raise InputError(f"sensor calibration: point {int(np.argmax(bad)) + 1} is not finite; touch it again")
    c = np.ones(len(k)) if weights is None else np.asarray(weights, dtype=float)
    if c.shape != (len(k),) or not np.isfinite(c).all() or (c <= 0.0).any():
        raise InputError(f"sensor calibration: weights must be {len(k)} positive numbers, got {weights!r}")
    for points, whose in ((k, "the sensor"), (b, "the robot")):
        wide, thin, _ = _spread(points)
        if wide < _NEAR:
            raise InputError(
                f"sensor calibration: the points of {whose} lie within {100 * wide:.1f} cm of their mean; choose "
                "points that are 20 to 60 cm apart (is the unit metres?)"
            )
        if thin < _THIN:
            raise InputError(
                f"sensor calibration: the points of {whose} lie on a line (within {100 * thin:.1f} cm), so "
                "the rotation about that line is unknown; add points well outside it"
            )
    return k, b, c


def _spread(points: Array) -> Array:
    """Return the standard deviations of points along their principal directions, largest first, shape (3,) [m]."""
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / math.sqrt(len(points)))


def _kabsch(k: Array, b: Array, c: Array) -> tuple[Pose, Array]:
    """Return the rigid motion from k to b, and the singular values of H."""
    weight = c / c.sum()
    k_mean, b_mean = weight @ k, weight @ b
    u, singular, vt = np.linalg.svd((k - k_mean).T @ (weight[:, None] * (b - b_mean)))
    rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return Pose(b_mean - rotation @ k_mean, matrix_to_quaternion(rotation)), singular


def _rms(k: Array, b: Array, c: Array) -> float:
    pose, _ = _kabsch(k, b, c)
    return float(np.sqrt(np.mean(np.sum((pose.apply(k) - b) ** 2, axis=1))))


def _suspect(k: Array, b: Array, c: Array, rms: float) -> int | None:
    """Return the index of the pair without which the others fit far better; None when no pair is an outlier."""
    if len(k) < LEAST_PAIRS + 1 or rms < _WORTH:
        return None
    every = np.arange(len(k))
    without = [_rms(k[every != i], b[every != i], c[every != i]) for i in every]
    best = int(np.argmin(without))
    return best if _MISTAKEN * without[best] < rms else None


def _misfit(k: Array, b: Array, c: Array, rms: float) -> str:
    """Return why no rigid motion maps one set to the other."""
    text = f"sensor calibration: the average error is {100 * rms:.0f} cm: "
    ratio = float(np.linalg.norm(b - b.mean(axis=0)) / np.linalg.norm(k - k.mean(axis=0)))
    if _rms(k * [-1.0, 1.0, 1.0], b, c) < 0.5 * rms:
        return text + "one of the frames is mirrored; reverse the sensor's x axis (is its picture mirrored?)"
    if not 0.67 < ratio < 1.5 and _rms(ratio * k, b, c) < 0.5 * rms:
        return text + f"the robot's points are {ratio:.3g} times as far apart as the sensor's; give both in metres"
    suspect = _suspect(k, b, c, rms)
    if suspect is not None:
        return text + f"point {suspect + 1} does not fit the others; touch it again, or leave it out"
    return text + "they are not the same points in the same order; touch them again one by one"
