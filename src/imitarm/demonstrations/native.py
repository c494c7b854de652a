"""Reader of imitarm's own CSV, the one that ``Demonstration.save`` writes."""

from __future__ import annotations

import re
from dataclasses import replace

from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reader import Reader, ReadOptions
from imitarm.errors import InputError
from imitarm.trajectory import FORMAT, read_demonstration_table

_MARK = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s*[#%][^\n]*\n)*?\s*[#%]\s*format:\s*" + FORMAT.encode() + rb"\b")


class NativeReader(Reader):
    """imitarm's own CSV: remarks with units and frame, columns t x y z, a quaternion, joints by name."""

    name = "imitarm CSV"

    def recognises(self, head: bytes) -> bool:
        """Tell by the remark ``# format: imitarm-demonstration``."""
        return _MARK.match(head.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) is not None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the one demonstration of the file; rows are not judged."""
        table = read_demonstration_table(path)
        if options.units not in (None, "m") or options.time_units not in (None, "s"):
            raise InputError(f"{path}: is in m and s, as its header says; leave out units")
        names = table.names or ()
        n_pose = 8 if "qw" in names else 4
        raw = RawDemonstration(
            path,
            options.seconds(path, table.values[:, 0], "s"),
            table.values[:, 1:4],
            table.values[:, 4:8] if n_pose == 8 else None,
            table.values[:, n_pose:] if len(names) > n_pose else None,
            names[n_pose:],
            table.remarks.get("task", "") or options.task,
        )
        return [replace(raw, lines=table.lines)]
