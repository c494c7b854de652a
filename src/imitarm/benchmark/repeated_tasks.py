"""Repeat a simulated task among moving obstacles with many seeds: packing, or sweeping while a cube is pushed about."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

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
from imitarm.tasks.pushed_cube import CUBE_OBSERVERS, run_pushed_cube
from imitarm.tasks.sweep import SweepTask
from imitarm.trajectory import Rollout


class RepeatedTask(NamedTuple):
    """A task that is run with many seeds.

    Attributes:
        title: title of the table.
        arm: function that loads the arm of the task.
        run: function that runs the task once. Its arguments are a seed, an arm and the name of an observer.
        observers: names of the observers, which are models of the sensor that observes the obstacles.
        success: text that says when a run counts as a success.
    """

    title: str
    arm: Callable[[], ArmModel]
    run: Callable[[int, ArmModel, str], Rollout]
    observers: tuple[str, ...]
    success: str


def _pack(seed: int, arm: ArmModel, observer: str) -> Rollout:
    return run_packing(PackingTask(seed), arm=arm, observer=OBSERVERS[observer])


def _sweep(seed: int, arm: ArmModel, observer: str) -> Rollout:
    return run_pushed_cube(seed, arm=arm, observer=CUBE_OBSERVERS[observer])


REPEATED_TASKS = {
    "packing": RepeatedTask(
        "Pick a cube and put it into a moving box while a bottle is pushed about",
        PackingTask.arm,
        _pack,
        tuple(OBSERVERS),
        "the cube rests in the box, and the arm has touched neither box nor bottle",
    ),
    "pushed-cube": RepeatedTask(
        "Sweep with a Panda while a cube is pushed about",
        lambda: SweepTask.arm("panda"),
        _sweep,
        tuple(CUBE_OBSERVERS),
        "all dirt is in the dustpan, and the arm has touched neither the cube nor the table",
    ),
}
"""The tasks of ``imitarm benchmark packing`` and ``imitarm benchmark pushed-cube``."""


@dataclass(frozen=True)
class TaskExperiment:
    """One run of a task.

    Attributes:
        task: a name in :data:`REPEATED_TASKS`.
        method: name of the observer, one of the task's ``observers``.
        seed: seed of the task.
    """

    task: str
    method: str
    seed: int


@dataclass(frozen=True, eq=False)
class TaskResult:
    """Result of one run.

    Attributes:
        experiment: the run.
        code: version of the code that ran, see :func:`~imitarm.benchmark.provenance.code_version`.
        outcome: ``"success"`` or ``"failed"``.
        reason: explanation of the outcome.
        values: ``duration`` of the run [s]; ``clearance``, the smallest measured distance of the arm from an obstacle
            [m]; ``avoiding``, the fraction of the control steps in which the policy avoided an obstacle.
    """

    experiment: TaskExperiment
    code: str
    outcome: str
    reason: str
    values: Mapping[str, float]

    @property
    def success(self) -> bool:
        """Whether the task was completed and no obstacle was touched."""
        return self.outcome == "success"


RESULTS = ResultFormat("imitarm-task-result 1", TaskExperiment, TaskResult, "imitarm benchmark")
"""How results are written and read."""


def run_repeatedly(
    task: str,
    count: int,
    *,
    first: int = 0,
    observer: str = "sensor",
    workers: Workers | None = None,
    out: Path,
    on_done: OnDone | None = None,
) -> list[TaskResult]:
    """Run a task once with each of ``count`` successive seeds.

    Args:
        task: a name in :data:`REPEATED_TASKS`.
        count: number of runs.
        first: the first seed.
        observer: name of the observer, one of the task's ``observers``.
        workers: processes that run the task; None: one for each processor.
        out: folder for the results. If the folder already contains results, only the missing seeds run.
        on_done: function that is called with the progress after each run.

    Raises:
        InputError: when a number is out of range, or the folder can't be used.
    """
    if count < 1 or first < 0:
        raise InputError(f"{task}: count must be at least 1 and first at least 0, got {count} and {first}")
    experiments = [TaskExperiment(task, observer, seed) for seed in range(first, first + count)]
    return run_experiments(experiments, run_one, RESULTS.store(out), workers, on_done=on_done)


def run_one(experiment: TaskExperiment) -> TaskResult:
    """Run a task with one seed; a function for worker processes."""
    task = REPEATED_TASKS[experiment.task]
    done = task.run(experiment.seed, _arm(experiment.task), experiment.method)
    statuses = done.details["statuses"]
    values = {
        "duration": done.trajectory.duration,
        "clearance": done.min_clearance,
        "avoiding": statuses.get("avoiding", 0) / max(sum(statuses.values()), 1),
    }
    return TaskResult(experiment, code_version(), "success" if done.success else "failed", done.reason, values)


@lru_cache(maxsize=2)
def _arm(task: str) -> ArmModel:
    return REPEATED_TASKS[task].arm()


def success_tables(results: Sequence[TaskResult]) -> list[Table]:
    """Return a table of the rate of success of one task, and a table of the failures."""
    task = REPEATED_TASKS[results[0].experiment.task]
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
        f"Success: {task.success}. Duration: median. Avoiding: fraction of the control steps in which the policy "
        "avoided an obstacle."
    )
    tables = [Table(task.title, columns, (row,), note)]
    failed = tuple((str(result.experiment.seed), result.reason) for result in results if not result.success)
    if failed:
        tables.append(Table("Failures", ("seed>", "reason"), failed))
    return tables
