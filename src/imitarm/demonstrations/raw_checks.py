"""Checks of what a file says before anything is computed with it: numbers, time stamps, quaternions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imitarm.demonstrations.finding import Finding, found
from imitarm.demonstrations.raw import RawDemonstration

_EPOCH = 1e8  # [s] later than this is a date (1973), not a time since the start
_FEW = 20  # samples


def check_rows(raw: RawDemonstration) -> Iterator[Finding]:
    """Find numbers that are not finite and recordings with hardly any samples."""
    broken = np.flatnonzero(raw.not_finite())
    if len(broken):
        yield found(
            raw,
            "error",
            "not-finite",
            f"{len(broken)} of {len(raw)} rows hold nan or inf",
            "mend the file, or read it with repair=True to drop those rows",
            int(broken[0]),
        )
    if len(raw) < _FEW:
        yield found(
            raw,
            "warning",
            "few-samples",
            f"only {len(raw)} samples",
            f"record at 50 Hz or faster, {_FEW} samples or more",
        )


def check_stamps(raw: RawDemonstration) -> Iterator[Finding]:
    """Find time stamps that go back or stand, that are dates, or that are no seconds."""
    late = np.flatnonzero(raw.late())
    if len(late):
        row = int(late[0])
        yield found(
            raw,
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
        yield found(
            raw,
            "note",
            "epoch-stamps",
            f"time stamps are dates ({times[0]:.0f} s), not seconds since the start",
            "nothing: align subtracts the first",
            0,
        )
    step = float(np.median(np.diff(np.sort(times))))
    if step > 0.5:
        unit = next((name for name, limit in (("ms", 500.0), ("us", 5e5)) if step <= limit), "ns")
        yield found(
            raw,
            "error",
            "time-units",
            f"samples are {step:.4g} s apart, {(times[-1] - times[0]) / 60:.4g} min in all: these are hardly seconds",
            f"read it with time_units={unit!r}, or with the right duration or rate",
        )


def check_quaternions(raw: RawDemonstration) -> Iterator[Finding]:
    """Find quaternions that are none, that are not of length one, and signs that flip."""
    if raw.quaternions is None:
        return
    q = np.where(raw.not_finite()[:, None], np.nan, raw.quaternions)
    length = np.nan_to_num(np.linalg.norm(q, axis=1), nan=1.0)
    off = np.abs(length - 1.0)
    worst = int(np.argmax(off))
    if off[worst] > 0.05:
        first = int(np.flatnonzero(off > 0.05)[0])
        yield found(
            raw,
            "error",
            "no-rotation",
            f"{int(np.sum(off > 0.05))} quaternions are none; the first has length {length[first]:.3g}",
            "check which columns hold the quaternion",
            first,
        )
    elif off[worst] > 0.005:
        yield found(
            raw,
            "warning",
            "quaternion-length",
            f"quaternions have length {length.min():.4f} to {length.max():.4f}; they are scaled to 1 when read",
            "write them with more digits",
            worst,
        )
    flips = np.flatnonzero(np.sum(q[1:] * q[:-1], axis=1) < 0.0) + 1
    if len(flips):
        yield found(
            raw,
            "note",
            "quaternion-flips",
            f"{len(flips)} times the quaternion's sign flips (the same rotation)",
            "nothing: signs are made continuous when read",
            int(flips[0]),
        )


def check_notes(raw: RawDemonstration) -> Iterator[Finding]:
    """Pass on what the reader left out."""
    for note in raw.notes:
        yield found(raw, "note", "not-used", note, "nothing, unless they matter to you")


RAW_CHECKS = (check_rows, check_stamps, check_quaternions, check_notes)
