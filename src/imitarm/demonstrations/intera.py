"""Reader of Intera joint recordings: what ``joint_recorder.py`` of Rethink's SDK writes on a Sawyer.

The first line is ``time,right_j0,...,right_j6,right_gripper``, or the same without a gripper and with a comma at the
end of every line. Times are seconds since the recorder began, angles are rad. There are no positions: they follow
from the arm.
"""

from __future__ import annotations

import re
from dataclasses import replace

from imitarm.demonstrations.columns import named_columns
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reader import Reader, ReadOptions
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import read_table

_HEADING = re.compile(rb"(?:\xef\xbb\xbf)?\s*time,(?:[a-z_]+,)*(?:left|right)_j\d", re.IGNORECASE)
_LIMB = re.compile(r"(left|right)_j\d+")


class InteraReader(Reader):
    """Joint angles over time, as recorded with Rethink's Intera SDK."""

    name = "Intera joint recording"

    def recognises(self, head: bytes) -> bool:
        """Tell by the column names, ``time`` and then joints such as ``right_j0``."""
        return _HEADING.match(head) is not None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the one motion of the file: joints, no positions."""
        if options.units is not None:
            raise InputError(f"{path}: holds joint angles, no lengths; leave out units")
        table = read_table(path)
        if table.names is None:
            raise FileFormatError(f"{path}: the first line must name the columns, time,right_j0,...; mend it")
        limbs = {match[1] for name in table.names if (match := _LIMB.fullmatch(name))}
        if len(limbs) > 1:
            raise FileFormatError(f"{path}: holds joints of two limbs, left and right; keep the columns of one")
        return [replace(named_columns(path, table.names, table.values, options), lines=table.lines)]
