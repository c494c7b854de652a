"""Live filters for what a camera sees: One-Euro smoothing, outlier detection, and jumps of the tracking."""

from __future__ import annotations

import math
from collections import deque
from operator import sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]

GAP = 0.3  # [s] after a longer gap a filter begins anew
_SMALL = 1e-9  # [rad] below this the series of sin(a)/a is exact to double precision


FARTHEST = 0.2  # [m] no camera's guess is farther off: an offset beyond was a motion
_NONE = [0.0, 0.0, 0.0]  # the offset of a joint that was never hidden
_AGAIN = 0.12  # [s] a joint that is seen, or guessed, again so soon has the offset that it had then


def smoothing_share(cutoff: Any, period: float) -> Any:
    r"""Return :math:`\alpha = 1 / (1 + 1/(2\pi f T))`: how much of a new value a low-pass filter takes over.

    Args:
        cutoff: f [Hz], a number or an array.
        period: T [s].
    """
    turned = (2.0 * math.pi * period) * cutoff
    return turned / (1.0 + turned)


class OneEuro:
    r"""The One-Euro filter of a vector (Casiez et al. 2012; METHODS A.9).

    A low-pass filter whose cut-off rises with the speed of the motion:

    .. math:: \hat x \leftarrow \hat x + \alpha(f_c)\,(x - \hat x), \qquad f_c = f_{min} + \beta\,|\hat{\dot x}|

    The speed is that of the vector, not of each axis, so the filter is the same in every direction. It is taken from
    two measured values; the usual difference to the smoothed value before holds the filter's own lag, and comes out
    too large on a steady motion, which matters to whoever leads with it. A value with a confidence
    c below 1 is taken over by c times as much.

    Args:
        min_cutoff: cut-off at rest [Hz].
        beta: how quickly it rises [Hz per unit/s]; for positions in metres 8 to 15.
        derivative_cutoff: of the estimated speed [Hz].
    """

    def __init__(self, min_cutoff: float = 1.0, beta: float = 10.0, derivative_cutoff: float = 1.0) -> None:
        if not (min_cutoff > 0.0 and beta >= 0.0 and derivative_cutoff > 0.0):
            raise InputError("OneEuro: cut-off frequencies must be positive [Hz] and beta not negative")
        self.min_cutoff, self.beta, self.derivative_cutoff = min_cutoff, beta, derivative_cutoff
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._time = -math.inf
        self._shape: tuple[int, ...] = ()
        self._last: list[list[float]] = []  # the vectors as they were measured, smoothed, and their velocities
        self._smooth: list[list[float]] = []
        self._speed: list[list[float]] = []
        self.value: Array = np.zeros(0)
        self.velocity: Array = np.zeros(0)

    def filter(self, time: float, x: Array, confidence: float | Array = 1.0) -> Array:
        """Take in measured vectors and return the smoothed ones, same shape; ``velocity`` is their derivative.

        Args:
            time: of the measurement [s]; when it is not later than the one before, that one is returned.
            x: a vector, shape (d,), or several, each with its own speed, shape (k, d).
            confidence: 0 to 1; for several vectors one number or shape (k, 1).
        """
        period = time - self._time
        if period <= 0.0:
            return self.value
        several = x.ndim == 2
        measured: list[list[float]] = x.tolist() if several else [x.tolist()]
        if period <= GAP and x.shape != self._shape:
            raise InputError(f"OneEuro: vectors of shape {self._shape} were begun with, got {x.shape}")
        self._time, self._shape = time, x.shape
        if period > GAP:
            self._begin(measured)
        else:
            trust = confidence.ravel().tolist() if isinstance(confidence, np.ndarray) else [confidence] * len(measured)
            self._go_on(measured, trust, period)
        self._last = measured
        self.value = np.array(self._smooth if several else self._smooth[0])
        self.velocity = np.array(self._speed if several else self._speed[0])
        return self.value

    def _begin(self, measured: list[list[float]]) -> None:
        self._smooth, self._speed = measured, [[0.0] * len(x) for x in measured]

    def _go_on(self, measured: list[list[float]], trust: list[float], period: float) -> None:
        """Filter by one period; in plain floats, which for a few short vectors take half of NumPy's time."""
        steady = smoothing_share(self.derivative_cutoff, period)
        smooth, speeds = [], []
        for x, last, value, velocity, c in zip(measured, self._last, self._smooth, self._speed, trust, strict=True):
            share = c * steady
            per_second = share / period
            kept = 1.0 - share
            speed = [kept * v + per_second * d for v, d in zip(velocity, self._difference(x, last))]  # noqa: B905
            cutoff = self.min_cutoff + self.beta * math.hypot(*speed)
            smooth.append(self._moved(value, self._difference(x, value), c * smoothing_share(cutoff, period)))
            speeds.append(speed)
        self._smooth, self._speed = smooth, speeds

    def _difference(self, x: list[float], before: list[float]) -> list[float]:
        return list(map(sub, x, before))

    def _moved(self, value: list[float], way: list[float], share: float) -> list[float]:
        return [a + share * d for a, d in zip(value, way)]  # noqa: B905


