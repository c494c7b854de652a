"""Lint: list the faults of demonstrations before a skill is learned from them.

Each check yields findings. The checks in this module examine each motion by itself, and compare the motions with each
other. The mean of several demonstrations is useful only if the demonstrations agree. If some of them run backwards,
stop early, end elsewhere or take another path, the mean is a motion that nobody demonstrated. Checks of the numbers in
a file are in ``raw.py``. Checks of units, and of a motion against an arm, are in ``plausibility.py``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import (
    moving_rows,
    noise_level,
    rotation_paths,
    smooth_speed,
    to_common_ends,
    turns,
)
from imitarm.demonstrations.groups import LEAST_GAP, aligned_paths, largest_distances, split_paths, two_groups
from imitarm.demonstrations.plausibility import FARTHEST, check_arm, check_stamps, check_units
from imitarm.demonstrations.raw import (
    RAW_CHECKS,
    SEVERITIES,
    Finding,
    RawDemonstration,
    Severity,
    ValidRows,
    check_arm_model,
)
from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.trajectory import Demonstration
from imitarm.validation import sequence

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

_GAP_STEPS = 5.0  # a gap is longer than this many usual steps
_GAP = 0.05  # [s] and longer than this
_IDLE = 0.3  # [s] shortest standing at an end that is reported
_IDLE_FRACTION = 0.05  # of the duration, likewise
_JUMP = 8.0  # times as fast as the samples around it
_JUMP_DISTANCE = 3e-3  # [m]
_JUMP_ANGLE = 0.1  # [rad]
_FAST = 3.0  # [m/s] faster than an arm is guided by hand
_DURATION_RATIO = 2.0
_FLAT = 1e-3  # [m] standard deviation below which there is no motion in a direction
_FEWEST = 4  # demonstrations that are needed to recognise an outlier
_OUTLIER_RATIO = 3.0  # times as far from the medoid as is usual
_OUTLIER_SPREADS = 6.0  # and so many robust standard deviations farther
_OUTLIER_DISTANCE = 0.02  # [m] and at least so far
_OUTLIER_ANGLE = 0.2  # [rad] likewise
_ENDS_APART = 0.25  # of the size of the motion, likewise of starts and goals
_ROTATIONS_APART = 0.6  # [rad] likewise of rotations
_OPPOSED = np.pi / 2.0  # [rad] rotations farther apart have no useful mean
_SHORT = {"goal": 0.12, "start": 0.2}  # fraction of the motion that an incomplete demonstration lacks, at least
_DIFFERENT = 0.1  # of the size of the motion: smallest mean distance between a motion and a reversed one
_ROTATED = 0.1  # [rad] smallest difference between demonstrations that only rotate
_ON_PATH = 0.35  # an incomplete motion ends this much nearer to the path of another one than to its end


def lint(demonstrations: Sequence[Demonstration | RawDemonstration], *, arm: ArmModel | None = None) -> list[Finding]:
    """Check each demonstration by itself and against the arm, and compare the demonstrations with each other.

    Args:
        demonstrations: demonstrations of one motion. Raw demonstrations (from ``read_raw``) may contain invalid
            numbers, which are reported.
        arm: arm that was recorded, with its tool; without an arm, joint limits and reach are not checked.

    Returns:
        Findings, errors first, then warnings, then notes; empty when nothing was found.

    Raises:
        InputError: when there are no demonstrations, or an object is not a demonstration.
    """
    check_arm_model(arm, "lint: arm")
    if not sequence(demonstrations, object, "lint: demonstrations"):
        raise InputError("lint: no demonstrations; read some first")
    findings: list[Finding] = []
    motions: list[ValidRows] = []
    for one in demonstrations:
        raw = RawDemonstration.of(one)
        for raw_check in (check_stamps, *RAW_CHECKS):
            findings += raw_check(raw)
        try:
            motion = ValidRows.of(raw.with_poses(arm))
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


def check_gaps(motion: ValidRows) -> Iterator[Finding]:
    """Find gaps in the recording: periods without samples."""
    steps = np.diff(motion.times)
    gaps = np.flatnonzero(steps > max(_GAP, _GAP_STEPS * float(np.median(steps))))
    if len(gaps):
        longest = int(gaps[np.argmax(steps[gaps])])
        moved = float(np.linalg.norm(motion.positions[longest + 1] - motion.positions[longest]))
        count = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
        message = (
            f"{count} of {steps[longest]:.3g} s (the usual time between samples is {np.median(steps):.3g} s), in which "
            "the tool moved "
            f"{1e3 * moved:.0f} mm"
        )
        remedy = "record again, or accept that a straight line replaces the motion in the gap"
        yield motion.finding("warning", "gap", message, remedy, longest + 1)


def check_idle(motion: ValidRows) -> Iterator[Finding]:
    """Find rest before and after the motion, and recordings in which the tool never moves."""
    rows = moving_rows(motion.times, motion.positions, motion.quaternions)
    if rows is None:
        yield motion.finding(
            "error", "still", "the tool does not move", "check units and columns, or leave out this demonstration"
        )
        return
    enough = max(_IDLE, _IDLE_FRACTION * motion.duration)
    head, tail = motion.times[rows[0]], motion.duration - motion.times[rows[1]]
    if head > enough:
        message = f"the tool rests for {head:.2f} s at the start, rows {motion.rows[0]} to {motion.rows[rows[0]]}"
        yield motion.finding("note", "idle-head", message, "none needed: align trims it", 0)
    if tail > enough:
        message = f"the tool rests for {tail:.2f} s at the end, rows {motion.rows[rows[1]]} to {motion.rows[-1]}"
        yield motion.finding("note", "idle-tail", message, "none needed: align trims it", rows[1])


def check_jumps(motion: ValidRows) -> Iterator[Finding]:
    """Find steps that are much faster than their neighbours: lost samples, glitches, jumps of a tracking system."""
    remedy = "record again, or cut the file before or after the jump"
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
    """Return the first sample after each jump of ``values`` (n, d), shape (k,), and the size of each jump, shape (k,).

    A step is a jump if it is much larger than the median of four steps near it: the second and third step before it,
    and the second and third step after it. The direct neighbours are left out, because a single bad sample causes two
    large steps in a row.
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


