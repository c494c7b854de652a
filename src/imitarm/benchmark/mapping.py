"""The mapping benchmark: which experiments it is made of, its tables, and the files it leaves behind."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from imitarm.benchmark.experiment import LIVE, REPLAYS, Experiment, plain, write_text
from imitarm.benchmark.mapping_methods import MAIN, METHODS
from imitarm.benchmark.mapping_pairs import comparison_table, rivals_table
from imitarm.benchmark.mapping_tables import (
    JUDGED,
    Results,
    accuracy_table,
    effort_table,
    limits_table,
    recordings_table,
    smoothness_table,
    success_table,
    torque_table,
)
from imitarm.benchmark.provenance import origin
from imitarm.benchmark.recording_plan import CAPTURED, KINDS
from imitarm.benchmark.tables import Table
from imitarm.benchmark.thesis_table import claims_table, printed_table
from imitarm.errors import InputError

CAMERAS = 8  # before which the captured arm is put: it is one person's


@dataclass(frozen=True)
class MappingBenchmark:
    """What is run.

    Attributes:
        people: made-up persons.
        first: of them; they are ``first`` to ``first + people - 1``. Persons below 200 are for working on methods,
            those from 200 on for judging: what was tuned with a person in sight is not judged by that person.
        repeats: closed-loop trials of each; recordings to replay are one of each kind a person.
        methods: rows, of :data:`imitarm.benchmark.mapping_methods.METHODS`.
        kinds: of recordings, of :data:`imitarm.benchmark.recording_plan.KINDS`.
        seconds: about how long a recording is [s].
        sigma: of the camera's error [m]; None: 1 to 2 cm, by the seed.
        live: whether cubes are stacked with the loop closed, by the main methods among the rows.
        data: folder of real recordings; empty: the captured arm is left out.

    Raises:
        InputError: when there is nothing to run.
    """

    people: int = 10
    first: int = JUDGED
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
            raise InputError("the benchmark needs a method, and a kind of recording or the closed loop")

    def experiments(self) -> list[Experiment]:
        """Return all experiments, those of one recording side by side."""
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
        return found


_TORQUES = {
    "mean_torque": "Mean of the absolute torque",
    "rms_torque": "Root mean square torque",
    "mean_motion_torque": "Mean of the absolute torque without weight",
}


def tables(results: Results) -> list[Table]:
    """Return every table that the results fill: what the thesis says of it first."""
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
        found.append(rivals_table(results, replayed))
    found += [comparison_table(results, tasks) for tasks in ([LIVE], replayed) if results.tasks(tasks)]
    if replayed:
        found += [limits_table(results, replayed), effort_table(results, replayed), smoothness_table(results, replayed)]
        found += [torque_table(results, replayed, name, title) for name, title in _TORQUES.items()]
    if results.tasks([CAPTURED]):
        found.append(limits_table(results, [CAPTURED]))
    return found


def write_tables(results: Results, found: Sequence[Table], folder: Path) -> tuple[Path, Path]:
    """Write ``mapping.md`` and ``mapping.json`` into the folder; return where they are."""
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


BEGIN, END = "<!-- imitarm benchmark mapping -->", "<!-- end -->"
"""Between these lines of a document stand the tables."""


def fill_document(path: Path, found: Sequence[Table], command: str, versions: Iterable[str]) -> None:
    """Put the tables into a document, between the lines :data:`BEGIN` and :data:`END`; the rest stays as it is.

    Args:
        path: of the document, Markdown.
        found: the tables.
        command: that printed them.
        versions: of the code of each result; the document says when it is not the code that is running.

    Raises:
        InputError: when the document can't be read, or has not these two lines in this order, once each.
    """
    check_document(path)
    head, rest = path.read_text(encoding="utf-8").split(f"{BEGIN}\n")
    tail = rest.split(f"{END}\n")[1]
    body = "\n".join(table.markdown() for table in found)
    write_text(path, f"{head}{BEGIN}\nPrinted by `{command}`. {origin(versions)}\n\n{body}\n{END}\n{tail}")


def check_document(path: Path) -> None:
    """Say at once when a document has no place for the tables; raises as :func:`fill_document` does."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: can't be read as a document ({error})") from error
    if text.count(f"{BEGIN}\n") != 1 or text.count(f"{END}\n") != 1 or text.index(BEGIN) > text.index(END):
        raise InputError(f"{path}: needs a line {BEGIN!r}, and after it a line {END!r}, once each: tables go between")
