"""Write the results of the mapping benchmark as one HTML page with tables, figures, and playbacks of person and robot.

The figures correspond to Figs 3.6 to 3.8 of the thesis. Each figure is one ``<svg>`` element.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from imitarm.benchmark.experiment import LIVE, MAIN, METHODS, Experiment, Result, plain
from imitarm.benchmark.mapping_comparisons import OURS
from imitarm.benchmark.mapping_tables import Results, number
from imitarm.benchmark.recordings import CAPTURED
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import Interval, Values, interval, rate_interval
from imitarm.kinematics.arm import ArmModel
from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, canvas
from imitarm.viewer.page import Figure, Header, Player, Tab, Tile, draw_page, render, shared_players
from imitarm.viewer.retarget_report import PLAYER_KEYS, MethodResult, RetargetReport, playback

_SHOWN: Final = 9.0  # [s] of the recording that is played
_WORDS: Final = {
    "Interval": "The 95 % confidence interval of a mean over persons (bootstrap over persons). Overlapping "
    "intervals do not rule out a difference. The table of paired comparisons tests whether there is a difference.",
    "Lag": "The constant delay of the tool after the hand that gives the best match between their motions.",
    "From first engagement": "The RMS distance between the tool and its true target, from the time at which the robot "
    "first follows the person until the end. Times in which the robot does not follow the person count as well.",
    "SPARC": "Spectral arc length of the speed: the closer to 0, the smoother the motion.",
    "Our interpretation": "The thesis describes its baselines only in words. The methods M1 to M3 "
    "are our implementations of these descriptions.",
}


def write_mapping_report(
    results: Results, tables: Sequence[Table], path: str | Path, *, provenance: Mapping[str, Any], folder: Path | None
) -> Path:
    """Write the page with :func:`~imitarm.viewer.page.draw_page` and return its path.

    Args:
        results: results of the benchmark.
        tables: tables that the command also prints.
        path: the file to write; its folder must exist.
        provenance: facts needed to repeat the benchmark.
        folder: folder that contains the recordings; None if they were not saved.

    Returns:
        Absolute path of the page.

    Raises:
        InputError: when the file can't be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: mapping_report_html(results, tables, provenance=provenance, folder=folder), path)


def mapping_report_html(
    results: Results, tables: Sequence[Table], *, provenance: Mapping[str, Any], folder: Path | None
) -> str:
    """Return the whole page as HTML; for the arguments, see :func:`write_mapping_report`."""
    shared, players = _players(results, folder)
    verdict, good = _verdict(results)
    summary = (
        "Every method follows the same recordings of simulated people. The same people also stack cubes with "
        "every method."
    )
    return render(
        "mapping.html",
        Header("Mapping benchmark", verdict, good, summary, _tiles(results)),
        data={"results": [_data(r) for r in results.all]},
        data_name="imitarm-mapping.json",
        provenance=provenance,
        words=_WORDS,
        shared=shared,
        figures=_figures(results),
        tables=[table.for_page() for table in tables],
        players=players,
    )


def _verdict(results: Results) -> tuple[str, bool]:
    runs = [
        r for r in results.all if r.experiment.method == OURS and r.experiment.task != LIVE and not r.without_recording
    ]
    if not runs:
        return f"{OURS} was not run", False
    broken = sum(_breaks(r) for r in runs)
    text = f"{OURS} exceeds a limit in {broken} of {len(runs)} recordings"
    return text, broken == 0


def _breaks(result: Result) -> bool:
    return bool(result.failure) or number(result, "limit_violations") > 0


def _tiles(results: Results) -> list[Tile]:
    tiles = []
    for name in results.methods:
        runs = results.of(name, [LIVE])
        if runs:
            done = sum(bool(r.values.get("success")) for r in runs)
            tiles.append(Tile(str(done), f"of {len(runs)}", f"towers stacked with {METHODS[name].title}"))
    return tiles[:5]


def _figures(results: Results) -> list[Figure]:
    tasks = results.tasks()
    stacking = results.tasks(["stacking"]) or tasks
    main = Results(r for r in results.all if r.experiment.method in MAIN)
    bars = "Bars: means over persons. Lines: 95 % intervals."
    return [
        Figure(successes(main), "Success", f"Four cubes stacked in closed loop. {bars}"),
        Figure(torques(main, stacking), "Mean torque of each joint (Fig 3.6)", bars),
        Figure(path_lengths(main, tasks), "Path length (Fig 3.7)", bars),
        Figure(times(main), "Time to complete (Fig 3.8)", f"Successful trials only. {bars}"),
        Figure(accuracy(main, tasks), "Accuracy", bars),
        Figure(limit_violations(main, tasks), "Limit violations", bars),
    ]


def _players(results: Results, folder: Path | None) -> tuple[tuple[str, str] | None, list[Tab]]:
    """Return 3-D playbacks of the first recording at the edge of reach, one for each of the main methods."""
    replayed = [r.experiment for r in results.all if r.experiment.task != LIVE and not r.failure]
    chosen = next((e for e in replayed if e.task == "edge"), next(iter(replayed), None))
    if chosen is None:
        return None, []
    recording = chosen.recording(folder)
    first = recording.skeletons[0].time
    seen = [skeleton for skeleton in recording.skeletons if skeleton.time - first <= _SHOWN]
    arm, methods = ArmModel.load(chosen.robot, tool="gripper"), []
    for name in [name for name in results.methods if name in MAIN]:
        run = METHODS[name](arm, recording.correspondence).run(seen, recording.start)
        methods.append(MethodResult(name, METHODS[name].title, run))
    if not methods:
        return None, []
    report = RetargetReport("Mapping benchmark", methods, seen, recording.correspondence, "", good=True)
    shared, own = shared_players({method.name: playback(report, method) for method in methods})
    tabs = [
        Tab(f"method-{m.name}", m.title, Player(f"Person and robot: {m.title}", own[m.name], PLAYER_KEYS))
        for m in methods
    ]
    return shared, tabs


def _data(result: Result) -> dict[str, Any]:
    experiment: Experiment = result.experiment
    person = None if experiment.task == CAPTURED else experiment.seed  # that one is not a simulated person
    facts = {"task": experiment.task, "method": experiment.method, "person": person}
    return {
        **facts,
        "repeat": experiment.repeat,
        "failure": result.failure,
        "values": plain(dict(result.values)),
    }


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
    """Draw the RMS distance between the tool and its true target, for each method and kind of recording."""
    text = "Root mean square distance of the tool to its true target"
    return _by_task(results, tasks, "tool_rms", 1e3, "tool RMS [mm]", text, name)


def limit_violations(results: Results, tasks: Sequence[str], *, name: str = "limits") -> str:
    """Draw the number of frames that exceed a limit, for each method and kind of recording."""
    text = "Frames that exceed a limit of position, velocity or acceleration"
    return _by_task(results, tasks, "limit_violations", 1.0, "frames per recording", text, name)


def times(results: Results, *, name: str = "times") -> str:
    """Draw the time to stack four cubes for each method, in the successful trials (Fig 3.8)."""

    def values(method: str) -> Values:
        return results.values(method, [LIVE], "time")

    return _live(
        results, lambda m: interval(values(m)), "time of successful trials [s]", "Time to stack four cubes", name
    )


def successes(results: Results, *, name: str = "successes") -> str:
    """Draw how often each method stacked all four cubes, with intervals over persons."""

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
    """Draw groups of bars with intervals, one bar for each series; return an empty text if there are no values."""
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