def check_speed(motion: ValidRows) -> Iterator[Finding]:
    """Find motions that are faster than a person can guide an arm."""
    speed, _ = smooth_speed(motion.times, motion.positions)
    fast = float(np.percentile(speed, 95))
    if fast > _FAST and np.abs(motion.positions).max() <= FARTHEST:
        remedy = "check duration, rate and time_units"
        yield motion.finding("warning", "speed", f"moves at {fast:.1f} m/s", remedy, int(np.argmax(speed)))


MOTION_CHECKS = (check_gaps, check_idle, check_jumps, check_units, check_speed)


def check_number(motions: Sequence[ValidRows]) -> Iterator[Finding]:
    """Report when there is only one demonstration."""
    if len(motions) == 1:
        message = "only one demonstration: it does not show how precise each part of the motion must be"
        yield motions[0].finding("warning", "single", message, "demonstrate the motion three times or more")


def check_kinds(motions: Sequence[ValidRows]) -> Iterator[Finding]:
    """Find rotations, joints or a third dimension that only some of the demonstrations have."""
    rotations, joints = ([getattr(m, what) is not None for m in motions] for what in ("quaternions", "joints"))
    count = f"of {len(motions)} demonstrations have"
    if any(rotations) and not all(rotations):
        message = f"{sum(rotations)} {count} rotations, but this one has no rotations"
        yield motions[rotations.index(False)].finding(
            "error", "mixed-rotations", message, "leave out this demonstration"
        )
    if any(joints) and not all(joints):
        message = f"{sum(joints)} {count} joints, but this one has no joints"
        yield motions[joints.index(False)].finding(
            "note", "mixed-joints", message, "none needed: skills are learned without joints"
        )
    flat = [bool(np.ptp(m.positions[:, 2]) == 0.0) for m in motions]
    deep = [float(np.ptp(m.positions[:, 2])) > _FLAT for m in motions]
    if any(flat) and any(deep):
        message = f"{sum(flat)} of {len(flat)} demonstrations are planar (z does not change), but the others are not"
        remedy = "do not mix recordings with and without z"
        yield motions[flat.index(True)].finding("warning", "mixed-dimensions", message, remedy)


