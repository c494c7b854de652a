"""How often four cubes are stacked: made-up people in the loop, every method, a camera of a given noise.

``python -m imitarm.benchmark.stacking --people 10 --repeats 5 --sigma 12`` prints rates with 95 % intervals.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from imitarm.benchmark.avoidance import wilson_interval
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.retarget import RETARGETERS
from imitarm.tasks.stack_trial import SIGMA, StackResult, stack_once

Trial = tuple[str, int, int, float]
"""Method, seed of the person, which repeat, sigma of the camera [m]."""


def run_trial(trial: Trial) -> StackResult:
    """Run one trial; what :func:`~imitarm.tasks.stack_trial.stack_once` needs, as plain values."""
    method, person, repeat, sigma = trial
    return stack_once(person, repeat, RETARGETERS[method], camera=partial(SkeletonCamera, sigma=sigma))


def summary(method: str, results: Sequence[StackResult]) -> list[str]:
    """Return one row of the table: method, rate, interval, median time and path of the successes, failures by class."""
    done = [result for result in results if result.success]
    low, high = wilson_interval(len(done), len(results))
    failures = Counter(result.failure for result in results if not result.success)
    return [
        method,
        f"{len(done)} of {len(results)}",
        f"{100 * low:.0f} to {100 * high:.0f}",
        f"{np.median([result.time for result in done]):.0f}" if done else "-",
        f"{np.median([result.path_length for result in done]):.2f}" if done else "-",
        ", ".join(f"{n} {what}" for what, n in failures.most_common()) or "none",
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Run all trials side by side and print the table."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.benchmark.stacking", description=__doc__)
    parser.add_argument("--people", type=int, default=10, help="made-up people (default 10)")
    parser.add_argument("--repeats", type=int, default=5, help="trials of each (default 5)")
    parser.add_argument(
        "--sigma", type=float, default=1e3 * SIGMA, help=f"of the camera's noise [mm] (default {1e3 * SIGMA:g})"
    )
    parser.add_argument("--methods", nargs="+", choices=RETARGETERS, default=list(RETARGETERS))
    arguments = parser.parse_args(argv)
    if arguments.people < 1 or arguments.repeats < 1:
        parser.error("--people and --repeats must be at least 1")
    trials: list[Trial] = [
        (method, person, repeat, 1e-3 * arguments.sigma)
        for method in arguments.methods
        for person in range(arguments.people)
        for repeat in range(arguments.repeats)
    ]
    console = Console(width=None if sys.stdout.isatty() else 160)
    with multiprocessing.get_context("spawn").Pool(min(os.cpu_count() or 1, len(trials))) as pool:
        results = list(track(pool.imap(run_trial, trials), "stacking", len(trials), console=console, transient=True))
    table = Table(title=f"{arguments.people} people x {arguments.repeats} trials, camera sigma {arguments.sigma:g} mm")
    for heading in ("method", "stacked", "95 % [%]", "time [s]", "path [m]", "failures"):
        table.add_column(heading)
    for method in arguments.methods:
        table.add_row(*summary(method, [r for r, t in zip(results, trials, strict=True) if t[0] == method]))
    console.print(table)
    console.print("time and path are medians over the trials that succeeded")
    return 0


if __name__ == "__main__":
    sys.exit(main())
