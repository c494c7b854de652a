"""Quality of a skeleton camera, estimated from its skeletons: noise, bone lengths, frame intervals, agreement of views.

When run as a program, this module measures how well MediaPipe tracks a person in videos, and how well several views of
one motion agree::

    python -m imitarm.capture.sensor_quality .cache/pose2sim/*.mp4
"""

from __future__ import annotations

import math
import sys
import time as clock
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from imitarm.capture.filters import SideFilter
from imitarm.capture.mediapipe import MediaPipeSource
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, Tracking
from imitarm.errors import ImitarmError, InputError

Array = NDArray[np.float64]

BONES = {"upper arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "hand": ("wrist", "hand")}
SLOW, QUICK = 0.1, 0.4  # [m/s] a slower joint is at rest, a faster one in motion
LATE = 1.4  # an interval longer than this many median ones lacks a frame
_ORDER = 5  # of the difference: a hand that waves at 2 Hz leaves 0.2 mm of it
_LEAST_FRAMES = 20
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class SensorNoise:
    r"""Noise of a skeleton camera, estimated from its skeletons alone.

    White noise is estimated from fifth-order differences of the positions in successive frames. A person's motion
    nearly vanishes in these differences. Noise of standard deviation :math:`\sigma` gives differences of standard
    deviation :math:`\sqrt{252}\,\sigma`. The estimate uses the median of the absolute differences, so that single jumps
    have little effect. Slow errors are not part of the white noise, but they change the bone lengths.

    Attributes:
        n_frames: number of skeletons.
        median_interval: median time between frames [s].
        jitter: standard deviation of the time between frames, excluding late frames [s].
        late: fraction of the intervals that are longer than 1.4 times the median interval.
        longest_interval: longest time between two frames [s].
        at_rest: white noise of each joint while it moves slower than 0.1 m/s, as the root mean square over the three
            axes, shape (25,) [m]; nan if there are too few frames in which the joint moves so slowly.
        in_motion: white noise of each joint while it moves faster than 0.4 m/s, shape (25,) [m].
        bones: mean and standard deviation of the length of each bone of both arms, by name (``"left forearm"``) [m].
        inferred: fraction of the frames in which each joint is inferred or lost, shape (25,).
    """

    n_frames: int
    median_interval: float
    jitter: float
    late: float
    longest_interval: float
    at_rest: Array
    in_motion: Array
    bones: dict[str, tuple[float, float]]
    inferred: Array

    def __str__(self) -> str:
        lines = [
            f"{self.n_frames} frames, every {1e3 * self.median_interval:.1f} ms, jitter {1e3 * self.jitter:.2f} ms, "
            f"{100.0 * self.late:.1f} % late, longest {1e3 * self.longest_interval:.0f} ms",
            f"{'joint':<15} {'white noise at rest':>20} {'in motion [mm]':>15} {'not tracked':>12}",
        ]
        for joint, rest, motion, inferred in zip(JOINTS, self.at_rest, self.in_motion, self.inferred, strict=True):
            lines.append(f"{joint:<15} {_mm(rest):>20} {_mm(motion):>15} {100.0 * inferred:>10.1f} %")
        lines.append(f"{'bone':<15} {'length [mm]':>20} {'std [mm]':>15}")
        lines += [f"{name:<15} {_mm(mean):>20} {_mm(std):>15}" for name, (mean, std) in self.bones.items()]
        return "\n".join(lines)


def _mm(value: float) -> str:
    return "-" if math.isnan(value) else f"{1e3 * value:.2f}"


def measure_noise(skeletons: Iterable[Skeleton]) -> SensorNoise:
    """Estimate the noise of a skeleton camera.

    Args:
        skeletons: skeletons of one person, in the order of their times; at least 20, some of them at rest.

    Raises:
        InputError: when there are too few skeletons, or their times don't increase.
    """
    seen = list(skeletons)
    if len(seen) < _LEAST_FRAMES:
        raise InputError(f"noise: {len(seen)} frames are too few to measure noise; record at least {_LEAST_FRAMES}")
    times = np.array([skeleton.time for skeleton in seen])
    points = np.array([skeleton.positions for skeleton in seen])
    tracking = np.array([skeleton.tracking for skeleton in seen])
    gaps = np.diff(times)
    if gaps.min() <= 0.0:
        raise InputError(f"noise: time does not increase at frame {int(np.argmin(gaps)) + 1}; sort the frames by time")
    median = float(np.median(gaps))
    usual = gaps < LATE * median
    rest, motion = _white(times, np.where((tracking == Tracking.TRACKED)[..., None], points, np.nan), usual)
    return SensorNoise(
        len(seen),
        median,
        float(gaps[usual].std()),
        float(np.mean(~usual)),
        float(gaps.max()),
        rest,
        motion,
        {f"{side} {bone}": _bone(points, *ends, side) for side in SIDES for bone, ends in BONES.items()},
        np.mean(tracking != Tracking.TRACKED, axis=0),
    )


def _white(times: Array, points: Array, usual: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return white noise at rest and in motion, each of shape (25,) [m]."""
    n = len(times) - _ORDER
    even = np.array([usual[i : i + _ORDER].all() for i in range(n)])
    weight = math.sqrt(sum(math.comb(_ORDER, i) ** 2 for i in range(_ORDER + 1)))
    size = np.abs(np.diff(points, _ORDER, axis=0)) / weight
    speed = np.linalg.norm(points[_ORDER:] - points[:-_ORDER], axis=2) / (times[_ORDER:] - times[:-_ORDER])[:, None]
    result = np.full((2, len(JOINTS)), np.nan)
    for row, chosen in enumerate((speed < SLOW, speed > QUICK)):  # nan is neither
        for joint in range(len(JOINTS)):
            use = size[even & chosen[:, joint] & np.isfinite(size[:, joint]).all(axis=1), joint]
            if len(use) >= _LEAST_FRAMES:
                result[row, joint] = _MAD_TO_SIGMA * math.sqrt(float(np.mean(np.square(np.median(use, axis=0)))))
    return result[0], result[1]


def _bone(points: Array, inner: str, outer: str, side: str) -> tuple[float, float]:
    """Return mean and standard deviation of a bone's length [m]; nan if no frame shows the bone."""
    length = np.linalg.norm(points[:, JOINT[f"{outer}_{side}"]] - points[:, JOINT[f"{inner}_{side}"]], axis=1)
    length = length[np.isfinite(length)]
    return (float(length.mean()), float(length.std())) if len(length) else (math.nan, math.nan)


# --- views of one motion

_LEAST_COMMON = 20  # images in which both views see the arm
_LIMBS = {"upper arm": (0, 1), "forearm": (1, 2)}


def guarded(recording: SkeletonRecording) -> SkeletonRecording:
    """Return the recording after :class:`SideFilter` has undone swaps of left and right."""
    return SkeletonRecording(list(SideFilter(recording)), name=recording.name)


def tracked_fraction(recording: SkeletonRecording, side: str) -> float:
    """Return the fraction of the frames in which shoulder, elbow and wrist are tracked."""
    return float(np.mean([skeleton.arm(side).confidence[:3].min() >= 1.0 for skeleton in recording.skeletons]))


def bone(recording: SkeletonRecording, side: str, name: str) -> tuple[float, float]:
    """Return the median length of ``"upper arm"`` or ``"forearm"`` [m], and its robust relative standard deviation.

    The standard deviation is estimated from the median absolute deviation, and is divided by the median length.
    """
    arms = [skeleton.arm(side) for skeleton in recording.skeletons]
    inner, outer = _LIMBS[name]
    lengths = np.array([np.linalg.norm(a.points[outer] - a.points[inner]) for a in arms if a.confidence[:3].min() >= 1])
    if not len(lengths):
        return np.nan, np.nan
    median = float(np.median(lengths))
    return median, _MAD_TO_SIGMA * float(np.median(np.abs(lengths - median))) / median


def arm_raised(recording: SkeletonRecording, side: str) -> dict[float, float]:
    """Return a mapping from time [s] to the angle between the spine and the line from shoulder to wrist [rad].

    The angle does not depend on the position of the camera. Times are rounded to 1 ms; times at which the arm is not
    tracked are left out.
    """
    return _angles(recording, (f"shoulder_{side}", f"wrist_{side}"), ("spine_base", "spine_shoulder"), side)


def elbow_bent(recording: SkeletonRecording, side: str) -> dict[float, float]:
    """Return a mapping from time [s] to the inner angle at the elbow [rad]; a straight arm has the angle pi.

    Times are rounded to 1 ms. Times at which the arm is not tracked are left out.
    """
    return _angles(recording, (f"elbow_{side}", f"wrist_{side}"), (f"elbow_{side}", f"shoulder_{side}"), side)


def _angles(
    recording: SkeletonRecording, one: tuple[str, str], other: tuple[str, str], side: str
) -> dict[float, float]:
    result = {}
    for skeleton in recording.skeletons:
        if skeleton.arm(side).confidence[:3].min() < 1.0:
            continue
        a, b = (skeleton.joint(end) - skeleton.joint(start) for start, end in (one, other))
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        if np.isfinite(angle):
            result[round(skeleton.time, 3)] = angle
    return result


def agreement(one: dict[float, float], other: dict[float, float]) -> tuple[float, int]:
    """Return the correlation coefficient of two signals at their common times, and the number of common times.

    The correlation is nan when there are fewer than 20 common times.
    """
    common = sorted(one.keys() & other.keys())
    if len(common) < _LEAST_COMMON:
        return np.nan, len(common)
    a, b = (np.array([signal[time] for time in common]) for signal in (one, other))
    return float(np.corrcoef(a, b)[0, 1]), len(common)


def wrist_difference(one: SkeletonRecording, other: SkeletonRecording) -> float:
    """Return the RMS difference of the vector from shoulder to wrist between two views of one motion [m].

    The function first rotates one view so that the difference is smallest; the rotation is the same for all frames. The
    positions and axes of the cameras therefore have no effect. The result is the combined error of both views; nan if
    both views track an arm at fewer than 20 common times, where each arm counts separately.
    """
    found = [{round(s.time, 3): s for s in view.skeletons} for view in (one, other)]
    pairs: list[tuple[Array, Array]] = []
    for time in sorted(found[0].keys() & found[1].keys()):
        for side in SIDES:
            a, b = (view[time].arm(side) for view in found)
            if min(a.confidence[:3].min(), b.confidence[:3].min()) >= 1.0:
                pairs.append((a.wrist - a.shoulder, b.wrist - b.shoulder))
    if len(pairs) < _LEAST_COMMON:
        return np.nan
    first, second = np.moveaxis(np.array(pairs), 1, 0)
    rotation, _ = Rotation.align_vectors(second, first)
    return float(np.sqrt(np.mean(np.sum(np.square(rotation.apply(first) - second), axis=1))))


def _describe(recording: SkeletonRecording, images: int, seconds: float, swaps: int) -> str:
    lines = [
        f"{recording.name}: {images} images, {len(recording)} with a person, {images / seconds:.0f} images per second, "
        f"swapped left and right corrected in {swaps} images"
    ]
    noise = measure_noise(recording.skeletons).in_motion if len(recording) >= _LEAST_COMMON else None
    for side in SIDES:
        bones = ", ".join(
            f"{name} {100.0 * length:.0f} cm, spread {100.0 * spread:.0f} %"
            for name in _LIMBS
            for length, spread in [bone(recording, side, name)]
        )
        wrist = np.nan if noise is None else 1e3 * noise[JOINT[f"wrist_{side}"]]
        lines.append(
            f"  {side} arm tracked in {100.0 * tracked_fraction(recording, side):.0f} %; {bones}; white noise of the "
            f"wrist in motion {wrist:.0f} mm"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print how well MediaPipe tracks each video, and how well the videos agree; return the exit status."""
    try:
        if not arguments:
            raise InputError("give one or more video files")
        views = []
        for path in arguments:
            with MediaPipeSource(Path(path)) as source:
                began = clock.monotonic()
                recording = SkeletonRecording(list(source), name=source.name)
                seconds = clock.monotonic() - began
            guard = SideFilter(recording)
            view = SkeletonRecording(list(guard), name=recording.name)
            views.append(view)
            sys.stdout.write(_describe(view, source.images, seconds, guard.swaps) + "\n")
        for one, other in combinations(views, 2):
            parts = []
            for what, signal in (("raised", arm_raised), ("elbow", elbow_bent)):
                for side in SIDES:
                    alike, n = agreement(signal(one, side), signal(other, side))
                    parts.append(f"{side} {what} {alike:.2f} ({n})")
            parts.append(f"wrist positions differ by {100.0 * wrist_difference(one, other):.0f} cm")
            sys.stdout.write(f"{one.name} and {other.name}: {', '.join(parts)}\n")
    except ImitarmError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
