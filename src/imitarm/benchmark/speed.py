"""Speed against installed peers, measured in one run, as ratios: ``make bench``.

Each row times something of ours and the same job in a peer, in turns (ours, peer, ours, peer, ...), so that whatever
else the machine does hits both, and compares medians. A row may also look at the results: speed that is bought with
accuracy doesn't count. One numerical thread each.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from imitarm.benchmark.speed_rows import ROWS, THREADS
from imitarm.benchmark.timing import Measurement, Row, duration, measure

_INSTALL = "pip install 'imitarm[bench]'"


def run(rows: Sequence[Callable[[], Row]] = ROWS) -> list[Measurement]:
    """Measure all rows; one whose peer is not installed says so."""
    measured = []
    for make in rows:
        try:
            row = make()
        except ImportError as error:
            summary = (make.__doc__ or make.__name__).splitlines()[0]
            note = f"{error}; {_INSTALL}"
            measured.append(Measurement(summary, float("nan"), float("nan"), "", "", None, note))
            continue
        measured.append(measure(row))
    return measured


def show(measured: Sequence[Measurement], console: Console) -> None:
    """Print the table."""
    table = Table(title="Speed (medians; ratio = how many times faster than the peer)")
    for heading in ("what", "ours", "peer", "", "ratio", "target", "", "results"):
        table.add_column(heading, justify="right" if heading in {"ours", "ratio"} else "left")
    for m in measured:
        verdict = {True: "met", False: "MISSED", None: "not measured"}[m.passed]
        ours = "" if np.isnan(m.ours) else duration(m.ours)
        peer, ratio = ("", "") if np.isnan(m.peer) else (duration(m.peer), f"{m.ratio:.1f} x")
        table.add_row(m.name, ours, peer, m.peer_name, ratio, m.target, verdict, m.note)
    console.print(table)


def main() -> int:
    """Measure and print; 0 when every target was met, 1 when one was missed, 2 when one could not be measured."""
    measured = run()
    show(measured, Console(width=None if sys.stdout.isatty() else 200))
    verdicts = [m.passed for m in measured]
    return 1 if False in verdicts else 2 if None in verdicts else 0


if __name__ == "__main__":
    if any(os.environ.get(name) != "1" for name in THREADS):  # read when NumPy is loaded, so begin again
        again = subprocess.run(
            [sys.executable, "-m", "imitarm.benchmark.speed"],
            check=False,
            env={**os.environ, **dict.fromkeys(THREADS, "1")},
        )
        sys.exit(again.returncode)
    sys.exit(main())
