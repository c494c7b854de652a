"""Saved results of the static benchmark: one line of JSON for each experiment, one file for each method."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from imitarm.benchmark.experiment import plain
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import Store
from imitarm.benchmark.static import StaticExperiment, StaticResult
from imitarm.errors import FileFormatError, InputError

FORMAT = "imitarm-static-result 1"
SUFFIX = ".jsonl"


class ResultLines(Store[StaticExperiment, StaticResult]):
    """A folder with one file for each method, and one line in it for each experiment.

    A line is written by one call to the operating system. A process that is killed can therefore leave at most one
    incomplete line at the end of a file. Such a line is ignored when the file is read, and the next result begins a new
    line. When an experiment has several lines, the last one counts.

    Args:
        folder: the folder; created if missing.
        reuse: whether a result of another version of the code is valid.

    Raises:
        InputError: when the folder can't be written to.
    """

    def __init__(self, folder: str | Path, *, reuse: bool = False) -> None:
        self.folder, self.reuse = Path(folder), reuse
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder}: results can't be saved there ({error.strerror}); name another folder"
            ) from error

    def known(self, experiments: Sequence[StaticExperiment]) -> dict[StaticExperiment, StaticResult]:
        """Return the saved results; results that are unreadable or (without ``reuse``) of other code are left out."""
        wanted = set(experiments)
        found = {}
        for method in dict.fromkeys(e.method for e in experiments):
            for result in read_lines(self.path(method)):
                if result.experiment in wanted and (self.reuse or result.code == code_version()):
                    found[result.experiment] = result
        return found

    def save(self, experiment: StaticExperiment, outcome: StaticResult) -> StaticResult:
        """Append one line, and return the result as it is read from the line.

        Raises:
            OSError: when the line can't be written.
        """
        line = json_line(outcome)
        data = line.encode() + b"\n"
        with self.path(experiment.method).open("a+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            if end:
                file.seek(end - 1)
                if file.read(1) != b"\n":  # a process was killed here
                    data = b"\n" + data
            if file.write(data) != len(data):
                raise OSError(28, "the disk is full")
        return result_of(line)

    def path(self, method: str) -> Path:
        """Return the file of a method."""
        return self.folder / f"{method}{SUFFIX}"


def json_line(result: StaticResult) -> str:
    """Return a result as one line of JSON; null stands for nan."""
    content = {
        "format": FORMAT,
        "experiment": asdict(result.experiment),
        "code": result.code,
        "outcome": result.outcome,
        "reason": result.reason,
        "values": plain(dict(result.values)),
    }
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def result_of(line: str) -> StaticResult:
    """Return the result in a line of JSON.

    Raises:
        ValueError: when the line is not JSON.
        FileFormatError: when the line is not a result of this version.
    """
    content: dict[str, Any] = json.loads(line)
    try:
        if content["format"] != FORMAT:
            raise FileFormatError(f"is not a result of this version ({FORMAT!r})")
        facts = content["experiment"]
        facts["options"] = tuple((name, value) for name, value in facts["options"])
        return StaticResult(
            StaticExperiment(**facts), content["code"], content["outcome"], content["reason"], content["values"]
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(f"is not a result ({type(error).__name__}: {error})") from error


def read_lines(path: Path) -> list[StaticResult]:
    """Return the results in a file; lines that can't be read are left out."""
    if not path.exists():
        return []
    found = []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            try:
                found.append(result_of(line))
            except ValueError:  # an incomplete line, or a method that no longer exists
                continue
    return found


def read_folders(folders: Iterable[str | Path]) -> list[StaticResult]:
    """Return the results of all folders; when an experiment has several results, the last one counts.

    Raises:
        InputError: when a folder does not exist or holds no results.
    """
    found: dict[StaticExperiment, StaticResult] = {}
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder; 'imitarm benchmark static --out {folder}' makes one")
        here = [result for path in sorted(folder.glob(f"*{SUFFIX}")) for result in read_lines(path)]
        found.update({result.experiment: result for result in here})
        if not here:
            raise InputError(f"{folder}: holds no results of 'imitarm benchmark static'")
    return list(found.values())
