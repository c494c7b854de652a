"""``imitarm benchmark tracking``: track recorded motions, with simulated noise, latency and dropouts of the sensor."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.tables import Table
from imitarm.benchmark.tracked_motions import RecordedMotion
from imitarm.control_loop.observer import Frame, SensorModel
from imitarm.evaluation.intervals import block_bootstrap
from imitarm.perception import Detection, ObstacleTracker
from imitarm.perception.consistency import chi_square_moments
from imitarm.perception.motion_filter import MOTIONS

Array = NDArray[np.float64]

SENSOR = SensorModel(noise=0.005, rate=30.0, latency=0.033, dropout=0.2)
Noise = float | tuple[float, ...]
NOISE_GRID: dict[str, tuple[Noise, ...]] = {  # tried for each model of motion; [m^2/s^3], [m^2/s^5]
    "constant-velocity": (0.002, 0.005, 0.01, 0.012, 0.015, 0.02, 0.03, 0.05),
    "constant-acceleration": (0.03, 0.1, 0.2, 0.3, 0.5, 1.0),
    "imm": ((0.002, 0.3), (0.002, 1.0), (0.005, 0.3), (0.005, 1.0), (0.01, 0.3), (0.01, 1.0)),
}
BLOCK = 2.0  # [s] length of the blocks of the bootstrap
_SETTLED = 1.0  # [s] after the first frame, from which errors count
_NEAR = 0.2  # [m] a track farther from an obstacle is not its track
CAMERA = 1.5  # [m] distance of the camera from the middle of the motion


@dataclass(frozen=True, eq=False)
class TrackLog:
    """The true and the estimated motion of one obstacle, frame by frame.

    Estimates are nan when the obstacle has no track.

    Attributes:
        times: time at which each frame arrived, shape (n,) [s].
        truth: true positions at these times, shape (n, 3) [m].
        velocity: true velocities at these times, shape (n, 3) [m/s].
        raw: last detected position of the obstacle at each frame, shape (n, 3) [m].
        filtered: positions that the tracker estimates for the time stamp of each frame, shape (n, 3) [m].
        predicted: positions that the tracker predicts for the time at which each frame arrived, shape (n, 3) [m].
        estimated_velocity: velocities that the tracker predicts for this time, shape (n, 3) [m/s].
        nees: normalised estimation error squared at the time stamp of each frame, shape (n,).
        ids: number of the obstacle's track at each frame, shape (n,); -1 if the obstacle has no track.
    """

    times: Array
    truth: Array
    velocity: Array
    raw: Array
    filtered: Array
    predicted: Array
    estimated_velocity: Array
    nees: Array
    ids: NDArray[np.int64]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Whether each frame counts, shape (n,). A frame counts after the first second, if the obstacle has a track."""
        return (self.ids >= 0) & (self.times >= self.times[0] + _SETTLED)

    def lag(self, estimate: Array) -> float:
        """Return the mean delay of an estimate, shape (n, 3) [m], behind the true position [s]."""
        used = self.settled & np.isfinite(estimate).all(axis=1)
        error, v = (estimate - self.truth)[used], self.velocity[used]
        return float(-(error * v).sum() / (v * v).sum())


@dataclass(frozen=True, eq=False)
class Tracking:
    """How one tracker followed a recorded motion.

    Attributes:
        logs: one log for each obstacle.
        nis: mean normalised innovation squared of each of the m frames in which a detection was assigned to a track,
            shape (m,).
        times: time at which each of these m frames arrived, shape (m,) [s].
        gate: largest normalised innovation squared with which the tracker assigns a detection to a track.
        seconds: processor time of each update, shape (n,) [s].
    """

    logs: tuple[TrackLog, ...]
    nis: Array
    times: Array
    gate: float
    seconds: Array

    @property
    def expected_nis(self) -> float:
        """Mean normalised innovation squared of a correct filter.

        The gate removes large innovations, so the mean is below 3.
        """
        return chi_square_moments(3, self.gate)[0]

    @property
    def nees(self) -> Array:
        """Normalised estimation error squared of all obstacles, in the frames that count (:attr:`TrackLog.settled`)."""
        return np.concatenate([log.nees[log.settled] for log in self.logs])


def with_camera(detections: Iterable[Detection], motion: RecordedMotion) -> list[Detection]:
    """Return the detections with the pose of a simulated camera, which looks at the middle of the motion."""
    from imitarm.kinematics.pose import Pose  # noqa: PLC0415

    middle = motion.positions.reshape(-1, 3).mean(axis=0)
    looking_along_x = np.array([0.5, -0.5, 0.5, -0.5])  # x of the camera is -y, y is -z, z is x
    reach = float(np.ptp(motion.positions.reshape(-1, 3)[:, 0])) / 2.0
    pose = Pose(middle - [CAMERA + reach, 0.0, 0.0], looking_along_x)
    return [Detection(d.obstacle, d.covariance, d.label, pose) for d in detections]


