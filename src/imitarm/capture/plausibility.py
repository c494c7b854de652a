"""Checks whether a recording can show a person in front of a sensor: units, axes, repeated frames and spikes."""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PLAUSIBLE_RATE = (10.0, 120.0)  # [Hz] frame rates of skeleton cameras
PLAUSIBLE_LIMB = (0.15, 0.45)  # [m] upper arms and forearms of adults, with margin

_TIME_UNITS = {"ns": 1e-9, "100 ns": 1e-7, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0}  # [s]
_LENGTH_UNITS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "dm": 0.1, "feet": 0.3048}  # [m]
FASTEST_HAND = 10.0  # [m/s] faster than a person moves for a robot to follow; real gestures have at most 2.2
LARGEST_STEP = 0.3  # [m] from one frame to the next, if it is also faster than FASTEST_HAND
_UPRIGHT = 0.5  # cosine of the largest angle between spine and vertical, as a median over the recording
_SPAN, _LEAST_SPANS = 3, 10  # [frames] over which a speed is measured; number of speeds needed
_SPIKE = 0.2  # [m] a smaller excursion is noise: arms in real gestures have up to 0.10
_BONE_CHANGE = 0.12  # [m] of a bone's length in a spike
_SPIKE_WIDTHS, _SPIKE_TIME = (1, 2, 3), 0.25  # [frames] a spike lasts, and [s] from the frame before to the one after

