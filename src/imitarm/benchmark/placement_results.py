"""Saved results of placements: one line of JSON for each, so that an interrupted benchmark can be continued."""

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
        clearance: smallest measured distance from arm and tool to an obstacle [m]; nan if the arm did not move.
        duration: duration of the motion divided by the duration of the skill; nan if the arm did not move.
        planning: time until the policy accepted or refused the scene [s].
        reason: explanation of the outcome.
        max_tilt: largest rotation of the tool that was allowed [rad]; None: the policy's default.
        computing: processor time of the planning [s]; other programs disturb it less than they disturb ``planning``.
        rmse: distance of the executed path from the mean of the demonstrations, see
            :class:`~imitarm.evaluation.path_style.PathStyle` [m]; nan unless the motion arrived.
        deviation: largest deviation from the mean, in standard deviations of the demonstrations; nan unless the motion
            arrived.
        tilt: largest rotation of the tool away from the learned rotation [rad]; nan unless the motion arrived.
        tool_rmse: for comparison, the ``rmse`` of a path that is planned for the tool alone, in the same scene and
            between the same ends [m]. It is nan if no such path was found, or if the motion did not arrive.
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
        """Whether the motion arrived and kept its clearance."""
        return self.outcome == "arrived"

    @property
    def accepted(self) -> bool:
        """Whether the policy found a plan."""
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
    """Read results from a file; if a run has several results, the last result counts.

    A last line without a line break is left out, because a program was killed before it finished this line.

    Raises:
        InputError: when a file can't be read.
        FileFormatError: when a line is not a result.
    """
    found: dict[Run, PlacementResult] = {}
    for path in paths:
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: can't be read as a file of results ({error})") from error
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
    """Remove an incomplete last line from a file of results; do nothing if there is no file.

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