@lru_cache(maxsize=8)
def _frames(motion: RecordedMotion, sensor: SensorModel, begin: float, end: float) -> tuple[Frame, ...]:
    """Return the frames of a part of a recording, from ``begin`` to ``end`` [s]."""
    return tuple(sensor.frame(motion.scene, k) for k in range(int(begin * sensor.rate) + 1, int(end * sensor.rate)))


def follow(
    motion: RecordedMotion,
    tracker: ObstacleTracker,
    sensor: SensorModel = SENSOR,
    part: tuple[float, float] = (0.0, 1.0),
) -> Tracking:
    """Track a recorded motion.

    Args:
        motion: the motion.
        tracker: a new tracker.
        sensor: the sensor.
        part: start and end of the part of the recording that is used, as fractions of its duration.
    """
    frames = _frames(motion, sensor, *(fraction * (motion.duration - sensor.latency) for fraction in part))
    n, n_obstacles = len(frames), len(motion.names)
    rows = {key: np.full((n_obstacles, n, 3), np.nan) for key in ("raw", "filtered", "predicted", "velocity")}
    nees, ids = np.full((n_obstacles, n), np.nan), np.full((n_obstacles, n), -1, dtype=np.int64)
    nis, nis_times, seconds = [], [], []
    stamps = np.array([frame.stamp for frame in frames])
    now = stamps + sensor.latency
    then, rates = (np.stack(x) for x in zip(*(motion.at(i, stamps) for i in range(n_obstacles)), strict=True))
    truth, velocity = (np.stack(x) for x in zip(*(motion.at(i, now) for i in range(n_obstacles)), strict=True))
    for k, frame in enumerate(frames):
        found = with_camera(frame.detections, motion) if tracker.motion == "ekf" else frame.detections
        began = time.process_time()
        tracks = tracker.update(frame.stamp, found)
        seconds.append(time.process_time() - began)
        distances = tracker.innovations
        if len(distances):
            nis.append(distances.mean())
            nis_times.append(now[k])
        for i in range(n_obstacles):
            rows["raw"][i, k] = _nearest([d.position for d in frame.detections], then[i, k], rows["raw"][i, k - 1])
            if not tracks:
                continue
            track = min(tracks, key=lambda t: float(np.linalg.norm(t.position - then[i, k])))
            if np.linalg.norm(track.position - then[i, k]) > _NEAR:
                continue
            ahead = track.predict(sensor.latency)
            rows["filtered"][i, k], ids[i, k] = track.position, track.track_id
            rows["predicted"][i, k], rows["velocity"][i, k] = ahead.position, ahead.velocity
            error = np.concatenate([track.position - then[i, k], track.velocity - rates[i, k]])
            nees[i, k] = error @ np.linalg.solve(track.covariance, error)
    logs = tuple(
        TrackLog(
            now,
            truth[i],
            velocity[i],
            raw=rows["raw"][i],
            filtered=rows["filtered"][i],
            predicted=rows["predicted"][i],
            estimated_velocity=rows["velocity"][i],
            nees=nees[i],
            ids=ids[i],
        )
        for i in range(n_obstacles)
    )
    return Tracking(logs, np.array(nis), np.array(nis_times), tracker.gate, np.array(seconds))


def _nearest(positions: Sequence[Array], truth: Array, last: Array) -> Array:
    """Return the detection of an obstacle, or the last one if the obstacle was not detected."""
    near = [p for p in positions if np.linalg.norm(p - truth) < 0.05]
    return min(near, key=lambda p: float(np.linalg.norm(p - truth))) if near else last


def chosen_noise(motion: RecordedMotion, model: str, sensor: SensorModel = SENSOR) -> Noise:
    """Return the process noise from a grid with which the filter is most consistent.

    The tracker follows the first half of the recording. The mean NIS and the mean NEES are each divided by the value of
    a correct filter. The process noise minimises the sum of the squared logarithms of these two quotients.
    """

    def distance(noise: Noise) -> float:
        found = follow(motion, ObstacleTracker(model, process_noise=noise), sensor, (0.0, 0.5))
        nis, nees = (float(np.mean(values)) for values in (found.nis, found.nees))
        return math.log(nis / found.expected_nis) ** 2 + math.log(nees / 6.0) ** 2

    return min(NOISE_GRID["constant-velocity" if model == "ekf" else model], key=distance)


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors * errors).sum(axis=-1).mean()))


