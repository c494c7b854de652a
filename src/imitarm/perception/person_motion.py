"""moving_arms: the arms of a person as capsules that move through a simulated world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.perception.person_capsules import PersonCapsules
from imitarm.scene import Capsule, MovingScene, Scene, Track
from imitarm.scene.obstacle import rotation_from_z
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_FEWEST = 2  # detections of a capsule
_STEP = 0.01  # [s] between two samples of a smoothed motion


def moving_arms(skeletons: Sequence[Skeleton], capsules: PersonCapsules, *, smoothing: float = 0.0) -> MovingScene:
    """Return the capsules of a person's arms, and their motions over time.

    Every capsule keeps its size, because bones do not change their length. Its length is the mean, and its radius the
    median over all skeletons. The motion of a capsule is the motion of its middle and of its axis. While a capsule
    is lost, its motion is interpolated. Before the first and after the last skeleton, the arms rest.

    Args:
        skeletons: skeletons of one person, with increasing times.
        capsules: object that converts each skeleton to capsules.
        smoothing: standard deviation of a Gaussian filter over time [s], which removes the noise of a recording; 0: no
            filter.

    Returns:
        The scene at the time of the first skeleton, with one capsule for each upper arm and each forearm.

    Raises:
        InputError: when fewer than two skeletons show an arm.
    """
    finite_number(smoothing, "moving_arms: smoothing", "s", at_least=0.0)
    seen: dict[str, list[tuple[float, Capsule]]] = {}
    for skeleton in skeletons:
        for detection in capsules.detections(skeleton):
            assert isinstance(detection.obstacle, Capsule)
            seen.setdefault(detection.label, []).append((skeleton.time, detection.obstacle))
    seen = {label: found for label, found in seen.items() if len(found) >= _FEWEST}
    if not seen:
        raise InputError(
            f"moving_arms: fewer than {_FEWEST} of {len(skeletons)} skeletons show an arm; choose another recording"
        )
    moving: dict[str, tuple[Capsule, Track]] = {}
    for label, found in seen.items():
        times = np.array([time for time, _ in found])
        starts, ends = (np.array([getattr(one, end) for _, one in found]) for end in ("start", "end"))
        radius = float(np.median([one.radius for _, one in found]))
        if smoothing > 0.0:
            times, starts, ends = _smoothed(times, starts, ends, smoothing)
        moving[label] = moving_capsule(starts, ends, radius, label, times)
    first = min(times[0][0] for times in seen.values())
    scene = Scene(None, tuple(capsule for capsule, _ in moving.values()), stamp=first)
    return MovingScene(scene, {label: track for label, (_, track) in moving.items()})


def moving_capsule(starts: Array, ends: Array, radius: float, name: str, times: Array) -> tuple[Capsule, Track]:
    """Return a capsule of constant length, and the motion of its middle and of its axis.

    Args:
        starts: positions of one end of the axis, shape (n, 3) [m].
        ends: positions of the other end, shape (n, 3) [m].
        radius: radius of the capsule [m].
        name: name of the capsule.
        times: times of the positions, shape (n,) [s].
    """
    axis = ends - starts
    length = np.linalg.norm(axis, axis=1)
    middle, unit = 0.5 * (starts + ends), axis / length[:, None]
    half = 0.5 * float(length.mean()) * unit[0]
    capsule = Capsule(middle[0] - half, middle[0] + half, radius, name=name)
    return capsule, Track(times, middle, _rotations(unit))


def _smoothed(times: Array, starts: Array, ends: Array, smoothing: float) -> tuple[Array, Array, Array]:
    """Return samples every 10 ms of a motion after a Gaussian filter over time."""
    even = np.arange(times[0], times[-1] + 0.5 * _STEP, _STEP)
    flat = np.concatenate([starts, ends], axis=1)
    made = np.stack([np.interp(even, times, column) for column in flat.T], axis=1)
    made = gaussian_filter1d(made, smoothing / _STEP, axis=0, mode="nearest")
    return even, made[:, :3], made[:, 3:]


def _rotations(units: Array) -> Array:
    """Return rotations that take z to each direction, each the smallest rotation from the one before, shape (n, 4)."""
    found = [rotation_from_z(units[0])]
    for before, now in pairwise(units):
        across = np.cross(before, now)
        sine = float(np.linalg.norm(across))
        angle = math.atan2(sine, float(before @ now))
        step = quaternion_exp(angle * across / sine) if sine > 1e-12 else np.array([1.0, 0.0, 0.0, 0.0])
        turned = quaternion_multiply(step, found[-1])
        found.append(turned / np.linalg.norm(turned))
    return np.array(found)
