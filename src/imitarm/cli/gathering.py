"""Taking skeletons from a source while showing how it goes, and printing what was found in them."""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Callable, Sequence

from imitarm.capture.issue import SEVERITIES, RecordingIssue
from imitarm.capture.skeleton import SIDES, Skeleton, SkeletonSource
from imitarm.capture.sources import WORDS
from imitarm.cli.screen import progress_bar, remark, say, show_table

COLOURS = {"error": "red", "warning": "yellow", "note": ""}
_WAIT = 0.2  # [s] between two looks at a source that is silent


def source_help() -> str:
    """Return what a source may be called, for ``--help``."""
    return "; ".join(f"{word}: {what}" for word, what in WORDS.items())


def add_side_and_person(parser: argparse.ArgumentParser) -> None:
    """Add whose arm, and which."""
    parser.add_argument("--side", choices=SIDES, default="right", help="the person's arm; default: right")
    parser.add_argument(
        "--person", type=int, metavar="N", help="of several, as the source counts them; default: the first who is seen"
    )


def gather(
    source: SkeletonSource,
    seconds: float | None,
    what: str,
    *,
    live: bool,
    total: float | None = None,
    on_skeleton: Callable[[Skeleton], None] | None = None,
) -> tuple[list[Skeleton], bool]:
    """Take skeletons until the source is over, the time is up, or the user stops it.

    Args:
        source: where from.
        seconds: how long, by the clock when live, else by the skeletons' times; None: to the end.
        what: is going on, for the progress bar.
        live: whether the source goes on until it is stopped.
        total: how long it will take, where that is known without ``seconds`` [s].
        on_skeleton: is told of each.

    Returns:
        what came, and whether the user stopped it.
    """
    taken: list[Skeleton] = []
    began = clock.monotonic()
    expected = total if seconds is None else seconds
    stopped = False
    progress = progress_bar()
    progress.disable = not progress.console.is_terminal
    with progress:
        task = progress.add_task(what, total=expected)
        try:
            while not source.over:
                skeleton = source.read(_WAIT)
                done = clock.monotonic() - began
                if skeleton is not None:
                    if not live:
                        done = skeleton.time - (taken[0].time if taken else skeleton.time)
                    if seconds is None or done <= seconds:
                        taken.append(skeleton)
                        if on_skeleton is not None:
                            on_skeleton(skeleton)
                if seconds is not None and done > seconds:
                    break
                waiting = live and not taken
                progress.update(
                    task,
                    completed=done if expected is not None else None,
                    description=f"{what}: waiting for a person" if waiting else f"{what}: {len(taken)} frames",
                )
        except KeyboardInterrupt:
            stopped = True
            remark(f"stopped; {len(taken)} frames are kept")
    return taken, stopped


def show_findings(findings: Sequence[RecordingIssue]) -> None:
    """Print the findings as a table, and how many there are of each kind."""
    if findings:
        show_table(
            ["", "place", "code", "finding", "remedy"],
            [(f.severity, f.place, f.code, f.message, f.remedy) for f in findings],
            styles=[COLOURS[f.severity] for f in findings],
        )
    counts = [(sum(f.severity == severity for f in findings), severity) for severity in SEVERITIES]
    say(", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts))
