"""The mapping benchmark's tables, from results that were saved: texts in rows, for a terminal or a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from imitarm.benchmark.experiment import LIVE, REPLAYS, Result
from imitarm.benchmark.intervals import Comparison, Interval, Values, compare, holm, interval, wilson_interval
from imitarm.benchmark.mapping_methods import METHODS
from imitarm.benchmark.recordings import CAPTURED, KINDS
from imitarm.benchmark.stacking import failures
from imitarm.benchmark.tables import Table

OURS = "modern"
_DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class Figure:
    """A measured number in the unit in which people think of it.

    Attributes:
        name: in ``Result.values``.
        title: with its unit.
        factor: from SI.
        digits: after the point.
    """

    name: str
    title: str
    factor: float = 1.0
    digits: int = 1


ACCURACY = (
    Figure("tool_rms", "tool [mm]", 1e3),
    Figure("tool_rms_without_lag", "without lag [mm]", 1e3),
    Figure("lag", "lag [ms]", 1e3, 0),
    Figure("executed_rms", "executed [mm]", 1e3),
    Figure("executed_rms_without_lag", "executed, without lag [mm]", 1e3),
    Figure("tool_rms_from_first", "from first hold [mm]", 1e3),
    Figure("orientation_rms", "turn [°]", _DEGREES),
    Figure("elbow_direction_rms", "upper arm [°]", _DEGREES),
    Figure("elbow_angle_rms", "elbow's swing [°]", _DEGREES),
)
EFFORT = (
    Figure("duration", "motion [s]"),
    Figure("teaching_time", "teaching [s]"),
    Figure("path_length", "path [m]", digits=2),
    Figure("settling_time", "settled after [s]", digits=2),
    Figure("effort", "∫τ² [N²m²s]", digits=0),
    Figure("gravity_effort", "of it weight", digits=0),
    Figure("peak_torque_ratio", "peak over rated", digits=2),
)
SMOOTHNESS = (
    Figure("jerk_rms", "jerk [m/s³]", digits=0),
    Figure("spectral_arc_length", "SPARC", digits=2),
    Figure("least_singular", "least singular value", digits=3),
)
_RECORDED = (Figure("recorded", "length [s]"), Figure("beyond_reach", "beyond reach [%]", 100.0))
_ACCURACY_NOTE = (
    "Mean over persons (95 % interval), root mean squares. Executed: by an arm that keeps its limits, which a real one "
    "does. Led: share of the time."
)
COMPARED = (
    Figure("tool_rms", "tool [mm]", 1e3),
    Figure("tool_rms_without_lag", "without lag [mm]", 1e3),
    Figure("executed_rms", "executed [mm]", 1e3),
    Figure("executed_rms_without_lag", "executed, without lag [mm]", 1e3),
    Figure("elbow_direction_rms", "upper arm [°]", _DEGREES),
    Figure("path_length", "path [m]", digits=2),
    Figure("settling_time", "settled after [s]", digits=2),
    Figure("mean_torque", "mean torque [N m]", digits=2),
    Figure("broken_limits", "frames beyond a limit", digits=0),
    SMOOTHNESS[0],
)
"""What ``modern`` is compared with the others in."""


class Results:
    """Results by method, task and name of what was measured."""

    def __init__(self, results: Iterable[Result]) -> None:
        self.all = list(results)
        self.methods = [name for name in METHODS if any(r.experiment.method == name for r in self.all)]

    def of(self, method: str, tasks: Sequence[str]) -> list[Result]:
        """Return the results of a method at some tasks."""
        return [r for r in self.all if r.experiment.method == method and r.experiment.task in tasks]

    def tasks(self, among: Sequence[str] = KINDS) -> list[str]:
        """Return those tasks that have results."""
        return [task for task in among if any(r.experiment.task == task for r in self.all)]

    def values(self, method: str, tasks: Sequence[str], name: str, joint: int | None = None) -> Values:
        """Return a number of each recording, by person and recording; nan where it is not known.

        Args:
            method: whose.
            tasks: at which.
            name: what was measured; ``"broken_limits"`` is the sum of the three counts.
            joint: of what is measured for each joint, which; None: the mean over the joints.
        """
        return {
            (r.experiment.seed, (r.experiment.task, r.experiment.repeat)): number(r, name, joint)
            for r in self.of(method, tasks)
        }


def number(result: Result, name: str, joint: int | None = None) -> float:
    """Return one number of a result, see :meth:`Results.values`."""
    if name == "broken_limits":
        return sum(result.value(f"{kind}_violations") for kind in ("position", "velocity", "acceleration"))
    found = result.values.get(name)
    if isinstance(found, list | tuple):
        return float(np.mean(found)) if joint is None else float(found[joint])
    return math.nan if found is None else float(found)


def written(found: Interval, figure: Figure) -> str:
    """Return mean, interval and, when some recordings have no number, how many have one."""
    if not math.isfinite(found.mean):
        return f"– (0 of {found.of})" if found.of else "–"
    values = [figure.factor * v for v in (found.mean, found.low, found.high)]
    text = f"{values[0]:.{figure.digits}f}"
    if math.isfinite(found.low):
        text += f" ({values[1]:.{figure.digits}f} to {values[2]:.{figure.digits}f})"
    return text if found.used == found.of else f"{text}, {found.used} of {found.of}"


def recordings_table(results: Results) -> Table:
    """Return how many recordings there are, how long, and how often they ask for what no arm of this length reaches."""
    rows = []
    for task in results.tasks(REPLAYS):
        some = results.of(results.methods[0], [task])
        persons = {r.experiment.seed for r in some}
        cells = [written(interval(results.values(results.methods[0], [task], f.name)), f) for f in _RECORDED]
        rows.append((task, str(len(some)), str(len(persons)), *cells))
    columns = ("kind", "recordings>", "persons, or cameras>", *(f"{figure.title}>" for figure in _RECORDED))
    note = "Beyond reach: share of the time in which the wrist is led farther than the robot's arm is long."
    return Table("Recordings, the same for every method", columns, tuple(rows), note)


def accuracy_table(results: Results, task: str) -> Table:
    """Return how well the methods follow the true arm in one kind of recording."""
    rows = []
    for name in results.methods:
        cells = [written(interval(results.values(name, [task], f.name)), f) for f in ACCURACY]
        led = interval(results.values(name, [task], "led_share")).mean
        rows.append((METHODS[name].title, *cells, f"{100 * led:.0f}" if math.isfinite(led) else "–"))
    columns = ("method", *(f"{figure.title}>" for figure in ACCURACY), "led [%]>")
    return Table(f"Accuracy, {task}", columns, tuple(rows), _ACCURACY_NOTE)


def effort_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return path, settling and torque."""
    return _figures(results, tasks, EFFORT, "Times, path, torques")


