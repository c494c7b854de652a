"""How fast the tool moves in spite of the sensor's noise, and from which row to which it moves at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import continuous_signs, quaternion_conjugate, quaternion_log, quaternion_multiply

Array = NDArray[np.float64]

_WINDOW = 0.2  # [s] over which speed is measured
_LONGEST_WINDOW = 0.1  # of the duration, likewise when samples are noisy
_IDLE_SHARE = 0.02  # of the fast part's speed that still counts as standing
_STILL = 1e-3  # [m/s] below this nothing moves
_STILL_TURN = 1e-2  # [rad/s]
_PLACE_SHARE = 0.005  # of the motion's size that still counts as one place
_PLACE = 5e-4  # [m]
_PLACE_TURN = 5e-3  # [rad]
_NOISE_FACTOR = 4.0  # standard deviations of noise that are taken for standing


def noise_level(values: Array) -> float:
    """Return the standard deviation of white noise on smooth samples (n, d), from their third differences.

    For white noise of deviation s the variance of a third difference is 20 s^2; the median keeps out what is left of
    the motion itself. Fewer than 20 samples can't tell the two apart: 0.
    """
    if len(values) < 20:
        return 0.0
    third = np.diff(values, n=3, axis=0)
    return float(np.max(1.4826 * np.median(np.abs(third), axis=0)) / np.sqrt(20.0))


def turns(quaternions: Array) -> Array:
    """Return the accumulated rotation (n, 3) [rad]: the sum of the rotation vectors of all steps."""
    q = continuous_signs(quaternions)
    steps = quaternion_log(quaternion_multiply(q[1:], quaternion_conjugate(q[:-1])))
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def moving_rows(times: Array, positions: Array, quaternions: Array | None = None) -> tuple[int, int] | None:
    """Return the first and the last row between which the tool moves, None when it never does.

    The tool stands at the start as long as it is slow and has not left its place. Slow is 2 % of the speed of its
    fast part, or what the noise alone makes; its place is 0.5 % of the size of the motion, likewise. The end is the
    same, backwards. Turning on the spot counts as moving.

    Args:
        times: strictly increasing, shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: wxyz, shape (n, 4), or None.
    """
    spans = [_moving(times, positions, _STILL, _PLACE)]
    if quaternions is not None:
        spans.append(_moving(times, turns(quaternions), _STILL_TURN, _PLACE_TURN))
    found = [span for span in spans if span is not None]
    return (min(first for first, _ in found), max(last for _, last in found)) if found else None


def _moving(times: Array, values: Array, still: float, place: float) -> tuple[int, int] | None:
    """Return the rows between which ``values`` (n, d) change."""
    noise, step = noise_level(values), float(np.median(np.diff(times)))
    window = _WINDOW
    fast = max(still, _IDLE_SHARE * float(np.percentile(smooth_speed(times, values, window)[0], 95)))
    # a line fitted over n samples has a slope of deviation noise sqrt(12 / n^3) / step: look longer when it is noisy
    quiet = (_NOISE_FACTOR * noise * np.sqrt(12.0 * step) / fast) ** (2.0 / 3.0)
    window = float(np.clip(quiet, _WINDOW, max(_WINDOW, _LONGEST_WINDOW * (times[-1] - times[0]))))
    slope, mean, n = smooth_slope(times, values, window)
    speed = np.linalg.norm(slope, axis=1)
    limit = np.maximum(fast, _NOISE_FACTOR * noise * np.sqrt(12.0 / n**3) / step)
    radius = np.maximum(
        max(place, _PLACE_SHARE * float(np.ptp(mean, axis=0).max())), _NOISE_FACTOR * noise / np.sqrt(n)
    )
    left = np.linalg.norm(mean - mean[0], axis=1) > radius
    not_yet = np.linalg.norm(mean - mean[-1], axis=1) > radius
    after_start, before_end = np.flatnonzero((speed > limit) | left), np.flatnonzero((speed > limit) | not_yet)
    if not len(after_start) or not len(before_end) or after_start[0] > before_end[-1]:
        return None
    return int(after_start[0]), int(before_end[-1])


def smooth_speed(times: Array, values: Array, window: float = _WINDOW) -> tuple[Array, Array]:
    """Return speed (n,) [unit/s] and mean (n, d) of ``values`` (n, d) over a window [s] about each sample."""
    slope, mean, _ = smooth_slope(times, values, window)
    return np.linalg.norm(slope, axis=1), mean


def smooth_slope(times: Array, values: Array, window: float = _WINDOW) -> tuple[Array, Array, Array]:
    """Fit a straight line to the samples in a window about each sample.

    Args:
        times: strictly increasing, shape (n,) [s].
        values: shape (n, d).
        window: how long [s]; neighbours count however far they are.

    Returns:
        least-squares slopes (n, d) [unit/s], means (n, d), and the number of samples in each window (n,).
    """
    t = times - times[0]
    here = np.arange(len(t))
    first = np.minimum(np.searchsorted(t, t - 0.5 * window - 1e-9), np.maximum(here - 1, 0))
    last = np.maximum(np.searchsorted(t, t + 0.5 * window + 1e-9), np.minimum(here + 2, len(t)))
    n = (last - first).astype(float)
    offset = values[0]
    centred = values - offset

    def windowed(column: Array) -> Array:
        total = np.concatenate([np.zeros((1, *column.shape[1:])), np.cumsum(column, axis=0)])
        return np.asarray(total[last] - total[first])

    sum_t, sum_x = windowed(t), windowed(centred)
    spread = np.maximum(windowed(t * t) - sum_t**2 / n, 1e-12)
    slope = (windowed(t[:, None] * centred) - sum_t[:, None] * sum_x / n[:, None]) / spread[:, None]
    return np.asarray(slope), np.asarray(sum_x / n[:, None] + offset), n
