"""LatencyLog: for each skeleton, the duration of each stage between person and robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import UnknownNameError
from imitarm.files.table import write_table

Array = NDArray[np.float64]

STAGES = {
    "expose": "from exposure to sending by the capture process",
    "arrive": "from sending to receipt by the retargeting process",
    "wait": "from receipt to the start of the next control step",
    "retarget": "from the start of the control step to the computed command",
    "send": "from the computed command to its sending",
    "robot": "from sending the command to its receipt by the robot process",
    "apply": "from receipt by the robot process to execution of the command",
    "total": "total, from exposure to execution of the command",
}
"""Processing stages of a skeleton, in order, with the interval that each stage covers.

If the processes run on two machines, a datagram's travel time is counted from that of the fastest datagram.
"""

_CHUNK = 1024


class LatencyLog:
    """A table of durations, with a row for each skeleton and a column for each stage; unmeasured durations are nan.

    Args:
        stages: names of the columns.

    Attributes:
        stages: names of the columns.
    """

    def __init__(self, stages: Sequence[str] = tuple(STAGES)) -> None:
        self.stages = tuple(stages)
        self._values = np.full((_CHUNK, len(self.stages)), np.nan)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def values(self) -> Array:
        """All durations, shape (n_frames, n_stages) [s]."""
        return self._values[: self._n]

    def add(self) -> int:
        """Add a row for a skeleton and return its index."""
        if self._n == len(self._values):
            self._values = np.vstack([self._values, np.full_like(self._values, np.nan)])
        self._n += 1
        return self._n - 1

    def record(self, frame: int, **seconds: float) -> None:
        """Store the durations of one or more stages of a skeleton.

        Args:
            frame: index of the row.
            **seconds: durations [s], one keyword for each stage.

        Raises:
            UnknownNameError: when there is no such stage.
        """
        for stage, value in seconds.items():
            if stage not in self.stages:
                raise UnknownNameError.among("stage", stage, self.stages)
            self._values[frame, self.stages.index(stage)] = value

    def statistics(self) -> list[tuple[str, int, float, float, float, float]]:
        """Return name, number of values, median, 95th and 99th percentile, and maximum [s] of each measured stage."""
        rows = []
        for stage, column in zip(self.stages, self.values.T, strict=True):
            known = column[np.isfinite(column)]
            if len(known):
                median, p95, p99 = np.percentile(known, (50.0, 95.0, 99.0)).tolist()
                rows.append((stage, len(known), median, p95, p99, float(known.max())))
        return rows

    def save(self, path: str | Path) -> None:
        """Write the log as a CSV table: the number of the skeleton, then the duration of each stage [s].

        Raises:
            InputError: when the file cannot be written.
        """
        table = np.column_stack([np.arange(self._n), self.values])
        write_table(path, {"format": "imitarm-latency", "units": "s"}, ("frame", *self.stages), table)
