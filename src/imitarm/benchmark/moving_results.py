"""Saved results of the moving benchmark, and the rows and scenes of its tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

from imitarm.benchmark import result_lines
from imitarm.benchmark.moving import MovingExperiment, MovingResult
from imitarm.benchmark.moving_controls import CONTROLS
from imitarm.benchmark.moving_scenes import FAMILIES
from imitarm.benchmark.result_lines import LineStore, results_in, results_of_folders

FORMAT = "imitarm-moving-result 1"
Scene = tuple[str, int, int]


class MovingLines(LineStore[MovingExperiment, MovingResult]):
    """The results of the moving benchmark, see :class:`~imitarm.benchmark.result_lines.LineStore`."""

    def line(self, outcome: MovingResult) -> str:
        """Return a result as one line of JSON."""
        return json_line(outcome)

    def result(self, line: str) -> MovingResult:
        """Return the result in a line.

        Raises:
            ValueError: when the line is not a result of this version.
        """
        return result_of(line)


def json_line(result: MovingResult) -> str:
    """Return a result as one line of JSON; null stands for nan."""
    return result_lines.json_line(result, FORMAT)


def result_of(line: str) -> MovingResult:
    """Return the result in a line of JSON.

    Raises:
        ValueError: when the line is not JSON.
        FileFormatError: when the line is not a result of this version.
    """
    return result_lines.from_json(line, FORMAT, MovingExperiment, MovingResult)


def read_lines(path: Path) -> list[MovingResult]:
    """Return the results in a file; lines that can't be read are left out."""
    return results_in(path, result_of)


def read_folders(folders: Iterable[str | Path]) -> list[MovingResult]:
    """Return the results of all folders; when an experiment has several results, the last one counts.

    Raises:
        InputError: when a folder does not exist or holds no results.
    """
    return results_of_folders(folders, result_of, "imitarm benchmark moving")


class MovingResults:
    """Results of many experiments, by row (method, with its options) and by scene."""

    def __init__(self, results: Sequence[MovingResult]) -> None:
        self.all = list(results)

    def in_world(self, world: str) -> MovingResults:
        """Return the results in one world."""
        return MovingResults([r for r in self.all if r.experiment.world == world])

    @cached_property
    def worlds(self) -> list[str]:
        """The worlds in which there are results."""
        return list(dict.fromkeys(r.experiment.world for r in self.all))

    @staticmethod
    def row_of(result: MovingResult) -> str:
        """Return the name of the row of a result: method, and options that are not the defaults."""
        options = ", ".join(f"{name} {value}" for name, value in result.experiment.options)
        return f"{result.experiment.method}{', ' if options else ''}{options}"

    @staticmethod
    def sensor_of(result: MovingResult) -> tuple[float, float, float, float, float]:
        """Return noise [m], rate [Hz], latency [s], dropout and occlusions [1/s]."""
        e = result.experiment
        return e.noise, e.rate, e.latency, e.dropout, e.occlusions

    @cached_property
    def rows(self) -> list[str]:
        """The rows: first the controls, then the methods in the order of their success."""
        by_row: dict[str, list[bool]] = defaultdict(list)
        for result in self.all:
            by_row[self.row_of(result)].append(result.success)
        controls = [row for row in CONTROLS if row in by_row]
        others = sorted((row for row in by_row if row not in CONTROLS), key=lambda row: (-_mean(by_row[row]), row))
        return [*others, *controls]

    def families(self) -> list[str]:
        """Return the families that were run, in their order."""
        there = {result.experiment.family for result in self.all}
        return [family for family in FAMILIES if family in there]

    def of(self, row: str, family: str | None = None) -> list[MovingResult]:
        """Return the results of a row, in one family or in all."""
        return [r for r in self.all if self.row_of(r) == row and (family is None or r.experiment.family == family)]

    @cached_property
    def by_scene(self) -> dict[Scene, dict[str, MovingResult]]:
        """The results of each scene, by row."""
        found: dict[Scene, dict[str, MovingResult]] = defaultdict(dict)
        for result in self.all:
            found[result.experiment.scene][self.row_of(result)] = result
        return dict(found)


def _mean(values: Sequence[bool]) -> float:
    return sum(values) / len(values)
