"""Lint: list what is wrong with demonstrations before a skill is learned from them.

Each check yields findings. This module checks each demonstration by itself: the numbers in its file, then its motion.
``arm_checks.py`` checks it against an arm, ``set_checks.py`` checks the demonstrations against each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import moving_rows, noise_level, smooth_speed, turns
from imitarm.demonstrations.arm_checks import check_arm
from imitarm.demonstrations.raw import LENGTH_TOLERANCE, SEVERITIES, Finding, RawDemonstration, Usable
from imitarm.demonstrations.reading import LENGTH_UNITS
from imitarm.demonstrations.set_checks import SET_CHECKS
from imitarm.errors import InputError
from imitarm.trajectory import Demonstration

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

_EPOCH = 1e8  # [s] later times are dates (after 1973), not times since the start
_FEW = 20  # samples
_LONGEST_STEP = 0.5  # [s] between samples
_STEPS = (2e-4, _LONGEST_STEP)  # [s] between samples of usual recorders
_GAP_STEPS = 5.0  # a gap is longer than this many usual steps
_GAP = 0.05  # [s] and longer than this
_IDLE = 0.3  # [s] shortest standing at an end that is reported
_IDLE_FRACTION = 0.05  # of the duration, likewise
_JUMP = 8.0  # times as fast as the samples around it
_JUMP_DISTANCE = 3e-3  # [m]
_JUMP_ANGLE = 0.1  # [rad]
_FAR = 3.0  # [m] farther than arms reach
_TINY = 5e-3  # [m] motions smaller than this are rare
_NO_MOTION = 1e-4  # [m]
_FAST = 3.0  # [m/s] faster than an arm is guided by hand


def lint(demonstrations: Sequence[Demonstration | RawDemonstration], *, arm: ArmModel | None = None) -> list[Finding]:
    """Check each demonstration, each against the arm, and all against each other.

    Args:
        demonstrations: of one motion. Raw ones (``read_raw``) are checked with all their faults; a Demonstration has
            none of the faults that reading refuses.
        arm: the arm that was recorded, with its tool; None: joint limits and reach are not checked.

    Returns:
        Findings, errors first, then warnings, then notes; empty when nothing was found.

    Raises:
        InputError: when there are no demonstrations.
    """
    if not demonstrations:
        raise InputError("lint: no demonstrations; read some first")
    findings: list[Finding] = []
    motions: list[Usable] = []
    for one in demonstrations:
        raw = RawDemonstration.of(one) if isinstance(one, Demonstration) else one
        for raw_check in RAW_CHECKS:
            findings += raw_check(raw)
        try:
            motion = Usable.of(raw.with_poses(arm))
        except InputError as error:
            message = str(error).removeprefix(f"{raw.source}: ")
            findings.append(raw.finding("error", "no-positions", message, "give the arm that was recorded"))
            continue
        if motion is None:
            findings.append(raw.finding("error", "too-short", "fewer than 5 valid rows", "record it again"))
            continue
        motions.append(motion)
        for motion_check in MOTION_CHECKS:
            findings += motion_check(motion)
        if arm is not None:
            findings += check_arm(motion, arm)
    if motions:
        for set_check in SET_CHECKS:
            findings += set_check(motions)
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


# --- the numbers in a file


def check_rows(raw: RawDemonstration) -> Iterator[Finding]:
    """Find numbers that are not finite, and recordings with few samples."""
    invalid = np.flatnonzero(raw.not_finite())
    if len(invalid):
        yield raw.finding(
            "error",
            "not-finite",
            f"{len(invalid)} of {len(raw)} rows hold nan or inf",
            "fix the file, or read it with repair=True to drop those rows",
            int(invalid[0]),
        )
    if len(raw) < _FEW:
        yield raw.finding(
            "warning", "few-samples", f"only {len(raw)} samples", f"record at 50 Hz or faster, {_FEW} samples or more"
        )


def check_stamps(raw: RawDemonstration) -> Iterator[Finding]:
    """Find time stamps that do not increase, that are dates, or that are not in seconds."""
    late = np.flatnonzero(raw.late())
    if len(late):
        row = int(late[0])
        yield raw.finding(
            "error",
            "non-monotonic-stamps",
            f"{len(late)} time stamps are not later than those before; the first is {raw.times[row]:.6g} s "
            f"after {np.nanmax(raw.times[:row]):.6g} s",
            "record again, or read it with repair=True to drop those rows",
            row,
        )
    times = raw.times[~raw.not_finite()]
    if len(times) < 3:
        return
    if np.abs(times).max() > _EPOCH:
        yield raw.finding(
            "note",
            "epoch-stamps",
            f"time stamps are dates ({times[0]:.0f} s), not seconds since the start",
            "none needed: align subtracts the first",
            0,
        )
    step = float(np.median(np.diff(np.sort(times))))
    if step > _LONGEST_STEP:
        fits = [
            f'time_units="{name}" (a sample every {step * factor:.3g} s)'
            for name, factor in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
            if _STEPS[0] <= step * factor <= _STEPS[1]
        ]
        yield raw.finding(
            "error",
            "time-units",
            f"samples are {step:.4g} s apart, {(times[-1] - times[0]) / 60:.4g} min in all; these are hardly seconds",
            f"read it with {' or '.join(fits)}" if fits else "check which column holds the time, and its unit",
        )


def check_quaternions(raw: RawDemonstration) -> Iterator[Finding]:
    """Find quaternions whose length is not one, and signs that flip."""
    if raw.quaternions is None:
        return
    q = np.where(raw.not_finite()[:, None], np.nan, raw.quaternions)
    length = np.nan_to_num(np.linalg.norm(q, axis=1), nan=1.0)
    off = np.abs(length - 1.0)
    worst = int(np.argmax(off))
    if off[worst] > LENGTH_TOLERANCE:
        first = int(np.flatnonzero(off > LENGTH_TOLERANCE)[0])
        yield raw.finding(
            "error",
            "no-rotation",
            f"{int(np.sum(off > LENGTH_TOLERANCE))} quaternions do not have length 1; the first has length "
            f"{length[first]:.3g}",
            "check which columns hold the quaternion",
            first,
        )
    elif off[worst] > 0.1 * LENGTH_TOLERANCE:
        yield raw.finding(
            "warning",
            "quaternion-length",
            f"quaternions have length {length.min():.4f} to {length.max():.4f}; they are scaled to 1 when read",
            "write them with more digits",
            worst,
        )
    flips = np.flatnonzero(np.sum(q[1:] * q[:-1], axis=1) < 0.0) + 1
    if len(flips):
        yield raw.finding(
            "note",
            "quaternion-flips",
            f"{len(flips)} times the quaternion's sign flips (q and -q are the same rotation)",
            "none needed: signs are made continuous when read",
            int(flips[0]),
        )


def check_held(raw: RawDemonstration) -> Iterator[Finding]:
    """Find values that are sampled and held: a recorder that runs faster than its sensor."""
    held = raw.held()
    if held.any():
        rows = (len(raw) - 1) / max(1, int((~held).sum()) - 1)
        yield raw.finding(
            "warning",
            "held-values",
            f"{held.sum()} of {len(raw)} rows repeat the row before: each value is held for about {rows:.2g} rows",
            "read it with thin=True to drop the repeated rows",
            int(np.flatnonzero(held)[0]),
        )


def check_notes(raw: RawDemonstration) -> Iterator[Finding]:
    """Pass on what the reader left out or assumed."""
    for note in raw.notes:
        yield raw.finding("note", "reader", note, "none, unless it matters to you")


RAW_CHECKS = (check_rows, check_stamps, check_quaternions, check_held, check_notes)


# --- one motion


def check_gaps(motion: Usable) -> Iterator[Finding]:
    """Find times without samples."""
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
    enough = max(_IDLE, _IDLE_FRACTION * motion.duration)
    head, tail = motion.times[rows[0]], motion.duration - motion.times[rows[1]]
    if head > enough:
        message = f"stands for {head:.2f} s at the start, rows {motion.rows[0]} to {motion.rows[rows[0]]}"
        yield motion.finding("note", "idle-head", message, "none needed: align trims it", 0)
    if tail > enough:
        message = f"stands for {tail:.2f} s at the end, rows {motion.rows[rows[1]]} to {motion.rows[-1]}"
        yield motion.finding("note", "idle-tail", message, "none needed: align trims it", rows[1])


def check_jumps(motion: Usable) -> Iterator[Finding]:
    """Find steps that are much faster than those around them: lost samples, glitches, a tracker that switched."""
    remedy = "record again, or cut the file before or after it"
    jumps, size = _jumps(motion.times, motion.positions, _JUMP_DISTANCE)
    if len(jumps):
        largest = f"{1e3 * size.max():.0f} mm"
        message = f"{len(jumps)} jumps, the largest {largest}" if len(jumps) > 1 else f"jumps by {largest}"
        yield motion.finding("error", "jump", message, remedy, int(jumps[0]))
    if motion.quaternions is not None:
        jumps, size = _jumps(motion.times, turns(motion.quaternions), _JUMP_ANGLE)
        if len(jumps):
            message = f"rotation jumps by up to {np.degrees(size.max()):.0f} degrees, {len(jumps)} times"
            yield motion.finding("error", "rotation-jump", message, remedy, int(jumps[0]))


def _jumps(times: Array, values: Array, floor: float) -> tuple[NDArray[np.int64], Array]:
    """Return the samples (k,) before which ``values`` (n, d) jump, and by how much (k,).

    A step is compared with the median of the steps two and three before and after it: neither a single bad sample (two
    large steps) nor a quick start hides among its own neighbours.
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
    """Find lengths that can't be metres, and offer every unit that fits."""
    distance = np.abs(motion.positions).max(axis=1)
    extent = float(np.ptp(motion.positions, axis=0).max())
    if distance.max() > _FAR:
        row = int(np.argmax(distance))
        fits = [
            f'units="{name}" (the motion is then {extent * metres:.3g} m large, {distance[row] * metres:.3g} m away)'
            for name, metres in LENGTH_UNITS.items()
            if distance[row] * metres <= _FAR and (extent * metres >= _TINY or extent < _NO_MOTION)
        ]
        remedy = f"read it with {' or '.join(fits)}" if fits else "check which columns hold the position"
        yield motion.finding("error", "units", f"{distance[row]:.4g} m from the base: hardly metres", remedy, row)
    elif _NO_MOTION < extent < _TINY and motion.quaternions is None:
        yield motion.finding(
            "warning", "units", f"the whole motion is {1e3 * extent:.2g} mm large", "check units: were they metres?"
        )


def check_speed(motion: Usable) -> Iterator[Finding]:
    """Find motions that are faster than a person guides an arm."""
    speed, _ = smooth_speed(motion.times, motion.positions)
    fast = float(np.percentile(speed, 95))
    if fast > _FAST and np.abs(motion.positions).max() <= _FAR:
        remedy = "check duration, rate and time_units"
        yield motion.finding("warning", "speed", f"moves at {fast:.1f} m/s", remedy, int(np.argmax(speed)))


MOTION_CHECKS = (check_gaps, check_idle, check_jumps, check_units, check_speed)
