"""RecordingIssue: one thing that is wrong with a recording of a person; and which unit its numbers fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

PLAUSIBLE_RATE = (10.0, 120.0)  # [Hz] frame rates of skeleton cameras
PLAUSIBLE_LIMB = (0.15, 0.45)  # [m] upper arms and forearms of adults, with margin

_TIME_UNITS = {"ns": 1e-9, "100 ns": 1e-7, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0}  # [s]
_LENGTH_UNITS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "dm": 0.1, "feet": 0.3048}  # [m]


@dataclass(frozen=True)
class RecordingIssue:
    """One thing that is wrong with a recording of a person, or worth knowing before a robot follows it.

    Attributes:
        severity: ``"error"``: no robot can follow this recording as it is; ``"warning"``: look at it; ``"note"``: for
            information.
        code: short name that stays the same from version to version, such as ``"gap"``.
        message: what is wrong, with figures.
        frame: the first frame concerned, counted from 0; None when the whole recording is concerned.
        time: time of that frame since the first one [s].
        remedy: what to do.
    """

    severity: Severity
    code: str
    message: str
    frame: int | None = None
    time: float | None = None
    remedy: str = ""

    @property
    def place(self) -> str:
        """Where to look: ``frame 12 (0.40 s)``, or nothing."""
        if self.frame is None:
            return ""
        return f"frame {self.frame}" + ("" if self.time is None else f" ({self.time:.2f} s)")

    def __str__(self) -> str:
        place = f"{self.place}: " if self.frame is not None else ""
        return f"{self.severity} {self.code}: {place}{self.message}" + (f"; {self.remedy}" if self.remedy else "")


def time_unit_that_fits(rate: float, unit: float) -> tuple[str, float] | None:
    """Return the unit in which time stamps give a plausible frame rate.

    Args:
        rate: frame rate when the stamps are read in ``unit`` [Hz].
        unit: the unit in which the stamps were read [s].

    Returns:
        the unit's name, and its length over that of ``unit``: what the times must be multiplied by. None when no
        other unit fits.
    """
    low, high = PLAUSIBLE_RATE
    fits = [
        (abs(math.log(rate * unit / (30.0 * other))), name, other / unit)
        for name, other in _TIME_UNITS.items()
        if low <= rate * unit / other <= high and not math.isclose(other, unit)
    ]
    return min(fits)[1:] if fits and rate > 0.0 else None


def length_unit_that_fits(limb: float) -> str | None:
    """Return the unit in which the length of a limb is that of a person's, None when no unit fits.

    Args:
        limb: length of an upper arm or a forearm, as read; in metres it is not plausible.
    """
    low, high = PLAUSIBLE_LIMB
    fits = [name for name, unit in _LENGTH_UNITS.items() if low <= limb * unit <= high]
    return fits[0] if fits else None
