"""The mapping benchmark compares retargeting methods: it runs experiments, and writes tables and files."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from imitarm.benchmark.experiment import LIVE, MAIN, METHODS, REPLAYS, Experiment, Result, plain, write_text
from imitarm.benchmark.mapping_comparisons import better_methods_table, claims_table, comparison_table, printed_table
from imitarm.benchmark.mapping_tables import (
    TEST,
    Results,
    accuracy_table,
    effort_table,
    limits_table,
    recordings_table,
    smoothness_table,
    success_table,
    torque_table,
)
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.recordings import CAPTURED, KINDS
from imitarm.benchmark.running import OnDone, Store, Workers, in_parallel, run_experiments
from imitarm.benchmark.tables import Table
from imitarm.errors import FileFormatError, ImitarmError, InputError

_RUNS, _RECORDINGS = "runs", "recordings"
CAMERAS = 8  # simulated cameras before the captured arm, which is that of one person


@dataclass(frozen=True)
class MappingBenchmark:
    """The choice of experiments for the mapping benchmark.

    Attributes:
        people: number of simulated persons.
        first: number of the first person; the persons are ``first`` to ``first + people - 1``. Use persons 0 to 199 for
            developing methods, and persons from 200 on for testing. A method is then never tested with a person with
            whom it was tuned.
        repeats: number of closed-loop trials of each person. The other tasks have one recording of each kind for each
            person.
        methods: names in :data:`imitarm.benchmark.experiment.METHODS`.
        kinds: kinds of recordings, from :data:`imitarm.benchmark.recordings.KINDS`.
        seconds: approximate duration of a recording [s].
        sigma: standard deviation of the camera's error [m]; None: 1 to 2 cm, chosen by the seed.
        live: whether to run closed-loop trials too, in which the person stacks cubes through the robot. Only methods
            with default options run in these trials.
        data: folder of real recordings; if empty, the task with motion capture is left out.

    Raises:
        InputError: when no experiment is selected, or a number is too small.
    """

    people: int = 10
    first: int = TEST
    repeats: int = 5
    methods: Sequence[str] = tuple(METHODS)
    kinds: Sequence[str] = KINDS
    seconds: float = 10.0
    sigma: float | None = None
    live: bool = True
    data: str = ""

    def __post_init__(self) -> None:
        if self.people < 1 or self.repeats < 1:
            raise InputError(f"people and repeats must be at least 1, got {self.people} and {self.repeats}")
        if self.first < 0:
            raise InputError(f"the first person must be at least 0, got {self.first}")
        if not self.methods or not (self.kinds or self.live or self.data):
            raise InputError(
                "no experiment is selected: choose at least one method, and a kind of recording or closed-loop trials"
            )

    def experiments(self) -> list[Experiment]:
        """Return all experiments, grouped by recording."""
        persons = range(self.first, self.first + self.people)
        found = [
            Experiment(kind, method, seed=person, seconds=self.seconds, sigma=self.sigma)
            for kind in self.kinds
            for person in persons
            for method in self.methods
        ]
        if self.data:
            seconds = 4.0 * self.seconds
            found += [
                Experiment(CAPTURED, method, "sawyer", self.first, camera, seconds, self.sigma, self.data)
                for camera in range(CAMERAS)
                for method in self.methods
            ]
        if self.live:
            found += [
                Experiment(LIVE, method, seed=person, repeat=repeat, sigma=self.sigma)
                for person in persons
                for repeat in range(self.repeats)
                for method in self.methods
                if method in MAIN
            ]
        return list(dict.fromkeys(found))


class ResultFolder(Store[Experiment, Result]):
    """A folder with one file for each result.

    Args:
        folder: the folder; created if missing.
        reuse: whether to use saved results of another version of the code.

    Raises:
        InputError: when the folder can't be written to.
    """

    def __init__(self, folder: Path, *, reuse: bool = False) -> None:
        self.folder, self.reuse = folder, reuse
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder.parent}: results can't be saved there ({error.strerror}); name another folder"
            ) from error

    def known(self, experiments: Sequence[Experiment]) -> dict[Experiment, Result]:
        """Return the saved results that can be used."""
        return {e: found for e in experiments if (found := self._kept(e)) is not None}

    def save(self, experiment: Experiment, outcome: Result) -> Result:
        """Write the result to a file; read it from the file again, and return it."""
        return Result.load(outcome.save(self.folder))

    def _kept(self, experiment: Experiment) -> Result | None:
        path = Result.path(self.folder, experiment)
        try:
            found = Result.load(path) if path.exists() else None
        except FileFormatError:
            return None
        return found if found is not None and (self.reuse or found.code == code_version()) else None


def run_all(
    experiments: Sequence[Experiment],
    folder: str | Path,
    workers: Workers | None = None,
    *,
    fresh: bool = False,
    reuse: bool = False,
    on_done: OnDone | None = None,
) -> list[Result]:
    """Run experiments in parallel, and return the results in the order of the experiments.

    Each result is written to a separate file in ``folder/runs`` as soon as the experiment is finished. If the same code
    has already saved a result of the same experiment, this result is read, and the experiment does not run again. The
    measured values do not depend on ``workers``.

    Args:
        experiments: the experiments to run.
        folder: folder for results and recordings; created if missing.
        workers: processes that run the experiments; None: one for each processor.
        fresh: whether to ignore saved results and run all experiments again.
        reuse: whether to use saved results that another version of the code produced. Each result names the version.
        on_done: function that is called with the progress after each experiment.

    Raises:
        InputError: when the folder can't be written to, or the backend does not exist.
        TaskFailedError: when a worker process ended unexpectedly; the results of finished experiments stay saved.
        KeyboardInterrupt: after Ctrl-C; the results of finished experiments stay saved.
    """
    place = Path(folder)
    store = ResultFolder(place / _RUNS, reuse=reuse)
    known = {} if fresh else store.known(experiments)
    # recordings first, so that methods share the files
    firsts = {e.plan: e for e in experiments if e.task in REPLAYS and e not in known}
    for _ in in_parallel(partial(_make_recording, place / _RECORDINGS), list(firsts.values()), workers):
        pass
    return run_experiments(
        experiments, partial(_run, place / _RECORDINGS), store, workers, fresh=fresh, on_done=on_done
    )


def _make_recording(folder: Path, experiment: Experiment) -> None:
    """Make the recording of an experiment; an error is ignored here, because the experiment reports it later."""
    with contextlib.suppress(ImitarmError):
        experiment.recording(folder)


def _run(folder: Path, experiment: Experiment) -> Result:
    return experiment.run(folder)


_TORQUES = {
    "mean_torque": "Mean of the absolute torque",
    "rms_torque": "Root mean square torque",
    "mean_motion_torque": "Mean of the absolute torque without gravity",
}


def tables(results: Results) -> list[Table]:
    """Return all tables that have results. The table of the claims of the thesis comes first."""
    replayed, found = results.tasks(), []
    if replayed:
        stacking = results.tasks(["stacking"]) or replayed
        found += [claims_table(results, stacking), printed_table(results, stacking)]
    if results.tasks([LIVE]):
        found.append(success_table(results))
    if results.tasks(REPLAYS):
        found.append(recordings_table(results))
    found += [accuracy_table(results, task) for task in results.tasks(REPLAYS)]
    if results.tasks([*replayed, LIVE]):
        found.append(better_methods_table(results, replayed))
    found += [comparison_table(results, tasks) for tasks in ([LIVE], replayed) if results.tasks(tasks)]
    if replayed:
        found += [limits_table(results, replayed), effort_table(results, replayed), smoothness_table(results, replayed)]
        found += [torque_table(results, replayed, name, title) for name, title in _TORQUES.items()]
    if results.tasks([CAPTURED]):
        found.append(limits_table(results, [CAPTURED]))
    return found


def write_tables(results: Results, found: Sequence[Table], folder: Path) -> tuple[Path, Path]:
    """Write ``mapping.md`` and ``mapping.json`` into the folder; return their paths."""
    document, data = folder / "mapping.md", folder / "mapping.json"
    write_text(document, "\n".join(table.markdown() for table in found))
    content = {
        "tables": [
            {"title": t.title, "columns": list(t.columns), "rows": [list(r) for r in t.rows], "note": t.note}
            for t in found
        ],
        "results": [
            {"name": r.experiment.name, "failure": r.failure, "code": r.code, "values": plain(dict(r.values))}
            for r in results.all
        ],
    }
    write_text(data, json.dumps(content, indent=1, allow_nan=False))
    return document, data
