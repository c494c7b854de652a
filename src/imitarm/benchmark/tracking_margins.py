"""Measure how often the errors of predicted positions stay within a margin, for synthetic and for recorded motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.tables import Table
from imitarm.benchmark.tracked_motions import RecordedMotion
from imitarm.benchmark.tracking import BLOCK, SENSOR
from imitarm.control_loop.observer import SensorModel
from imitarm.evaluation.intervals import block_bootstrap, wilson_interval
from imitarm.perception import CoverageMargin, ObstacleTracker
from imitarm.scene import MovingScene, Scene, Sphere

Array = NDArray[np.float64]

TIMES = np.linspace(0.0, 0.5, 6)
"""Times after the arrival of a frame for which positions are predicted (look-ahead times) [s]."""
COVERAGE = 0.95
_CALIBRATION, _TEST, _REAL = 0, 1, 2  # streams of random numbers
_TOGETHER = 30  # obstacles that one tracker follows at the same time
_SPACING = 10.0  # [m] between them: none can be mistaken for another
_WATCHED = 1.0  # [s] of frames before a prediction
_STRIDE = 0.1  # [s] between windows of a recorded motion
_JOINT = 5  # obstacles in the row about several obstacles


class Windows(NamedTuple):
    """Errors of predictions.

    Attributes:
        errors: distance between predicted and true position at each of :data:`TIMES`, shape (n, n_times) [m].
        starts: time of each prediction, shape (n,) [s].
    """

    errors: Array
    starts: Array


def random_motion(rng: np.random.Generator) -> Callable[[float], Array]:
    """Return a random motion that begins near the origin: steady, swaying, or stop-and-go, at 0.1 to 0.6 m/s."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    across = np.cross(direction, rng.normal(size=3))
    across /= np.linalg.norm(across)
    speed, kind = rng.uniform(0.1, 0.6), int(rng.integers(3))
    rate, phase = rng.uniform(0.3, 1.0) * 2.0 * np.pi, rng.uniform(0.0, 2.0 * np.pi)
    sway = min(0.5 * speed / rate, 0.15)

    def moved(time: float) -> Array:
        if kind == 0:
            return speed * time * direction
        if kind == 1:
            return np.asarray(speed * time * direction + sway * np.sin(rate * time + phase) * across)
        way = speed * (time - np.sin(rate * time + phase) / rate)  # the speed varies from 0 to twice its mean
        return np.asarray(0.5 * way * direction)

    return moved


def synthetic_windows(n: int, stream: int, sensor: SensorModel = SENSOR, seed: int = 0) -> Array:
    """Return the errors of ``n`` predictions of independent motions, shape (n, n_times) [m].

    The tracker observes each obstacle for 1 s. It then predicts the positions of the obstacle at :data:`TIMES` after
    the last frame.

    Args:
        n: number of windows (a window is a prediction and the true motion after it).
        stream: number of a stream of random numbers; different streams are independent.
        sensor: the simulated sensor. A window in which the obstacle has no track after 1 s is replaced.
        seed: seed of the random numbers.
    """
    found: list[Array] = []
    batch = 0
    while len(found) < n:
        rng = np.random.default_rng([seed, stream, batch])
        batch += 1
        found.extend(_batch(rng, sensor))
    return np.array(found[:n])


def _moved(place: Array, motion: Callable[[float], Array], time: float) -> Array:
    return place + motion(time)


def _batch(rng: np.random.Generator, sensor: SensorModel) -> list[Array]:
    """Return the windows of obstacles that one tracker follows."""
    columns, rows = 6, _TOGETHER // 6
    places = _SPACING * np.array([[i - columns / 2, j - rows / 2, 0.0] for i in range(columns) for j in range(rows)])
    motions = [random_motion(rng) for _ in places]
    truth = MovingScene(
        Scene(None, tuple(Sphere(place, 0.05) for place in places)),
        {i: partial(_moved, place, motion) for i, (place, motion) in enumerate(zip(places, motions, strict=True))},
    )
    sensor = SensorModel(
        sensor.noise, sensor.rate, sensor.latency, sensor.dropout, reach=100.0, seed=int(rng.integers(2**31))
    )
    tracker = ObstacleTracker(max_obstacles=_TOGETHER + 2)
    for frame in sensor.arrived(truth, -1.0, _WATCHED):
        tracks = tracker.update(frame.stamp, frame.detections)
    now = frame.arrival
    predicted = [tracker.scene(now + tau).packed.positions for tau in TIMES]
    true = [truth.poses(now + tau)[0] for tau in TIMES]
    errors = []
    for i in range(len(places)):
        distance = np.linalg.norm(predicted[0] - true[0][i], axis=1)
        track = int(distance.argmin()) if len(tracks) else 0
        if len(tracks) and distance[track] < 0.5 * _SPACING:
            errors.append(np.array([np.linalg.norm(p[track] - t[i]) for p, t in zip(predicted, true, strict=True)]))
    return errors


