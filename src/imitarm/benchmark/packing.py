"""Repeat the packing task with many seeds: pick a cube and put it into a moving box while a bottle is pushed about."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import OnDone, Store, Workers, run_experiments
from imitarm.benchmark.tables import Table
from imitarm.errors import FileFormatError, InputError
from imitarm.evaluation.intervals import wilson_interval
from imitarm.files.document import as_document
from imitarm.kinematics.arm import ArmModel
from imitarm.tasks.packing import PackingTask
from imitarm.tasks.packing_run import OBSERVERS, run_packing

_REMEDY = "delete the file and run the benchmark again"


@dataclass(frozen=True)
class PackingResult:
    """Result of one run.

    Attributes:
        seed: seed of the task.
        observer: how box and bottle were observed, a name in :data:`~imitarm.tasks.packing_run.OBSERVERS`.
        success: whether the cube is in the box and nothing was touched.
        reason: explanation.
        duration: duration of the run [s].
        clearance: smallest measured distance between the arm and the box or the bottle [m].
        avoiding: fraction of the steps in which the policy evaded something.
        code: version of the code.
    """

    seed: int
    observer: str
    success: bool
    reason: str
    duration: float
    clearance: float
    avoiding: float
    code: str


@dataclass(frozen=True)
class PackingStore(Store[tuple[str, int], PackingResult]):
    """Results in a file, one line of JSON for each run.

    Attributes:
        path: the file; None: results are not saved.
    """

    path: Path | None

    def known(self, experiments: Sequence[tuple[str, int]]) -> dict[tuple[str, int], PackingResult]:
        """Return the saved results of the running code; a last line without an end is left out.

        Raises:
            InputError: when the file can't be read.
            FileFormatError: when a line is not a result.
        """
        if self.path is None or not self.path.exists():
            return {}
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self.path}: can't be read as a file of results ({error})") from error
        found = {}
        for number, line in enumerate(text.split("\n")[:-1], 1):
            where = f"{self.path}, line {number}"
            try:
                result = as_document(json.loads(line), PackingResult, where, _REMEDY)
            except ValueError as error:
                raise FileFormatError(f"{where}: is not a result ({error}); {_REMEDY}") from error
            if result.code == code_version() and (result.observer, result.seed) in experiments:
                found[result.observer, result.seed] = result
        if text and not text.endswith("\n"):  # the last run was killed while it wrote
            self.path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
        return found

    def save(self, experiment: tuple[str, int], outcome: PackingResult) -> PackingResult:
        """Append a result to the file."""
        del experiment
        if self.path is not None:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write(json.dumps(asdict(outcome), allow_nan=False) + "\n")
        return outcome


def run_packings(
    count: int,
    *,
    first: int = 0,
    observer: str = "sensor",
    workers: Workers | None = None,
    out: Path | None = None,
    on_done: OnDone | None = None,
) -> list[PackingResult]:
    """Run the task with ``count`` seeds.

    Args:
        count: number of runs.
        first: the first seed.
        observer: how box and bottle are observed, a name in :data:`~imitarm.tasks.packing_run.OBSERVERS`.
        workers: processes that run the task.
        out: file in which results are saved, so that an interrupted benchmark continues; None: not saved.
        on_done: function called with the progress.

    Raises:
        InputError: when a number is out of range, or the observer or the file can't be used.
    """
    if count < 1 or first < 0:
        raise InputError(f"packing: count must be at least 1 and first at least 0, got {count} and {first}")
    experiments = [(observer, seed) for seed in range(first, first + count)]
    return run_experiments(experiments, run_one, PackingStore(out), workers, on_done=on_done)


def run_one(experiment: tuple[str, int]) -> PackingResult:
    """Run the task with one seed; a function for worker processes."""
    observer, seed = experiment
    done = run_packing(PackingTask(seed), arm=_arm(), observer=OBSERVERS[observer])
    statuses = done.details["statuses"]
    return PackingResult(
        seed,
        observer,
        done.success,
        done.reason,
        done.trajectory.duration,
        done.min_clearance,
        statuses.get("avoiding", 0) / max(sum(statuses.values()), 1),
        code_version(),
    )


@lru_cache(maxsize=1)
def _arm() -> ArmModel:
    return PackingTask.arm()


def packing_tables(results: Sequence[PackingResult]) -> list[Table]:
    """Return the rate of success with its interval, and a list of the failures."""
    n, done = len(results), sum(result.success for result in results)
    low, high = wilson_interval(done, n)
    median: Callable[[Sequence[float]], float] = partial(np.median)
    row = (
        results[0].observer,
        f"{done} of {n}",
        f"{100 * low:.1f} to {100 * high:.1f}",
        f"{median([result.duration for result in results]):.1f}",
        f"{1e3 * min(result.clearance for result in results):.1f}",
        f"{100 * float(np.mean([result.avoiding for result in results])):.0f}",
    )
    columns = ("observer", "success>", "95 % interval [%]>", "duration [s]>", "least clearance [mm]>", "avoiding [%]>")
    note = (
        "Success: the cube rests in the box, and the arm has touched neither box nor bottle. Duration: median. "
        "Avoiding: fraction of the control steps in which the policy evaded something."
    )
    tables = [Table("Pick a cube and put it into a moving box while a bottle is pushed about", columns, (row,), note)]
    failed = tuple((str(result.seed), result.reason) for result in results if not result.success)
    if failed:
        tables.append(Table("Failures", ("seed>", "reason"), failed))
    return tables
