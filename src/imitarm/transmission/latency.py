"""LatencyLog: how long each stage takes on the way from a person to a robot, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import UnknownNameError
from imitarm.files.table import write_table

Array = NDArray[np.float64]

STAGES = {
    "expose": "exposure to sent by the capture process",
    "arrive": "sent to received",
    "wait": "received to taken by a control step",
    "retarget": "taken to command ready",
    "send": "command ready to sent to the robot",
    "robot": "sent to received by the robot",
    "apply": "received by the robot to applied",
    "total": "exposure to applied",
}
"""The stages a frame goes through, in order, and what each is. Between two machines the quickest way counts as none."""

_CHUNK = 1024


class LatencyLog:
    """One row a frame, one column a stage; what a frame did not go through, or was not measured, is nan.

    Args:
        stages: names of the columns.

    Attributes:
        stages: as given.
    """

    def __init__(self, stages: Sequence[str] = tuple(STAGES)) -> None:
        self.stages = tuple(stages)
        self._values = np.full((_CHUNK, len(self.stages)), np.nan)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def values(self) -> Array:
        """All that was noted, shape (n_frames, n_stages) [s]."""
        return self._values[: self._n]

    def begin(self) -> int:
        """Begin with a frame, and return its number."""
        if self._n == len(self._values):
            self._values = np.vstack([self._values, np.full_like(self._values, np.nan)])
        self._n += 1
        return self._n - 1

    def note(self, frame: int, **seconds: float) -> None:
        """Note how long stages of a frame have taken, by their names [s].

        Raises:
            UnknownNameError: when there is no such stage.
        """
        for stage, value in seconds.items():
            if stage not in self.stages:
                raise UnknownNameError.among("stage", stage, self.stages)
            self._values[frame, self.stages.index(stage)] = value

    def rows(self) -> list[tuple[str, int, float, float, float, float]]:
        """Return for each stage that was measured its name, how often, median, 95th, 99th percentile, largest [s]."""
        rows = []
        for stage, column in zip(self.stages, self.values.T, strict=True):
            known = column[np.isfinite(column)]
            if len(known):
                median, p95, p99 = np.percentile(known, (50.0, 95.0, 99.0)).tolist()
                rows.append((stage, len(known), median, p95, p99, float(known.max())))
        return rows

    def save(self, path: str | Path) -> None:
        """Write all of it as a table: the frame's number, then each stage [s].

        Raises:
            InputError: when it can't be written.
        """
        table = np.column_stack([np.arange(self._n), self.values])
        write_table(path, {"format": "imitarm-latency", "units": "s"}, ("frame", *self.stages), table)
