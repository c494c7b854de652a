"""Association: decide which detection belongs to which track."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.detection import Detection
from imitarm.perception.motion_filter import Innovation, Measurements, inverse_3x3
from imitarm.perception.rotation_rate import turned
from imitarm.perception.tracks import UNCONFIRMED, Tracks
from imitarm.scene.obstacle import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FORBIDDEN = 1e9  # cost of a pair outside the gate: worse than any number of pairs inside
_ONES = np.ones(3)
_OTHER_KIND, _MOST = 4.0, 9.0  # see unlikeness
_SIZE, _ANGLE = 0.02, 0.4  # [m], [rad]
_LONGEST_GAP = 0.25  # [s] since the last detection, after which a track has no successor
_NONE = np.empty(0, dtype=np.intp)


class Pairs(NamedTuple):
    """Pairs of a track and the detection that was assigned to this track.

    Attributes:
        tracks: index of the track of each pair, shape (k,).
        detections: index of the detection of each pair, shape (k,).
        distances: normalised innovation squared ``d^2`` of each pair (see :func:`assign`), shape (k,).
        innovation: measured minus predicted position of each pair; None: the caller must compute the innovations again.
    """

    tracks: Indices
    detections: Indices
    distances: Array
    innovation: Innovation | None = None

    def joined(self, other: Pairs) -> Pairs:
        """Return these pairs, followed by the pairs of ``other``."""
        tracks, detections, distances = (np.concatenate(pair) for pair in zip(self[:3], other[:3], strict=True))
        return Pairs(tracks, detections, distances)

    def in_order(self) -> Pairs:
        """Return the pairs, sorted by the index of the track."""
        order = self.tracks.argsort()
        return Pairs(self.tracks[order], self.detections[order], self.distances[order])


NO_PAIRS = Pairs(_NONE, _NONE, np.empty(0))


def assigned(tracks: Tracks, detections: Sequence[Detection], measured: Measurements, gate: float) -> Pairs:
    """Assign detections to tracks, each at most once; confirmed tracks get their detections before the others do.

    Args:
        tracks: the tracks, predicted to the time of the detections.
        detections: the m detections.
        measured: the m detections as measurements.
        gate: largest normalised innovation squared of a pair, see :func:`assign`.
    """
    if not len(tracks) or not detections:
        return NO_PAIRS
    allowed = matching_labels(tracks.labels, [d.label for d in detections])
    mean, covariance = tracks.moments
    mean, covariance = mean[:, :3], covariance[:, :3, :3]
    confirmed, pairs = tracks.ids != UNCONFIRMED, NO_PAIRS
    free = np.ones(len(detections), dtype=bool)
    groups = (confirmed,) if tracks.all_confirmed else (confirmed, ~confirmed)
    for rows in (group.nonzero()[0] for group in groups):
        columns = free.nonzero()[0]

        def unlike(some: Indices, others: Indices, rows: Indices = rows, columns: Indices = columns) -> Array:
            shapes = [tracks.detections[i].solid for i in rows[some].tolist()]
            seen = [detections[i].solid for i in columns[others].tolist()]
            return unlikeness(shapes, seen, tracks.sizes[rows[some]])

        part = None if allowed is None else allowed[np.ix_(rows, columns)]
        found = assign(mean[rows], covariance[rows], measured.rows(columns), gate, part, unlike)
        if len(groups) == 1:
            return found
        found = Pairs(rows[found.tracks], columns[found.detections], found.distances)
        free[found.detections] = False
        pairs = pairs.joined(found)
    return pairs.in_order()


def successors(tracks: Tracks, new: NDArray[np.bool_], gate: float, spare: float) -> Pairs:
    r"""Find new tracks that follow the obstacles of older tracks, after sudden changes of their velocities.

    An obstacle that suddenly stops, starts or turns back leaves the gate of its track, and its detections begin a new
    track. Two tracks may belong to the same obstacle if their labels match, no update had detections of both, and

    .. math:: |z - p| \le \sqrt{\gamma\,\mathrm{tr}\,S} + (|v| + v_0)\,\tau

    Here, ``z`` is the position of the new track, ``p`` and ``v`` are the predicted position and velocity of the
    confirmed track, ``S`` is the covariance of ``z - p``, ``gamma`` is the gate, and ``tau`` is the time since the last
    detection of the confirmed track, at most 0.25 s. Each track is used at most once, and the sum of the distances is
    the smallest possible.

    Args:
        tracks: the tracks at the time of an update.
        new: whether each track is about to be confirmed, shape (n,).
        gate: ``gamma``, the largest normalised innovation squared of a pair inside the gate.
        spare: ``v_0``, change of the velocity of an obstacle at rest [m/s].

    Returns:
        The pairs; ``tracks`` are the older tracks, ``detections`` are the new tracks, and ``distances`` are [m].
    """
    since, columns = tracks.stamp - tracks.last_seen, new.nonzero()[0]
    rows = ((tracks.ids != UNCONFIRMED) & (since > 0.0) & (since <= _LONGEST_GAP)).nonzero()[0]
    if not len(rows):
        return NO_PAIRS
    mean, covariance = tracks.moments
    traces = np.trace(covariance[:, :3, :3], axis1=1, axis2=2)
    change = (np.linalg.norm(mean[rows, 3:6], axis=1) + spare) * since[rows]
    distance = np.linalg.norm(mean[rows, None, :3] - mean[columns, :3], axis=2)
    near = distance <= np.sqrt(gate * (traces[rows, None] + traces[columns])) + change[:, None]
    lives = (1 << tracks.ages[columns]) - 1  # the updates since each new track began
    near &= tracks.hits[rows, None] & tracks.hits[columns] & lives == 0
    allowed = matching_labels([tracks.labels[i] for i in rows.tolist()], [tracks.labels[i] for i in columns.tolist()])
    older, newer = (near if allowed is None else near & allowed).nonzero()
    if not len(older):
        return NO_PAIRS
    found = _best(older, newer, distance[older, newer], np.zeros(len(older)), distance.shape)
    return Pairs(rows[found.tracks], columns[found.detections], found.distances)


def assign(
    positions: Array,
    covariances: Array,
    measured: Measurements,
    gate: float,
    allowed: NDArray[np.bool_] | None = None,
    unlike: Callable[[Indices, Indices], Array] | None = None,
) -> Pairs:
    """Assign detections to tracks; each detection and each track is used at most once.

    The innovation ``nu`` of a pair is the measured minus the predicted position, and ``S`` is its covariance. A pair is
    possible if the normalised innovation squared ``d^2 = nu' S^-1 nu`` is at most ``gate``, a quantile of the
    chi-square distribution with 3 degrees of freedom. The function considers only assignments with the largest possible
    number of pairs. Among these, it chooses the most probable assignment, which has the smallest sum of
    ``d^2 + log det S``. If ``unlike`` is given, the sum also contains the value of ``unlike`` for each pair.

    Args:
        positions: predicted positions of n tracks, shape (n, 3) [m].
        covariances: covariances of these positions, shape (n, 3, 3) [m^2].
        measured: the m measured positions with their covariances.
        gate: largest ``d^2`` of a possible pair.
        allowed: whether each pair may be assigned, shape (n, m); None: every pair may.
        unlike: function of the indices of k tracks and of k detections. It returns how much their shapes differ, shape
            (k,), see :func:`unlikeness`. It is called only if more than one assignment is possible.
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
    cost = np.log(innovation.determinant)
    if unlike is not None:
        cost = cost + unlike(tracks, detections)
    return _best(tracks, detections, distance, cost, (n, m))


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


