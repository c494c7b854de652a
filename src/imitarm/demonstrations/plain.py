"""Reader of plain text tables: x y z with or without time, quaternion, joints and column names."""

from __future__ import annotations

from dataclasses import replace

from imitarm.demonstrations.columns import named_columns, unnamed_columns
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reader import Reader, ReadOptions
from imitarm.files.table import kind_of, read_table


class PlainReader(Reader):
    """Any text table of numbers, set apart by comma, semicolon, tab or blanks.

    With names the columns may stand in any order; without, their number says what they are. A remark
    ``# units: cm`` before the numbers, or a name such as ``x [cm]``, gives the unit.
    """

    name = "plain table"

    def recognises(self, head: bytes) -> bool:
        """Take all that is text."""
        return kind_of(head) is None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the one motion of the file."""
        table = read_table(path)
        units = next(iter(table.remarks.get("units", "").replace(",", " ").split()), None)
        if table.names is None:
            raw = unnamed_columns(path, table.values, options, units=units)
        else:
            raw = named_columns(path, table.names, table.values, options, units=units)
        return [replace(raw, lines=table.lines, task=table.remarks.get("task", "") or raw.task)]