class OneEuroRotation(OneEuro):
    """The One-Euro filter of a rotation (quaternion w x y z): steps and speed are rotation vectors in the base frame.

    Its ``filter`` takes a unit quaternion, shape (4,), and returns the smoothed one; ``velocity`` is (3,) [rad/s].

    Args:
        min_cutoff: cut-off at rest [Hz].
        beta: how quickly it rises [Hz per rad/s].
        derivative_cutoff: of the estimated angular velocity [Hz].
    """

    def __init__(self, min_cutoff: float = 1.0, beta: float = 1.0, derivative_cutoff: float = 1.0) -> None:
        super().__init__(min_cutoff, beta, derivative_cutoff)

    def _begin(self, measured: list[list[float]]) -> None:
        self._smooth, self._speed = measured, [[0.0, 0.0, 0.0]]

    def _difference(self, x: list[float], before: list[float]) -> list[float]:
        """Return log(x before^-1)."""
        (a, b, c, d), (w, i, j, k) = x, before
        real = a * w + b * i + c * j + d * k
        u, v, z = b * w - a * i - c * k + d * j, c * w - a * j - d * i + b * k, d * w - a * k - b * j + c * i
        sine = math.sqrt(u * u + v * v + z * z)
        share = 2.0 * math.atan2(sine, abs(real)) / sine if sine > _SMALL else 2.0
        share = share if real >= 0.0 else -share
        return [share * u, share * v, share * z]

    def _moved(self, value: list[float], way: list[float], share: float) -> list[float]:
        """Return exp(share way) value, of length one."""
        (x, y, z), (w, i, j, k) = way, value
        half = 0.5 * share * math.sqrt(x * x + y * y + z * z)
        share *= 0.5 * math.sin(half) / half if half > _SMALL else 0.5
        a, b, c, d = math.cos(half), share * x, share * y, share * z
        w, i, j, k = (
            a * w - b * i - c * j - d * k,
            a * i + b * w + c * k - d * j,
            a * j - b * k + c * w + d * i,
            a * k + b * j - c * i + d * w,
        )
        length = math.sqrt(w * w + i * i + j * j + k * k)
        return [w / length, i / length, j / length, k / length]


class Hampel:
    r"""Tells a jump from a motion: a value too far from the median of the last moments is an outlier (METHODS A.9).

    :math:`|x - \mathrm{med}| > \max(4 \cdot 1.4826\,\mathrm{MAD},\; r)`. A real jump is believed once the window has
    filled with it: after half the window most values agree.

    Args:
        window: [s].
        least: r, what is never an outlier [m]: more than a quick hand goes within half the window.
    """

    def __init__(self, window: float = 0.3, least: float = 0.02) -> None:
        self.window, self.least = window, least
        self._seen: deque[tuple[float, list[float]]] = deque()

    def reset(self) -> None:
        """Forget the past."""
        self._seen.clear()

    def accept(self, time: float, x: Array) -> bool:
        """Take in a value (d,) and return whether it fits those before it."""
        seen = self._seen
        while seen and (time - seen[0][0] > self.window or time <= seen[0][0]):
            seen.popleft()
        seen.append((time, x.tolist()))
        if len(seen) < 4:
            return True
        # a handful of short vectors: plain floats take a third of NumPy's time
        half = len(seen) // 2
        middle = [sorted(axis)[half] for axis in zip(*(value for _, value in seen), strict=True)]
        away = [math.dist(value, middle) for _, value in seen]
        return away[-1] <= max(4.0 * 1.4826 * sorted(away)[half], self.least)


