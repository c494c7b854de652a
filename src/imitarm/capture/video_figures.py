"""How well MediaPipe sees a person in a video, in figures; of one motion from several sides, also how alike.

For example::

    python -m imitarm.capture.video_figures .cache/pose2sim/*.mp4
"""

from __future__ import annotations

import sys
import time as clock
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from imitarm.capture.mediapipe import MediaPipeSource
from imitarm.capture.noise import measure_noise
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.sides import SwapGuard
from imitarm.capture.skeleton import JOINT, SIDES
from imitarm.errors import ImitarmError, InputError

Array = NDArray[np.float64]

_LEAST_COMMON = 20  # pictures in which both views see the arm
_BONES = {"upper arm": (0, 1), "forearm": (1, 2)}
_MAD = 1.4826


def guarded(recording: SkeletonRecording) -> SkeletonRecording:
    """Return a recording with left and right kept apart, as a retargeter is given it."""
    return SkeletonRecording(list(SwapGuard(recording)), name=recording.name)


def tracked_share(recording: SkeletonRecording, side: str) -> float:
    """Return the share of the frames in which shoulder, elbow and wrist are tracked."""
    return float(np.mean([skeleton.arm(side).confidence[:3].min() >= 1.0 for skeleton in recording.skeletons]))


def bone(recording: SkeletonRecording, side: str, name: str) -> tuple[float, float]:
    """Return the median length of ``"upper arm"`` or ``"forearm"`` [m] and its spread, robustly, over that length."""
    arms = [skeleton.arm(side) for skeleton in recording.skeletons]
    inner, outer = _BONES[name]
    lengths = np.array([np.linalg.norm(a.points[outer] - a.points[inner]) for a in arms if a.confidence[:3].min() >= 1])
    if not len(lengths):
        return np.nan, np.nan
    median = float(np.median(lengths))
    return median, _MAD * float(np.median(np.abs(lengths - median))) / median


def arm_raised(recording: SkeletonRecording, side: str) -> dict[float, float]:
    """Return the angle between arm (shoulder to wrist) and spine, by time rounded to a millisecond [rad].

    It is the same from wherever one looks; times at which the arm is not tracked are left out.
    """
    return _angles(recording, (f"shoulder_{side}", f"wrist_{side}"), ("spine_base", "spine_shoulder"), side)


def elbow_bent(recording: SkeletonRecording, side: str) -> dict[float, float]:
    """Return the angle between forearm and upper arm, by time rounded to a millisecond [rad]; as :func:`arm_raised`."""
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
    """Return the correlation of two signals over the times they share, and how many times those are.

    The correlation is nan when they share fewer than 20.
    """
    common = sorted(one.keys() & other.keys())
    if len(common) < _LEAST_COMMON:
        return np.nan, len(common)
    a, b = (np.array([signal[time] for time in common]) for signal in (one, other))
    return float(np.corrcoef(a, b)[0, 1]), len(common)


def wrist_difference(one: SkeletonRecording, other: SkeletonRecording) -> float:
    """Return by how much two views differ on the wrists, seen from the shoulders, root mean square [m].

    One rotation for the whole recording, which fits best, is between the views; so neither's place nor its axes count.
    What is left is the error of both together. It is nan when they share fewer than 20 frames.
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
    turn, _ = Rotation.align_vectors(second, first)
    return float(np.sqrt(np.mean(np.sum(np.square(turn.apply(first) - second), axis=1))))


def _describe(recording: SkeletonRecording, pictures: int, seconds: float, swaps: int) -> str:
    lines = [
        f"{recording.name}: {pictures} pictures, {len(recording)} with a person, {pictures / seconds:.0f} a second, "
        f"sides exchanged in {swaps}"
    ]
    noise = measure_noise(recording.skeletons).in_motion if len(recording) >= _LEAST_COMMON else None
    for side in SIDES:
        bones = ", ".join(
            f"{name} {100.0 * length:.0f} cm, spread {100.0 * spread:.0f} %"
            for name in _BONES
            for length, spread in [bone(recording, side, name)]
        )
        wrist = np.nan if noise is None else 1e3 * noise[JOINT[f"wrist_{side}"]]
        lines.append(
            f"  {side} arm tracked in {100.0 * tracked_share(recording, side):.0f} %; {bones}; white noise of the "
            f"wrist in motion {wrist:.0f} mm"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print the figures of video files, and how alike they are; return the exit status."""
    try:
        if not arguments:
            raise InputError("name one or more video files")
        views = []
        for path in arguments:
            with MediaPipeSource(Path(path)) as source:
                began = clock.monotonic()
                recording = SkeletonRecording(list(source), name=source.name)
                seconds = clock.monotonic() - began
            guard = SwapGuard(recording)
            view = SkeletonRecording(list(guard), name=recording.name)
            views.append(view)
            sys.stdout.write(_describe(view, source.pictures, seconds, guard.swaps) + "\n")
        for one, other in combinations(views, 2):
            parts = []
            for what, signal in (("raised", arm_raised), ("elbow", elbow_bent)):
                for side in SIDES:
                    alike, n = agreement(signal(one, side), signal(other, side))
                    parts.append(f"{side} {what} {alike:.2f} ({n})")
            parts.append(f"wrists differ by {100.0 * wrist_difference(one, other):.0f} cm")
            sys.stdout.write(f"{one.name} and {other.name}: {', '.join(parts)}\n")
    except ImitarmError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
