"""The update of all tracks as compiled code, where it has been built; NumPy computes the same without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled import library
from imitarm.compiled.kernels import address

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def updated(
    mean: Array,
    covariance: Array,
    first: NDArray[np.bool_],
    dt: float,
    noise: float,
    rows: Array,
    gate: float,
    max_speed: float,
) -> tuple[Array, Array, Indices, Array] | None:
    """Predict and update all tracks; None without compiled code, or if the assignment is not obvious.

    Args:
        mean: states of n tracks, shape (n, 1, s).
        covariance: their covariances, shape (n, 1, s, s).
        first: which tracks choose their detections before the others, shape (n,).
        dt: time since these states [s].
        noise: spectral density of the process noise.
        rows: rows of m detections (:attr:`Detection.row`), shape (m, 15).
        gate: largest normalised innovation squared.
        max_speed: largest speed [m/s].

    Returns:
        New states and covariances of the same shapes; index of the detection of each track (n,), -1 without one;
        normalised innovation squared of each track (n,), valid where there is a detection.
    """
    kernel = library()
    if kernel is None:
        return None
    n, _, s = mean.shape
    states = np.empty(n * s + n * s * s + n)
    x, P = states[: n * s].reshape(mean.shape), states[n * s : -n].reshape(covariance.shape)
    x[:] = mean
    P[:] = covariance
    indices = np.empty(n + len(rows), dtype=np.int64)
    places = [address(array) for array in (states, rows, first, indices)]
    if kernel.track_kernel_update(n, len(rows), s, dt, noise, gate, max_speed, *places):
        return None
    return x, P, indices[:n], states[-n:]
