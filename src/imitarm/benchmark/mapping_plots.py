"""The mapping benchmark's figures, in the manner of Figs 3.6 to 3.8 of the thesis; each is one ``<svg>`` element."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from imitarm.benchmark.experiment import LIVE
from imitarm.benchmark.mapping_methods import METHODS
from imitarm.benchmark.mapping_tables import Results
from imitarm.evaluation.intervals import Interval, Values, interval, rate_interval
from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, canvas

_COLOURS = (
    *(palette.ADAPTED, palette.MEASURED, palette.UNMOVED, palette.DEMONSTRATION, palette.MOVED),
    *(palette.NOMINAL, palette.OBSTACLE, palette.LIMIT),
)
_HATCHES = ("", "///", "...", "xxx", "---", "\\\\\\", "+++", "ooo")


def torques(results: Results, tasks: Sequence[str], *, name: str = "torques") -> str:
    """Draw the mean torque of each joint for each method (Fig 3.6)."""
    groups = [f"τ{joint + 1}" for joint in range(7)]
    series = [
        (method, [interval(results.values(method, tasks, "mean_torque", joint)) for joint in range(7)])
        for method in results.methods
    ]
    return _grouped(
        name, "Mean of the absolute torque of each joint, for each method", "mean |τ| [N m]", groups, series
    )


def path_lengths(results: Results, tasks: Sequence[str], *, name: str = "paths") -> str:
    """Draw the path length for each method (Fig 3.7)."""
    return _by_task(results, tasks, "path_length", 1.0, "path of the tool [m]", "Path length for each method", name)


def accuracy(results: Results, tasks: Sequence[str], *, name: str = "accuracy") -> str:
    """Draw the distance of the tool to where the true hand leads it, for each method and kind of recording."""
    text = "Root mean square distance of the tool to where the true hand leads it"
    return _by_task(results, tasks, "tool_rms", 1e3, "tool RMS [mm]", text, name)


def broken_limits(results: Results, tasks: Sequence[str], *, name: str = "limits") -> str:
    """Draw in how many frames of a recording a limit is broken, for each method and kind of recording."""
    text = "Frames that break a limit of position, velocity or acceleration"
    return _by_task(results, tasks, "broken_limits", 1.0, "frames a recording", text, name)


def times(results: Results, *, name: str = "times") -> str:
    """Draw the time to stack four cubes for each method, of the trials that succeeded (Fig 3.8)."""

    def values(method: str) -> Values:
        return results.values(method, [LIVE], "time")

    return _live(results, lambda m: interval(values(m)), "time of the successes [s]", "Time to stack four cubes", name)


def successes(results: Results, *, name: str = "successes") -> str:
    """Draw how often four cubes were stacked, with intervals over persons."""

    def rate(method: str) -> Interval:
        return _scaled(rate_interval(results.values(method, [LIVE], "success")), 100.0)

    return _live(results, rate, "stacked [%]", "How often four cubes were stacked", name)


def _live(results: Results, found: Callable[[str], Interval], unit: str, text: str, name: str) -> str:
    methods = [method for method in results.methods if results.of(method, [LIVE])]
    return _grouped(name, text, unit, [""], [(method, [found(method)]) for method in methods])


def _by_task(
    results: Results, tasks: Sequence[str], measured: str, factor: float, unit: str, text: str, name: str
) -> str:
    series = []
    for method in results.methods:
        found = [interval(results.values(method, [task], measured)) for task in tasks]
        series.append((method, [_scaled(f, factor) for f in found]))
    return _grouped(name, text, unit, list(tasks), series)


def _scaled(found: Interval, factor: float) -> Interval:
    mean, low, high = factor * found.mean, factor * found.low, factor * found.high
    return Interval(mean, low, high, found.persons, found.used, found.of)


def _grouped(
    name: str, description: str, unit: str, groups: Sequence[str], series: Sequence[tuple[str, Sequence[Interval]]]
) -> str:
    """Draw bars in groups, one of each series in a group, with their intervals; nothing when there is no number."""
    if not any(math.isfinite(found.mean) for _, bars in series for found in bars):
        return ""
    rows = -(-len(series) // 2)
    size = (5.5, 2.35 + 0.19 * rows)
    with canvas(name, description, size) as drawing:
        axes = drawing.axes(0.72, 0.42 + 0.19 * rows, 5.4, size[1] - 0.1)
        width = 0.84 / max(len(series), 1)
        for i, (method, bars) in enumerate(series):
            at = np.arange(len(groups)) + (i - 0.5 * (len(series) - 1)) * width
            means = np.array([found.mean for found in bars])
            spread = np.array([[found.mean - found.low, found.high - found.mean] for found in bars]).T
            look = {"color": _COLOURS[i % len(_COLOURS)], "hatch": _HATCHES[i % len(_HATCHES)], "edgecolor": "white"}
            axes.bar(at, np.nan_to_num(means), 0.92 * width, lw=0.3, label=METHODS[method].title, **look)
            axes.errorbar(at, means, np.nan_to_num(spread), fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
        axes.set_xticks(range(len(groups)), groups)
        axes.tick_params(axis="x", length=0)
        axes.grid(axis="x", visible=False)
        axes.set_ylabel(unit)
        drawing.legend(2)
    return drawing.svg
