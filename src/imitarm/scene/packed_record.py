"""Conversion of packed obstacles to the C structure of compiled code, and from the results of compiled code."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled.kernels import Block, Record
from imitarm.scene.convex_hull import Polytope
from imitarm.scene.distances import OF_THE_SIZE, PackedObstacles

Array = NDArray[np.float64]

RECORD_WORDS = 11
"""Number of 8-byte words of the C structure ``Obstacles``."""


def record_of(packed: PackedObstacles) -> tuple[Record, float]:
    """Return the C structure ``Obstacles``, and the time [s] by which ``packed`` is later than its poses."""
    known: tuple[Record, float] | None = packed.__dict__.get("_record")
    if known is None:
        if "_ahead" in packed.__dict__:
            earlier, dt = packed.__dict__["_ahead"]
            record, before = record_of(earlier)
            known = record, before + dt
        else:
            known = _built(packed), 0.0
        packed.__dict__["_record"] = known
    return known


def placed_by(
    shapes: PackedObstacles, block: Block, quaternions: Array, resized: bool, *kept: object
) -> PackedObstacles:
    """Return obstacles whose poses ``track_obstacles`` in ``compiled/tracks.c`` has computed; they do not rotate.

    Args:
        shapes: the same n obstacles at another time.
        block: memory with the C structure ``Obstacles``, followed by positions, velocities and angular velocities (n, 3
            each), covariances (n, 3, 3), times of the last detections (n), sizes (n, 3), radii (n), and the square of
            the largest speed (1).
        quaternions: rotations, shape (n, 4).
        resized: whether a size is not that of ``shapes``.
        kept: objects that own other memory to which the structure points; the result keeps them alive.
    """
    n, words, a = len(shapes), block.array, RECORD_WORDS
    fastest = math.sqrt(words.item(-1))
    placed = shapes.copy(
        positions=words[a : a + 3 * n].reshape(n, 3),
        quaternions=quaternions,
        velocities=words[a + 3 * n : a + 6 * n].reshape(n, 3),
        angular_velocities=words[a + 6 * n : a + 9 * n].reshape(n, 3),
        covariances=words[a + 9 * n : a + 18 * n].reshape(n, 3, 3),
        stamps=words[a + 18 * n : a + 19 * n],
        still=fastest == 0.0,
        rotating=False,
        fastest=fastest,
        _record=(Record.at(block.address, block, shapes, *kept), 0.0),
    )
    if resized:
        for name in OF_THE_SIZE:
            placed.__dict__.pop(name, None)
        placed.__dict__["sizes"] = words[a + 19 * n : a + 22 * n].reshape(n, 3)
    return placed


def _built(packed: PackedObstacles) -> Record:
    rows = (
        packed.positions,
        packed.quaternions,
        packed.sizes,
        packed.velocities,
        packed.angular_velocities,
        packed.covariances,
        packed.radii,
        packed.stamps,
    )
    kinds = np.ascontiguousarray(packed.kinds, dtype=np.int8)
    hulls = [None if polytope is None else _hull_record(polytope) for polytope in packed.polytopes]
    return Record(len(packed), kinds, *[_plain(row) for row in rows], hulls)


def _hull_record(polytope: Polytope) -> Record:
    """Return the C structure ``Hull``; the polytope keeps it."""
    record: Record | None = polytope.__dict__.get("_record")
    if record is None:
        arrays = "normals", "offsets", "cosines", "starts", "directions", "lengths"
        sizes = len(polytope.offsets), len(polytope.lengths)
        record = polytope.__dict__["_record"] = Record(*sizes, *[_plain(getattr(polytope, name)) for name in arrays])
    return record


def _plain(array: Any) -> Array:
    return np.ascontiguousarray(array, dtype=float)
