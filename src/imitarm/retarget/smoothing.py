"""Live filters for camera data: One-Euro smoothing, outlier detection, and compensation of jumps in tracking."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]

GAP = 0.3  # [s] a filter restarts after a longer gap
_SMALL = 1e-9  # [rad] below this the series of sin(a)/a is exact to double precision


LONGEST_OFFSET = 0.2  # [m] no inferred position is farther off: a larger jump is a motion
_NONE = [0.0, 0.0, 0.0]  # offset of a joint that was never hidden
_FLICKER = 0.12  # [s] a joint that returns to its previous tracking within this time gets its previous offset


def smoothing_weight(cutoff: Any, period: float) -> Any:
    r"""Return the weight of a new value in a low-pass filter, :math:`\alpha = 1 / (1 + 1/(2\pi f T))`.

    Args:
        cutoff: cut-off frequency f [Hz], a number or an array.
        period: sampling period T [s].
    """
    angle = (2.0 * math.pi * period) * cutoff
    return angle / (1.0 + angle)


class OneEuro:
    r"""The One-Euro filter for vectors (Casiez, Roussel and Vogel, CHI 2012).

    This low-pass filter raises its cut-off frequency with the speed of the motion:

    .. math:: \hat x \leftarrow \hat x + \alpha(f_c)\,(x - \hat x), \qquad f_c = f_{min} + \beta\,|\hat{\dot x}|

    The speed is the norm of the whole velocity vector, so the filter acts equally in all directions. The velocity is
    computed from the difference of two successive measured values. The original filter instead uses the difference
    between a measured value and the previous smoothed value. During steady motion, smoothed values lag behind measured
    values, so the original filter overestimates the velocity. The weight :math:`\alpha` of a value is multiplied by the
    value's confidence.

    Args:
        min_cutoff: cut-off frequency at rest [Hz].
        beta: increase of the cut-off frequency with speed [Hz per unit/s]; 8 to 15 for positions in metres.
        derivative_cutoff: cut-off frequency of the estimated speed [Hz].
    """

    def __init__(self, min_cutoff: float = 1.0, beta: float = 10.0, derivative_cutoff: float = 1.0) -> None:
        if not (min_cutoff > 0.0 and beta >= 0.0 and derivative_cutoff > 0.0):
            raise InputError("OneEuro: cut-off frequencies must be positive [Hz] and beta not negative")
        self.min_cutoff, self.beta, self.derivative_cutoff = min_cutoff, beta, derivative_cutoff
        self.reset()

    def reset(self) -> None:
        """Delete all previous values."""
        self._time = -math.inf
        self._shape: tuple[int, ...] = ()
        self._last: list[list[float]] = []  # the vectors as measured, smoothed, and their velocities
        self._smooth: list[list[float]] = []
        self._speed: list[list[float]] = []
        self.value: Array = np.zeros(0)
        self.velocity: Array = np.zeros(0)

    def filter(self, time: float, x: Array, confidence: float | Array = 1.0) -> Array:
        """Process measured vectors and return the smoothed vectors; the attribute ``velocity`` is their derivative.

        Args:
            time: time of the measurement [s]; if it is not later than the previous time, the previous result is
                returned.
            x: one vector, shape (d,), or k vectors that are filtered separately, shape (k, d).
            confidence: confidence of the measurement, from 0 to 1. For k vectors, pass one number for all, or an array
                of shape (k, 1).
        """
        period = time - self._time
        if period <= 0.0:
            return self.value
        several = x.ndim == 2
        measured: list[list[float]] = x.tolist() if several else [x.tolist()]
        if period <= GAP and x.shape != self._shape:
            raise InputError(f"OneEuro: the first vectors had shape {self._shape}, but these have shape {x.shape}")
        self._time, self._shape = time, x.shape
        if period > GAP:
            self._begin(measured)
        else:
            trust = confidence.ravel().tolist() if isinstance(confidence, np.ndarray) else [confidence] * len(measured)
            self._continue(measured, trust, period)
        self._last = measured
        self.value = np.array(self._smooth if several else self._smooth[0])
        self.velocity = np.array(self._speed if several else self._speed[0])
        return self.value

    def _begin(self, measured: list[list[float]]) -> None:
        self._smooth, self._speed = measured, [[0.0] * len(x) for x in measured]

    def _continue(self, measured: list[list[float]], trust: list[float], period: float) -> None:
        """Filter one sample with plain floats, which is twice as fast as NumPy for a few short vectors."""
        radians = 2.0 * math.pi * period
        least, beta, steady = self.min_cutoff, self.beta, smoothing_weight(self.derivative_cutoff, period)
        smooth, speeds = [], []
        for x, last, value, velocity, c in zip(measured, self._last, self._smooth, self._speed, trust, strict=True):
            weight = c * steady
            per_second = weight / period
            kept = 1.0 - weight
            speed = [kept * v + per_second * (a - b) for v, a, b in zip(velocity, x, last)]  # noqa: B905
            angle = radians * (least + beta * math.hypot(*speed))
            fraction = c * angle / (1.0 + angle)
            smooth.append([b + fraction * (a - b) for a, b in zip(x, value)])  # noqa: B905
            speeds.append(speed)
        self._smooth, self._speed = smooth, speeds


class OneEuroRotation(OneEuro):
    """The One-Euro filter for rotations, given as unit quaternions wxyz.

    The method ``filter`` takes a unit quaternion, shape (4,), and returns the smoothed quaternion. The attribute
    ``velocity`` is the angular velocity, shape (3,) [rad/s].

    Args:
        min_cutoff: cut-off frequency at rest [Hz].
        beta: increase of the cut-off frequency with speed [Hz per rad/s].
        derivative_cutoff: cut-off frequency of the estimated angular velocity [Hz].
    """

    def __init__(self, min_cutoff: float = 1.0, beta: float = 1.0, derivative_cutoff: float = 1.0) -> None:
        super().__init__(min_cutoff, beta, derivative_cutoff)

    def _begin(self, measured: list[list[float]]) -> None:
        self._smooth, self._speed = measured, [[0.0, 0.0, 0.0]]

    def _continue(self, measured: list[list[float]], trust: list[float], period: float) -> None:
        weight = trust[0] * smoothing_weight(self.derivative_cutoff, period)
        kept, per_second = 1.0 - weight, weight / period
        (p, q, r), (x, y, z) = self._speed[0], _rotation_between(self._last[0], measured[0])
        p, q, r = kept * p + per_second * x, kept * q + per_second * y, kept * r + per_second * z
        cutoff = self.min_cutoff + self.beta * math.sqrt(p * p + q * q + r * r)
        fraction = trust[0] * smoothing_weight(cutoff, period)
        x, y, z = _rotation_between(self._smooth[0], measured[0])
        self._smooth, self._speed = [_rotated(self._smooth[0], fraction * x, fraction * y, fraction * z)], [[p, q, r]]


def _rotation_between(before: list[float], after: list[float]) -> tuple[float, float, float]:
    """Return the rotation vector log(after before^-1) [rad] between two unit quaternions."""
    (w, i, j, k), (a, b, c, d) = before, after
    real = a * w + b * i + c * j + d * k
    u, v, z = b * w - a * i - c * k + d * j, c * w - a * j - d * i + b * k, d * w - a * k - b * j + c * i
    sine = math.sqrt(u * u + v * v + z * z)
    factor = 2.0 * math.atan2(sine, abs(real)) / sine if sine > _SMALL else 2.0
    factor = factor if real >= 0.0 else -factor
    return factor * u, factor * v, factor * z


def _rotated(quaternion: list[float], x: float, y: float, z: float) -> list[float]:
    """Rotate a unit quaternion by the rotation vector (x, y, z) [rad], and normalise the result."""
    w, i, j, k = quaternion
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    factor = 0.5 * math.sin(half) / half if half > _SMALL else 0.5
    a, b, c, d = math.cos(half), factor * x, factor * y, factor * z
    w, i, j, k = (
        a * w - b * i - c * j - d * k,
        a * i + b * w + c * k - d * j,
        a * j - b * k + c * w + d * i,
        a * k + b * j - c * i + d * w,
    )
    length = math.sqrt(w * w + i * i + j * j + k * k)
    return [w / length, i / length, j / length, k / length]


class Hampel:
    r"""Detects outliers: values too far from the median of a sliding window (Hampel identifier).

    A value x is an outlier if :math:`|x - \mathrm{med}| > \max(4 \cdot 1.4826\,\mathrm{MAD},\; r)`, where med is the
    median of the window and MAD the median absolute deviation from it. After a real jump, the new values count as
    outliers until they fill half of the window.

    Args:
        window: duration of the sliding window [s].
        least: distance r from the median within which no value is an outlier [m]. Choose a distance larger than a fast
            hand moves within half the window.
    """

    def __init__(self, window: float = 0.3, least: float = 0.02) -> None:
        self.window, self.least = window, least
        self._times: deque[float] = deque()
        self._values: deque[list[float]] = deque()

    def reset(self) -> None:
        """Delete all previous values."""
        self._times.clear()
        self._values.clear()

    def accept(self, time: float, x: Array) -> bool:
        """Add a value (d,) to the window, and return False if the value is an outlier."""
        times, values, value = self._times, self._values, x.tolist()
        while times and (time - times[0] > self.window or time <= times[0]):
            times.popleft()
            values.popleft()
        times.append(time)
        values.append(value)
        if len(times) < 4:
            return True
        # plain floats: for a few short vectors three times as fast as NumPy
        half = len(times) // 2
        middle = [sorted(axis)[half] for axis in zip(*values, strict=True)]
        distance = math.dist(value, middle)
        if distance <= self.least:  # nearly always
            return True
        return distance <= 4.0 * 1.4826 * sorted([math.dist(each, middle) for each in values])[half]


class TrackingOffsets:
    r"""Compensates for the jumps that occur when the state of a joint changes between tracked and inferred.

    When a joint is hidden, a camera infers its position. The error of the inferred position is several times larger
    than the error of the tracked position. When the tracking state changes, the measured position jumps, mostly because
    of the error of the inferred position. When a joint becomes inferred, this class therefore adds an offset o to the
    measured position :math:`\tilde x`. The offset is chosen so that the motion continues without a jump:

    .. math:: o = x_p + v\,\Delta t - \tilde x, \qquad x = \tilde x + o

    where x is the compensated position, :math:`x_p` the previous compensated position, v the velocity and :math:`\Delta
    t` the time step. While the joint is inferred, the offset is constant, so the compensated position changes by as
    much as the measured position. When the joint is tracked again, a new offset is chosen in the same way. While the
    joint is tracked, the offset decays with time and with the distance :math:`|\Delta x|` that the joint moves:

    .. math:: o \leftarrow o\,\exp(-\Delta t / T - |\Delta x| / L).

    A person who watches the robot does not notice the slow decay of the offset, but would notice if the robot jumped
    away and back.

    A joint may flicker between tracked and inferred. If the joint returns to a state within 0.12 s, it therefore gets
    its previous offset for this state again. With a new offset at every change, the position of a flickering joint
    would drift away from the measured position. The length of an offset is at most 0.2 m.

    Args:
        time: time constant T with which the offset decays [s].
        distance: length constant L with which the offset decays as the joint moves [m].

    Raises:
        InputError: when an argument is not positive.
    """

    def __init__(self, time: float = 10.0, distance: float = 0.15) -> None:
        if not (time > 0.0 and distance > 0.0):
            raise InputError(
                f"TrackingOffsets: time [s] and distance [m] must be positive, got {time!r} and {distance!r}"
            )
        self._time, self._distance = time, distance
        self.reset()

    def reset(self) -> None:
        """Delete all previous values."""
        self._clock = 0.0
        self._confidence: list[float] = []
        self._measured: list[list[float]] = []
        self._offsets: list[list[float]] | None = None
        # by joint and confidence: the time, and the offset then
        self._kept: dict[tuple[int, float], tuple[float, list[float]]] = {}

    def offset(self, joint: int) -> float:
        """Return the length of the offset between the compensated and the measured position of a joint [m]."""
        return 0.0 if self._offsets is None else math.hypot(*self._offsets[joint])

    def compensate(self, points: Array, confidence: list[float], velocity: Array, period: float) -> Array:
        """Return the compensated positions of the joints, shape (k, 3) [m].

        Args:
            points: measured positions, shape (k, 3) [m].
            confidence: confidence of each point, k numbers; 1 if the point is tracked.
            velocity: velocity of each point, from the previous estimate, shape (k, 3) [m/s].
            period: time since the previous call [s].
        """
        before, self._confidence = self._confidence, confidence
        last, self._measured = self._measured, points.tolist()
        if not before:
            return points
        self._clock += period
        if self._offsets is None and confidence == before:  # nothing has been hidden so far
            return points
        was = [_NONE] * len(before) if self._offsets is None else self._offsets
        offsets = list(was)
        for i, (now, then) in enumerate(zip(confidence, before, strict=True)):
            x, o = self._measured[i], was[i]
            if now != then:
                self._kept[i, then] = self._clock, o
                by_axis = zip(o, last[i], x, velocity[i].tolist(), strict=True)
                continued = [a + b + period * v - c for a, b, c, v in by_axis]
                offsets[i] = self._changed(i, now, continued)
            elif now >= 1.0 and o is not _NONE:
                left = math.exp(-period / self._time - math.dist(x, last[i]) / self._distance)
                offsets[i] = [left * a for a in o]
        self._offsets = offsets
        return points + np.array(offsets)

    def _changed(self, joint: int, confidence: float, continued: list[float]) -> list[float]:
        """Return the offset of a joint whose tracking has changed.

        The result is the recent offset for the new tracking state if there is one, or else a new offset.
        """
        when, offset = self._kept.get((joint, confidence), (-math.inf, continued))
        if self._clock - when > _FLICKER:
            offset = continued
        length = math.hypot(*offset)
        return offset if length <= LONGEST_OFFSET else [a * (LONGEST_OFFSET / length) for a in offset]
