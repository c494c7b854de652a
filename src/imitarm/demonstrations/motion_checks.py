"""Checks of one motion: gaps, idle ends, jumps, units, speed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.finding import Finding, Usable
from imitarm.demonstrations.idle import moving_rows, noise_level, smooth_speed, turns

Array = NDArray[np.float64]

_GAP_STEPS = 5.0  # usual steps that make a gap
_GAP = 0.05  # [s] and at least this long
_IDLE = 0.3  # [s] an idle end that is worth trimming
_IDLE_SHARE = 0.05  # of the duration, likewise
_JUMP = 8.0  # times as fast as the samples around
_JUMP_DISTANCE = 3e-3  # [m]
_JUMP_ANGLE = 0.1  # [rad]
_FAR = 3.0  # [m] further than arms reach
_TINY = 5e-3  # [m] smaller than motions that are shown
_STILL = 1e-4  # [m]
_FAST = 3.0  # [m/s] faster than an arm is guided by hand


def check_gaps(motion: Usable) -> Iterator[Finding]:
    """Find moments without samples."""
    steps = np.diff(motion.times)
    gaps = np.flatnonzero(steps > max(_GAP, _GAP_STEPS * float(np.median(steps))))
    if len(gaps):
        longest = int(gaps[np.argmax(steps[gaps])])
        moved = float(np.linalg.norm(motion.positions[longest + 1] - motion.positions[longest]))
        count = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
        yield motion.finding(
            "warning",
            "gap",
            f"{count} of {steps[longest]:.3g} s (usual step {np.median(steps):.3g} s), "
            f"in which the tool moved {1e3 * moved:.0f} mm",
            "record again, or accept a straight line across it",
            longest + 1,
        )


def check_idle(motion: Usable) -> Iterator[Finding]:
    """Find standing before and after the motion, and motions that never move."""
    rows = moving_rows(motion.times, motion.positions, motion.quaternions)
    if rows is None:
        yield motion.finding("error", "still", "the tool does not move", "leave it out, or check units and columns")
        return
    enough = max(_IDLE, _IDLE_SHARE * motion.duration)
    head, tail = motion.times[rows[0]], motion.duration - motion.times[rows[1]]
    if head > enough:
        message = f"stands for {head:.2f} s at the start, rows {motion.rows[0]} to {motion.rows[rows[0]]}"
        yield motion.finding("note", "idle-head", message, "nothing: align trims it", 0)
    if tail > enough:
        message = f"stands for {tail:.2f} s at the end, rows {motion.rows[rows[1]]} to {motion.rows[-1]}"
        yield motion.finding("note", "idle-tail", message, "nothing: align trims it", rows[1])


def check_jumps(motion: Usable) -> Iterator[Finding]:
    """Find steps that are much faster than those around: lost samples, glitches, a tracker that changed its mind."""
    remedy = "record again, or cut the file before or after it"
    jumps, size = _jumps(motion.times, motion.positions, _JUMP_DISTANCE)
    if len(jumps):
        largest = 1e3 * size.max()
        message = (
            f"{len(jumps)} jumps, the largest {largest:.0f} mm" if len(jumps) > 1 else f"jumps by {largest:.0f} mm"
        )
        yield motion.finding("error", "jump", message, remedy, int(jumps[0]))
    if motion.quaternions is not None:
        jumps, size = _jumps(motion.times, turns(motion.quaternions), _JUMP_ANGLE)
        if len(jumps):
            message = f"rotation jumps by up to {np.degrees(size.max()):.0f} degrees, {len(jumps)} times"
            yield motion.finding("error", "rotation-jump", message, remedy, int(jumps[0]))


def _jumps(times: Array, values: Array, floor: float) -> tuple[NDArray[np.int64], Array]:
    """Return the samples (k,) before which ``values`` (n, d) jump, and by how much (k,).

    A step is compared with the median of the steps two and three before and after it, so that neither a single bad
    sample (two large steps) nor a quick start hides in its own neighbourhood.
    """
    if len(times) < 8:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    dt = np.maximum(np.diff(times), 0.5 * float(np.median(np.diff(times))))  # stamps may bunch, the arm does not
    size = np.linalg.norm(np.diff(values, axis=0), axis=1)
    speed = np.pad(size / dt, 3, mode="reflect")
    n = len(size)
    around = np.median(np.stack([speed[3 + k : 3 + k + n] for k in (-3, -2, 2, 3)]), axis=0)
    jumps = np.flatnonzero((speed[3:-3] > _JUMP * around) & (size > max(floor, 10.0 * noise_level(values))))
    return jumps + 1, size[jumps]


def check_units(motion: Usable) -> Iterator[Finding]:
    """Find lengths that can't be metres."""
    distance = np.abs(motion.positions).max(axis=1)
    extent = float(np.ptp(motion.positions, axis=0).max())
    if distance.max() > _FAR:
        row = int(np.argmax(distance))
        unit = next((name for name, per_m in (("cm", 100.0), ("mm", 1000.0)) if distance[row] / per_m <= _FAR), None)
        remedy = f"read it with units={unit!r}" if unit else "check which columns hold the position"
        yield motion.finding("error", "units", f"{distance[row]:.4g} m from the base: hardly metres", remedy, row)
    elif _STILL < extent < _TINY and motion.quaternions is None:
        yield motion.finding(
            "warning", "units", f"the whole motion is {1e3 * extent:.2g} mm large", "check units: were they metres?"
        )


def check_speed(motion: Usable) -> Iterator[Finding]:
    """Find motions that are faster than a person guides an arm."""
    speed, _ = smooth_speed(motion.times, motion.positions)
    fast = float(np.percentile(speed, 95))
    if fast > _FAST and np.abs(motion.positions).max() <= _FAR:
        yield motion.finding(
            "warning",
            "speed",
            f"moves at {fast:.1f} m/s",
            "check duration, rate and time_units",
            int(np.argmax(speed)),
        )


MOTION_CHECKS = (check_gaps, check_idle, check_jumps, check_units, check_speed)
