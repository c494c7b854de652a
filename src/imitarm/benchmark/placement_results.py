"""Saved results of placements. Each result is one line of JSON, so that an interrupted benchmark can be continued."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from imitarm.benchmark.experiment import plain
from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import as_document

_REMEDY = "delete the file and run the benchmark again"


@dataclass(frozen=True)
class Setup:
    """A skill and the arm that reproduces it.

    Attributes:
        skill: path of the skill file.
        robot: name of an arm, or the path of its file.
        tool: name of a tool, or the path of its file; None for no tool.
    """

    skill: str
    robot: str
    tool: str | None


class Run(NamedTuple):
    """One policy in one placement.

    Attributes:
        policy: name in :data:`~imitarm.policies.POLICIES`.
        setup: the skill and the arm.
        seed: seed of the placement.
        max_tilt: largest rotation of the tool away from the learned rotation [rad]; None: the policy's default.
    """

    policy: str
    setup: Setup
    seed: int
    max_tilt: float | None = None


@dataclass(frozen=True)
class PlacementResult:
    """Result of one policy in one placement.

    Attributes:
        policy: name of the policy.
        setup: the skill and the arm.
        seed: seed of the placement.
        outcome: one of :data:`~imitarm.benchmark.placements.OUTCOMES`.
        clearance: smallest measured distance between the arm (with its tool) and an obstacle [m]; nan if the arm did
            not move.
        duration: duration of the motion divided by the duration of the skill; nan if the arm did not move.
        planning: wall-clock time until the policy accepted or refused the placement [s].
        reason: explanation of the outcome.
        max_tilt: largest allowed rotation of the tool away from the learned rotation [rad]; None: the policy's default.
        computing: processor time until the policy accepted or refused the placement [s]. Other programs disturb this
            time less than ``planning``.
        rmse: distance of the executed path from the mean of the demonstrations, see
            :class:`~imitarm.evaluation.path_style.PathStyle` [m]; nan if the motion did not arrive.
        deviation: largest deviation of the executed path from this mean, in standard deviations of the demonstrations;
            nan if the motion did not arrive.
        tilt: largest rotation of the tool away from the learned rotation during the motion [rad]; nan if the motion did
            not arrive.
        tool_rmse: the ``rmse`` of a path that is planned for the tool without the arm, in the same scene and between
            the same ends [m]; nan if no such path was found, or if the motion did not arrive.
        code: version of the code, see :func:`~imitarm.benchmark.provenance.code_version`.
    """

    policy: str
    setup: Setup
    seed: int
    outcome: str
    clearance: float
    duration: float
    planning: float
    reason: str
    max_tilt: float | None = None
    computing: float = math.nan
    rmse: float = math.nan
    deviation: float = math.nan
    tilt: float = math.nan
    tool_rmse: float = math.nan
    code: str = ""

    @property
    def run(self) -> Run:
        """The run that gave this result."""
        return Run(self.policy, self.setup, self.seed, self.max_tilt)

    @property
    def arrived(self) -> bool:
        """Whether the motion arrived and kept the required clearance."""
        return self.outcome == "arrived"

    @property
    def accepted(self) -> bool:
        """Whether the policy accepted the placement."""
        return self.outcome != "refused"


def append_result(path: Path, result: PlacementResult) -> None:
    """Append a result to a file as one line.

    Raises:
        InputError: when the file can't be written.
    """
    line = json.dumps(plain(asdict(result)), allow_nan=False)
    try:
        with path.open("a", encoding="utf-8", newline="\n") as file:
            file.write(f"{line}\n")
    except OSError as error:
        raise InputError(f"{path}: results can't be saved there ({error.strerror}); name another file") from error


def load_results(paths: Iterable[Path]) -> dict[Run, PlacementResult]:
    """Read results from files. If a run has several results, the last result counts.

    A last line without a line break is ignored: the program was killed before it had finished this line.

    Raises:
        InputError: when a file can't be read.
        FileFormatError: when a line is not a result.
    """
    found: dict[Run, PlacementResult] = {}
    for path in paths:
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{path}: can't be read as a file of results ({error}); name a file that --out wrote"
            ) from error
        for number, line in enumerate(text.split("\n")[:-1], 1):
            result = _result(line, f"{path}, line {number}")
            found[result.run] = result
    return found


def _result(line: str, where: str) -> PlacementResult:
    try:
        content = json.loads(line)
    except ValueError as error:
        raise FileFormatError(f"{where}: is not a result ({error}); {_REMEDY}") from error
    if isinstance(content, dict):  # null stands for nan, but for None where a limit is not set
        optional = ("max_tilt", "setup")
        content = {k: math.nan if v is None and k not in optional else v for k, v in content.items()}
    return as_document(content, PlacementResult, where, _REMEDY)


def repaired(path: Path) -> None:
    """Remove an incomplete last line from a file of results. The file need not exist.

    Raises:
        InputError: when the file can't be read or written.
    """
    try:
        if not path.exists():
            return
        content = path.read_bytes()
        if content and not content.endswith(b"\n"):
            with path.open("r+b") as file:
                file.truncate(content.rfind(b"\n") + 1)
    except OSError as error:
        raise InputError(f"{path}: results can't be saved there ({error.strerror}); name another file") from error
