"""RecordingIssue: one fault found in a recording of a person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class RecordingIssue:
    """One fault of a recording of a person, or one fact that a user should know before a robot follows the recording.

    Attributes:
        severity: ``"error"``: no robot can follow this recording as it is; ``"warning"``: a user should inspect the
            recording at this place; ``"note"``: information that requires no action.
        code: short name that does not change between versions, such as ``"gap"``.
        message: description of the fault, with figures.
        frame: first affected frame, counted from 0; None when the whole recording is affected.
        time: time of the first affected frame, counted from the first frame [s].
        remedy: what the user can do about the issue.
    """

    severity: Severity
    code: str
    message: str
    frame: int | None = None
    time: float | None = None
    remedy: str = ""

    @property
    def place(self) -> str:
        """Place of the issue, for example ``frame 12 (0.40 s)``; empty when the whole recording is affected."""
        if self.frame is None:
            return ""
        return f"frame {self.frame}" + ("" if self.time is None else f" ({self.time:.2f} s)")

    def __str__(self) -> str:
        place = f"{self.place}: " if self.frame is not None else ""
        return f"{self.severity} {self.code}: {place}{self.message}" + (f"; {self.remedy}" if self.remedy else "")
