"""Packed obstacles as a C structure, for compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled.kernels import Record
from imitarm.scene.convex_hull import Polytope
from imitarm.scene.distances import PackedObstacles

Array = NDArray[np.float64]


def record_of(packed: PackedObstacles) -> tuple[Record, float]:
    """Return the C structure ``Obstacles``, and the time [s] from its poses to those of ``packed``."""
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
