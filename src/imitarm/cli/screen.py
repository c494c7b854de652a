"""Terminal output of commands: results go to stdout, progress and remarks go to stderr."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.status import Status
from rich.table import Table

_WIDTH_IN_FILES = 160  # columns when the output is not a terminal, so that paths are not broken
_LONG = 2.0  # [s] a progress bar appears after this time


def _console(stream: TextIO) -> Console:
    fixed = not stream.isatty() and "COLUMNS" not in os.environ
    # without markup, because rich would take "[2]" in "pouring.npy[2]" for a style
    return Console(file=stream, width=_WIDTH_IN_FILES if fixed else None, markup=False, emoji=False, highlight=False)


def say(*lines: str) -> None:
    """Print lines to stdout."""
    for line in lines:
        _console(sys.stdout).print(line, soft_wrap=True)  # do not break paths


def remark(line: str) -> None:
    """Print a line to stderr."""
    _console(sys.stderr).print(line, soft_wrap=True)


def show_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "", styles: Iterable[str] = ()
) -> None:
    """Print a table to stdout.

    Args:
        columns: headings; a column whose heading ends in ``>`` is right-aligned.
        rows: the cells.
        title: title above the table.
        styles: one colour for each row; if empty, rows have no colours.
    """
    table = Table(title=title or None, title_justify="left", header_style="bold")
    for column in columns:
        table.add_column(column.removesuffix(">"), justify="right" if column.endswith(">") else "left", overflow="fold")
    colours = list(styles)
    for i, row in enumerate(rows):
        table.add_row(*row, style=colours[i] if colours else None)
    _console(sys.stdout).print(table)


def working(what: str) -> Status:
    """Show an activity indicator while the ``with`` block runs, if stderr is a terminal."""
    return _console(sys.stderr).status(what)


def progress_bar() -> Progress:
    """Show a progress bar and the remaining time while the ``with`` block runs."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(*columns, console=_console(sys.stderr), transient=True)


@contextmanager
def watched(what: str, fraction: Callable[[], float]) -> Iterator[None]:
    """Show a progress bar for the work in the ``with`` block; the bar appears 2 s after the start of the work.

    Args:
        what: description of the work.
        fraction: function that returns the finished fraction of the work, 0 to 1; another thread calls it five times
            per second.
    """
    over = threading.Event()

    def watch() -> None:
        if over.wait(_LONG):
            return
        with progress_bar() as progress:
            task = progress.add_task(what, total=1.0)
            while not over.wait(0.2):
                progress.update(task, completed=min(max(fraction(), 0.0), 1.0))

    watcher = threading.Thread(target=watch, daemon=True, name=what)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
