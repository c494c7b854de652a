"""Recorded motions of a person's arm and of a trolley, as moving obstacles whose true positions are known."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.formats import MotionCapture
from imitarm.errors import FileFormatError
from imitarm.kinematics.pose import Pose
from imitarm.scene import Capsule, Cylinder, MovingScene, Scene
from imitarm.scene.motion import Motion
from imitarm.scene.obstacle import rotation_from_z

Array = NDArray[np.float64]

PERIOD = 0.01  # [s] of the resampled motions
_SMOOTHING = {"arm": 0.13, "trolley": 0.31}  # [s] windows of the local cubic polynomials
_RADII = {"upper arm": 0.05, "forearm": 0.04}  # [m]
TROLLEY_SCALE = 0.5  # of lengths and of times: speeds stay as recorded, and accelerations double


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Obstacles that move as they were recorded.

    Attributes:
        name: name of the recording.
        names: name of each obstacle.
        times: times of the samples, from 0 in steps of :data:`PERIOD`, shape (n,) [s].
        positions: centres of the obstacles, shape (n_obstacles, n, 3) [m].
        velocities: velocities of the obstacles' centres, shape (n_obstacles, n, 3) [m/s].
        scene: scene that contains the moving obstacles.
    """

    name: str
    names: tuple[str, ...]
    times: Array
    positions: Array
    velocities: Array
    scene: MovingScene

    @property
    def duration(self) -> float:
        """Duration of the recording [s]."""
        return float(self.times[-1])

    def at(self, obstacle: int, times: Array) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of one obstacle at ``times`` [s].

        For times of shape (...), both arrays have the shape (..., 3).
        """
        rows = np.stack([self.positions[obstacle], self.velocities[obstacle]])
        found = np.stack([[np.interp(times, self.times, column) for column in row.T] for row in rows])
        return np.moveaxis(found[0], 0, -1), np.moveaxis(found[1], 0, -1)


def recorded_motions(data: Path) -> list[RecordedMotion]:
    """Read the recordings of the arm and of the trolley.

    Args:
        data: folder of real recordings, with the subfolders ``mocap_arm`` and ``mocap_trolley``.

    Raises:
        InputError: when a file is missing or can't be read.
    """
    return [captured_arm(data), captured_trolley(data)]


def captured_arm(data: Path) -> RecordedMotion:
    """Read the recorded motion of a person's arm: two capsules of the true length represent upper arm and forearm."""
    capture = MotionCapture.load(data / "mocap_arm" / "recording.tsv")
    times, joints, velocities = _resampled(capture.times, capture.points[:, :3], _SMOOTHING["arm"])
    middles = np.stack([0.5 * (joints[:, i] + joints[:, i + 1]) for i in range(2)])
    rates = np.stack([0.5 * (velocities[:, i] + velocities[:, i + 1]) for i in range(2)])
    obstacles: list[Capsule] = []
    motions: dict[str | int, Motion] = {}
    for i, (name, radius) in enumerate(_RADII.items()):
        axes = joints[:, i + 1] - joints[:, i]
        half = 0.5 * float(np.median(np.linalg.norm(axes, axis=1))) * np.array([0.0, 0.0, 1.0])
        obstacles.append(Capsule(middles[i, 0] - half, middles[i, 0] + half, radius, name=name))
        motions[name] = _posed(times, middles[i], axes)
    scene = MovingScene(Scene(None, tuple(obstacles)), motions)
    return RecordedMotion("arm of a person", tuple(_RADII), times, middles, rates, scene)


def captured_trolley(data: Path) -> RecordedMotion:
    """Read the recorded motion of a trolley: an upright cylinder. Its lengths and times are halved."""
    path = data / "mocap_trolley" / "mid.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[1:]
        stamps = np.array([datetime.strptime(row[0], "%Y-%m-%d %H:%M:%S.%f").timestamp() for row in rows])
        points = np.array([[float(value) for value in row[1:4]] for row in rows])
    except (OSError, ValueError, IndexError) as error:
        raise FileFormatError(f"{path}: can't be read as the recording of the trolley ({error})") from error
    later = np.r_[True, np.diff(np.maximum.accumulate(stamps)) > 0.0]  # some rows were written out of order
    later[1:] &= (np.diff(points, axis=0) != 0.0).any(axis=1)  # a repeated row: the trolley was lost
    times, positions, velocities = _resampled(stamps[later], points[later, None], _SMOOTHING["trolley"])
    positions = TROLLEY_SCALE * (positions - positions.mean(axis=0))
    times = TROLLEY_SCALE * times
    even = np.arange(0.0, times[-1], PERIOD)
    where, rate = (np.stack([np.interp(even, times, c) for c in x[:, 0].T], axis=1) for x in (positions, velocities))
    start = Pose(where[0], np.array([1.0, 0.0, 0.0, 0.0]))
    obstacle = Cylinder(start, 0.15, 0.3, name="trolley")
    scene = MovingScene(Scene(None, (obstacle,)), {"trolley": _interpolated(even, where)})
    return RecordedMotion("trolley", ("trolley",), even, where[None], rate[None], scene)


def _resampled(stamps: Array, points: Array, window: float) -> tuple[Array, Array, Array]:
    """Return times from 0 (n,), points (n, k, 3) and velocities, smoothed by local cubic polynomials."""
    from scipy.signal import savgol_filter  # noqa: PLC0415  slow to import

    times = np.arange(0.0, stamps[-1] - stamps[0], PERIOD)
    flat = points.reshape(len(points), -1)
    even = np.stack([np.interp(times, stamps - stamps[0], column) for column in flat.T], axis=1)
    length = round(window / PERIOD) | 1
    shape = (len(times), *points.shape[1:])
    smooth = savgol_filter(even, length, 3, axis=0).reshape(shape)
    rates = savgol_filter(even, length, 3, deriv=1, delta=PERIOD, axis=0).reshape(shape)
    return times, smooth, rates


def _interpolated(times: Array, positions: Array) -> Callable[[float], Array]:
    """Return the position (3,) as a function of time."""
    return lambda time: np.array([np.interp(time, times, column) for column in positions.T])


def _posed(times: Array, positions: Array, axes: Array) -> Callable[[float], Pose]:
    """Return the pose of a capsule as a function of time; its axis follows ``axes`` (n, 3)."""
    where, axis = _interpolated(times, positions), _interpolated(times, axes)
    return lambda time: Pose(where(time), rotation_from_z(axis(time)))