def unlikeness(first: Sequence[Solid], second: Sequence[Solid], sizes: Array) -> Array:
    """Return how much the shapes of k tracks and k detections differ, shape (k,); 0 for equal shapes, at most 9.

    Shapes of different kinds, such as a sphere and a box, differ by 4. They may still be one obstacle, because a camera
    can confuse the kinds. For shapes of the same kind, the result is a sum of two squares: of the difference of size
    divided by 20 mm, and of the angle between the rotations divided by 0.4 rad.

    Args:
        first: shapes of the tracks, as last detected.
        second: shapes of the detections.
        sizes: smoothed sizes of the tracks, shape (k, 3) [m].
    """
    found = np.full(len(first), _OTHER_KIND)
    same = [i for i, (a, b) in enumerate(zip(first, second, strict=True)) if a.kind == b.kind]
    if same:
        kinds = [first[i].kind for i in same]
        before, now = (np.array([solids[i].quaternion for i in same]) for solids in (first, second))
        angle = np.linalg.norm(turned(kinds, before, now), axis=1)
        change = np.linalg.norm(sizes[same] - np.array([second[i].size for i in same]), axis=1)
        found[same] = np.minimum((change / _SIZE) ** 2 + (angle / _ANGLE) ** 2, _MOST)
    return found


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


def distinct(detections: Sequence[Detection], measured: Measurements, gate: float) -> Indices:
    """Return the indices of the detections that remain if each obstacle counts once, shape (k,).

    Two detections are of one obstacle if their positions may be equal and each position is inside the other shape. The
    more accurate detection remains.

    Args:
        detections: the detections of one update.
        measured: the detections as measurements.
        gate: see :func:`duplicates`.
    """
    dropped: set[int] = set()
    for i, j in duplicates(measured, gate):
        first, second = detections[i], detections[j]
        inside = first.obstacle.signed_distance(second.position) < 0.0
        if not inside or second.obstacle.signed_distance(first.position) >= 0.0 or dropped & {i, j}:
            continue
        dropped.add(i if _accuracy(first) > _accuracy(second) else j)
    return np.array([i for i in range(len(detections)) if i not in dropped], dtype=np.intp)


def _accuracy(detection: Detection) -> tuple[float, ...]:
    """Return a key by which detections are sorted, the most accurate first, whatever their order was."""
    return (float(np.trace(detection.covariance)), *detection.position.tolist())


def duplicates(measured: Measurements, gate: float) -> list[tuple[int, int]]:
    """Return the pairs ``(i, j)``, ``i < j``, of measurements whose positions may be equal.

    Two positions may be equal if their squared distance, normalised by the sum of their covariances, is at most
    ``gate``.
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
    """Return whether label i and label j of ``others`` may be those of one obstacle, shape (n, m); None: all may."""
    if not any(labels) or not any(others):
        return None
    return np.array([[not a or not b or a == b for b in others] for a in labels])
