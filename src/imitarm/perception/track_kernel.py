"""The update of all tracks as compiled code, where it has been built; NumPy computes the same without it.

:func:`build` compiles ``track_kernel.c`` with the C compiler of the machine and puts the result beside it. Nothing else
needs a compiler.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

SOURCE = Path(__file__).with_suffix(".c")
LIBRARY = SOURCE.with_suffix(".compiled")
_VERSION = 1
_COMPILERS = ("cc", "gcc", "clang")


def build() -> str:
    """Compile the kernel; return a sentence that says what was done."""
    compiler = next((path for name in _COMPILERS if (path := shutil.which(name))), None)
    if compiler is None:
        return "no C compiler was found; the tracker uses NumPy"
    made = LIBRARY.with_suffix(".new")
    command = [compiler, "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-o", str(made), str(SOURCE), "-lm"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        return f"{Path(compiler).name} failed; the tracker uses NumPy:\n{done.stderr}"
    made.replace(LIBRARY)
    return f"built {LIBRARY.name}"


@cache
def library() -> Any:
    """Return the compiled library; None if it was not built, or for another version."""
    try:
        found = ctypes.CDLL(str(LIBRARY))
        found.track_kernel_version.restype = ctypes.c_int64
        if found.track_kernel_version() != _VERSION:
            return None
        update = found.track_kernel_update
    except (OSError, AttributeError):
        return None
    integer, pointer, number = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double
    update.argtypes = [*[integer] * 3, *[number] * 4, *[pointer] * 4]
    update.restype = integer
    return found


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
    """Predict and update all tracks; None if the kernel was not built, or if the assignment is not obvious.

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
    places = [array.__array_interface__["data"][0] for array in (states, rows, first, indices)]
    if kernel.track_kernel_update(n, len(rows), s, dt, noise, gate, max_speed, *places):
        return None
    return x, P, indices[:n], states[-n:]
