"""Distances of many candidate positions to moving obstacles, for policies that compare them in every control step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.scene.distances import Members, PackedObstacles, every, take
from imitarm.scene.rounded import ROUNDS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def displaced_distances(
    packed: PackedObstacles, members: Indices, times: Array, origins: Array, scales: Array, directions: Array
) -> Array:
    """Return the distances of groups of points; each group has its own obstacle and its own time.

    The points of group k are ``origins[k] + scales[k] directions[j]``. The arguments are not checked, to save time in
    control steps.

    Args:
        packed: obstacles at their reference time.
        members: index of the obstacle of each group, shape (k,).
        times: time of each group, after the obstacles' reference time, shape (k,) [s].
        origins: origin of each group in the base frame, shape (k, 3) [m].
        scales: shape (k,) [m].
        directions: vectors of any length, shape (m, 3).

    Returns:
        Shape (k, m) [m], negative inside.
    """
    if not packed.rotating:
        return _displaced_by_family(packed, members, times, origins, scales, directions)
    distance = np.empty((len(members), len(directions)))
    for time in np.unique(times).tolist():
        now = (times == time).nonzero()[0]
        given = members[now], np.zeros(len(now)), origins[now], scales[now], directions
        distance[now] = _displaced_by_family(packed.after(time), *given)
    return distance


def _displaced_by_family(
    packed: PackedObstacles, members: Indices, times: Array, origins: Array, scales: Array, directions: Array
) -> Array:
    """Return :func:`displaced_distances` for obstacles that keep their rotation."""
    families, place = packed._sorted[1], packed._place_of[members]
    if len(families) == 1:
        return _displaced(packed, families[0], place, times, origins, scales, directions)
    distance = np.empty((len(members), len(directions)))
    for family in families:
        rows = ((place >= family.places.start) & (place < family.places.stop)).nonzero()[0]
        if len(rows):
            given = place[rows], times[rows], origins[rows], scales[rows], directions
            distance[rows] = _displaced(packed, family, *given)
    return distance


def _displaced(
    packed: PackedObstacles,
    family: Members,
    place: Indices,
    times: Array,
    origins: Array,
    scales: Array,
    directions: Array,
) -> Array:
    """Return :func:`displaced_distances` for groups of one family; ``place`` is in the order of ``_sorted``."""
    frames, m = packed._frames, len(directions)
    center = frames.center[:, place, 0] + frames.velocity[:, place, 0] * times
    parameters = take(family.parameters, place - family.places.start)
    if frames.upright:
        q = origins.T - center
    else:
        q = np.matmul(frames.to_local[place], origins[:, :, None])[..., 0].T - center
    if family.formula is ROUNDS.formula and parameters[1] is None and parameters[0] is not None:
        turned_back = q.T if frames.upright else np.matmul(q.T[:, None], frames.to_local[place])[:, 0]
        return _displaced_from_spheres(parameters[0], turned_back, scales, directions)
    if frames.upright:
        points = q[:, :, None] + scales[:, None] * directions.T[:, None]
    else:
        turned = np.matmul(directions, frames.to_local[place].swapaxes(1, 2)).transpose(2, 0, 1)
        points = q[:, :, None] + scales[:, None] * turned
    return family.formula(np.ascontiguousarray(points), False, *every(parameters))[0].reshape(-1, m)


def _displaced_from_spheres(radius: Array, q: Array, scales: Array, directions: Array) -> Array:
    """Return distances from spheres: ``|q + c d|^2 = |q|^2 + 2 c q.d + c^2 |d|^2`` is one product of matrices."""
    left, right = np.empty((len(scales), 5)), np.empty((5, len(directions)))
    np.multiply(q, (2.0 * scales)[:, None], out=left[:, :3])
    left[:, 3], left[:, 4] = scales * scales, np.add.reduce(q * q, axis=1)
    right[:3], right[4] = directions.T, 1.0
    right[3] = np.add.reduce(directions * directions, axis=1)
    squares = left.dot(right)
    np.maximum(squares, 0.0, out=squares)  # rounding at the centre of a sphere
    distance = np.sqrt(squares, out=squares)
    distance -= radius[:, None]
    return distance
