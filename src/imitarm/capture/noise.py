"""measure_noise: how noisy a skeleton camera is, from what it saw: noise of each joint, bones, frame intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, Tracking
from imitarm.errors import InputError

Array = NDArray[np.float64]

BONES = {"upper arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "hand": ("wrist", "hand")}
SLOW, QUICK = 0.1, 0.4  # [m/s] a joint below is at rest, one above is in motion
LATE = 1.4  # an interval longer than so many median ones had a frame left out
_ORDER = 5  # of the difference: a hand at 2 Hz leaves 0.2 mm of it
_LEAST_FRAMES = 20
_MAD = 1.4826


@dataclass(frozen=True, eq=False)
class SensorNoise:
    r"""How noisy a skeleton camera is, as far as its own skeletons tell.

    What is new in every frame shows in differences of fifth order of neighbouring frames, in which a person's motion
    all but vanishes: white noise of standard deviation :math:`\sigma` makes differences of :math:`\sqrt{252}\,\sigma`;
    the median of their size is taken, so that single jumps don't count. What changes slowly shows in bones that
    change their lengths.

    Attributes:
        n_frames: how many skeletons were looked at.
        median_interval: between frames [s].
        jitter: standard deviation of the intervals without the late ones [s].
        late: share of the intervals that are longer than 1.4 times the median one.
        longest_interval: [s].
        at_rest: white noise of each joint while it is slower than 0.1 m/s, root mean square over the axes, shape (25,)
            [m]; nan where the joint was too seldom so slow.
        in_motion: the same while it is faster than 0.4 m/s.
        bones: mean and standard deviation of the length of each bone of both arms, by name (``"left forearm"``) [m].
        inferred: share of the frames in which each joint is inferred or lost, shape (25,).
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
    """Measure how noisy a skeleton camera is.

    Args:
        skeletons: of one person, in the order of their times; at least 20, some of them of a person at rest.

    Raises:
        InputError: when there are too few, or their times don't increase.
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
                result[row, joint] = _MAD * math.sqrt(float(np.mean(np.square(np.median(use, axis=0)))))
    return result[0], result[1]


def _bone(points: Array, inner: str, outer: str, side: str) -> tuple[float, float]:
    """Return mean and standard deviation of the length of a bone over the frames that show it; nan if none does."""
    length = np.linalg.norm(points[:, JOINT[f"{outer}_{side}"]] - points[:, JOINT[f"{inner}_{side}"]], axis=1)
    length = length[np.isfinite(length)]
    return (float(length.mean()), float(length.std())) if len(length) else (math.nan, math.nan)