def recorded_windows(motion: RecordedMotion, part: tuple[float, float], sensor: SensorModel = SENSOR) -> Windows:
    """Return the errors of predictions that begin every 0.1 s of a recorded motion.

    Args:
        motion: the motion.
        part: the used part of the recording: its start and its end, as fractions of the duration of the recording.
        sensor: the sensor.
    """
    begin, end = (fraction * motion.duration for fraction in part)
    tracker, errors, starts = ObstacleTracker(), [], []
    due = begin + _WATCHED
    for k in range(int(begin * sensor.rate) + 1, int((end - TIMES[-1] - sensor.latency) * sensor.rate)):
        frame = sensor.frame(motion.scene, k)
        tracks = tracker.update(frame.stamp, frame.detections)
        if frame.arrival < due or not tracks:
            continue
        due += _STRIDE
        predicted = np.array([tracker.scene(frame.arrival + tau).packed.positions for tau in TIMES])
        worst = np.zeros(len(TIMES))
        for i in range(len(motion.names)):
            true = motion.at(i, frame.arrival + TIMES)[0]
            nearest = int(np.linalg.norm(predicted[0] - true[0], axis=1).argmin())
            worst = np.maximum(worst, np.linalg.norm(predicted[:, nearest] - true, axis=1))
        errors.append(worst)
        starts.append(frame.arrival)
    return Windows(np.array(errors), np.array(starts))


def margin_table(n: int, motions: Sequence[RecordedMotion] = (), sensor: SensorModel = SENSOR, seed: int = 0) -> Table:
    """Return a table of how many windows are within the margin. These windows were not used for the calibration.

    Args:
        n: number of synthetic windows for testing. Another n windows are used for calibration.
        motions: recorded motions.
        sensor: the sensor.
        seed: seed of the random numbers.
    """
    calibration, test = (synthetic_windows(n, stream, sensor, seed) for stream in (_CALIBRATION, _TEST))
    one = CoverageMargin.calibrate(calibration, COVERAGE, times=TIMES)
    several = CoverageMargin.calibrate(calibration, COVERAGE, _JOINT, times=TIMES)
    groups = test[: n // _JOINT * _JOINT].reshape(-1, _JOINT, len(TIMES)).max(axis=1)
    rows = [
        _independent(f"{n} synthetic windows", one, test),
        _independent(f"{len(groups)} groups of {_JOINT} synthetic obstacles", several, groups),
    ]
    for motion in motions:
        before, after = (recorded_windows(motion, part, sensor) for part in ((0.0, 0.5), (0.5, 1.0)))
        own = CoverageMargin.calibrate(before.errors, COVERAGE, times=TIMES)
        for name, margin in (("first half", own), ("synthetic windows", one)):
            covered = margin.covered(after.errors, TIMES).astype(float)
            low, high = block_bootstrap(covered, after.starts, BLOCK)
            rows.append(
                (f"{motion.name}, second half", name, *_line(margin), _percent(covered.mean(), low, min(high, 1.0)))
            )
    return Table(
        "Coverage of margins",
        ("tested on", "calibrated on", "offset [mm]>", "growth [mm/s]>", "windows within the margin [%]>"),
        tuple(rows),
        f"Predictions for 0 to {TIMES[-1]:g} s after the arrival of a frame. A window is within the margin if its "
        f"error is below the margin at all times of the window. Required: {100 * COVERAGE:g} %. In brackets: Wilson "
        f"interval for synthetic windows, block-bootstrap interval (blocks of {BLOCK:g} s) for recorded motion.",
    )


def _independent(name: str, margin: CoverageMargin, errors: Array) -> tuple[str, ...]:
    """Return the row of independent windows."""
    covered = margin.covered(errors, TIMES)
    low, high = wilson_interval(int(covered.sum()), len(covered))
    return name, "other synthetic windows", *_line(margin), _percent(float(covered.mean()), low, high)


def _line(margin: CoverageMargin) -> tuple[str, str]:
    return f"{1e3 * margin.offset:.1f}", f"{1e3 * margin.growth:.0f}"


def _percent(mean: float, low: float, high: float) -> str:
    return f"{100 * mean:.1f} ({100 * low:.1f} to {100 * high:.1f})"
