"""Options and output that the benchmarks have in common: processes, tables, and documents to fill."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from imitarm.benchmark.running import LOCAL, Workers
from imitarm.benchmark.tables import Place, Table
from imitarm.cli.screen import say, show_table
from imitarm.errors import InputError


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which processes run the experiments."""
    parser.add_argument("--jobs", type=int, metavar="N", help="number of processes; default: one for each processor")
    parser.add_argument(
        "--backend",
        default=LOCAL,
        metavar="NAME",
        help="loky (processes of this machine), dask (with --scheduler), or another backend of joblib",
    )
    parser.add_argument(
        "--scheduler", default="", metavar="ADDRESS", help="Dask scheduler whose workers run the experiments"
    )


def workers_of(arguments: argparse.Namespace) -> Workers:
    """Return the processes that the options ask for.

    Raises:
        InputError: when an option is wrong.
    """
    if arguments.jobs is not None and arguments.jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {arguments.jobs}")
    return Workers(arguments.jobs, arguments.backend, arguments.scheduler)


def add_fill(parser: argparse.ArgumentParser) -> None:
    """Add the option that names a document to fill with tables."""
    text = "put the tables into this document, between the lines '<!-- imitarm benchmark NAME -->' and '<!-- end -->'"
    parser.add_argument("--fill", type=Path, metavar="FILE", help=text)


def place_of(arguments: argparse.Namespace, benchmark: str) -> Place | None:
    """Return the document to fill with tables, after checking that it can be filled; None if no document is given."""
    return None if arguments.fill is None else Place(arguments.fill, benchmark)


def report_tables(found: Sequence[Table], place: Place | None, versions: Sequence[str]) -> None:
    """Print tables, and put them into a document."""
    for table in found:
        show_table(table.columns, table.rows, title=table.title)
        if table.note:
            say(table.note)
        say("")
    if place is not None:
        place.fill(found, command_line(), versions)
        say(f"filled {place.document}")


def command_line() -> str:
    """Return the command line without file names that apply only to this machine."""
    words, places = (
        sys.argv[1:],
        {"--out", "--report", "--fill", "--json", "--markdown", "--jobs", "--backend", "--scheduler"},
    )
    kept = [
        w
        for i, w in enumerate(words)
        if w not in places | {"--fresh", "--reuse"} and (i == 0 or words[i - 1] not in places)
    ]
    named = ["recordings" if i > 0 and kept[i - 1] == "--data" else Path(w).name for i, w in enumerate(kept)]
    return shlex.join(["imitarm", *named])