def smoothness_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return jerk, spectral arc length and distance from singularity."""
    return _figures(results, tasks, SMOOTHNESS, "Smoothness and singularity")


def _figures(results: Results, tasks: Sequence[str], figures: Sequence[Figure], title: str) -> Table:
    rows = tuple(
        (METHODS[name].title, *(written(interval(results.values(name, tasks, f.name)), f) for f in figures))
        for name in results.methods
    )
    columns = ("method", *(f"{figure.title}>" for figure in figures))
    return Table(f"{title}: {', '.join(tasks)}", columns, rows, "Mean over persons (95 % interval).")


def torque_table(results: Results, tasks: Sequence[str], name: str, title: str) -> Table:
    """Return a torque of each joint (Fig 3.6)."""
    rows = []
    for method in results.methods:
        found = [interval(results.values(method, tasks, name, joint)) for joint in range(7)]
        figure = Figure(name, "", digits=2)
        rows.append((METHODS[method].title, *(written(f, figure) for f in found)))
    columns = ("method", *(f"τ{joint + 1}>" for joint in range(7)))
    return Table(f"{title} [N m]: {', '.join(tasks)}", columns, tuple(rows), "Mean over persons (95 % interval).")


def limits_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return what breaks limits, by finite differences of the joint positions alone."""
    rows = []
    for name in results.methods:
        runs = [r for r in results.of(name, tasks) if not r.failure]
        clean = sum(number(r, "broken_limits") == 0 for r in runs)
        counts = [
            sum(int(r.value(f"{kind}_violations")) for r in runs) for kind in ("position", "velocity", "acceleration")
        ]
        ratios = [
            max((r.value(f"{kind}_ratio") for r in runs), default=math.nan) for kind in ("velocity", "acceleration")
        ]
        own = sum(int(r.value("failures")) for r in runs)
        row = (METHODS[name].title, f"{clean} of {len(results.of(name, tasks))}", *(str(n) for n in counts))
        rows.append((*row, *(f"{ratio:.2f}" for ratio in ratios), str(own)))
    heads = ("method", "recordings without>", "position>", "velocity>", "acceleration>")
    columns = (*heads, "worst velocity>", "worst acceleration>", "known to the method>")
    note = "Frames that break a limit; the worst as a share of the limit; faults the method found itself and left."
    return Table(f"Limits broken: {', '.join(tasks)}", columns, tuple(rows), note)


