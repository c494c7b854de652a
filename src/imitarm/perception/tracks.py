"""Tracks: the state of a tracker at one time, as arrays. TrackedObstacle: one track of a Tracks object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.html_table import html_table
from imitarm.perception.detection import Detection, estimated
from imitarm.perception.motion_filter import Belief, Measurements, MotionFilter
from imitarm.perception.rotation_rate import Rates, turned_on
from imitarm.perception.track_memory import TrackMemory
from imitarm.scene import Obstacle
from imitarm.scene.distances import resized
from imitarm.validation import finite_number

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FULL_COUNT = 10  # detections after which a size is smoothed with a fixed weight
UNCONFIRMED = -1  # the number of a track that is not confirmed yet


@dataclass(frozen=True, eq=False)
class Tracks:
    """The state of n tracks at one time, with one row for each track. The object is immutable.

    Attributes:
        filter: Kalman filters of the tracks.
        stamp: time of the state [s].
        belief: estimated state of each obstacle (position, velocity and, for some filters, acceleration) with its
            covariance.
        ids: number of each track, shape (n,); ``UNCONFIRMED`` for a track that is not confirmed yet.
        last_seen: time of the last detection of each track, shape (n,) [s].
        hits: one whole number for each track, shape (n,). Each bit of the number stands for one of the last updates,
            and is 1 if the track had a detection in this update.
        ages: number of updates since the track began, shape (n,).
        sizes: size of each shape, averaged over detections, shape (n, 3) [m].
        counts: number of detections over which each size is averaged, shape (n,).
        rates: angular velocity of each obstacle, with its noise.
        detections: last detection of each track, n entries.
        labels: last label of each track that was not empty, n entries.
        next_id: number for the track that is confirmed next.
    """

    filter: MotionFilter
    stamp: float
    belief: Belief
    ids: NDArray[np.int64]
    last_seen: Array
    hits: NDArray[np.int64]
    ages: NDArray[np.int64]
    sizes: Array
    counts: NDArray[np.int64]
    rates: Rates
    detections: tuple[Detection, ...]
    labels: tuple[str, ...]
    next_id: int = 0

    def changed(self, **changes: object) -> Tracks:
        """Return a copy with new values for some attributes; faster than :func:`dataclasses.replace`."""
        copied = object.__new__(Tracks)
        copied.__dict__.update({key: getattr(self, key) for key in _ATTRIBUTES}, **changes)
        return copied

    @cached_property
    def memory(self) -> TrackMemory:
        """The tracks in one block of memory, for compiled code."""
        columns = {name: getattr(self, name) for name in (*_IN_MEMORY, "ids")}
        quaternions = np.array([detection.solid.quaternion for detection in self.detections]).reshape(-1, 4)
        return TrackMemory.of(self.belief.mean, self.belief.covariance, quaternions, columns)

    def in_memory(self, memory: TrackMemory, stamp: float, detections: tuple[Detection, ...], rates: Rates) -> Tracks:
        """Return confirmed tracks after a detection of each of them, which compiled code has computed.

        Arrays are made when they are first read.

        Args:
            memory: the new tracks.
            stamp: time of the detections [s].
            detections: in the order of the tracks; each has the outline of the detection before.
            rates: new angular velocities.
        """
        seen, values = object.__new__(Tracks), self.__dict__
        seen.__dict__.update({key: values[key] for key in _LASTING}, memory=memory, stamp=stamp, rates=rates)
        seen.__dict__.update(
            detections=detections, all_confirmed=True, outlines=self.outlines, order=self.order, in_order=self.in_order
        )
        return seen

    def renewed(
        self, memory: TrackMemory, stamp: float, detections: tuple[Detection, ...], labels: tuple[str, ...]
    ) -> Tracks:
        """Return tracks after compiled code has ended or begun some of them; they do not rotate.

        Args:
            memory: the new tracks.
            stamp: time of the last update [s].
            detections: the last detection of each of these n tracks, then all detections of the update.
            labels: the last labels of the same, where they are not empty.
        """
        tracks, sources, ids = object.__new__(Tracks), memory.array("detected").tolist(), memory.array("ids")
        next_id = max([self.next_id, *(number + 1 for number in ids.tolist())])
        tracks.__dict__.update(filter=self.filter, stamp=stamp, memory=memory, ids=ids, next_id=next_id)
        chosen, named = tuple([detections[k] for k in sources]), tuple([labels[k] for k in sources])
        tracks.__dict__.update(rates=Rates.none(memory.n), detections=chosen, labels=named)
        return tracks

    def __getattr__(self, name: str) -> Any:
        """Make the arrays of tracks that are in a block of memory; reject unknown attributes."""
        memory: TrackMemory | None = self.__dict__.get("memory")
        if memory is None or (name not in _IN_MEMORY and name != "belief"):
            raise AttributeError(f"Tracks has no attribute {name!r}")
        value: Any
        if name == "belief":
            value = Belief(memory.array("mean"), memory.array("covariance"), np.ones((memory.n, 1)))
        else:
            value = memory.array(name)
        object.__setattr__(self, name, value)
        return value

    @cached_property
    def outlines(self) -> list[str]:
        """Label, kind and name of each track as last detected; empty for a convex hull."""
        return [detection.outline for detection in self.detections]

    @cached_property
    def order(self) -> list[int]:
        """The indices of the confirmed tracks, in the order of their numbers."""
        rows = self.confirmed
        order: list[int] = rows[self.ids[rows].argsort()].tolist()
        return order

    @cached_property
    def in_order(self) -> bool:
        """Whether all tracks are confirmed, and in the order of their numbers."""
        return self.order == list(range(len(self.ids)))

    @cached_property
    def form(self) -> tuple[object, ...]:
        """What does not change while the confirmed tracks only move or change size: number, name and kind of each."""
        return self.shapes(np.array(self.order, dtype=np.intp))

    @classmethod
    def none(cls, motion_filter: MotionFilter, stamp: float, next_id: int = 0) -> Tracks:
        """Return an object without tracks."""
        whole = np.zeros(0, dtype=np.int64)
        belief = motion_filter.born(np.zeros((0, 3)), np.zeros((0, 3, 3)))
        sizes = np.zeros((0, 3))
        return cls(
            motion_filter, stamp, belief, whole, np.zeros(0), whole, whole, sizes, whole, Rates.none(0), (), (), next_id
        )

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def born(
        cls, motion_filter: MotionFilter, stamp: float, detections: Sequence[Detection], measured: Measurements
    ) -> Tracks:
        """Return new tracks, one for each detection; ``measured`` are the detections as measurements."""
        k = len(detections)
        ones = np.ones(k, dtype=np.int64)
        return cls(
            motion_filter,
            stamp,
            motion_filter.born(measured.positions, measured.noise),
            ids=np.full(k, UNCONFIRMED, dtype=np.int64),
            last_seen=np.full(k, stamp),
            hits=ones,
            ages=ones,
            sizes=np.array([d.solid.size for d in detections], dtype=float).reshape(k, 3),
            counts=ones,
            rates=Rates.none(k),
            detections=tuple(detections),
            labels=tuple(d.label for d in detections),
        )

    @property
    def confirmed(self) -> Indices:
        """Indices of the confirmed tracks, shape (k,)."""
        return (self.ids != UNCONFIRMED).nonzero()[0]

    def rows(self, rows: Indices) -> Tracks:
        """Return the tracks with the indices ``rows``."""
        chosen = rows.tolist()
        return self.changed(
            belief=self.belief.rows(rows),
            ids=self.ids[rows],
            last_seen=self.last_seen[rows],
            hits=self.hits[rows],
            ages=self.ages[rows],
            sizes=self.sizes[rows],
            counts=self.counts[rows],
            rates=self.rates.rows(rows),
            detections=tuple(self.detections[i] for i in chosen),
            labels=tuple(self.labels[i] for i in chosen),
        )

    def continued(self, older: Indices, newer: Indices) -> Tracks:
        """Return the tracks, where each track in ``older`` goes on as its successor in ``newer``, which is removed."""
        last_seen, hits, sizes, counts = (a.copy() for a in (self.last_seen, self.hits, self.sizes, self.counts))
        last_seen[older], hits[older] = self.last_seen[newer], self.hits[newer]
        seen, labels = list(self.detections), list(self.labels)
        for i, j in zip(older.tolist(), newer.tolist(), strict=True):
            if seen[i].solid.kind != seen[j].solid.kind:  # sizes of two kinds have different meanings
                sizes[i], counts[i] = sizes[j], counts[j]
            seen[i], labels[i] = seen[j], labels[j] or labels[i]
        merged = self.changed(
            belief=self.belief.replaced(older, self.belief.rows(newer)),
            last_seen=last_seen,
            hits=hits,
            sizes=sizes,
            counts=counts,
            detections=tuple(seen),
            labels=tuple(labels),
        )
        return merged.rows(np.delete(np.arange(len(self)), newer))

    def joined(self, other: Tracks) -> Tracks:
        """Return these tracks, followed by the tracks of ``other``, which must have the same stamp."""
        return self.changed(
            belief=self.belief.joined(other.belief),
            ids=np.concatenate([self.ids, other.ids]),
            last_seen=np.concatenate([self.last_seen, other.last_seen]),
            hits=np.concatenate([self.hits, other.hits]),
            ages=np.concatenate([self.ages, other.ages]),
            sizes=np.concatenate([self.sizes, other.sizes]),
            counts=np.concatenate([self.counts, other.counts]),
            rates=self.rates.joined(other.rates),
            detections=self.detections + other.detections,
            labels=self.labels + other.labels,
        )

    def at(self, time: float) -> Tracks:
        """Return the tracks, predicted to ``time`` [s]."""
        return self.changed(stamp=time, belief=self.filter.predict(self.belief, time - self.stamp))

    @cached_property
    def moments(self) -> tuple[Array, Array]:
        """Mean (n, m) and covariance (n, m, m) of each obstacle's state, combined over all models of motion."""
        return self.belief.combined()

    def shapes(self, rows: Indices) -> tuple[object, ...]:
        """Return number, name and kind of each track; equal results mean that tracks only move or change size."""
        parts: list[object] = []
        for row, track_id in zip(rows.tolist(), self.ids[rows].tolist(), strict=True):
            detection = self.detections[row]
            parts += (
                track_id,
                self.labels[row],
                detection.obstacle.name,
                detection.solid.kind,
                id(detection.solid.polytope),
            )
        return tuple(parts)

    def quaternions(self, rows: Indices) -> Array:
        """Return the rotations of the last detections, quaternions wxyz, shape (k, 4)."""
        return np.array([self.detections[row].solid.quaternion for row in rows.tolist()]).reshape(-1, 4)

    @cached_property
    def reported_rates(self) -> Array:
        """Angular velocity of each obstacle, reduced by its noise (see ``Rates``), shape (n, 3) [rad/s]."""
        return self.rates.reported

    @cached_property
    def all_confirmed(self) -> bool:
        """Whether every track is confirmed."""
        return bool((self.ids != UNCONFIRMED).all())

    @cached_property
    def view(self) -> tuple[TrackedObstacle, ...]:
        """The confirmed tracks, in the order of their numbers."""
        return tuple([TrackedObstacle(self, row) for row in self.order])


