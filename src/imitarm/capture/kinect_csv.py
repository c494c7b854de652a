"""Reader of skeletons as programs on the Kinect for Windows SDK write them: a table without a header."""

from __future__ import annotations

import numpy as np

from imitarm.capture.finding import Finding
from imitarm.capture.native import assembled
from imitarm.capture.skeleton import JOINTS, Skeleton
from imitarm.errors import FileFormatError
from imitarm.files.table import parse_table

TICK = 1e-7  # [s] of the SDK's TimeSpan
COLUMNS = 1 + 4 * len(JOINTS)


def read(path: str, content: bytes) -> tuple[list[Skeleton], list[Finding], str]:
    """Read a table of 101 columns: time in ticks of 100 ns, then x, y, z [m] and state of 25 joints in SDK order.

    Time counts from the first frame. Such a file tells neither persons nor the states of hands. A comma at the end of
    a line is accepted.

    Args:
        path: for messages.
        content: of the file.

    Returns:
        the skeletons, what is worth knowing about the file, and where the skeletons were from.

    Raises:
        FileFormatError: when the file is another table, was cut off, or a value is none; the message names file and
            line.
    """
    table = parse_table(path, content)
    n, columns = table.values.shape
    if columns != COLUMNS:
        raise FileFormatError(
            f"{path}, line {int(table.lines[0])}: {columns} columns; a recording of skeletons is imitarm's own, which "
            f"begins with '# format: imitarm-skeletons', or a Kinect SDK table of {COLUMNS} columns (time, then x, y, "
            "z and state of 25 joints); export it as one of these"
        )
    ticks = table.values[:, 0]
    skeletons, findings = assembled(table, (ticks - ticks[0]) * TICK, table.values[:, 1:].reshape(n, len(JOINTS), 4))
    if np.isfinite(ticks).all() and n > 1 and abs(float(ticks[-1] - ticks[0])) * TICK / (n - 1) < 1e-3:
        raise FileFormatError(
            f"{path}: {n} frames within {abs(float(ticks[-1] - ticks[0])) * TICK:.3g} s; its times are not in units of "
            "100 ns as the Kinect SDK has them; multiply seconds by 10 000 000"
        )
    return skeletons, findings, "Kinect SDK"
