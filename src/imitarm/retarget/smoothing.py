"""Live smoothing of what a camera sees: calm at rest, quick in motion; and a guard against jumps."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]

GAP = 0.3  # [s] after a longer gap a filter begins anew
_SMALL = 1e-9  # [rad] below this the series of sin(a)/a is exact to double precision


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
        self._raw: Array = np.zeros(0)
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
        if period > GAP:
            self._time, self.value = time, np.array(x, dtype=float)
            self._raw, self.velocity = self.value, np.zeros_like(self.value)
            return self.value
        if period <= 0.0:
            return self.value
        self._time = time
        share = confidence * smoothing_share(self.derivative_cutoff, period)
        self.velocity = self.velocity + share * (self._difference(x, self._raw) / period - self.velocity)
        self._raw = np.array(x, dtype=float)
        speed = np.sqrt(np.einsum("...i,...i->...", self.velocity, self.velocity))[..., None]
        share = confidence * smoothing_share(self.min_cutoff + self.beta * speed, period)
        self.value = self._moved(share * self._difference(x, self.value))
        return self.value

    def _difference(self, x: Array, before: Array) -> Array:
        return x - before

    def _moved(self, step: Array) -> Array:
        return self.value + step


class OneEuroRotation(OneEuro):
    """The One-Euro filter of a rotation (quaternion w x y z): steps and speed are rotation vectors in the base frame.

    Args:
        min_cutoff: cut-off at rest [Hz].
        beta: how quickly it rises [Hz per rad/s].
        derivative_cutoff: of the estimated angular velocity [Hz].
    """

    def __init__(self, min_cutoff: float = 1.0, beta: float = 1.0, derivative_cutoff: float = 1.0) -> None:
        super().__init__(min_cutoff, beta, derivative_cutoff)

    def filter(self, time: float, x: Array, confidence: float | Array = 1.0) -> Array:
        """Take in a measured unit quaternion (4,) and return the smoothed one; ``velocity`` is (3,) [rad/s]."""
        if time - self._time > GAP:
            super().filter(time, x)
            self.velocity = np.zeros(3)
            return self.value
        return super().filter(time, x, confidence)

    def _difference(self, x: Array, before: Array) -> Array:
        """Return log(x before^-1); in plain floats, which for four numbers takes a quarter of NumPy's time."""
        (a, b, c, d), (w, i, j, k) = x.tolist(), before.tolist()
        real = a * w + b * i + c * j + d * k
        u, v, z = b * w - a * i - c * k + d * j, c * w - a * j - d * i + b * k, d * w - a * k - b * j + c * i
        sine = math.sqrt(u * u + v * v + z * z)
        share = 2.0 * math.atan2(sine, abs(real)) / sine if sine > _SMALL else 2.0
        share = share if real >= 0.0 else -share
        return np.array([share * u, share * v, share * z])

    def _moved(self, step: Array) -> Array:
        """Return exp(step) value, of length one."""
        (x, y, z), (w, i, j, k) = step.tolist(), self.value.tolist()
        half = 0.5 * math.sqrt(x * x + y * y + z * z)
        share = 0.5 * math.sin(half) / half if half > _SMALL else 0.5
        a, b, c, d = math.cos(half), share * x, share * y, share * z
        w, i, j, k = (
            a * w - b * i - c * j - d * k,
            a * i + b * w + c * k - d * j,
            a * j - b * k + c * w + d * i,
            a * k + b * j - c * i + d * w,
        )
        length = math.sqrt(w * w + i * i + j * j + k * k)
        return np.array([w / length, i / length, j / length, k / length])


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
