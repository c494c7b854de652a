"""Obstacles of family M10: two capsules that move like the recorded arm of a real person."""

from __future__ import annotations

import math
import os
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from imitarm.benchmark.moving_motions import BEFORE
from imitarm.benchmark.real_motions import real_motions
from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_exp, rotate
from imitarm.perception.person_motion import moving_capsule
from imitarm.scene import Capsule
from imitarm.scene.motion import Track

Array = NDArray[np.float64]

DATA = "IMITARM_DATA"
"""Name of the environment variable that contains the path of the folder with real recordings."""
_UPPER, _FORE = 0.050, 0.042  # [m] radii of the two capsules
_STEP = 0.01  # [s]
_SMOOTH = 0.06  # [s] standard deviation of the filter that removes the noise of the recordings
_LEAST_SPEED = 0.1  # [m/s] of the point of the arm that meets the tool
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # camera frame, y up, to z up


class _Recorded(NamedTuple):
    """Shoulder, elbow and hand over time, shape (n, 3, 3) [m], every 10 ms, z up."""

    points: Array


@lru_cache(maxsize=2)
def _recordings(folder: str) -> tuple[_Recorded, ...]:
    found = []
    for motion in real_motions(Path(folder)):
        arms = [arm for skeleton in motion.skeletons if (arm := skeleton.arm(motion.side)).seen]
        arms = [arm for arm in arms if np.isfinite(arm.points[3]).all()]
        times = np.array([arm.time for arm in arms])
        times, first = np.unique(times - times[0], return_index=True)
        points = np.array([arm.points[[0, 1, 3]] for arm in arms])[first] @ _UP.T
        even = np.arange(0.0, times[-1], _STEP)
        flat = points.reshape(len(points), 9)
        made = np.stack([np.interp(even, times, column) for column in flat.T], axis=1)
        found.append(_Recorded(gaussian_filter1d(made, _SMOOTH / _STEP, axis=0).reshape(-1, 3, 3)))
    return tuple(found)


def has_recordings() -> bool:
    """Return whether the folder of real recordings exists and contains the motion capture."""
    return (Path(os.environ.get(DATA, "")) / "mocap_arm" / "recording.tsv").is_file()


def person_arm(
    rng: np.random.Generator, time: float, meeting: Array, until: float
) -> tuple[tuple[Capsule, Capsule], tuple[Track, Track]]:
    """Return the upper arm and the forearm of a person as two capsules, and their recorded motions.

    Sizes and speeds are those of the recording. The function randomly chooses a recording, an instant of the recording,
    a point of the forearm, and a rotation about the vertical axis. It rotates and shifts the recording so that, at this
    instant, the chosen point is at the meeting point.

    Args:
        rng: source of the random numbers.
        time: time at which the chosen point of the forearm is at the meeting point [s].
        meeting: the meeting point on the learned path, shape (3,) [m].
        until: time after which the returned motions end [s].

    Raises:
        InputError: when the recordings are missing.
    """
    if not has_recordings():
        raise InputError(
            f"M10 needs the recordings of real persons: set {DATA} to the folder with mocap_arm and kinect_gestures, "
            "or leave M10 out with --families"
        )
    recorded = _recordings(os.environ[DATA])
    points = recorded[int(rng.integers(len(recorded)))].points
    share = float(rng.uniform(0.3, 1.0))
    meets = points[:, 1] + share * (points[:, 2] - points[:, 1])
    speed = np.linalg.norm(np.gradient(meets, _STEP, axis=0), axis=1)
    moving = np.flatnonzero(speed >= min(_LEAST_SPEED, 0.9 * float(speed.max())))
    at = int(moving[rng.integers(len(moving))])
    turn = quaternion_exp(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))
    placed = rotate(np.broadcast_to(turn, (len(points), 3, 4)), points - meets[at]) + meeting
    times: Array = _STEP * (np.arange(len(points), dtype=float) - at) + time
    keep = (times >= -BEFORE) & (times <= until)
    parts = []
    for name, first, radius in (("upper arm", 0, _UPPER), ("forearm", 1, _FORE)):
        parts.append(moving_capsule(placed[keep, first], placed[keep, first + 1], radius, name, times[keep]))
    (upper, upper_track), (fore, fore_track) = parts
    return (upper, fore), (upper_track, fore_track)
