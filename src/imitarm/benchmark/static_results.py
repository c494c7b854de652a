"""Saved results of the static benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from imitarm.benchmark import result_lines
from imitarm.benchmark.result_lines import SUFFIX, LineStore, results_in, results_of_folders
from imitarm.benchmark.static import StaticExperiment, StaticResult

FORMAT = "imitarm-static-result 1"

__all__ = ["FORMAT", "SUFFIX", "ResultLines", "json_line", "read_folders", "read_lines", "result_of"]


class ResultLines(LineStore[StaticExperiment, StaticResult]):
    """The results of the static benchmark, see :class:`~imitarm.benchmark.result_lines.LineStore`."""

    def line(self, outcome: StaticResult) -> str:
        """Return a result as one line of JSON."""
        return json_line(outcome)

    def result(self, line: str) -> StaticResult:
        """Return the result in a line.

        Raises:
            ValueError: when the line is not a result of this version.
        """
        return result_of(line)


def json_line(result: StaticResult) -> str:
    """Return a result as one line of JSON; null stands for nan."""
    return result_lines.json_line(result, FORMAT)


def result_of(line: str) -> StaticResult:
    """Return the result in a line of JSON.

    Raises:
        ValueError: when the line is not JSON.
        FileFormatError: when the line is not a result of this version.
    """
    return result_lines.from_json(line, FORMAT, StaticExperiment, StaticResult)


def read_lines(path: Path) -> list[StaticResult]:
    """Return the results in a file; lines that can't be read are left out."""
    return results_in(path, result_of)


def read_folders(folders: Iterable[str | Path]) -> list[StaticResult]:
    """Return the results of all folders; when an experiment has several results, the last one counts.

    Raises:
        InputError: when a folder does not exist or holds no results.
    """
    return results_of_folders(folders, result_of, "imitarm benchmark static")