def success_table(results: Results) -> Table:
    """Return how often four cubes were stacked with the loop closed; time and path only of what succeeded."""
    rows = []
    for name in results.methods:
        runs = results.of(name, [LIVE])
        if not runs:
            continue
        done = [r for r in runs if r.values.get("success")]
        low, high = wilson_interval(len(done), len(runs))
        figures = [
            Figure("time", "", digits=0),
            Figure("path_length", "", digits=2),
            Figure("mean_torque", "", digits=2),
        ]
        cells = []
        for figure in figures:
            values = {(r.experiment.seed, r.experiment.repeat): number(r, figure.name) for r in done}
            cells.append(written(interval(values), figure))
        why = failures([str(r.values.get("failure", r.failure) or "") for r in runs if r not in done])
        rate = (f"{len(done)} of {len(runs)}", f"{100 * low:.0f} to {100 * high:.0f}")
        rows.append((METHODS[name].title, *rate, *cells, why))
    columns = ("method", "stacked>", "95 % [%]>", "time [s]>", "path [m]>", "mean torque [N m]>", "failures")
    note = "Time, path and torque are means over persons (95 % interval) of the trials that succeeded."
    return Table("Four cubes stacked, loop closed", columns, tuple(rows), note)


def comparison_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return ``modern`` against each other method, paired over the same recordings."""
    rows = []
    rivals = [name for name in results.methods if name != OURS]
    for figure in COMPARED:
        if OURS not in results.methods:
            break
        ours = results.values(OURS, tasks, figure.name)
        found = [compare(ours, results.values(name, tasks, figure.name)) for name in rivals]
        for name, comparison, p in zip(rivals, found, holm([c.p for c in found]), strict=True):
            rows.append((figure.title, METHODS[name].title, *_difference(comparison, figure), f"{p:.3f}"))
    columns = ("measure", f"{OURS} less", "difference (95 %)>", "relative [%]>", "pairs>", "p, Holm>")
    note = "Persons are resampled; p by sign flips of the persons' differences, corrected within each measure."
    return Table(f"Paired comparison: {', '.join(tasks)}", columns, tuple(rows), note)


def rivals_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return where another method is better than ``modern``: in each kind of recording, and with the loop closed."""
    rows = []
    rivals = [name for name in results.methods if name != OURS and OURS in results.methods]
    for task in tasks:
        for figure in COMPARED:
            ours = results.values(OURS, [task], figure.name)
            found = [compare(ours, results.values(name, [task], figure.name)) for name in rivals]
            for name, comparison, p in zip(rivals, found, holm([c.p for c in found]), strict=True):
                if comparison.difference.low > 0.0:  # less is better in all of them
                    cells = _difference(comparison, figure)
                    rows.append((task, figure.title, METHODS[name].title, *cells, f"{p:.3f}"))
    done = {name: [bool(r.values.get("success")) for r in results.of(name, [LIVE])] for name in [OURS, *rivals]}
    for name in rivals:
        if done[OURS] and done[name] and np.mean(done[name]) > np.mean(done[OURS]):
            text = f"{sum(done[OURS])} of {len(done[OURS])} against {sum(done[name])} of {len(done[name])}"
            rows.append((LIVE, "stacked", METHODS[name].title, text, "", "", ""))
    columns = ("recordings", "measure", "better", "difference (95 %)>", "relative [%]>", "pairs>", "p, Holm>")
    note = f"All measures whose interval says that {OURS} is worse, and every method that stacked more often."
    return Table(f"Where another method is better than {OURS}", columns, tuple(rows), note)


def _difference(comparison: Comparison, figure: Figure) -> tuple[str, str, str]:
    found = comparison.difference
    if not math.isfinite(found.mean):
        return "–", "–", f"0 of {found.of}"
    low, mean, high = (figure.factor * v for v in (found.low, found.mean, found.high))
    text = f"{mean:+.{figure.digits}f} ({low:+.{figure.digits}f} to {high:+.{figure.digits}f})"
    share = f"{100 * comparison.relative:+.0f}" if math.isfinite(comparison.relative) else "–"
    return text, share, f"{found.used} of {found.of}"


def all_tables(results: Results) -> list[Table]:
    """Return every table that the results fill."""
    tasks, tables = results.tasks(), []
    if results.tasks([LIVE]):
        tables.append(success_table(results))
    if results.tasks(REPLAYS):
        tables.append(recordings_table(results))
    tables += [accuracy_table(results, task) for task in results.tasks(REPLAYS)]
    if tasks:
        tables.append(rivals_table(results, tasks))
        tables += [comparison_table(results, tasks), limits_table(results, tasks), effort_table(results, tasks)]
        tables.append(smoothness_table(results, tasks))
        tables.append(torque_table(results, tasks, "mean_torque", "Mean of the absolute torque"))
        tables.append(torque_table(results, tasks, "rms_torque", "Root mean square torque"))
        tables.append(torque_table(results, tasks, "mean_motion_torque", "Mean of the absolute torque without weight"))
    if results.tasks([CAPTURED]):
        tables.append(limits_table(results, [CAPTURED]))
    return tables
