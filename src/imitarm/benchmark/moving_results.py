"""Saved results of the moving benchmark, which can be selected by table row, family and scene."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property

from imitarm.benchmark.moving import MovingExperiment, MovingResult
from imitarm.benchmark.moving_controls import CONTROLS
from imitarm.benchmark.moving_scenes import FAMILIES
from imitarm.benchmark.result_lines import ResultFormat

Scene = tuple[str, int, int]


RESULTS = ResultFormat("imitarm-moving-result 1", MovingExperiment, MovingResult, "imitarm benchmark moving")
"""How results are written and read."""


class MovingResults:
    """Results of many experiments, by scene and by table row. Each row of a table is a method with its options."""

    def __init__(self, results: Sequence[MovingResult]) -> None:
        self.all = list(results)

    def in_setting(self, setting: str) -> MovingResults:
        """Return the results of one setting, see :attr:`~imitarm.benchmark.moving.MovingExperiment.setting`."""
        return MovingResults([r for r in self.all if r.experiment.setting == setting])

    @cached_property
    def settings(self) -> list[str]:
        """The settings of which there are results."""
        return list(dict.fromkeys(r.experiment.setting for r in self.all))

    @staticmethod
    def row_of(result: MovingResult) -> str:
        """Return the name of the table row of a result: the method, and the options that replace its defaults."""
        options = ", ".join(f"{name} {value}" for name, value in result.experiment.options)
        return f"{result.experiment.method}{', ' if options else ''}{options}"

    @staticmethod
    def sensor_of(result: MovingResult) -> tuple[float, float, float, float, float]:
        """Return the sensor of a result: noise [m], rate [Hz], latency [s], dropout probability, occlusions [1/s]."""
        e = result.experiment
        return e.noise, e.rate, e.latency, e.dropout, e.occlusions

    @cached_property
    def rows(self) -> list[str]:
        """The names of the table rows.

        The compared methods come first, in the order of their success. The methods that check the benchmark follow.
        """
        by_row: dict[str, list[bool]] = defaultdict(list)
        for result in self.all:
            by_row[self.row_of(result)].append(result.success)
        controls = [row for row in CONTROLS if row in by_row]
        others = sorted((row for row in by_row if row not in CONTROLS), key=lambda row: (-_mean(by_row[row]), row))
        return [*others, *controls]

    def families(self) -> list[str]:
        """Return the families that have results, in the order of ``FAMILIES``."""
        there = {result.experiment.family for result in self.all}
        return [family for family in FAMILIES if family in there]

    def of(self, row: str, family: str | None = None) -> list[MovingResult]:
        """Return the results of a row in one family; None: in all families."""
        return [r for r in self.all if self.row_of(r) == row and (family is None or r.experiment.family == family)]

    @cached_property
    def by_scene(self) -> dict[Scene, dict[str, MovingResult]]:
        """For each scene, the result of each table row (a method with its options)."""
        found: dict[Scene, dict[str, MovingResult]] = defaultdict(dict)
        for result in self.all:
            found[result.experiment.scene][self.row_of(result)] = result
        return dict(found)


def _mean(values: Sequence[bool]) -> float:
    return sum(values) / len(values)
