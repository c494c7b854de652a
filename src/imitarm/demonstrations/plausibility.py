"""Check whether the units of a motion are plausible, and whether an arm can execute the motion.

A remedy proposes all units that fit the numbers in the file. The checks against an arm concern joint names, joint
units, joint limits, joint speed and reach.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import smooth_slope
from imitarm.demonstrations.raw import Finding, RawDemonstration, ValidRows
from imitarm.demonstrations.reading import LENGTH_UNITS, TIME_UNITS
from imitarm.errors import InputError

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

FARTHEST = 3.0  # [m] no arm reaches farther from its base
_TINY = 5e-3  # [m] motions smaller than this are rare
_NO_MOTION = 1e-4  # [m]
_EPOCH = 1e8  # [s] later times are dates (after 1973), not times since the start
_STEPS = (2e-4, 0.5)  # [s] between samples of usual recorders
_SHORTEST_STEP = 5e-5  # [s] no recorder is faster than 20 kHz
_OVER = 0.01  # [rad] by which measured joints may exceed a limit
_SPEED_WINDOW = 0.06  # [s] encoders have little noise
_MARGIN = 5e-3  # [m] by which measured positions may exceed the reach
_DEGREES = 2.5 * np.pi  # [rad] no joint rotates farther, so these are degrees


def check_stamps(raw: RawDemonstration) -> Iterator[Finding]:
    """Find time stamps that do not increase, are dates, or are probably in a unit other than the assumed unit."""
    late = np.flatnonzero(raw.late())
    if len(late):
        row = int(late[0])
        message = f"{len(late)} time stamps are not later than the previous ones; the first is {raw.times[row]:.6g} s "
        message += f"after {np.nanmax(raw.times[:row]):.6g} s"
        remedy = "record again, or read it with repair=True to drop those rows"
        yield raw.finding("error", "non-monotonic-stamps", message, remedy, row)
    times = raw.times[~raw.not_finite()]
    if len(times) < 3:
        return
    if np.abs(times).max() > _EPOCH:
        message = f"time stamps are dates ({times[0]:.0f} s), not seconds since the start"
        yield raw.finding("note", "epoch-stamps", message, "none needed: align subtracts the first time stamp", 0)
    steps = np.diff(np.sort(times))
    step = float(np.median(steps))
    in_file = step / TIME_UNITS[raw.time_unit]
    fits = [
        (name, f"a sample every {in_file * factor:.3g} s")
        for name, factor in TIME_UNITS.items()
        if name != raw.time_unit and _STEPS[0] <= in_file * factor <= _STEPS[1]
    ]
    unit = {"s": "seconds"}.get(raw.time_unit, raw.time_unit)
    if step > _STEPS[1]:
        minutes = (times[-1] - times[0]) / 60.0
        message = f"samples are {step:.4g} s apart, and the motion lasts {minutes:.4g} min; are the times in {unit}?"
    elif 0.0 < step < _SHORTEST_STEP:
        message = f"samples are only {step:.3g} s apart, which no recorder achieves; are the times in {unit}?"
    else:
        return
    other = "check which column holds the time, and its unit"
    yield raw.finding("error", "time-units", message, _remedy(raw, "time", "time_units", fits, other))


def check_units(motion: ValidRows) -> Iterator[Finding]:
    """Find positions that are probably in a unit other than the assumed unit, and propose every unit that fits."""
    raw = motion.raw
    distance = np.abs(motion.positions).max(axis=1)
    extent = float(np.ptp(motion.positions, axis=0).max())
    if distance.max() > FARTHEST:
        row = int(np.argmax(distance))
        far, wide = (length / LENGTH_UNITS[raw.length_unit] for length in (distance[row], extent))
        fits = [
            (
                name,
                f"the motion then extends over {wide * metres:.3g} m and is up to {far * metres:.3g} m from the base",
            )
            for name, metres in LENGTH_UNITS.items()
            if name != raw.length_unit and far * metres <= FARTHEST and (wide * metres >= _TINY or extent < _NO_MOTION)
        ]
        unit = {"m": "metre"}.get(raw.length_unit, raw.length_unit)
        message = f"{distance[row]:.4g} m from the base: the unit is probably not the {unit}"
        remedy = _remedy(raw, "length", "units", fits, "check which columns hold the position")
        yield motion.finding("error", "units", message, remedy, row)
    elif _NO_MOTION < extent < _TINY and motion.quaternions is None:
        message = f"the whole motion extends over only {1e3 * extent:.2g} mm"
        unit = {"m": "metres"}.get(raw.length_unit, raw.length_unit)
        yield motion.finding("warning", "units", message, f"check the unit: are the numbers in {unit}?")


def _remedy(raw: RawDemonstration, kind: str, option: str, fits: list[tuple[str, str]], otherwise: str) -> str:
    """Return the remedy: an option with a unit that fits, or a correction of the unit that the file states."""
    if not fits:
        return otherwise
    if kind in raw.units_in_file:
        stated = raw.length_unit if kind == "length" else raw.time_unit
        units = " or ".join(f"{name} ({effect})" for name, effect in fits)
        return f"the file states the unit {stated}; correct the unit in the file to {units}"
    return "read it with " + " or ".join(f'{option}="{name}" ({effect})' for name, effect in fits)


def check_arm(motion: ValidRows, arm: ArmModel) -> Iterator[Finding]:
    """Check that joints belong to the arm, are in rad and within limits, and that positions are within reach."""
    if motion.joints is None:
        yield from _check_reach(motion, arm)
        return
    try:
        q = motion.raw.joints_of(arm)[motion.rows]
    except InputError as error:
        remedy = "give the arm that was recorded"
        yield motion.finding("error", "other-arm", str(error).removeprefix(f"{motion.raw.source}: "), remedy)
        return
    if np.abs(q).max() > _DEGREES:
        row, joint = np.unravel_index(np.argmax(np.abs(q)), q.shape)
        yield motion.finding(
            "error",
            "joint-units",
            f"{arm.joint_names[joint]} is at {q[row, joint]:.4g} rad: this number is in degrees",
            "convert the joints to rad, or put the unit in the names: right_j0 [deg]",
            int(row),
        )
        return
    over = np.maximum(arm.lower - q, q - arm.upper)
    if over.max() > _OVER:
        row, joint = np.unravel_index(np.argmax(over), over.shape)
        yield motion.finding(
            "error",
            "joint-limit",
            f"{arm.joint_names[joint]} is at {q[row, joint]:.3f} rad, {over[row, joint]:.3f} beyond its limit "
            f"[{arm.lower[joint]:.3f}, {arm.upper[joint]:.3f}]",
            f"repeat the motion within the limits of {arm.name}, or give the arm that was recorded",
            int(row),
        )
    speed = np.abs(smooth_slope(motion.times, q, _SPEED_WINDOW)[0]) / arm.max_velocity
    if speed.max() > 1.0:
        row, joint = np.unravel_index(np.argmax(speed), speed.shape)
        yield motion.finding(
            "warning",
            "joint-speed",
            f"{arm.joint_names[joint]} rotates at {speed[row, joint] * arm.max_velocity[joint]:.2f} rad/s, but "
            f"{arm.name} allows {arm.max_velocity[joint]:.2f}",
            "reproduce the motion with a longer duration",
            int(row),
        )


def _check_reach(motion: ValidRows, arm: ArmModel) -> Iterator[Finding]:
    centre, radius = reach(arm)
    distance = np.linalg.norm(motion.positions - centre, axis=1)
    row = int(np.argmax(distance))
    if distance[row] > radius + _MARGIN:
        yield motion.finding(
            "error",
            "reach",
            f"{int(np.sum(distance > radius + _MARGIN))} positions are out of reach: {distance[row]:.3f} m from the "
            f"shoulder of {arm.name}, which reaches {radius:.3f} m",
            "check units and frame (the arm's base), or choose a larger arm",
            row,
        )


def reach(arm: ArmModel, *, n_samples: int = 400, seed: int = 0) -> tuple[Array, float]:
    """Return the position of an arm's shoulder, and the largest distance from the shoulder to the tool's tip.

    The shoulder is the point on the first joint's axis that is nearest to the second joint's axis. Gradient ascent
    within the joint limits, from random postures, finds the distance. The result can be slightly smaller than the true
    reach, but not larger.

    Args:
        arm: arm with its tool.
        n_samples: number of random postures; gradient ascent starts from the four with the largest distance.
        seed: seed of the random postures.

    Returns:
        Shoulder position in the base frame, shape (3,) [m], and largest distance [m].
    """
    centre = _shoulder(arm)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    postures = np.random.default_rng(seed).uniform(low, high, (n_samples, arm.n_joints))
    distance = np.linalg.norm(arm.tool_path(postures)[0] - centre, axis=1)
    best = 0.0
    for q in postures[np.argsort(distance)[-4:]]:
        here, step = q, 0.5
        value = float(np.linalg.norm(arm.tool_pose(here).position - centre))
        while step > 1e-3:
            offset = arm.tool_pose(here).position - centre
            uphill = arm.tool_jacobian(here)[:3].T @ (offset / value)
            there = np.clip(here + step * uphill / max(float(np.linalg.norm(uphill)), 1e-9), low, high)
            further = float(np.linalg.norm(arm.tool_pose(there).position - centre))
            here, value, step = (there, further, step) if further > value + 1e-7 else (here, value, 0.5 * step)
        best = max(best, value)
    return centre, best


def _shoulder(arm: ArmModel) -> Array:
    """Return the point on the first joint's axis that is nearest to the second joint's axis, shape (3,) [m]."""
    q = np.array(arm.home)
    columns = arm.tool_jacobian(q)
    position = arm.tool_pose(q).position
    axes = columns[3:].T
    if arm.n_joints < 2 or not (axes[0].any() and axes[1].any()):
        return np.zeros(3)
    # a point of joint j's axis, from v_j = a_j x (p - o_j)
    anchors = [position - np.cross(columns[:3, j], axes[j]) for j in (0, 1)]
    normal = np.cross(axes[0], axes[1])
    between = anchors[1] - anchors[0]
    if np.linalg.norm(normal) < 1e-6:
        along = float(between @ axes[0])
    else:
        along = float(np.cross(between, axes[1]) @ normal / (normal @ normal))
    return np.asarray(anchors[0] + along * axes[0])
