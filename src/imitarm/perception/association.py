"""Association: decide which detection belongs to which track."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.motion_filter import Innovation, Measurements, inverse_3x3

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FORBIDDEN = 1e9  # cost of a pair outside the gate: worse than any number of pairs inside
_ONES = np.ones(3)
_NONE = np.empty(0, dtype=np.intp)


class Pairs(NamedTuple):
    """Pairs of a track and the detection that was assigned to this track.

    Attributes:
        tracks: index of the track of each pair, shape (k,).
        detections: index of the detection of each pair, shape (k,).
        distances: normalised innovation squared ``d^2`` of each pair (see :func:`assign`), shape (k,).
        innovation: innovations of the pairs, that is, measured minus predicted positions; None if they must be computed
            again.
    """

    tracks: Indices
    detections: Indices
    distances: Array
    innovation: Innovation | None = None

    def joined(self, other: Pairs) -> Pairs:
        """Return the pairs of both objects as one object."""
        tracks, detections, distances = (np.concatenate(pair) for pair in zip(self[:3], other[:3], strict=True))
        return Pairs(tracks, detections, distances)

    def in_order(self) -> Pairs:
        """Return the pairs, sorted by the index of the track."""
        order = self.tracks.argsort()
        return Pairs(self.tracks[order], self.detections[order], self.distances[order])


NO_PAIRS = Pairs(_NONE, _NONE, np.empty(0))


def assign(
    positions: Array, covariances: Array, measured: Measurements, gate: float, allowed: NDArray[np.bool_] | None = None
) -> Pairs:
    """Assign detections to tracks; each detection and each track is used at most once.

    The innovation ``nu`` of a pair is the measured minus the predicted position, and ``S`` is its covariance. A pair is
    possible if the normalised innovation squared ``d^2 = nu' S^-1 nu`` is at most ``gate``, a quantile of the
    chi-square distribution with 3 degrees of freedom. The function considers only assignments with the largest possible
    number of pairs. Among these, it chooses the most probable assignment, which has the smallest sum of
    ``d^2 + log det S``.

    Args:
        positions: predicted positions of n tracks, shape (n, 3) [m].
        covariances: covariances of these positions, shape (n, 3, 3) [m^2].
        measured: the m measured positions with their covariances.
        gate: largest ``d^2`` of a possible pair.
        allowed: whether each pair may be assigned, shape (n, m); None: every pair may.
    """
    n, m = len(positions), len(measured.positions)
    if not n or not m:
        return NO_PAIRS
    tracks, detections = _near(positions, covariances, measured, gate, allowed).nonzero()
    if not len(tracks):
        return NO_PAIRS
    innovation = Innovation.of(positions.take(tracks, 0), covariances.take(tracks, 0), measured.rows(detections))
    distance = innovation.squared
    possible = distance <= gate
    if not possible.all():
        inside = possible.nonzero()[0]
        tracks, detections, distance = tracks[inside], detections[inside], distance[inside]
        innovation = innovation.rows(inside)
    if len(set(tracks.tolist())) == len(tracks) == len(set(detections.tolist())):
        return Pairs(tracks, detections, distance, innovation)  # no choice is left
    return _best(tracks, detections, distance, np.log(innovation.determinant), (n, m))


def _near(
    positions: Array, covariances: Array, measured: Measurements, gate: float, allowed: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Return the pairs (n, m) that may lie inside the gate: ``d^2 >= |nu|^2 / trace S`` excludes most of the others."""
    if measured.rotations is not None:  # the innovation is not a difference of positions
        near = np.ones((len(positions), len(measured.positions)), dtype=bool)
    else:
        traces = covariances.reshape(len(positions), 9)[:, ::4] @ _ONES
        noise = measured.noise.reshape(len(measured.noise), 9)[:, ::4] @ _ONES
        near = squared_distances(positions, measured.positions) <= gate * (traces[:, None] + noise)
    return near if allowed is None else near & allowed


def squared_distances(first: Array, second: Array) -> Array:
    """Return the squared distances (n, m) [m^2] between points (n, 3) and (m, 3), correct up to rounding errors."""
    offsets: Array = first.T[:, :, None] - second.T[:, None]
    offsets *= offsets
    return np.asarray(offsets[0] + offsets[1] + offsets[2])


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
    """Return the pairs ``(i, j)``, ``i < j``, of measurements whose positions do not differ significantly.

    "Not significantly" means that the squared distance of the positions, normalised by the sum of their covariances, is
    at most ``gate``.
    """
    positions, noise = measured.positions, measured.noise
    if len(positions) < 2:
        return []
    traces = noise.reshape(len(noise), 9)[:, ::4] @ _ONES
    squared = squared_distances(positions, positions)
    squared.reshape(-1)[:: len(positions) + 1] = np.inf
    if squared.min() > 2.0 * gate * traces.max():
        return []
    close = np.triu(squared <= gate * (traces[:, None] + traces), 1)
    if not close.any():
        return []
    first, second = close.nonzero()
    inverse, _ = inverse_3x3(noise[first] + noise[second])
    difference = positions[first] - positions[second]
    inside = np.einsum("ki,kij,kj->k", difference, inverse, difference) <= gate
    return list(zip(first[inside].tolist(), second[inside].tolist(), strict=True))


def matching_labels(labels: Sequence[str], others: Sequence[str]) -> NDArray[np.bool_] | None:
    """Return whether label i and other label j may belong to one obstacle, shape (n, m); None if this holds for all."""
    if not any(labels) or not any(others):
        return None
    return np.array([[not a or not b or a == b for b in others] for a in labels])