def check_durations(motions: Sequence[ValidRows]) -> Iterator[Finding]:
    """Find demonstrations that take much longer than the shortest demonstration."""
    durations = np.array([motion.duration for motion in motions])
    if durations.max() > _DURATION_RATIO * durations.min():
        slow = int(np.argmax(durations))
        message = f"takes {durations[slow]:.2f} s, but the shortest demonstration takes {durations.min():.2f} s"
        remedy = "check that both demonstrations show the whole motion; align makes the durations equal"
        yield motions[slow].finding("warning", "durations", message, remedy)


def check_plane(motions: Sequence[ValidRows]) -> Iterator[Finding]:
    """Find a direction in which no demonstration moves: all motions lie in one plane or on one line."""
    positions = np.concatenate([motion.positions for motion in motions])
    deviations, directions = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[1:]
    deviations = deviations / np.sqrt(len(positions))
    flat = deviations < _FLAT
    if flat.any() and deviations[0] > _FLAT:
        normal = directions[-1] * np.sign(directions[-1][np.argmax(np.abs(directions[-1]))])
        vector = " ".join(f"{x:.2f}" for x in normal + 0.0)
        within = f"{1e3 * deviations[flat].max():.2g} mm"
        if flat.sum() == 1:
            message = f"all motions lie within {within} of a plane with the normal ({vector})"
        else:
            message = f"all motions lie within {within} of a straight line that is perpendicular to ({vector})"
        yield Finding(
            "note", "planar", message, remedy="none needed: the skill keeps the position along this normal constant"
        )


def check_agreement(motions: Sequence[ValidRows]) -> Iterator[Finding]:
    """Find demonstrations that run backwards, are incomplete, or differ in start, goal, path or rotation."""
    trajectories = [one for motion in motions if (one := motion.moving_part()) is not None]
    if len(trajectories) < len(motions) or len(motions) < 2:
        return
    scale = _Scale(1e3, "mm", LEAST_GAP)
    paths = np.stack([_by_length(one.positions) for one in trajectories])
    size = float(np.median(np.linalg.norm(np.ptp(paths, axis=1), axis=1)))
    if size < _FLAT:  # the tool only rotates
        if any(one.quaternions is None for one in trajectories):
            return
        scale = _Scale(float(np.degrees(1.0)), "degrees", _ROTATED)
        paths = np.stack([_by_length(path) for path in rotation_paths(trajectories)])
        size = float(np.median(np.linalg.norm(np.ptp(paths, axis=1), axis=1)))
    odd: set[int] = set()
    found = [*_backwards(paths, size, motions, scale), *_incomplete(paths, size, motions, scale)]
    for i, message, code, remedy in found:
        if i not in odd:
            odd.add(i)
            yield motions[i].finding("error", code, message, remedy)
    rest = [i for i in range(len(motions)) if i not in odd]
    if len(rest) >= 2:
        positions, rotations = aligned_paths([trajectories[i] for i in rest])
        yield from _groups([motions[i] for i in rest], positions, rotations, size)
        if len(rest) >= _FEWEST:
            yield from _outliers([motions[i] for i in rest], positions, rotations)


@dataclass(frozen=True)
class _Scale:
    """The unit in which differences are reported, its conversion factor, and the smallest relevant difference."""

    factor: float
    unit: str
    smallest: float


