"""Speed against installed peers and yardsticks, measured in one run, as ratios: ``make bench``.

    python benchmarks/speed.py                  every row against its reference
    python benchmarks/speed.py --against DIR    every row against the same row in another checkout

A row times something of ours and a reference in turns (A, B, A, B, ...), so that whatever else the machine does slows
both, and compares them in pairs. The table prints the median ratio and its 95 % confidence interval. A row may also
evaluate the results: speed at the expense of accuracy does not count. Numerical libraries run with one thread.

With ``--against``, both checkouts run in processes of their own, also in turns. The rows of the other checkout are its
own, in ``benchmarks/``, so that they call what it has. CPU time is compared, except where a row starts processes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
if __name__ == "__main__" and any(os.environ.get(name) != "1" for name in THREADS):
    # the libraries read it when they are loaded, so begin again
    again = subprocess.run([sys.executable, *sys.argv], check=False, env=os.environ | dict.fromkeys(THREADS, "1"))
    sys.exit(again.returncode)

from checkouts import Change, compare_checkouts
from speed_rows import ROWS
from timing import Measurement, Row, duration, measure

_INSTALL = "pip install 'imitarm[bench]'"


def run(rows: Sequence[Callable[[], Row]] = ROWS) -> list[Measurement]:
    """Measure the rows; one whose peer is not installed says so."""
    measured = []
    for make in rows:
        try:
            row = make()
        except ImportError as error:
            summary, note = (make.__doc__ or make.__name__).splitlines()[0], f"{error}; {_INSTALL}"
            measured.append(Measurement(summary, float("nan"), float("nan"), "", None, "", None, note))
            continue
        measured.append(measure(row))
    return measured


def show(measured: Sequence[Measurement], console: Console) -> None:
    """Print the table of rows against their references."""
    table = Table(title="Speed: median ratio (95 % interval of the median)")
    for heading in ("what", "ours", "reference", "", "ratio", "target", "", "results"):
        table.add_column(heading, justify="right" if heading in {"ours", "reference"} else "left")
    for m in measured:
        ours, reference = ("" if np.isnan(seconds) else duration(seconds) for seconds in (m.ours, m.reference))
        ratio = "" if m.ratio is None else str(m.ratio)
        verdict = {True: "met", False: "MISSED", None: "not measured"}[m.passed]
        table.add_row(m.name, ours, reference, m.reference_name, ratio, m.target, verdict, m.note)
    console.print(table)


def show_changes(changes: Sequence[Change], console: Console) -> None:
    """Print the table of two checkouts."""
    table = Table(title="Time of this checkout over time of the other: median ratio (95 % interval of the median)")
    for heading in ("what", "before", "after", "after / before", "", ""):
        table.add_column(heading, justify="right" if heading in {"before", "after"} else "left")
    for c in changes:
        verdict = {True: "", False: "SLOWER", None: "not measured"}[c.passed]
        before, after = ("" if np.isnan(seconds) else duration(seconds) for seconds in (c.before, c.after))
        r = c.ratio
        ratio = "" if r is None else f"{r.median:.3f} ({r.low:.3f} to {r.high:.3f})"
        table.add_row(c.name, before, after, ratio, verdict, c.note)
    console.print(table)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print.

    Returns:
        0 when every target was met, 1 when one was missed (with ``--against``: when a row got slower, so that the whole
        interval of its ratio is above 1), 2 when one could not be measured.
    """
    names = [make.__name__ for make in ROWS]
    parser = argparse.ArgumentParser(description="speed against peers, as ratios")
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"rows to measure; default: all of {', '.join(names)}")
    parser.add_argument("--against", type=Path, metavar="DIR", help="another checkout, such as a git worktree")
    arguments = parser.parse_args(argv)
    unknown = sorted(set(arguments.rows) - set(names))
    if unknown:
        parser.error(f"no row {', '.join(unknown)}; there are {', '.join(names)}")
    if arguments.against is not None and not (arguments.against / "src" / "imitarm").is_dir():
        parser.error(f"--against {arguments.against}: there is no src/imitarm in it; name the folder of a checkout")
    console = Console(width=None if sys.stdout.isatty() else 220)
    rows = [make for make in ROWS if not arguments.rows or make.__name__ in arguments.rows]
    if arguments.against is None:
        measured = run(rows)
        show(measured, console)
        verdicts = [m.passed for m in measured]
    else:
        changes = compare_checkouts([make.__name__ for make in rows], arguments.against)
        show_changes(changes, console)
        verdicts = [c.passed for c in changes]
    return 1 if False in verdicts else 2 if None in verdicts else 0


if __name__ == "__main__":
    sys.exit(main())
