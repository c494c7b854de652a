"""HandCurve: a smooth curve of a hand's pose over time, which can be fitted during the motion."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
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
from imitarm.retarget.baselines.nurbs import NURBS, Smoothing, fit_nurbs

Array = NDArray[np.float64]

_DEGREE = 3
_MU = 1.0  # smoothing of the live curve; cross validation takes longer than a frame and gives about this value
_SIGMA = 0.012  # [m] standard deviation of a Kinect; samples farther than 2.5 of it lose weight
_LATE = 0.02  # fraction by which the clock adapts to a frame that is later than usual
_RESTART = 0.25  # [s] a source whose clock jumps by more has restarted


@dataclass(frozen=True, eq=False)
class RotationCurve:
    r"""A smooth curve of rotations, :math:`R(t) = R_0 \exp(c(t))`, where c is a :class:`NURBS` of rotation vectors.

    Rotation vectors relative to a mean rotation are continuous and have no singularity for angles below 360 degrees.
    Roll, pitch and yaw do not have these properties.

    Attributes:
        reference: reference rotation :math:`R_0`, quaternion wxyz, shape (4,).
        vectors: curve c of the rotation vectors [rad] over time [s].
    """

    reference: Array
    vectors: NURBS

    def evaluate(self, t: ArrayLike) -> Array:
        """Return the rotations at times (k,) as quaternions wxyz, shape (k, 4); for a single time, shape (4,)."""
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
    """Fit a curve to rotations: to their rotation vectors relative to their mean rotation (:func:`fit_nurbs`).

    Args:
        times: times of the samples, strictly increasing, shape (k,) [s].
        quaternions: unit quaternions wxyz, shape (k, 4); q and -q are the same rotation.
        confidence: confidences from 0 to 1, shape (k,); None: all 1.
        degree: degree of the curve.
        n_control: number of control points; None: see :func:`fit_nurbs`.
        smoothing: weight of the smoothing, ``"gcv"`` or ``"morozov"``, see :func:`fit_nurbs`.
        sigma: standard deviation of the measured rotation vectors on each axis [rad]; None: it is estimated.
        robust: whether to reduce the weight of outliers.

    Raises:
        InputError: for the same reasons as :func:`fit_nurbs`.
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
    """Return rotation vectors (k, 3) in which the angle does not jump by 2 pi when it passes pi."""
    length = np.sqrt(np.sum(vectors * vectors, axis=1))
    if not length.max() > 0.5 * math.pi:  # no two of them differ by 180 degrees
        return vectors
    result, middle = vectors.copy(), int(np.argmin(length))
    for k, beside in [(k, k - 1) for k in range(middle + 1, len(length))] + [(k, k + 1) for k in range(middle)[::-1]]:
        if length[k] > 1e-9:
            turns = np.round((result[beside] @ vectors[k] / length[k] - length[k]) / (2.0 * math.pi))
            result[k] = vectors[k] * (1.0 + turns * 2.0 * math.pi / length[k])
    return result


@dataclass(frozen=True, eq=False)
class HandSample:
    """Pose of a hand in one frame.

    Attributes:
        time: time of the frame, on the clock of the camera or recording [s].
        wrist: wrist position in the base frame, shape (3,) [m].
        hand: hand rotation in the base frame, quaternion wxyz, shape (4,).
        confidence: confidences of the position and of the rotation, each 0 to 1.
    """

    time: float
    wrist: Array
    hand: Array
    confidence: tuple[float, float]


@dataclass(frozen=True, eq=False)
class HandCurve:
    """A smooth curve of a hand's position and rotation.

    Attributes:
        wrist: curve of the wrist position [m] over time [s].
        hand: curve of the hand rotation over time [s].
    """

    wrist: NURBS
    hand: RotationCurve

    @classmethod
    def through(cls, samples: Sequence[HandSample], smoothing: Smoothing = "gcv", *, robust: bool = True) -> HandCurve:
        """Fit a curve of positions and a curve of rotations to at least four samples.

        Raises:
            InputError: when there are fewer than four samples, or times do not increase.
        """
        if len(samples) <= _DEGREE:
            raise InputError(f"HandCurve: needs at least {_DEGREE + 1} frames that show the arm, got {len(samples)}")
        times = np.array([sample.time for sample in samples])
        confidence = np.array([sample.confidence for sample in samples])
        wrist = fit_nurbs(
            times,
            [sample.wrist for sample in samples],
            confidence[:, 0],
            degree=_DEGREE,
            smoothing=smoothing,
            sigma=_SIGMA,
            robust=robust,
        )
        hand = fit_rotations(
            times,
            [sample.hand for sample in samples],
            confidence[:, 1],
            degree=_DEGREE,
            smoothing=smoothing,
            robust=False,
        )
        return cls(wrist, hand)

    def at(self, time: float) -> tuple[Array, Array]:
        """Return wrist (3,) [m] and hand quaternion (4,) at a time [s]; both are constant beyond the curve."""
        return self.wrist.evaluate(time), self.hand.evaluate(time)


class DelayedCurve:
    """Smooths a hand's motion while it is captured.

    The filter fits a curve to the last 0.6 s (``window``) and evaluates this curve ``lag`` seconds in the past.

    The end of a fitted curve changes with every new frame. A point that is ``lag`` seconds earlier changes less,
    because there are frames before and after it. Frames arrive at irregular times. The filter therefore advances its
    time with the control steps, and uses the time stamps of the frames only to correct this time.

    Args:
        window: length of the time window to which the curve is fitted [s].
        lag: time between the evaluated point of the curve and the current time [s].
        smooth: whether to fit a curve; if False, the result is the pose in the newest frame.
        whole: curve of the complete motion, which is evaluated without lag; None: a curve is fitted to the last frames.
    """

    def __init__(
        self, window: float = 0.6, lag: float = 0.07, *, smooth: bool = True, whole: HandCurve | None = None
    ) -> None:
        if not 0.2 <= window <= 5.0 or not 0.0 <= lag <= 0.5 * window:
            raise InputError("DelayedCurve: window must be 0.2 to 5 s, and lag must be 0 s to half of window")
        self._window, self._smooth, self._whole = window, smooth, whole
        self._lag = lag if whole is None else 0.0
        self._samples: deque[HandSample] = deque()
        self._curve: HandCurve | None = None
        self._clock, self._ahead = 0.0, -math.inf

    def add(self, sample: HandSample) -> None:
        """Add a frame that is later than the previous one."""
        ahead = sample.time - self._clock
        off = ahead - self._ahead
        self._ahead = ahead if off > 0.0 or off < -_RESTART else self._ahead + _LATE * off
        seen = self._samples
        while seen and sample.time - seen[0].time > self._window:
            seen.popleft()
        seen.append(sample)
        if self._smooth and self._whole is None:
            self._curve = HandCurve.through(seen, _MU) if len(seen) > _DEGREE else None

    def step(self, dt: float) -> None:
        """Advance the time of the filter by ``dt`` [s]."""
        self._clock += dt

    def now(self) -> tuple[Array, Array] | None:
        """Return the current smoothed wrist (3,) [m] and hand quaternion (4,); None before the first frame."""
        if not self._samples:
            return None
        curve = self._curve if self._whole is None else self._whole
        if curve is None:
            return self._samples[-1].wrist, self._samples[-1].hand
        return curve.at(self._clock + self._ahead - self._lag)