def accuracy_rows(motion: RecordedMotion, found: dict[str, Tracking]) -> list[tuple[str, ...]]:
    """Return the rows of the table of errors.

    Each obstacle has a row for the detections and a row for each model of motion.
    """
    rows: list[tuple[str, ...]] = []
    for i, name in enumerate(motion.names):
        first = next(iter(found.values())).logs[i]
        rows.append((name, "last detection", *_cells(first, first.raw), "–", "–"))
        for model, tracking in found.items():
            log = tracking.logs[i]
            used = log.settled
            speed = _rms((log.estimated_velocity - log.velocity)[used])
            switches = int((np.diff(log.ids[log.ids >= 0]) != 0).sum())
            if model == "constant-velocity":
                rows.append((name, f"{model}, not predicted", *_cells(log, log.filtered), f"{speed:.3f}", "–"))
            rows.append((name, model, *_cells(log, log.predicted), f"{speed:.3f}", str(switches)))
    return rows


def _cells(log: TrackLog, estimate: Array) -> tuple[str, str, str]:
    used = log.settled & np.isfinite(estimate).all(axis=1)
    errors = np.linalg.norm((estimate - log.truth)[used], axis=1)
    high = float(np.quantile(errors, 0.95))
    return f"{1e3 * _rms(errors[:, None]):.1f}", f"{1e3 * high:.1f}", f"{1e3 * log.lag(estimate):.0f}"


def consistency_rows(
    motion: RecordedMotion, found: dict[str, Tracking], noises: dict[str, Noise]
) -> list[tuple[str, ...]]:
    """Return the rows of the table of consistency, with the means of NIS and NEES and their intervals."""
    rows: list[tuple[str, ...]] = []
    for model, tracking in found.items():
        times = np.concatenate([log.times[log.settled] for log in tracking.logs])
        rate = str(noises[model]) if isinstance(noises[model], tuple) else f"{noises[model]:g}"
        cells = [*_mean_cells(tracking.nis, tracking.times, tracking.expected_nis)]
        cells += _mean_cells(tracking.nees, times, 6.0)
        rows.append((motion.name, model, rate, *cells, f"{1e6 * float(np.median(tracking.seconds)):.0f}"))
    return rows


def _mean_cells(values: Array, times: Array, expected: float) -> tuple[str, str]:
    """Return a mean with its interval, and whether the expected value lies in it."""
    mean = float(values.mean())
    low, high = block_bootstrap(values, times, BLOCK)
    verdict = "consistent" if low <= expected <= high else "too cautious" if high < expected else "too confident"
    return f"{mean:.2f} ({low:.2f} to {high:.2f})", verdict


def tracking_tables(motions: Sequence[RecordedMotion], sensor: SensorModel = SENSOR) -> list[Table]:
    """Return a table of errors and a table of consistency, both measured in the second half of each recording."""
    accuracy: list[tuple[str, ...]] = []
    consistency: list[tuple[str, ...]] = []
    for motion in motions:
        noises = {model: chosen_noise(motion, model, sensor) for model in MOTIONS}
        found = {
            model: follow(motion, ObstacleTracker(model, process_noise=noises[model]), sensor, (0.5, 1.0))
            for model in MOTIONS
        }
        accuracy += accuracy_rows(motion, found)
        consistency += consistency_rows(motion, found, noises)
    said = (
        f"Simulated sensor: noise {1e3 * sensor.noise:g} mm, {sensor.rate:g} Hz, latency {1e3 * sensor.latency:g} ms, "
        f"dropout {100 * sensor.dropout:g} %. Errors: difference between the estimate and the true motion at the time "
        "at which a frame arrives."
    )
    return [
        Table(
            "Errors on real motion",
            (
                "obstacle",
                "estimate",
                "position, RMS [mm]>",
                "95th percentile [mm]>",
                "lag [ms]>",
                "velocity, RMS [m/s]>",
                "new track numbers of the tracked obstacle>",
            ),
            tuple(accuracy),
            said,
        ),
        Table(
            "Consistency on real motion",
            (
                "recording",
                "model of motion",
                "process noise",
                "NIS, mean>",
                "",
                "NEES, mean>",
                " ",
                "processor time of an update [µs]>",
            ),
            tuple(consistency),
            "The process noise was chosen in the first half of each recording, so that NIS and NEES are nearest to "
            "those of a correct filter. A correct filter has a NEES of 6 and an NIS of 2.89. The NIS is below 3 "
            "because the gate removes large innovations. In brackets: block-bootstrap interval of the mean (95 %, "
            f"blocks of {BLOCK:g} s).",
        ),
    ]