class Anchoring:
    r"""Takes a jump that comes with a change of tracking for an error of the camera, not for a motion.

    A joint that is hidden is inferred, and its error is then another one and several times larger. The step between
    the last tracked and the first inferred position is mostly that, and so is the step back. So when a joint is
    guessed, its offset o is set such that the motion goes on as it was,

    .. math:: o = x_p + v\,\Delta t - \tilde x, \qquad x = \tilde x + o

    with :math:`x_p` the position before and v its velocity. While the joint is guessed the offset stands: its
    motion is followed, its place is not believed. When it is seen again it is anchored once more, and while it is
    seen the offset fades, with time and with the way that the joint goes,

    .. math:: o \leftarrow o\,\exp(-\Delta t / T - |\Delta x| / L).

    A person who looks at the robot never notices that; a robot that jumped and jumped back would be noticed.

    A joint that flickers between seen and guessed is anchored once: for an eighth of a second both keep their own
    offset. Else the place that is measured would never count, and the estimate would go on at its own velocity. An
    offset is never longer than 0.2 m.

    Args:
        time: T [s].
        way: L [m].

    Raises:
        InputError: when one of them is not positive.
    """

    def __init__(self, time: float = 10.0, way: float = 0.15) -> None:
        if not (time > 0.0 and way > 0.0):
            raise InputError(f"Anchoring: time [s] and way [m] must be positive, got {time!r} and {way!r}")
        self._time, self._way = time, way
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._clock = 0.0
        self._confidence: list[float] = []
        self._measured: list[list[float]] = []
        self._offsets: list[list[float]] | None = None
        # of joint and confidence: when, and its offset
        self._kept: dict[tuple[int, float], tuple[float, list[float]]] = {}

    def shift(self, joint: int) -> float:
        """Return how far a joint is taken to be from where it is measured [m]."""
        return 0.0 if self._offsets is None else math.hypot(*self._offsets[joint])

    def anchor(self, points: Array, confidence: list[float], velocity: Array, period: float) -> Array:
        """Return where the joints are taken to be, shape (k, 3) [m].

        Args:
            points: as measured, shape (k, 3) [m].
            confidence: of each, k numbers; 1 when it is seen.
            velocity: of each as it was estimated before, shape (k, 3) [m/s].
            period: since the call before [s].
        """
        before, self._confidence = self._confidence, confidence
        last, self._measured = self._measured, points.tolist()
        if not before:
            return points
        self._clock += period
        if self._offsets is None and confidence == before:  # nothing was ever hidden
            return points
        was = [_NONE] * len(before) if self._offsets is None else self._offsets
        offsets = list(was)
        for i, (now, then) in enumerate(zip(confidence, before, strict=True)):
            x, o = self._measured[i], was[i]
            if now != then:
                self._kept[i, then] = self._clock, o
                by_axis = zip(o, last[i], x, velocity[i].tolist(), strict=True)
                going_on = [a + b + period * v - c for a, b, c, v in by_axis]
                offsets[i] = self._anchored(i, now, going_on)
            elif now >= 1.0 and o is not _NONE:
                left = math.exp(-period / self._time - math.dist(x, last[i]) / self._way)
                offsets[i] = [left * a for a in o]
        self._offsets = offsets
        return points + np.array(offsets)

    def _anchored(self, joint: int, confidence: float, going_on: list[float]) -> list[float]:
        """Return the offset of a joint whose tracking has changed: the one it had a moment ago, or a new one."""
        when, offset = self._kept.get((joint, confidence), (-math.inf, going_on))
        if self._clock - when > _AGAIN:
            offset = going_on
        length = math.hypot(*offset)
        return offset if length <= FARTHEST else [a * (FARTHEST / length) for a in offset]
