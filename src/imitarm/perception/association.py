"""Association: which detection belongs to which track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.motion_filter import Measurements, inverse_3x3

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FORBIDDEN = 1e9  # cost of a pair outside the gate: worse than any number of pairs inside
_NONE = np.empty(0, dtype=np.intp)


class Pairs(NamedTuple):
    """Tracks and the detections that were assigned to them.

    Attributes:
        tracks: indices of tracks, shape (k,).
        detections: index of the detection of each of these tracks, shape (k,).
        distances: normalised innovation squared of each pair, shape (k,).
    """

    tracks: Indices
    detections: Indices
    distances: Array

    def joined(self, other: Pairs) -> Pairs:
        """Return both sets of pairs."""
        return Pairs(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


NO_PAIRS = Pairs(_NONE, _NONE, np.empty(0))


def assign(
    positions: Array, covariances: Array, measured: Measurements, gate: float, allowed: NDArray[np.bool_] | None = None
) -> Pairs:
    """Assign detections to tracks, each at most once.

    With the innovation ``nu`` of a pair and its covariance ``S``, a pair is possible if its normalised innovation
    squared ``d^2 = nu' S^-1 nu`` is at most ``gate``, the quantile of the chi-square distribution with 3 degrees of
    freedom. Among the assignments with the most pairs, the one with the smallest sum of ``d^2 + log det S`` is chosen:
    the most probable one.

    Args:
        positions: predicted positions of n tracks, shape (n, 3) [m].
        covariances: covariances of these positions, shape (n, 3, 3) [m^2].
        measured: m measurements.
        gate: largest possible ``d^2``.
        allowed: pairs that may be assigned, shape (n, m); None: all.
    """
    n, m = len(positions), len(measured.positions)
    if not n or not m:
        return NO_PAIRS
    near = _near(positions, covariances, measured, gate)
    if allowed is not None:
        near &= allowed
    tracks, detections = near.nonzero()
    if not len(tracks):
        return NO_PAIRS
    innovation, jacobian, noise = measured.rows(detections).innovation(positions[tracks])
    P = covariances[tracks]
    S = (P if jacobian is None else jacobian @ P @ jacobian.swapaxes(-1, -2)) + noise
    inverse, determinant = inverse_3x3(S)
    distance = np.einsum("ki,kij,kj->k", innovation, inverse, innovation)
    possible = distance <= gate
    if not possible.all():
        tracks, detections, distance = tracks[possible], detections[possible], distance[possible]
        determinant = determinant[possible]
    if len(set(tracks.tolist())) == len(tracks) == len(set(detections.tolist())):
        return Pairs(tracks, detections, distance)  # no choice is left
    return _best(tracks, detections, distance, np.log(determinant), (n, m))


def _near(positions: Array, covariances: Array, measured: Measurements, gate: float) -> NDArray[np.bool_]:
    """Return the pairs (n, m) that may lie inside the gate: ``d^2 >= |nu|^2 / trace S`` excludes most of the others."""
    if measured.rotations is not None:  # the innovation is not a difference of positions
        return np.ones((len(positions), len(measured.positions)), dtype=bool)
    offsets = positions[:, None] - measured.positions
    squared = np.einsum("nmi,nmi->nm", offsets, offsets)
    traces = np.einsum("nii->n", covariances)[:, None] + np.einsum("mii->m", measured.noise)
    near: NDArray[np.bool_] = squared <= gate * traces
    return near


def _best(tracks: Indices, detections: Indices, distance: Array, log: Array, shape: tuple[int, int]) -> Pairs:
    """Return the best assignment among possible pairs."""
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  slow to import, and often not needed

    costs, squared = np.full(shape, _FORBIDDEN), np.full(shape, np.inf)
    costs[tracks, detections] = distance + log
    squared[tracks, detections] = distance
    rows, columns = linear_sum_assignment(costs)
    inside = np.isfinite(squared[rows, columns])
    rows, columns = rows[inside], columns[inside]
    return Pairs(rows, columns, squared[rows, columns])


def duplicates(measured: Measurements, gate: float) -> list[tuple[int, int]]:
    """Return the pairs ``(i, j)`` of measurements, ``i < j``, whose positions do not differ significantly.

    The squared distance of the positions, normalised with the sum of both covariances, is at most ``gate``.
    """
    positions, noise = measured.positions, measured.noise
    if len(positions) < 2:
        return []
    offsets = positions[:, None] - positions
    traces = np.einsum("mii->m", noise)
    squared = np.einsum("nmi,nmi->nm", offsets, offsets)
    close = np.triu(squared <= gate * (traces[:, None] + traces), 1)
    if not close.any():
        return []
    first, second = close.nonzero()
    inverse, _ = inverse_3x3(noise[first] + noise[second])
    difference = offsets[first, second]
    inside = np.einsum("ki,kij,kj->k", difference, inverse, difference) <= gate
    return list(zip(first[inside].tolist(), second[inside].tolist(), strict=True))