_TRUNK = np.array([JOINT[name] for name in ("spine_base", "spine_mid", "spine_shoulder", "neck", "head")])
_UPPER = np.array([JOINT[name] for name in ("head", "neck", "spine_shoulder", "shoulder_left", "shoulder_right")])
_LOWER = np.array([JOINT[name] for name in ("spine_base", "hip_left", "hip_right")])
_BONES = np.array(
    [
        (JOINT[a if a in JOINT else f"{a}_{side}"], JOINT[f"{b}_{side}"])
        for side in SIDES
        for a, b in (("spine_shoulder", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand"))
    ]
)


# --- units


def time_unit_that_fits(rate: float, unit: float) -> tuple[str, float] | None:
    """Return the unit of time in which the time stamps would give a plausible frame rate.

    Args:
        rate: frame rate that results if the time stamps are in ``unit`` [Hz].
        unit: unit in which the time stamps were read, given by its length [s].

    Returns:
        The name of the unit, and the factor by which the times must be multiplied to correct them; None when no unit
        other than ``unit`` gives a plausible frame rate.
    """
    low, high = PLAUSIBLE_RATE
    fits = [
        (abs(math.log(rate * unit / (30.0 * other))), name, other / unit)
        for name, other in _TIME_UNITS.items()
        if low <= rate * unit / other <= high and not math.isclose(other, unit)
    ]
    return min(fits)[1:] if fits and rate > 0.0 else None


def time_unit_name(unit: float) -> str:
    """Return the name of a unit of time of this length [s]: ``"s"``, ``"100 ns"`` and so on."""
    return next((name for name, other in _TIME_UNITS.items() if math.isclose(other, unit)), f"{unit:g} s")


def length_unit_that_fits(limb: float) -> str | None:
    """Return the unit of length in which a limb has a plausible length; None when no unit fits.

    Args:
        limb: length of an upper arm or a forearm, as a number in the unknown unit of the file.
    """
    low, high = PLAUSIBLE_LIMB
    fits = [name for name, unit in _LENGTH_UNITS.items() if low <= limb * unit <= high]
    return fits[0] if fits else None


# --- axes


def axes_that_fit(positions: Array) -> tuple[str, str] | None:
    """Return a description of the fault and the axes to use, for positions (n, 25, 3); None when the axes are correct.

    The axes are correct when the spine points up (y) and the trunk is in front of the sensor (z above 0). If several
    choices of axes satisfy these conditions, the function prefers axes in which the person faces the sensor. In these
    axes, the right shoulder has a larger x than the left shoulder. Right-handed axes are preferred to left-handed axes.
    """
    spine = _median(_mean(positions[:, _UPPER]) - _mean(positions[:, _LOWER]))
    trunk = _median(_mean(positions[:, _TRUNK]))
    across = _median(positions[:, JOINT["shoulder_right"]] - positions[:, JOINT["shoulder_left"]])
    if not (np.isfinite(spine).all() and np.isfinite(trunk).all() and np.linalg.norm(spine) > 0.0):
        return None
    spine = spine / np.linalg.norm(spine)
    upright = spine[1] >= _UPRIGHT
    if upright and trunk[2] > 0.0:
        return None
    if upright:
        fault = f"the person is behind the sensor (z = {trunk[2]:.2f} m)"
    else:
        axis = int(np.argmax(np.abs(spine)))
        fault = f"the head is not above the hips: the direction from hips to head is {'-' if spine[axis] < 0.0 else ''}"
        fault += f"{'xyz'[axis]}, but should be y"
    best: tuple[float, str] | None = None
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        axes, sign = list(order), np.array(signs)
        rows = np.eye(3)[axes] * sign[:, None]
        if (rows @ spine)[1] < np.sqrt(0.5) or (rows @ trunk)[2] <= 0.0:
            continue
        facing = float((rows @ across)[0] / np.linalg.norm(across)) if np.isfinite(across).all() else 0.0
        mirrored = float(np.linalg.det(rows)) < 0.0
        score = facing - 0.5 * mirrored + 1e-6 * float(np.trace(rows))
        names = ", ".join(("-" if s < 0.0 else "") + "xyz"[a] for a, s in zip(axes, sign, strict=True))
        if best is None or score > best[0]:
            best = score, ("mirrored, " if mirrored else "") + names
    return fault, "" if best is None else best[1]


def _mean(points: Array) -> Array:
    """Return the mean position of the visible joints of each frame, shape (n, 3); nan where no joint is visible."""
    seen: Mask = np.all(np.isfinite(points), axis=2, keepdims=True)
    count = seen.sum(axis=1)
    total = np.where(seen, points, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _median(points: Array) -> Array:
    """Return the median position over the frames in which it is known, shape (3,); nan if it is never known."""
    known = points[np.isfinite(points).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


# --- frames that repeat, joints that jump


def repeats_previous(positions: Array) -> Mask:
    """Return whether each frame after the first repeats the previous frame exactly, shape (n - 1,)."""
    same = (positions[1:] == positions[:-1]) | (np.isnan(positions[1:]) & np.isnan(positions[:-1]))
    seen = np.any(np.all(np.isfinite(positions[1:]), axis=2), axis=1)
    return np.asarray(same.all(axis=(1, 2)) & seen)


def runs(repeated: Mask) -> list[tuple[int, int]]:
    """Return the first and the last frame of each run of identical frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], repeated.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def joint_steps(times: Array, positions: Array) -> tuple[Array, Array]:
    """Return how far [m] and how fast [m/s] each joint moves from each frame to the next, shape (n - 1, 25)."""
    step = np.linalg.norm(np.diff(positions, axis=0), axis=2)
    period = np.diff(times)[:, None]
    return step, np.where(period > 0.0, step / np.where(period > 0.0, period, 1.0), 0.0)


def hand_speed(times: Array, positions: Array, spikes: Mask) -> float:
    """Return the speed of the faster hand [m/s].

    The speed of a hand is the 90th percentile of its mean speeds over three frames. A mean speed does not count if its
    first or its last frame is in a spike.

    Args:
        times: time stamps, shape (n,) [s], increasing.
        positions: shape (n, 25, 3) [m].
        spikes: whether each joint is in a spike, shape (n, 25).

    Returns:
        The speed; nan when both hands have fewer than 10 mean speeds.
    """
    speeds = []
    for wrist in (JOINT[f"wrist_{side}"] for side in SIDES):
        moved = np.linalg.norm(positions[_SPAN:, wrist] - positions[:-_SPAN, wrist], axis=1)
        known = np.isfinite(moved) & ~spikes[_SPAN:, wrist] & ~spikes[:-_SPAN, wrist]
        if known.sum() >= _LEAST_SPANS:
            speeds.append(float(np.percentile((moved / (times[_SPAN:] - times[:-_SPAN]))[known], 90.0)))
    return max(speeds, default=math.nan)


def find_spikes(times: Array, positions: Array) -> tuple[Mask, Array]:
    r"""Find joints that jump away for one to three frames, at most 0.25 s, and come back.

    Let A be the position of a joint in the last frame before a possible spike, and B its position in the first frame
    after the spike. The joint is in a spike if all three conditions hold:

    * The distance d of the joint from the straight line between A and B is more than 0.2 m.
    * The distance between A and B is less than d / 2.
    * The joint moves faster than 10 m/s both into and out of the spike, or an arm bone that ends at the joint changes
      its length. A change counts if the length differs by more than 0.12 m from the mean length in the frames just
      before and after the spike.

    Within the first and the last three frames of a recording, any jump of more than 0.3 m at more than 10 m/s is a
    spike.

    Args:
        times: time stamps, shape (n,) [s], increasing.
        positions: shape (n, 25, 3) [m].

    Returns:
        Two arrays (n, 25), for each frame and joint: whether the joint is in a spike, and how far it jumps [m].
    """
    n = len(times)
    found, size = np.zeros(positions.shape[:2], dtype=bool), np.zeros(positions.shape[:2])
    bones = np.linalg.norm(positions[:, _BONES[:, 0]] - positions[:, _BONES[:, 1]], axis=2)
    step, speed = joint_steps(times, positions)
    with np.errstate(invalid="ignore"):
        for width in _SPIKE_WIDTHS:
            m = n - width - 1
            if m < 1:
                break
            span = times[width + 1 :] - times[:m]
            base = positions[width + 1 :] - positions[:m]
            away = np.full((m, len(JOINTS)), np.inf)
            for k in range(1, width + 1):
                fraction = ((times[k : k + m] - times[:m]) / span)[:, None, None]
                line = positions[:m] + fraction * base
                away = np.minimum(away, np.linalg.norm(positions[k : k + m] - line, axis=2))
            fast = np.minimum(speed[:m], speed[width : width + m]) > FASTEST_HAND
            change = np.full((m, len(_BONES)), np.inf)
            for k in range(1, width + 1):
                change = np.minimum(change, np.abs(bones[k : k + m] - 0.5 * (bones[:m] + bones[width + 1 :])))
            stretched = np.zeros_like(fast)
            for bone, joints in zip(np.moveaxis(change > _BONE_CHANGE, 1, 0), _BONES, strict=True):
                stretched[:, joints] |= bone[:, None]
            spike = (span <= _SPIKE_TIME)[:, None] & (away > _SPIKE) & (np.linalg.norm(base, axis=2) < 0.5 * away)
            spike &= fast | stretched
            for k in range(1, width + 1):
                found[k : k + m] |= spike
                size[k : k + m] = np.maximum(size[k : k + m], np.where(spike, away, 0.0))
        leap = (step > LARGEST_STEP) & (speed > FASTEST_HAND)
    for width in _SPIKE_WIDTHS[: max((n - 1) // 2, 0)]:
        for edge, i in ((slice(0, width), width - 1), (slice(n - width, n), n - 1 - width)):
            at = leap[i] & ~found[i] & ~found[i + 1]
            found[edge] |= at
            size[edge] = np.maximum(size[edge], np.where(at, step[i], 0.0))
    return found, size
