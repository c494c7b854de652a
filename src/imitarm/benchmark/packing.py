"""Repeat the packing task with many seeds: pick a cube and put it into a moving box while a bottle is pushed about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.result_lines import ResultFormat
from imitarm.benchmark.running import OnDone, Workers, run_experiments
from imitarm.benchmark.tables import Table
from imitarm.errors import InputError
from imitarm.evaluation.intervals import wilson_interval
from imitarm.kinematics.arm import ArmModel
from imitarm.tasks.packing import PackingTask
from imitarm.tasks.packing_run import OBSERVERS, run_packing


@dataclass(frozen=True)
class PackingExperiment:
    """One run of the task.

    Attributes:
        method: how box and bottle are observed, a name in :data:`~imitarm.tasks.packing_run.OBSERVERS`.
        seed: seed of the task.
    """

    method: str
    seed: int


@dataclass(frozen=True, eq=False)
class PackingResult:
    """Result of one run.

    Attributes:
        experiment: the run.
        code: version of the code.
        outcome: ``"packed"`` if the cube is in the box and nothing was touched, otherwise ``"failed"``.
        reason: explanation.
        values: ``duration`` of the run [s]; ``clearance``, the smallest measured distance of the arm from box and
            bottle [m]; ``avoiding``, the fraction of the steps in which the policy evaded something.
    """

    experiment: PackingExperiment
    code: str
    outcome: str
    reason: str
    values: Mapping[str, float]

    @property
    def success(self) -> bool:
        """Whether the cube is in the box and nothing was touched."""
        return self.outcome == "packed"


RESULTS = ResultFormat("imitarm-packing-result 1", PackingExperiment, PackingResult, "imitarm benchmark packing")
"""How results are written and read."""


def run_packings(
    count: int,
    *,
    first: int = 0,
    observer: str = "sensor",
    workers: Workers | None = None,
    out: Path,
    on_done: OnDone | None = None,
) -> list[PackingResult]:
    """Run the task with ``count`` seeds.

    Args:
        count: number of runs.
        first: the first seed.
        observer: how box and bottle are observed, a name in :data:`~imitarm.tasks.packing_run.OBSERVERS`.
        workers: processes that run the task.
        out: folder in which results are saved, so that an interrupted benchmark continues.
        on_done: function called with the progress.

    Raises:
        InputError: when a number is out of range, or the folder can't be used.
    """
    if count < 1 or first < 0:
        raise InputError(f"packing: count must be at least 1 and first at least 0, got {count} and {first}")
    experiments = [PackingExperiment(observer, seed) for seed in range(first, first + count)]
    return run_experiments(experiments, run_one, RESULTS.store(out), workers, on_done=on_done)


def run_one(experiment: PackingExperiment) -> PackingResult:
    """Run the task with one seed; a function for worker processes."""
    done = run_packing(PackingTask(experiment.seed), arm=_arm(), observer=OBSERVERS[experiment.method])
    statuses = done.details["statuses"]
    values = {
        "duration": done.trajectory.duration,
        "clearance": done.min_clearance,
        "avoiding": statuses.get("avoiding", 0) / max(sum(statuses.values()), 1),
    }
    outcome = "packed" if done.success else "failed"
    return PackingResult(experiment, code_version(), outcome, done.reason, values)


@lru_cache(maxsize=1)
def _arm() -> ArmModel:
    return PackingTask.arm()


def packing_tables(results: Sequence[PackingResult]) -> list[Table]:
    """Return the rate of success with its interval, and a list of the failures."""
    n, done = len(results), sum(result.success for result in results)
    low, high = wilson_interval(done, n)
    row = (
        results[0].experiment.method,
        f"{done} of {n}",
        f"{100 * low:.1f} to {100 * high:.1f}",
        f"{np.median([result.values['duration'] for result in results]):.1f}",
        f"{1e3 * min(result.values['clearance'] for result in results):.1f}",
        f"{100 * float(np.mean([result.values['avoiding'] for result in results])):.0f}",
    )
    columns = ("observer", "success>", "95 % interval [%]>", "duration [s]>", "least clearance [mm]>", "avoiding [%]>")
    note = (
        "Success: the cube rests in the box, and the arm has touched neither box nor bottle. Duration: median. "
        "Avoiding: fraction of the control steps in which the policy evaded something."
    )
    tables = [Table("Pick a cube and put it into a moving box while a bottle is pushed about", columns, (row,), note)]
    failed = tuple((str(result.experiment.seed), result.reason) for result in results if not result.success)
    if failed:
        tables.append(Table("Failures", ("seed>", "reason"), failed))
    return tables