_Odd = tuple[int, str, str, str]  # which demonstration, message, code, remedy


def _by_length(positions: Array) -> Array:
    """Return the path resampled at equal distances, shape (n, 3), so that it no longer depends on the speed."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], len(positions))
    return np.stack([np.interp(even, length, column) for column in positions.T], axis=1)


def _mean_distance(paths: Array, others: Array) -> Array:
    """Return the mean distance between each path in ``paths`` and each path in ``others``, shape (m, m)."""
    return np.stack([np.linalg.norm(others - path, axis=2).mean(axis=1) for path in paths])


def _backwards(paths: Array, size: float, motions: Sequence[ValidRows], scale: _Scale) -> Iterator[_Odd]:
    """Find motions that run backwards: after reversal, they are much nearer to the most typical motion."""
    forward, backward = _mean_distance(paths, paths), _mean_distance(paths[:, ::-1], paths)
    typical = int(np.argmin(forward.sum(axis=1)))
    differs = forward[:, typical] > max(scale.smallest, _DIFFERENT * size)
    for i in np.flatnonzero((backward < 0.5 * forward)[:, typical] & differs):
        message = f"runs in the opposite direction to {motions[typical].name}"
        yield int(i), message, "direction", "leave out this demonstration, or learn a separate skill for each direction"


def _incomplete(paths: Array, size: float, motions: Sequence[ValidRows], scale: _Scale) -> Iterator[_Odd]:
    """Find motions that begin or end in the middle of the path of the other motions."""
    m, n, _ = paths.shape
    for end, verb in (("goal", "stops"), ("start", "begins")):
        along = paths if end == "goal" else paths[:, ::-1]  # towards the end in question
        distances = (np.linalg.norm(along - path[-1], axis=2) for path in along)  # of one end to all paths (m, n)
        found = [(np.argmin(d, axis=1), d.min(axis=1), d[:, -1]) for d in distances]
        nearest, least, apart = (np.stack(part) for part in zip(*found, strict=True))
        short = (apart > max(scale.smallest, _SHORT[end] * size)) & (least < _ON_PATH * apart)
        short &= nearest < (1.0 - _SHORT[end]) * (n - 1)
        for i in range(m):
            whole = np.flatnonzero(short[i] & ~short.any(axis=1))
            if len(whole) and 2 * short[i].sum() >= m - 1:
                done = nearest[i, whole[0]] / (n - 1)
                percent = 100.0 * (done if verb == "stops" else 1.0 - done)
                message = (
                    f"{verb} at {percent:.0f} % of the path of {motions[whole[0]].name}, which is "
                    f"{scale.factor * apart[i, whole[0]]:.0f} {scale.unit} from the {end} of this path"
                )
                yield i, message, "incomplete", "leave out this demonstration, or record the whole motion again"


def _groups(motions: Sequence[ValidRows], positions: Array, rotations: Array | None, size: float) -> Iterator[Finding]:
    """Find two groups of demonstrations that differ in start, goal, path from start to goal, or rotation."""
    between = to_common_ends(positions)
    kinds: list[tuple[str, Severity, str, Array, float, float, str]] = [
        ("ends", "warning", "starts", largest_distances(positions[:, :1]), _ENDS_APART * size, 1e3, "mm"),
        ("ends", "warning", "goals", largest_distances(positions[:, -1:]), _ENDS_APART * size, 1e3, "mm"),
        ("two-paths", "error", "paths between the same ends", largest_distances(between), size, 1e3, "mm"),
    ]
    if rotations is not None:
        apart = np.stack([_angles(rotations, q).max(axis=1) for q in rotations])
        if apart.max() > _OPPOSED:
            odd = int(np.argmax(apart.sum(axis=1)))
            name, degrees = motions[int(np.argmax(apart[odd]))].name, np.degrees(apart[odd].max())
            message = (
                f"its rotation differs by up to {degrees:.0f} degrees from {name} at the same fraction of the motion, "
                "so the mean of both rotations would be meaningless"
            )
            remedy = (
                "check how the tool was held and the order of the quaternions (wxyz or xyzw), or leave out this "
                "demonstration"
            )
            yield motions[odd].finding("error", "two-rotations", message, remedy)
        else:
            kinds.append(("two-rotations", "warning", "rotations", apart, _ROTATIONS_APART, np.degrees(1.0), "degrees"))
    for code, severity, what, distance, floor, factor, unit in kinds:
        if code == "two-paths":
            split = split_paths(distance, size)
        else:
            split = two_groups(distance, floor if unit == "degrees" else max(LEAST_GAP, floor))
        if split is None:
            continue
        group, gap = split
        few, many = sorted((np.flatnonzero(group), np.flatnonzero(~group)), key=len)
        if code != "ends" and len(few) == 1 and len(motions) >= _FEWEST:
            continue  # one among many is an outlier
        groups = f"of {_names(motions, few)} and of {_names(motions, many)}"
        message = f"the {what} {groups} are {factor * gap:.0f} {unit} apart"
        remedy = "learn a separate skill from each group: the mean of the groups is a motion that nobody demonstrated"
        yield motions[few[0]].finding(severity, code, message, remedy)


def _angles(rotations: Array, reference: Array) -> Array:
    """Return the angles between quaternions (m, n, 4) and reference quaternions (n, 4), shape (m, n) [rad]."""
    back = quaternion_conjugate(reference)
    return np.stack([np.linalg.norm(quaternion_log(quaternion_multiply(q, back)), axis=1) for q in rotations])


def _names(motions: Sequence[ValidRows], which: NDArray[np.int64]) -> str:
    """Return the names of demonstrations for a message: at most three, then the number of the others."""
    names = [motions[i].name for i in which]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _outliers(motions: Sequence[ValidRows], positions: Array, rotations: Array | None) -> Iterator[Finding]:
    """Find aligned demonstrations that are unusually far from the medoid, the motion nearest to all others."""
    distance = _mean_distance(positions, positions)
    center = int(np.argmin(np.sum(distance, axis=1)))
    for i in _unlike(distance[center], center, _OUTLIER_DISTANCE):
        usual = float(np.median(np.delete(distance[center], center)))
        message = (
            f"is {1e3 * distance[center, i]:.0f} mm from the most typical demonstration "
            f"({motions[center].raw.source}), but the typical distance is {1e3 * usual:.0f} mm"
        )
        yield motions[i].finding(
            "warning", "outlier", message, "check this demonstration, and leave it out if it shows another motion"
        )
    if rotations is None:
        return
    angle = _angles(rotations, rotations[center]).mean(axis=1)
    for i in _unlike(angle, center, _OUTLIER_ANGLE):
        message = (
            f"is rotated by {np.degrees(angle[i]):.0f} degrees from the most typical demonstration "
            f"({motions[center].raw.source}), but the typical angle is "
            f"{np.degrees(np.median(np.delete(angle, center))):.0f} degrees"
        )
        remedy = "check this demonstration, and the order of its quaternions (wxyz or xyzw)"
        yield motions[i].finding("warning", "rotation-outlier", message, remedy)


def _unlike(distance: Array, center: int, floor: float) -> list[int]:
    """Return the demonstrations whose ``distance`` (n,) from the demonstration ``center`` is unusually large."""
    others = np.delete(distance, center)
    usual = float(np.median(others))
    spread = 1.4826 * float(np.median(np.abs(others - usual)))
    limit = max(floor, _OUTLIER_RATIO * usual, usual + _OUTLIER_SPREADS * spread)
    return [int(i) for i in np.flatnonzero(distance > limit)]


SET_CHECKS = (check_number, check_kinds, check_durations, check_plane, check_agreement)
