"""Timing the same rows in two checkouts: a process for each, which times a block of calls when it is told to."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from timing import Ratio

HERE = Path(__file__).resolve().parents[1]
_PAIRS = 21
_FEW, _LONG = 7, 1.0  # pairs of a row of which a measurement takes this long [s]

# Runs in the checkout's own process, with only the checkout's code in its path. It answers each line that it reads.
# Rows that time themselves read `perf_counter` too; the time of the CPU leaves out what other processes take of it.
_WORKER = """
import importlib, json, sys, time
time.perf_counter = time.process_time
answers, sys.stdout = sys.stdout, sys.stderr
rows = {make.__name__: make for make in importlib.import_module(sys.argv[1]).ROWS}

def seconds(row, block):
    if row.self_timed:
        return float(row.ours())
    begin = time.perf_counter()
    for _ in range(block):
        row.ours()
    return (time.perf_counter() - begin) / block

for line in sys.stdin:
    ask = json.loads(line)
    try:
        if "row" in ask:
            row, block = rows[ask["row"]](), 1
            seconds(row, 1)
            while not row.self_timed and seconds(row, block) * block < 5e-3:
                block *= 2
            answer = {"name": row.name}
        else:
            answer = {"seconds": seconds(row, block)}
    except Exception as error:
        answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), file=answers, flush=True)
"""


@dataclass(frozen=True)
class Change:
    """How the time of a row differs between two checkouts.

    Attributes:
        name: name of the row.
        before: median CPU time in the other checkout [s]; nan when it could not be measured.
        after: median CPU time in this checkout [s]; nan when it could not be measured.
        ratio: after over before; None when it could not be measured.
        passed: False when the whole interval of the ratio is above 1; None when it could not be measured.
        note: why it could not be measured.
    """

    name: str
    before: float
    after: float
    ratio: Ratio | None
    passed: bool | None
    note: str = ""


class Checkout:
    """A process that runs the rows of a checkout with the checkout's code.

    Args:
        folder: folder of the checkout.
    """

    def __init__(self, folder: Path) -> None:
        own = folder / "benchmarks"
        # before there was a folder benchmarks, the rows were part of the package
        module = "speed_rows" if own.is_dir() else "imitarm.benchmark.speed_rows"
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(own), str(folder / "src")])}
        self._process = subprocess.Popen(
            [sys.executable, "-c", _WORKER, module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=folder,
        )

    def __enter__(self) -> Checkout:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(BrokenPipeError), self._process:
            pass  # closes the pipes, which ends the process, and waits

    def prepare(self, row: str) -> str:
        """Make a row and warm it up; return its name.

        Raises:
            RuntimeError: when this checkout does not have the row, or it fails.
        """
        return str(self._ask(row=row)["name"])

    def seconds(self) -> float:
        """Return how much CPU time a call of the prepared row takes [s]."""
        return float(self._ask()["seconds"])

    def _ask(self, **question: str) -> dict[str, Any]:
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(question) + "\n")
            process.stdin.flush()
        except BrokenPipeError as error:
            raise RuntimeError("the process of this checkout has ended; see its error above") from error
        line = process.stdout.readline()
        if not line:
            raise RuntimeError("the process of this checkout has ended; see its error above")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer


def compare_checkouts(rows: Sequence[str], other: Path, *, this: Path = HERE, pairs: int = _PAIRS) -> list[Change]:
    """Time rows in two checkouts in turns.

    Args:
        rows: names of the functions that make them.
        other: folder of the other checkout: before.
        this: folder of this checkout: after.
        pairs: measurements of each row in each checkout; fewer where one takes more than a second.
    """
    with Checkout(other.resolve()) as before, Checkout(this) as after:
        return [_compare(row, before, after, pairs) for row in rows]


def _compare(row: str, before: Checkout, after: Checkout, pairs: int) -> Change:
    try:
        name = after.prepare(row)
    except RuntimeError as error:
        return Change(row, float("nan"), float("nan"), None, None, f"in this checkout: {error}")
    try:
        before.prepare(row)
        begin = time.perf_counter()
        times = [(before.seconds(), after.seconds())]
        n = pairs if time.perf_counter() - begin < 2.0 * _LONG else min(pairs, _FEW)
        times += [(before.seconds(), after.seconds()) for _ in range(n - 1)]
    except RuntimeError as error:
        return Change(name, float("nan"), float("nan"), None, None, f"in the other checkout: {error}")
    earlier, later = zip(*times, strict=True)
    ratio = Ratio.of(later, earlier)
    return Change(name, float(np.median(earlier)), float(np.median(later)), ratio, ratio.low <= 1.0)
