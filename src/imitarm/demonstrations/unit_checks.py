"""Checks of units: find time stamps that can't be in seconds and positions that can't be in metres.

Each remedy proposes the units that fit the numbers in the file, whatever unit they were read in.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imitarm.demonstrations.raw import Finding, RawDemonstration, ValidRows
from imitarm.demonstrations.reading import LENGTH_UNITS, TIME_UNITS

FARTHEST = 3.0  # [m] no arm reaches farther from its base
_TINY = 5e-3  # [m] motions smaller than this are rare
_NO_MOTION = 1e-4  # [m]
_EPOCH = 1e8  # [s] later times are dates (after 1973), not times since the start
_STEPS = (2e-4, 0.5)  # [s] between samples of usual recorders
_SHORTEST_STEP = 5e-5  # [s] no recorder is faster than 20 kHz


def check_stamps(raw: RawDemonstration) -> Iterator[Finding]:
    """Find time stamps that do not increase, are dates, or are in another unit than the one they were read in."""
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
    """Find positions that are in another unit than the one they were read in, and propose every unit that fits."""
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
    """Return the remedy that names the units that fit; an option can't replace a unit that the file states."""
    if not fits:
        return otherwise
    if kind in raw.units_in_file:
        stated = raw.length_unit if kind == "length" else raw.time_unit
        units = " or ".join(f"{name} ({effect})" for name, effect in fits)
        return f"the file states the unit {stated}; correct the unit in the file to {units}"
    return "read it with " + " or ".join(f'{option}="{name}" ({effect})' for name, effect in fits)
