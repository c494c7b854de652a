"""Distances of many candidate positions to moving obstacles, fast enough for every control step of a policy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply, quaternion_to_matrix
from imitarm.scene.distances import KINDS, Members, PackedObstacles, every, take
from imitarm.scene.edged import DEPTH
from imitarm.scene.rounded import ROUNDS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def displaced_distances(
    packed: PackedObstacles, members: Indices, times: Array, origins: Array, scales: Array, directions: Array
) -> Array:
    """Return the distances of points to obstacles. The points form groups, each with its own obstacle and time.

    The points of group k are ``origins[k] + scales[k] directions[j]``. The arguments are not checked, to save time in
    control steps.

    Args:
        packed: obstacles at their reference time.
        members: index of the obstacle of each group, shape (k,).
        times: time of each group, after the obstacles' reference time, shape (k,) [s].
        origins: origin of each group in the base frame, shape (k, 3) [m].
        scales: length by which the directions are multiplied in each group, shape (k,) [m].
        directions: vectors of any length, shape (m, 3).

    Returns:
        Signed distances, shape (k, m) [m], negative inside the obstacle.
    """
    families, place = packed._sorted[1], packed._place_of[members]
    to_local, q = _local(packed, members, place, times, origins)
    if len(families) == 1:
        return _displaced(families[0], place, to_local, q, scales, directions)
    distance = np.empty((len(members), len(directions)))
    for family in families:
        rows = ((place >= family.places.start) & (place < family.places.stop)).nonzero()[0]
        if len(rows):
            turned = None if to_local is None else to_local[rows]
            distance[rows] = _displaced(family, place[rows], turned, q[:, rows], scales[rows], directions)
    return distance


def _local(
    packed: PackedObstacles, members: Indices, place: Indices, times: Array, origins: Array
) -> tuple[Array | None, Array]:
    """Return the rotation into the local frame of each group (k, 3, 3), None for upright ones, and origins (3, k)."""
    frames = packed._frames
    if packed.rotating:
        steps = quaternion_exp(times[:, None] * packed.angular_velocities[members])
        rotations = quaternion_to_matrix(quaternion_multiply(steps, packed.quaternions[members]))
        to_local = rotations.swapaxes(1, 2)
        away = origins - packed.positions[members] - times[:, None] * packed.velocities[members]
        q = np.matmul(to_local, away[:, :, None])[..., 0].T
        q[2, packed.kinds[members] == KINDS.index("half_space")] += DEPTH
        return to_local, q
    center = frames.center[:, place, 0] + frames.velocity[:, place, 0] * times
    if frames.upright:
        return None, origins.T - center
    to_local = frames.to_local[place]
    return to_local, np.matmul(to_local, origins[:, :, None])[..., 0].T - center


def _displaced(
    family: Members, place: Indices, to_local: Array | None, q: Array, scales: Array, directions: Array
) -> Array:
    """Return :func:`displaced_distances` for groups of one family, whose origins are ``q`` (3, k) in local frames."""
    m, parameters = len(directions), take(family.parameters, place - family.places.start)
    if family.formula is ROUNDS.formula and parameters[1] is None and parameters[0] is not None:
        turned_back = q.T if to_local is None else np.matmul(q.T[:, None], to_local)[:, 0]
        return _displaced_from_spheres(parameters[0], turned_back, scales, directions)
    if to_local is None:
        points = q[:, :, None] + scales[:, None] * directions.T[:, None]
    else:
        turned = np.matmul(directions, to_local.swapaxes(1, 2)).transpose(2, 0, 1)
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
