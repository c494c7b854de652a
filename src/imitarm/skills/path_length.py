"""Measures of the bends of a motion: the relative length of a learned path, and the angle by which a motion turns.

A path that is much shorter than the motion has lost bends. The more a motion turns, the more samples are needed to
represent it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_RULER = 0.02  # of the motion's extent: smaller bends do not count


def relative_length(path: Array, motion: Array) -> float:
    """Return the length of a path (n, d), divided by the length of a motion (m, d), both without their smallest bends.

    Both lengths are sums of chords of at least 2 % of the motion's extent, so that noise does not count.
    """
    ruler = _RULER * _extent(motion)
    learned, shown = (float(np.linalg.norm(_chords(points, ruler), axis=1).sum()) for points in (path, motion))
    return learned / shown if shown > 0.0 else 1.0


def turning(motion: Array) -> float:
    """Return the sum of the angles between successive chords of a motion (n, d) [rad]; one circle gives 2 pi."""
    chords = _chords(motion, _RULER * _extent(motion))
    if len(chords) < 2:
        return 0.0
    directions = chords / np.linalg.norm(chords, axis=1, keepdims=True)
    return float(np.arccos(np.clip(np.sum(directions[1:] * directions[:-1], axis=1), -1.0, 1.0)).sum())


def _extent(points: Array) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _chords(points: Array, ruler: float) -> Array:
    """Return the differences between successive points that are at least ``ruler`` apart, shape (k, d)."""
    kept = [points[0]]
    for point in points[1:]:
        step = point - kept[-1]
        if float(step @ step) >= ruler * ruler > 0.0:
            kept.append(point)
    return np.diff(np.array(kept), axis=0)