_ATTRIBUTES = tuple(Tracks.__dataclass_fields__)
_LASTING = "filter", "ids", "labels", "next_id"  # what does not change while every track is seen
_IN_MEMORY = "last_seen", "hits", "ages", "sizes", "counts"


class TrackedObstacle:
    """The estimate of one obstacle at one time.

    Attributes:
        tracks: all tracks at this time.
        row: index of this track in ``tracks``.
    """

    def __init__(self, tracks: Tracks, row: int) -> None:
        self.tracks, self.row = tracks, row

    @property
    def track_id(self) -> int:
        """Number of the track: 0, 1, ... in the order of confirmation."""
        return int(self.tracks.ids[self.row])

    @property
    def stamp(self) -> float:
        """Time of the estimate [s]."""
        return self.tracks.stamp

    @property
    def last_seen(self) -> float:
        """Time of the last detection [s]."""
        return float(self.tracks.last_seen[self.row])

    @property
    def label(self) -> str:
        """Last label that was not empty."""
        return self.tracks.labels[self.row]

    @property
    def position(self) -> Array:
        """Estimated position of the local frame's origin, shape (3,) [m]."""
        return self.tracks.moments[0][self.row, :3]

    @property
    def velocity(self) -> Array:
        """Estimated velocity, shape (3,) [m/s]."""
        return self.tracks.moments[0][self.row, 3:6]

    @property
    def angular_velocity(self) -> Array:
        """Estimated angular velocity, shape (3,) [rad/s]; 0 if it is not larger than its noise."""
        return self.tracks.reported_rates[self.row]

    @property
    def covariance(self) -> Array:
        """Covariance of position and velocity, shape (6, 6) [m^2, m^2/s, m^2/s^2]."""
        return self.tracks.moments[1][self.row, :6, :6]

    @cached_property
    def obstacle(self) -> Obstacle:
        """The obstacle at ``stamp``, with velocity, covariance of the position, track number and name.

        The size is averaged over the detections. The rotation is the rotation of the last detection, predicted to
        ``stamp`` with the estimated angular velocity.
        """
        tracks, row = self.tracks, self.row
        shape = tracks.detections[row].obstacle
        if (tracks.sizes[row] != shape.solid().size).any():
            shape = resized(shape, tracks.sizes[row])
        name = shape.name or self.label or f"track {self.track_id}"
        covariance = self.covariance[:3, :3]
        covariance = 0.5 * (covariance + covariance.T)
        rates, elapsed = self.angular_velocity[None], np.array([tracks.stamp - self.last_seen])
        quaternion = turned_on(shape.solid().quaternion[None], rates, elapsed)[0]
        moved = shape.placed(self.position, quaternion, self.velocity, rates[0])
        return estimated(moved, covariance, self.track_id, name)

    def predict(self, horizon: float) -> TrackedObstacle:
        """Return the obstacle ``horizon`` seconds later, without new detections; its uncertainty grows.

        Args:
            horizon: how far ahead the obstacle is predicted [s].

        Raises:
            InputError: when the horizon is not a finite number.
        """
        horizon = finite_number(horizon, "TrackedObstacle.predict: horizon", "s")
        return TrackedObstacle(self.tracks.rows(np.array([self.row])).at(self.stamp + horizon), 0)

    def __repr__(self) -> str:
        position = np.round(self.position, 3).tolist()
        return f"TrackedObstacle({self.track_id}, at {position} m, {np.round(self.velocity, 3).tolist()} m/s)"

    def _repr_html_(self) -> str:
        deviation = 1e3 * np.sqrt(np.diagonal(self.covariance)[:3])
        return html_table(
            f"TrackedObstacle {self.track_id}",
            {
                "shape": self.obstacle.kind,
                "label": self.label,
                "position": f"{np.round(self.position, 4).tolist()} m",
                "standard deviation": f"{np.round(deviation, 1).tolist()} mm",
                "velocity": f"{np.round(self.velocity, 3).tolist()} m/s",
                "stamp, last seen": f"{self.stamp:.3f} s, {self.last_seen:.3f} s",
            },
        )


def smoothed_sizes(sizes: Array, rows: Indices, measured: Array, counts: NDArray[np.int64]) -> Array:
    """Return the averaged sizes (n, 3) [m] of all tracks after new measurements (k, 3) [m] of the tracks ``rows``."""
    error = measured - (sizes if len(rows) == len(sizes) else sizes[rows])  # all rows are in order
    if not error.any():
        return sizes
    smoothed = sizes.copy()
    smoothed[rows] += error / np.minimum(counts[rows], _FULL_COUNT)[:, None]
    return smoothed
