"""Options and output that the benchmarks have in common: processes, tables, and documents that receive the tables."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from imitarm.benchmark.running import LOCAL, Outcome, Store, Work, Workers, run_experiments
from imitarm.benchmark.tables import Place, Table
from imitarm.cli.screen import progress_bar, say, show_table
from imitarm.errors import InputError


class Actions(argparse._SubParsersAction):  # type: ignore[type-arg]
    """The actions of a benchmark. An option before an action is an error, because the action would ignore the option.

    Use it as ``parser.add_subparsers(action=Actions)``.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Check the options before the action, then read the action."""
        given = [
            option.option_strings[0]
            for option in parser._actions
            if option.option_strings and getattr(namespace, option.dest, option.default) != option.default
        ]
        if given:
            raise InputError(
                f"{' '.join(given)}: an option before '{values[0]}' has no effect; leave it out, or write it after "
                f"'{values[0]}' if 'imitarm benchmark ... {values[0]} --help' lists it"
            )
        super().__call__(parser, namespace, values, option_string)


def add_saved(parser: argparse.ArgumentParser) -> None:
    """Add the two options that say which saved results are used; only one of them can be given."""
    saved = parser.add_mutually_exclusive_group()
    saved.add_argument("--fresh", action="store_true", help="ignore saved results and run all experiments again")
    saved.add_argument(
        "--reuse",
        action="store_true",
        help="use saved results of the same experiments even if another version of the code computed them",
    )


def scene_to_play(text: str, example: str) -> tuple[str, int, int]:
    """Return family, dimension and seed of a scene that ``--play`` names.

    Args:
        text: the argument of the option.
        example: a correct argument, for the message.

    Raises:
        InputError: when the text does not have this form.
    """
    try:
        family, dimension, seed = text.split(",")
        return family, int(dimension), int(seed)
    except ValueError as error:
        raise InputError(f"--play {text}: write family, dimension and seed, such as {example}") from error


def scenes_to_play(arguments: argparse.Namespace, example: str) -> list[tuple[str, int, int]]:
    """Return the scenes that ``--play`` names.

    Args:
        arguments: the parsed arguments ``play`` and ``report``.
        example: a correct argument, for the message.

    Raises:
        InputError: when a scene is not named correctly, or there is no report to draw it in.
    """
    if arguments.play and arguments.report is None:
        raise InputError("--play draws scenes in the page of --report; name this page with --report FILE")
    return [scene_to_play(text, example) for text in arguments.play]


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


@dataclass(frozen=True)
class Finished(Generic[Outcome]):
    """Results of the experiments of one command.

    Attributes:
        outcomes: all results, in the order of the experiments.
        kept: number of results that an earlier run had saved.
        seconds: duration of the run [s].
    """

    outcomes: list[Outcome]
    kept: int
    seconds: float

    @property
    def summary(self) -> str:
        """Number, duration and rate of the experiments, as one sentence."""
        ran = len(self.outcomes) - self.kept
        speed = 60.0 * ran / self.seconds
        return (
            f"{ran} experiments in {self.seconds:.0f} s: {speed:.0f} per minute; "
            f"{self.kept} results of earlier runs were used"
        )


def run_with_progress(
    name: str,
    wanted: Sequence[Work],
    run: Callable[[Work], Outcome],
    store: Store[Work, Outcome],
    workers: Workers,
    *,
    fresh: bool,
) -> Finished[Outcome]:
    """Run experiments with a progress bar; if ``fresh`` is False, saved results are reused.

    The bar is called ``name``. The other arguments are those of :func:`~imitarm.benchmark.running.run_experiments`.
    """
    began, kept = time.perf_counter(), [0]

    def on_done(done: int, of: int) -> None:
        if not bar.tasks:
            kept[0] = done
            bar.add_task(name, total=of)
        bar.update(bar.tasks[0].id, completed=done)

    with progress_bar() as bar:
        done = run_experiments(wanted, run, store, workers, fresh=fresh, on_done=on_done)
    return Finished(done, kept[0], time.perf_counter() - began)


def add_fill(parser: argparse.ArgumentParser) -> None:
    """Add the option that names a document into which the tables are written."""
    text = "put the tables into this document, between the lines '<!-- imitarm benchmark NAME -->' and '<!-- end -->'"
    parser.add_argument("--fill", type=Path, metavar="FILE", help=text)


def place_of(arguments: argparse.Namespace, benchmark: str) -> Place | None:
    """Check that the tables can be written into the document, and return its place; None if no document is given."""
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
    """Return the command line, without names of files that exist only on this machine."""
    words, places = (
        sys.argv[1:],
        {"--out", "--report", "--figure", "--fill", "--json", "--markdown", "--jobs", "--backend", "--scheduler"},
    )
    kept = [
        w
        for i, w in enumerate(words)
        if w not in places | {"--fresh", "--reuse", "--force"} and (i == 0 or words[i - 1] not in places)
    ]
    named = ["recordings" if i > 0 and kept[i - 1] == "--data" else Path(w).name for i, w in enumerate(kept)]
    return shlex.join(["imitarm", *named])
