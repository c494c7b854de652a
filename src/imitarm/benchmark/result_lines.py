"""Save the results of a benchmark: one file for each method, with one line of JSON for each experiment."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic

from imitarm.benchmark.experiment import plain
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import Outcome, Store, Work
from imitarm.errors import FileFormatError, InputError

SUFFIX = ".jsonl"


@dataclass(frozen=True)
class ResultFormat(Generic[Work, Outcome]):
    """File format of the results of one benchmark. Each result is one line of JSON.

    The class of the results has the attributes ``experiment``, ``code``, ``outcome``, ``reason`` and ``values``, in
    this order. The class of the experiments is a dataclass with an attribute ``method``.

    Attributes:
        name: name and version of the format.
        experiment: class of the experiments.
        outcome: class of the results.
        command: command that makes a folder of results. Error messages name this command.
    """

    name: str
    experiment: Callable[..., Work]
    outcome: Callable[..., Outcome]
    command: str

    def store(self, folder: str | Path, *, reuse: bool = False) -> LineStore[Work, Outcome]:
        """Return a store that reads and writes results in a folder.

        Args:
            folder: the folder; created if missing.
            reuse: whether to use saved results of another version of the code.

        Raises:
            InputError: when the folder can't be written to.
        """
        return LineStore(folder, self, reuse=reuse)

    def line(self, result: Any) -> str:
        """Return a result as one line of JSON, in which null stands for nan."""
        content = {
            "format": self.name,
            "experiment": asdict(result.experiment),
            "code": result.code,
            "outcome": result.outcome,
            "reason": result.reason,
            "values": plain(dict(result.values)),
        }
        return json.dumps(content, allow_nan=False, separators=(",", ":"))

    def result(self, line: str) -> Outcome:
        """Return the result that a line of JSON contains.

        Raises:
            ValueError: when the line is not JSON.
            FileFormatError: when the line is not a result of this version.
        """
        content: dict[str, Any] = json.loads(line)
        try:
            if content["format"] != self.name:
                raise FileFormatError(f"is not a result of this version ({self.name!r})")
            facts = content["experiment"]
            if "options" in facts:
                facts["options"] = tuple((name, value) for name, value in facts["options"])
            values = content["code"], content["outcome"], content["reason"], content["values"]
            return self.outcome(self.experiment(**facts), *values)
        except (KeyError, TypeError, AttributeError) as error:
            raise FileFormatError(f"is not a result ({type(error).__name__}: {error})") from error

    def read(self, path: Path) -> list[Outcome]:
        """Return the results in a file. Lines that can't be read are ignored."""
        if not path.exists():
            return []
        found = []
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                try:
                    found.append(self.result(line))
                except ValueError:  # an incomplete line, or a method that no longer exists
                    continue
        return found

    def read_folders(self, folders: Iterable[str | Path]) -> list[Outcome]:
        """Return the results of all folders. If an experiment has several results, the last result counts.

        Raises:
            InputError: when a folder does not exist or holds no results.
        """
        found: dict[Any, Outcome] = {}
        for folder in map(Path, folders):
            if not folder.is_dir():
                raise InputError(f"{folder}: there is no such folder; '{self.command} --out {folder}' makes one")
            here: list[Any] = [r for path in sorted(folder.glob(f"*{SUFFIX}")) for r in self.read(path)]
            found.update({saved.experiment: saved for saved in here})
            if not here:
                raise InputError(f"{folder}: holds no results of '{self.command}'; name the folder that --out named")
        return list(found.values())


class LineStore(Store[Work, Outcome]):
    """A folder of results. Each method has a file, and each experiment has a line in the file of its method.

    The store writes a line by one call to the operating system. If the process is killed, at most the last line of a
    file is incomplete. The store ignores an incomplete line, and writes the next result to a new line. If an experiment
    has several lines, the last line counts.

    Args:
        folder: the folder; created if missing.
        form: file format of a result.
        reuse: whether to use saved results of another version of the code.

    Raises:
        InputError: when the folder can't be written to.
    """

    def __init__(self, folder: str | Path, form: ResultFormat[Work, Outcome], *, reuse: bool = False) -> None:
        self.folder, self.form, self.reuse = Path(folder), form, reuse
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder}: results can't be saved there ({error.strerror}); name another folder"
            ) from error

    def known(self, experiments: Sequence[Work]) -> dict[Work, Outcome]:
        """Return the saved results that can be used.

        The method leaves out unreadable lines. Without ``reuse``, it also leaves out the results that
        another version of the code computed.
        """
        wanted = set(experiments)
        found: dict[Work, Outcome] = {}
        for method in dict.fromkeys(_method(e) for e in experiments):
            for result in self.form.read(self.path(method)):
                saved: Any = result
                if saved.experiment in wanted and (self.reuse or saved.code == code_version()):
                    found[saved.experiment] = result
        return found

    def save(self, experiment: Work, outcome: Outcome) -> Outcome:
        """Append a result to its file as one line; return the result as it is read from this line.

        Raises:
            OSError: when the line can't be written.
        """
        line = self.form.line(outcome)
        data = line.encode() + b"\n"
        with self.path(_method(experiment)).open("a+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            if end:
                file.seek(end - 1)
                if file.read(1) != b"\n":  # a process was killed here
                    data = b"\n" + data
            if file.write(data) != len(data):
                raise OSError(28, "the disk is full")
        return self.form.result(line)

    def path(self, method: str) -> Path:
        """Return the file of a method."""
        return self.folder / f"{method}{SUFFIX}"


def _method(experiment: Any) -> str:
    return str(experiment.method)
