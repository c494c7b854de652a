"""What lint says, and the view of a motion that its checks look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.raw import RawDemonstration

Array = NDArray[np.float64]
Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with demonstrations, or worth knowing before they are learnt from.

    Attributes:
        severity: ``"error"``: nothing good can be learnt; ``"warning"``: look at it; ``"note"``: for information.
        code: short name that stays the same from version to version, such as ``"gap"``.
        message: what is wrong, with figures.
        source: the demonstration concerned, empty when it is all of them.
        row: the first sample concerned, from 0; None when it is the whole.
        line: the line of that sample in the text file, from 1; None when the file is not text.
        remedy: what to do.
    """

    severity: Severity
    code: str
    message: str
    source: str = ""
    row: int | None = None
    line: int | None = None
    remedy: str = ""

    @property
    def place(self) -> str:
        """Where to look: ``line 12``, ``row 10`` or nothing."""
        if self.line is not None:
            return f"line {self.line}"
        return "" if self.row is None else f"row {self.row}"

    def __str__(self) -> str:
        place = ", ".join(part for part in (self.source, self.place) if part)
        return f"{self.severity} {self.code}: {place + ': ' if place else ''}{self.message}; {self.remedy}"


@dataclass(frozen=True, eq=False)
class Usable:
    """The rows of a raw demonstration that can be computed with: finite, and each later than the one before.

    Attributes:
        raw: where they are from.
        rows: their places in ``raw``, shape (n,).
        times: shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: of length one, shape (n, 4), or None.
        joints: shape (n, n_joints) [rad], or None.
    """

    raw: RawDemonstration
    rows: NDArray[np.int64]
    times: Array
    positions: Array
    quaternions: Array | None
    joints: Array | None

    @classmethod
    def of(cls, raw: RawDemonstration) -> Usable | None:
        """Choose the usable rows; None when fewer than 5 are left or there are no positions."""
        if raw.positions is None:
            return None
        bad = raw.not_finite() | raw.late()
        quaternions = raw.quaternions
        if quaternions is not None:
            quaternions = np.where(bad[:, None], 0.0, quaternions)
            length = np.linalg.norm(quaternions, axis=1)
            bad |= length < 0.1
            quaternions = quaternions / np.maximum(length, 0.1)[:, None]
        rows = np.flatnonzero(~bad)
        if len(rows) < 5:
            return None
        return cls(
            raw,
            rows,
            raw.times[rows] - raw.times[rows[0]],
            raw.positions[rows],
            None if quaternions is None else quaternions[rows],
            None if raw.joints is None else raw.joints[rows],
        )

    @property
    def duration(self) -> float:
        """From the first to the last usable row [s]."""
        return float(self.times[-1])

    def finding(self, severity: Severity, code: str, message: str, remedy: str, index: int | None = None) -> Finding:
        """Build a finding about sample ``index`` of the usable ones."""
        return found(self.raw, severity, code, message, remedy, None if index is None else int(self.rows[index]))


def found(
    raw: RawDemonstration, severity: Severity, code: str, message: str, remedy: str, row: int | None = None
) -> Finding:
    """Build a finding about ``row`` of a raw demonstration."""
    return Finding(severity, code, message, raw.source, row, None if row is None else raw.line(row), remedy)
