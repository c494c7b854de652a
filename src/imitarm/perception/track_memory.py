"""Tracks in one block of memory, and what compiled code computes from it: an update of all tracks, and their obstacles.

The block contains 8-byte words: the arrays of :class:`~imitarm.perception.tracks.Tracks` one after the other, then the
results of an update. ``tracks_at`` in ``compiled/tracks.c`` has the same layout.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled import library
from imitarm.compiled.kernels import Block
from imitarm.scene.distances import PackedObstacles
from imitarm.scene.packed_record import RECORD_WORDS, placed_by, record_of

Array = NDArray[np.float64]

ALL_SEEN, IN_ORDER = 1, 2
"""Flags of :func:`updated`; the second is set only together with the first.

``ALL_SEEN``: every track is confirmed and has one of the detections, and no detection is left. ``IN_ORDER``: detection
i belongs to track i.
"""

_SIZES, _QUATERNIONS, _COLUMNS = 3, 4, ("last_seen", "hits", "ages", "counts", "ids", "distances", "detected")
_WORDS = _SIZES + _QUATERNIONS + len(_COLUMNS)  # of each track, beside its state and its covariance
_ROW_BYTES = 8 * (3 + 9 + _SIZES + _QUATERNIONS)  # of a detection


class TrackMemory(NamedTuple):
    """n tracks with s components of the state in one block of memory.

    Attributes:
        n: number of tracks.
        s: number of components of a state.
        block: the memory.
    """

    n: int
    s: int
    block: Block

    @classmethod
    def of(cls, mean: Array, covariance: Array, quaternions: Array, columns: dict[str, NDArray[Any]]) -> TrackMemory:
        """Copy arrays into a new block.

        Args:
            mean: states, shape (n, 1, s).
            covariance: covariances of the states, shape (n, 1, s, s).
            quaternions: rotations detected last, shape (n, 4).
            columns: ``sizes``, ``last_seen``, ``hits``, ``ages``, ``counts`` and ``ids`` of the tracks.
        """
        n, _, s = mean.shape
        words = [mean, covariance, columns["sizes"], quaternions]
        words += [np.ascontiguousarray(columns[name]).view(np.float64) for name in _COLUMNS[:5]]
        return cls(n, s, Block(np.concatenate([*(array.ravel() for array in words), np.zeros(2 * n)])))

    def array(self, name: str) -> NDArray[Any]:
        """Return a part of the block by its name.

        The names are ``mean`` (n, 1, s), ``covariance`` (n, 1, s, s), ``sizes`` (n, 3), ``last_seen``, ``hits``,
        ``ages``, ``counts`` and ``ids`` (n,); and of the last update ``distances`` and ``detected`` (n,): distance and
        index of the detection of each track. The index is -1 for a track without a detection.
        """
        n, s, words = self.n, self.s, self.block.array
        start = n * (s + s * s)
        if name == "mean":
            return words[: n * s].reshape(n, 1, s)
        if name == "covariance":
            return words[n * s : start].reshape(n, 1, s, s)
        if name == "sizes":
            return words[start : start + _SIZES * n].reshape(n, _SIZES)
        if name == "quaternions":
            return words[start + _SIZES * n : start + (_SIZES + _QUATERNIONS) * n].reshape(n, _QUATERNIONS)
        start += (_SIZES + _QUATERNIONS + _COLUMNS.index(name)) * n
        column = words[start : start + n]
        return column if name in {"last_seen", "distances"} else column.view(np.int64)


def updated(
    memory: TrackMemory, stamp: float, dt: float, rows: bytes, *numbers: float, window: int
) -> tuple[TrackMemory, int] | None:
    """Predict and update all tracks by compiled code; None without this code, or if the assignment is not obvious.

    The compiled code computes the same values as ``MotionFilter.predict``, ``assign``, ``MotionFilter.update`` and
    ``ObstacleTracker._seen``.

    Args:
        memory: the tracks.
        stamp: time of the detections [s].
        dt: time from the states of the tracks to the detections [s].
        rows: rows of m detections (:attr:`Detection.row`), shape (m, 19), as bytes.
        numbers: spectral density of the process noise; largest normalised innovation squared of a possible assignment;
            largest speed [m/s].
        window: number of updates that ``hits`` remembers.

    Returns:
        The new memory and flags. Without the flag ``ALL_SEEN``, only the states, the covariances, ``distances`` and
        ``detected`` are new.
    """
    kernel = library()
    if kernel is None:
        return None
    n, s, before = memory
    m = len(rows) // _ROW_BYTES
    after = Block(np.empty(n * (s + s * s + _WORDS) + m))
    flags: int = kernel.track_update(
        n, m, s, (1 << window) - 1, stamp, dt, *numbers, before.address, rows, after.address
    )
    return None if flags < 0 else (TrackMemory(n, s, after), flags)


def renewed(
    memory: TrackMemory,
    stamp: float,
    rows: bytes,
    changed: bytes,
    variances: bytes,
    *numbers: int,
    max_unseen: float,
) -> TrackMemory:
    """Take over what the detections of an update say, end and begin tracks, and confirm tracks.

    The compiled code computes the same as ``Tracks.born`` and the methods ``_seen``, ``_pruned`` and ``_confirmed`` of
    ``ObstacleTracker``.

    Args:
        memory: result of :func:`updated` without the flag ``ALL_SEEN``; this call changes it.
        stamp: time of the detections [s].
        rows: see :func:`updated`.
        changed: 1 for each track whose detection has another kind of shape than the detection before, otherwise 0.
        variances: variances of each component of a new track's velocity and acceleration, shape (2,), as bytes.
        numbers: hits and updates after which a track is confirmed, and number of the next track.
        max_unseen: time after the last detection at which a track ends [s].

    Returns:
        The new tracks. Their ``detected`` contains the index of each track in ``memory``, or n + j for a track that
        begins with detection j.
    """
    (n, s, block), m = memory, len(rows) // _ROW_BYTES
    after = Block(np.empty((n + m) * (s + s * s + _WORDS)))
    places = variances, rows, changed, block.address, after.address
    count: int = library().track_renew(n, m, s, *numbers, stamp, max_unseen, *places)
    return TrackMemory(count, s, after)


def obstacles(memory: TrackMemory, dt: float, noise: float, shapes: PackedObstacles) -> PackedObstacles | None:
    """Return the obstacles of all tracks ``dt`` [s] later; None without compiled code, or if ``dt`` is negative.

    The tracks must not rotate.

    Args:
        memory: the tracks.
        dt: time from the states of the tracks [s].
        noise: spectral density of the process noise.
        shapes: the same obstacles at any time; their sizes may differ.
    """
    kernel, (n, s, block) = library(), memory
    if kernel is None or dt < 0.0:
        return None
    record, _ = record_of(shapes)
    placed = Block(np.empty(RECORD_WORDS + 23 * n + 1))
    resized = kernel.track_obstacles(n, s, dt, noise, block.address, record.address, placed.address)
    return placed_by(shapes, placed, memory.array("quaternions"), bool(resized), block)
