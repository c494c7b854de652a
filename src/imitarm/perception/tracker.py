"""ObstacleTracker: estimates positions and velocities of moving obstacles from noisy and late detections."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.perception.association import Pairs, assigned, distinct, successors
from imitarm.perception.consistency import Consistency, chi_square_quantile
from imitarm.perception.detection import Detection
from imitarm.perception.motion_filter import Belief, Measurements, MotionFilter
from imitarm.perception.rotation_rate import Rates, turned, turned_on
from imitarm.perception.track_memory import ALL_SEEN, IN_ORDER, TrackMemory, obstacles, renewed, updated
from imitarm.perception.tracks import UNCONFIRMED, TrackedObstacle, Tracks, smoothed_sizes
from imitarm.scene import Obstacle, Scene
from imitarm.validation import finite_number, instance, sequence, time_stamp, whole_number

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_ROW = 19  # numbers in a row of a detection
_RESET = 10.0  # [s] a stamp that goes back by more was given by another clock
_RECENT = 300  # updates whose innovations are kept


class _Step(NamedTuple):
    """One accepted update: what went in, and what was known afterwards."""

    stamp: float
    detections: tuple[Detection, ...]
    tracks: Tracks
    distances: Array  # normalised innovation squared of each assigned detection


class ObstacleTracker:
    """Tracks many obstacles with Kalman filters: computes positions, velocities and covariances from detections.

    Thesis Eq 5.2 predicts the motion, here without the unknown input ``B u`` and with noise of a given covariance.
    :class:`~imitarm.perception.motion_filter.MotionFilter` lists the equations.

    1. *Assignment.* The innovation ``nu`` is the measured minus the predicted position, with the covariance ``S``. A
    detection can belong to a track if ``d^2 = nu' S^-1 nu`` is at most a limit, the gate. This limit is the quantile of
    the chi-square distribution for the probability ``gate``. Confirmed tracks get their detections before the other
    tracks do.
    2. *Birth.* Every detection that was not assigned starts a new track. The track is confirmed if at least
       ``confirm[0]`` of its first ``confirm[1]`` updates had a detection. Only confirmed tracks are reported.
    3. *Death.* A track without a detection continues at its velocity, and its covariance grows. The track ends when it
       has had no detection for more than ``max_unseen`` seconds.
    4. *Latency.* ``scene(time)`` predicts all tracks from the time of the last detections to ``time``. This prediction
       compensates the latency of the sensor (thesis Eqs 5.3 and 5.4 give the predicted positions and their
       covariances).

    **Late detections.** Detections may arrive out of order. If an update is at most ``history`` seconds older than the
    newest update, the tracker inserts it and repeats all updates after it. The result is therefore the same as if all
    updates had arrived in order. Older updates are ignored, and :attr:`ignored` counts them as ``"late"``.

    **Sudden changes.** If an obstacle suddenly stops, starts or turns back, its detections leave the gate and begin a
    new track. When the tracker confirms the new track, it merges the two tracks if they belong to the same obstacle
    (:func:`~imitarm.perception.association.successors`). The merged track keeps the number of the older track.

    **Other imperfect input.** :attr:`ignored` also counts three other cases. A second update with the same stamp and
    the same detections is ignored (``"repeated"``). Two detections of one update are duplicates if their positions may
    be equal and one shape is inside the other. Then only the more accurate detection is used (``"duplicate"``). If
    there are more than ``max_obstacles`` tracks, the tracks with the oldest detections are removed (``"removed"``).
    More than ``max_obstacles`` detections in one update are an error, and no track changes.

    **Consistency.** :attr:`consistency` compares the mean of ``d^2`` with the band in which it lies for correct
    covariances. If the mean is above the band, the detections are noisier than their covariance states, or
    ``process_noise`` is too small.

    **Rotation.** A track has the rotation of its last detection. With ``rotations``, its angular velocity is estimated
    from the rotations of its detections (:class:`~imitarm.perception.rotation_rate.Rates`). Sizes are averaged over the
    detections.

    Args:
        motion: model of the motion: ``"constant-velocity"``, ``"constant-acceleration"``, ``"imm"`` or ``"ekf"``.
            ``"imm"`` (interacting multiple model) combines the first two models, weighted by their likelihoods.
            ``"ekf"`` (extended Kalman filter) assumes a constant velocity and positions measured in the camera's frame
            (:attr:`Detection.camera_to_base`).
        process_noise: spectral density of the noise that disturbs the velocity [m^2/s^3] or, with constant
            acceleration, the acceleration [m^2/s^5]; two numbers for ``"imm"``. None: 0.05 for constant velocity, 1 for
            constant acceleration, (0.02, 30) for ``"imm"``.
        gate: probability that a correct detection of a tracked obstacle is within the gate.
        confirm: two numbers (hits, updates): a track is confirmed if at least ``hits`` of its first ``updates`` updates
            had a detection of the obstacle.
        max_unseen: time after the last detection at which a track ends [s].
        max_speed: largest speed of an obstacle [m/s]; a larger estimate is scaled down.
        max_obstacles: largest number of tracks, and of detections in one update.
        initial_speed: standard deviation of each component of a new track's velocity [m/s].
        history: largest age of a late update, relative to the newest update [s].
        rotations: whether angular velocities are estimated; otherwise they are 0. A policy that guarantees its
            clearance replaces an obstacle with an angular velocity by a sphere around it.

    Raises:
        InputError: when an argument is out of its range.
    """

    def __init__(
        self,
        motion: str = "constant-velocity",
        *,
        process_noise: float | Sequence[float] | None = None,
        gate: float = 0.99,
        confirm: tuple[int, int] = (2, 3),
        max_unseen: float = 0.5,
        max_speed: float = 3.0,
        max_obstacles: int = 32,
        initial_speed: float = 0.5,
        history: float = 0.5,
        rotations: bool = False,
    ) -> None:
        self.motion = motion
        self.filter = MotionFilter(motion, process_noise, initial_speed)
        probability = finite_number(gate, "ObstacleTracker: gate", above=0.0)
        if probability >= 1.0:
            raise InputError(f"ObstacleTracker: gate must be a probability below 1, got {gate:g}")
        self.gate = chi_square_quantile(probability, 3)
        self.confirm = _checked_confirm(confirm)
        self.max_unseen = finite_number(max_unseen, "ObstacleTracker: max_unseen", "s", above=0.0)
        self.max_speed = finite_number(max_speed, "ObstacleTracker: max_speed", "m/s", above=0.0)
        self.max_obstacles = whole_number(max_obstacles, "ObstacleTracker: max_obstacles", at_least=1)
        self.history = finite_number(history, "ObstacleTracker: history", "s", at_least=0.0)
        self.rotations = instance(rotations, bool, "ObstacleTracker: rotations")
        self._compiles = len(self.filter.orders) == 1 and motion != "ekf"
        self.reset()

    def reset(self) -> None:
        """Delete all tracks and all counts of :attr:`ignored`; track numbers start from 0 again."""
        self.ignored: Counter[str] = Counter()
        self._steps: deque[_Step] = deque()
        self._distances: deque[Array] = deque(maxlen=_RECENT)
        self._forgotten = False  # whether steps are no longer kept
        self._scene: Scene | None = None
        self._form: tuple[object, ...] = ()  # of the tracks in it

    @property
    def stamp(self) -> float | None:
        """Time of the newest accepted update [s]; None before the first update."""
        return self._steps[-1].stamp if self._steps else None

    @property
    def tracks(self) -> tuple[TrackedObstacle, ...]:
        """The confirmed tracks at the time :attr:`stamp`, in the order of their numbers."""
        return self._steps[-1].tracks.view if self._steps else ()

    @property
    def innovations(self) -> Array:
        """Normalised innovation squared of each detection that was assigned in the newest update, shape (k,)."""
        return self._steps[-1].distances if self._steps else np.empty(0)

    @property
    def consistency(self) -> Consistency:
        """Mean normalised innovation squared (NIS) of the last 300 updates, and its 95 % band for a correct filter."""
        values = np.concatenate(list(self._distances)) if self._distances else np.empty(0)
        return Consistency.of(values, gate=self.gate)

    def update(self, stamp: float, detections: Sequence[Detection]) -> tuple[TrackedObstacle, ...]:
        """Update the tracks with the detections of one sensor at one time.

        Args:
            stamp: time of the measurement [s].
            detections: everything that the sensor detected at that time; may be empty.

        Returns:
            The confirmed tracks at the newest stamp, in the order of their numbers.

        Raises:
            InputError: when ``stamp`` is not a finite number or more than 10 s before the newest stamp, an entry of
                ``detections`` is not a detection, or there are more than ``max_obstacles`` detections. The tracks are
                then not changed.
        """
        stamp = time_stamp(stamp, "ObstacleTracker.update: stamp")
        found = sequence(detections, Detection, "ObstacleTracker.update: detections")
        if len(found) > self.max_obstacles:
            raise InputError(
                f"ObstacleTracker.update: {len(found)} detections are more than max_obstacles = {self.max_obstacles}; "
                "increase max_obstacles, or leave out detections that are out of reach"
            )
        if self._steps and stamp < self._steps[-1].stamp:
            self._insert(stamp, found)
        elif self._steps and stamp == self._steps[-1].stamp and self._repeats(stamp, found):
            self.ignored["repeated"] += 1
        else:
            self._append(stamp, found)
        return self.tracks

    def scene(self, time: float, *, goal: Pose | None = None, fixtures: Sequence[Obstacle] = ()) -> Scene:
        """Return a scene whose obstacles are the confirmed tracks, predicted to ``time``.

        Each obstacle has its predicted position and velocity, the covariance of the predicted position, and the number
        of its track. The scene's ``packed.stamps`` contains the time of the last detection of each obstacle. Only an
        update can end a track, so obstacles do not disappear while no updates arrive.

        Args:
            time: time to which the obstacles are predicted, and stamp of the scene [s].
            goal: goal of the scene.
            fixtures: fixtures (known obstacles that do not move) of the scene.

        Raises:
            InputError: when an argument is invalid.
        """
        time = time_stamp(time, "ObstacleTracker.scene: time")
        if type(fixtures) is not tuple:
            fixtures = sequence(fixtures, Obstacle, "ObstacleTracker.scene: fixtures")  # type: ignore[type-abstract]
        if not self._steps:
            return Scene(goal, (), time, tuple(fixtures))
        tracks = self._steps[-1].tracks
        base, form = self._scene, tracks.form
        same = self._form is form or self._form == form
        if base is None or not same or base.goal is not goal or base.fixtures != tuple(fixtures):
            seen = tuple(track.obstacle for track in self.tracks)
            self._scene = base = Scene(goal, seen, tracks.stamp, tuple(fixtures))
        self._form = form
        if not len(base.packed):
            return replace(base, stamp=time)
        if self._compiles and not self.rotations and tracks.in_order:
            placed = obstacles(tracks.memory, time - tracks.stamp, self.filter.noise[0], base.packed)
            if placed is not None:
                return Scene.predicted(base, placed, time)
        rows = np.array(tracks.order, dtype=np.intp)
        mean, covariance = tracks.filter.predict(tracks.belief.rows(rows), time - tracks.stamp).combined()
        last_seen, rates = tracks.last_seen[rows], tracks.reported_rates[rows]
        rotations = turned_on(tracks.quaternions(rows), rates, time - last_seen)
        position, velocity = np.ascontiguousarray(mean[:, :3]), np.ascontiguousarray(mean[:, 3:6])
        uncertainty = np.ascontiguousarray(covariance[:, :3, :3])
        rigid = [polytope is not None for polytope in base.packed.polytopes]
        sizes = np.where(np.array(rigid)[:, None], base.packed.sizes, tracks.sizes[rows])
        poses = position, rotations, velocity, rates, last_seen, uncertainty
        moved = base.packed.placed(*poses, None if (sizes == base.packed.sizes).all() else sizes)
        return Scene.predicted(base, moved, time)

    def _repeats(self, stamp: float, detections: tuple[Detection, ...]) -> bool:
        """Whether an update with this stamp and the same detections was accepted before."""
        return any(
            step.stamp == stamp
            and len(step.detections) == len(detections)
            and all(a.repeats(b) for a, b in zip(step.detections, detections, strict=True))
            for step in self._steps
        )

    def _append(self, stamp: float, detections: tuple[Detection, ...]) -> None:
        """Take in an update that is not older than any other."""
        before = self._steps[-1].tracks if self._steps else Tracks.none(self.filter, stamp)
        self._steps.append(self._advanced(before, stamp, detections))
        self._distances.append(self._steps[-1].distances)
        while len(self._steps) > 1 and self._steps[1].stamp <= stamp - self.history:
            self._steps.popleft()
            self._forgotten = True

    def _insert(self, stamp: float, detections: tuple[Detection, ...]) -> None:
        """Take in a late update: go back to its time, and repeat the later ones."""
        newest, oldest = self._steps[-1].stamp, self._steps[0].stamp
        if newest - stamp > _RESET:
            raise InputError(
                f"ObstacleTracker.update: stamp {stamp:.3f} s is {newest - stamp:.1f} s before the newest stamp "
                f"({newest:.3f} s); all sensors must use one clock. Call reset() after the clock was set back"
            )
        if stamp < newest - self.history or (stamp < oldest and self._forgotten):
            self.ignored["late"] += 1
            return
        if self._repeats(stamp, detections):
            self.ignored["repeated"] += 1
            return
        later = []
        while self._steps and self._steps[-1].stamp > stamp:
            later.append(self._steps.pop())
            self._distances.pop()
        self._append(stamp, detections)
        for step in reversed(later):
            self._append(step.stamp, step.detections)

    def _advanced(self, tracks: Tracks, stamp: float, detections: tuple[Detection, ...]) -> _Step:
        """Return the tracks after one update."""
        given, rows = detections, b"".join([d.row_bytes for d in detections])
        known = self._compiled(tracks, stamp, detections, rows)
        if isinstance(known, _Step):
            return known
        table = np.frombuffer(rows).reshape(-1, _ROW)
        measured = self._measurements(detections, table)
        if known is None:
            tracks = tracks.at(stamp)
            apart = distinct(detections, measured, self.gate)
            if len(apart) < len(detections):
                self.ignored["duplicate"] += len(detections) - len(apart)
                detections, table = tuple([detections[i] for i in apart.tolist()]), table[apart]
                measured = measured.rows(apart)
            pairs = assigned(tracks, detections, measured, self.gate)
            belief = self._corrected(tracks.belief, pairs, measured)
        else:
            belief, pairs = known
        tracks = self._seen(tracks.changed(stamp=stamp, belief=belief), pairs, detections, table[:, 12:15])
        tracks = self._pruned(tracks)
        if len(pairs.detections) < len(detections):
            free = np.ones(len(detections), dtype=bool)
            free[pairs.detections] = False
            left = free.nonzero()[0]
            born = Tracks.born(self.filter, stamp, [detections[i] for i in left.tolist()], measured.rows(left))
            tracks = self._fitted(tracks.joined(born))
        return _Step(stamp, given, self._confirmed(tracks), pairs.distances)

    def _compiled(
        self, tracks: Tracks, stamp: float, detections: tuple[Detection, ...], rows: bytes
    ) -> _Step | tuple[Belief, Pairs] | None:
        """Return the result of compiled code: the whole step if all tracks were seen, otherwise beliefs and pairs.

        None: the compiled code is not built, or can't decide the assignment.
        """
        if not self._compiles or not len(tracks.ids):
            return None
        dt, (noise,) = stamp - tracks.stamp, self.filter.noise
        numbers, window = (noise, self.gate, self.max_speed), self.confirm[1]
        found = updated(tracks.memory, stamp, dt, rows, *numbers, window=window)
        if found is None:
            return None
        memory, flags = found
        if flags & ALL_SEEN:
            index = None if flags & IN_ORDER else memory.array("detected")
            ordered = detections if index is None else tuple([detections[i] for i in index.tolist()])
            outlines = [d.outline for d in ordered]
            if outlines == tracks.outlines and "" not in outlines:
                rates = self._turned(tracks, stamp, np.arange(len(ordered)), ordered)
                now = tracks.in_memory(memory, stamp, ordered, rates)
                if "form" in tracks.__dict__:
                    now.__dict__["form"] = tracks.form
                return _Step(stamp, detections, now, memory.array("distances"))
        index, labels = memory.array("detected"), tracks.labels
        if any(labels):
            for label, i in zip(labels, index.tolist(), strict=True):
                if i >= 0 and label != (other := detections[i].label) and label and other:
                    return None
        seen = (index >= 0).nonzero()[0]
        pairs = Pairs(seen, index[seen], memory.array("distances")[seen])
        fits = len(tracks.ids) + len(detections) <= self.max_obstacles
        known = tracks.ids != UNCONFIRMED
        fits &= not ((index < 0) & known).any() or not ((index >= 0) & ~known).any()  # no track has a successor
        if fits and not self.rotations and not flags & ALL_SEEN:
            return _Step(stamp, detections, self._renewed(tracks, memory, stamp, detections, rows), pairs.distances)
        return Belief(memory.array("mean"), memory.array("covariance"), np.ones((memory.n, 1))), pairs

    def _renewed(
        self, tracks: Tracks, memory: TrackMemory, stamp: float, detections: tuple[Detection, ...], rows: bytes
    ) -> Tracks:
        """Return the tracks after an update in which some tracks were not seen, began or ended; by compiled code.

        The number of tracks and detections together must be at most ``max_obstacles``.
        """
        index = memory.array("detected").tolist()
        seen = [old if i < 0 else detections[i] for i, old in zip(index, tracks.detections, strict=True)]
        changed = bytes([a.solid.kind != b.solid.kind for a, b in zip(seen, tracks.detections, strict=True)])
        labels = [d.label or old for d, old in zip(seen, tracks.labels, strict=True)]
        variances, numbers = np.array(self.filter.variances).tobytes(), (*self.confirm, tracks.next_id)
        after = renewed(memory, stamp, rows, changed, variances, *numbers, max_unseen=self.max_unseen)
        return tracks.renewed(after, stamp, (*seen, *detections), (*labels, *[d.label for d in detections]))

    def _measurements(self, detections: tuple[Detection, ...], table: Array) -> Measurements:
        """Return the detections, whose rows are ``table`` (k, 15), as measurements."""
        positions, noise = table[:, :3], table[:, 3:12].reshape(-1, 3, 3)
        if self.motion != "ekf" or all(d.camera_to_base is None for d in detections):
            return Measurements(positions, noise)
        unknown = np.full((3, 3), np.nan)
        cameras = [d.camera_to_base for d in detections]
        rotations = np.array([unknown if c is None else c.rotation.T for c in cameras])
        origins = np.array([np.zeros(3) if c is None else c.position for c in cameras])
        return Measurements(positions, noise, rotations, origins)

    def _corrected(self, belief: Belief, pairs: Pairs, measured: Measurements) -> Belief:
        """Return the beliefs after the assigned measurements."""
        rows = pairs.tracks
        if not len(rows):
            return belief
        every = len(rows) == len(belief.mean)  # then the rows are in order
        before = belief if every else belief.rows(rows)
        after = self.filter.update(before, measured.rows(pairs.detections), pairs.innovation)
        self._cap(after.mean)
        return after if every else belief.replaced(rows, after)

    def _seen(self, tracks: Tracks, pairs: Pairs, detections: tuple[Detection, ...], sizes: Array) -> Tracks:
        """Return the tracks with what else the assigned detections say; their ``sizes`` are (m, 3) [m]."""
        hits, ages = tracks.hits << 1 & (1 << self.confirm[1]) - 1, tracks.ages + 1
        rows, columns = pairs.tracks, pairs.detections
        if not len(rows):
            return tracks.changed(hits=hits, ages=ages)
        hits[rows] |= 1
        last_seen, counts = tracks.last_seen.copy(), tracks.counts.copy()
        last_seen[rows] = tracks.stamp
        seen, labels = list(tracks.detections), list(tracks.labels)
        rates = self._turned(tracks, tracks.stamp, rows, [detections[i] for i in columns.tolist()])
        for row, index in zip(rows.tolist(), columns.tolist(), strict=True):
            detection = detections[index]
            if detection.solid.kind != seen[row].solid.kind:
                counts[row] = 0
            seen[row] = detection
            labels[row] = detection.label or labels[row]
        counts[rows] += 1
        return tracks.changed(
            hits=hits,
            ages=ages,
            last_seen=last_seen,
            sizes=smoothed_sizes(tracks.sizes, rows, sizes[columns], counts),
            counts=counts,
            rates=rates,
            detections=tuple(seen),
            labels=tuple(labels),
        )

    def _turned(self, tracks: Tracks, stamp: float, rows: Indices, detections: Sequence[Detection]) -> Rates:
        """Return the angular velocities after detections at ``stamp`` of the tracks with the indices ``rows``."""
        if not self.rotations:
            return tracks.rates
        before, now = [tracks.detections[i].solid for i in rows.tolist()], [d.solid for d in detections]
        kinds = [b.kind if a.kind == b.kind else "sphere" for a, b in zip(before, now, strict=True)]
        turns = turned(kinds, np.array([a.quaternion for a in before]), np.array([b.quaternion for b in now]))
        return tracks.rates.seen(rows, turns, stamp - tracks.last_seen[rows])

    def _cap(self, mean: Array) -> None:
        """Scale down speeds above ``max_speed`` in the states (..., m)."""
        velocity = mean[..., 3:6]
        squared = np.add.reduce(velocity * velocity, axis=-1)
        if squared.max() > self.max_speed**2:
            velocity *= (self.max_speed / np.sqrt(np.maximum(squared, self.max_speed**2)))[..., None]

    def _pruned(self, tracks: Tracks) -> Tracks:
        """Return the tracks without those that have ended."""
        needed, window = self.confirm
        if tracks.all_confirmed and len(tracks) and tracks.stamp - tracks.last_seen.min() <= self.max_unseen:
            return tracks
        alive = tracks.stamp - tracks.last_seen <= self.max_unseen + 1e-9
        missed = np.bitwise_count(tracks.hits) < needed
        alive &= (tracks.ids != UNCONFIRMED) | (tracks.ages < window) | ~missed
        return tracks if alive.all() else tracks.rows(alive.nonzero()[0])

    def _fitted(self, tracks: Tracks) -> Tracks:
        """Return at most ``max_obstacles`` tracks; those that were not seen for longest are left out."""
        surplus = len(tracks) - self.max_obstacles
        if surplus <= 0:
            return tracks
        self.ignored["removed"] += surplus
        order = np.lexsort([tracks.ids != UNCONFIRMED, tracks.last_seen])  # of those equally old, unconfirmed first
        return tracks.rows(np.sort(order[surplus:]))

    def _confirmed(self, tracks: Tracks) -> Tracks:
        """Return the tracks with numbers for those that have been detected often enough."""
        if tracks.all_confirmed:
            return tracks
        new = (tracks.ids == UNCONFIRMED) & (np.bitwise_count(tracks.hits) >= self.confirm[0])
        if not new.any():
            return tracks
        pairs = successors(tracks, new, self.gate, self.filter.initial_speed)
        if len(pairs.tracks):
            tracks = tracks.continued(pairs.tracks, pairs.detections)
            new = np.delete(new, pairs.detections)
        ids = tracks.ids.copy()
        count = int(new.sum())
        ids[new] = tracks.next_id + np.arange(count)
        return tracks.changed(ids=ids, next_id=tracks.next_id + count)


def _checked_confirm(confirm: object) -> tuple[int, int]:
    if not isinstance(confirm, tuple | list) or len(confirm) != 2:
        raise InputError(f"ObstacleTracker: confirm must be two numbers (hits, updates), got {confirm!r}")
    updates = whole_number(confirm[1], "ObstacleTracker: updates of confirm", at_least=1, at_most=32)
    return whole_number(confirm[0], "ObstacleTracker: hits of confirm", at_least=1, at_most=updates), updates
