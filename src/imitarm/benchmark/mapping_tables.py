"""The tables of the mapping benchmark, built from saved results, for a terminal or a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from imitarm.benchmark.experiment import LIVE, METHODS, REPLAYS, Result, count_failures
from imitarm.benchmark.recordings import CAPTURED, KINDS
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import Interval, Values, interval, rate_interval

TEST = 200
"""Number of the first test person. Persons with smaller numbers were used for developing the methods."""
_DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class Figure:
    """A measure in a table, with its title and unit.

    Attributes:
        name: name in ``Result.values``.
        title: title of the table column, including the unit.
        factor: factor from SI units to the reported unit.
        digits: number of decimals.
        more: True if a larger value is better; False if a smaller value is better.
    """

    name: str
    title: str
    factor: float = 1.0
    digits: int = 1
    more: bool = False


ACCURACY = (
    Figure("tool_rms", "tool [mm]", 1e3),
    Figure("tool_rms_without_lag", "without lag [mm]", 1e3),
    Figure("lag", "lag [ms]", 1e3, 0),
    Figure("executed_rms", "executed [mm]", 1e3),
    Figure("executed_rms_without_lag", "executed, without lag [mm]", 1e3),
    Figure("tool_rms_from_first", "from first engagement [mm]", 1e3),
    Figure("orientation_rms", "orientation [°]", _DEGREES),
    Figure("elbow_direction_rms", "upper arm [°]", _DEGREES),
    Figure("elbow_angle_rms", "swivel angle [°]", _DEGREES),
)
EFFORT = (
    Figure("duration", "motion [s]"),
    Figure("teaching_time", "teaching [s]"),
    Figure("path_length", "path [m]", digits=2),
    Figure("settling_time", "settled after [s]", digits=2),
    Figure("effort", "∫τ² [N²m²s]", digits=0),
    Figure("gravity_effort", "∫τ² of gravity alone", digits=0),
    Figure("peak_torque_ratio", "peak over rated", digits=2),
)
SMOOTHNESS = (
    Figure("jerk_rms", "jerk [m/s³]", digits=0),
    Figure("spectral_arc_length", "SPARC", digits=2, more=True),
    Figure("least_singular", "least singular value", digits=3, more=True),
)
ENGAGED = Figure("engaged_fraction", "engaged [%]", 100.0, 0, more=True)
TORQUES = (
    Figure("mean_torque", "mean torque [N m]", digits=2),
    Figure("rms_torque", "RMS torque [N m]", digits=2),
    Figure("mean_motion_torque", "mean torque without gravity [N m]", digits=2),
)
"""The torque measures, averaged over the joints. Each measure also has a table with one column for each joint."""
LOOP = (Figure("time", "time [s]", digits=0), Figure("path_length", "path [m]", digits=2), TORQUES[0])

_RECORDED = (Figure("recorded", "length [s]"), Figure("beyond_reach", "beyond reach [%]", 100.0))
_MEANS_NOTE = "Each value is the mean over persons (95 % interval)."
_ACCURACY_NOTE = (
    "Distances are root mean squares. Executed: distance of a simulated arm that follows the commands within its "
    "limits, as a real arm does. From first engagement: distance from the time at which the robot first follows the "
    "person. Engaged: fraction of the time in which the robot followed the person."
)
_CAPTURED_NOTE = (
    "Each value is the mean over the simulated cameras (smallest … largest). All recordings show the motion of one "
    "person, so there is no interval."
)
_ONE = -1  # person of the captured arm: it is the same whichever simulated body carries it


class Results:
    """All results of a mapping benchmark, which can be selected by method, task and measure."""

    def __init__(self, results: Iterable[Result]) -> None:
        self.all = list(results)
        self.methods = [name for name in METHODS if any(r.experiment.method == name for r in self.all)]

    def of(self, method: str, tasks: Sequence[str]) -> list[Result]:
        """Return the results of one method in the given tasks."""
        return [r for r in self.all if r.experiment.method == method and r.experiment.task in tasks]

    def tasks(self, among: Sequence[str] = KINDS) -> list[str]:
        """Return those of the given tasks that have results."""
        return [task for task in among if any(r.experiment.task == task for r in self.all)]

    def values(self, method: str, tasks: Sequence[str], name: str, joint: int | None = None) -> Values:
        """Return one value of a measure for each recording or trial; nan where the value is unknown.

        Args:
            method: name of the method.
            tasks: tasks whose results are included.
            name: name of the measure. ``"limit_violations"`` is the sum of three numbers: the frames that exceed a
                limit of position, of velocity, and of acceleration. In closed-loop trials, ``"success"`` is 1 or 0. All
                other measures of these trials are known only if the trial succeeded.
            joint: index of the joint, for measures with one value for each joint; None for the mean over the joints.
        """
        return {
            (_person(r), (r.experiment.task, r.experiment.repeat)): number(r, name, joint)
            for r in self.of(method, tasks)
        }


def _person(result: Result) -> int:
    return _ONE if result.experiment.task == CAPTURED else result.experiment.seed


def number(result: Result, name: str, joint: int | None = None) -> float:
    """Return one measure of one result; for the names, see :meth:`Results.values`."""
    if result.experiment.task == LIVE:
        done = bool(result.values.get("success"))
        if name == "success" or not done:
            return float(done) if name == "success" else math.nan
    if name == "limit_violations":
        return sum(result.value(f"{kind}_violations") for kind in ("position", "velocity", "acceleration"))
    found = result.values.get(name)
    if isinstance(found, list | tuple):
        return float(np.mean(found)) if joint is None else float(found[joint])
    return math.nan if found is None else float(found)


def written(found: Interval, figure: Figure) -> str:
    """Return a table cell with mean and interval. If values are missing, it also states the number of known values."""
    if not math.isfinite(found.mean):
        return f"– (0 of {found.of})" if found.of else "–"
    values = [figure.factor * v for v in (found.mean, found.low, found.high)]
    text = f"{values[0]:.{figure.digits}f}"
    if math.isfinite(found.low):
        text += f" ({values[1]:.{figure.digits}f} to {values[2]:.{figure.digits}f})"
    return text if found.used == found.of else f"{text}, {found.used} of {found.of}"


def written_each(values: Values, figure: Figure) -> str:
    """Return a table cell with the mean and, in brackets, the smallest and the largest value."""
    known = [figure.factor * value for _, value in sorted(values.items()) if math.isfinite(value)]
    if not known:
        return f"– (0 of {len(values)})" if values else "–"
    text = f"{np.mean(known):.{figure.digits}f}"
    if len(known) > 1:
        text += f" ({min(known):.{figure.digits}f} … {max(known):.{figure.digits}f})"
    return text if len(known) == len(values) else f"{text}, {len(known)} of {len(values)}"


def _cells(results: Results, name: str, task: str, figures: Sequence[Figure]) -> list[str]:
    """Return table cells for one kind of recording: means with intervals or, for motion capture, with ranges."""
    found = [results.values(name, [task], figure.name) for figure in figures]
    if task == CAPTURED:
        return [written_each(values, figure) for values, figure in zip(found, figures, strict=True)]
    return [written(interval(values), figure) for values, figure in zip(found, figures, strict=True)]


def recordings_table(results: Results) -> Table:
    """Return a table of the recordings: number, duration, and how long the target is beyond the robot's reach."""
    rows = []
    for task in results.tasks(REPLAYS):
        runs = [r for r in results.all if r.experiment.task == task]
        asked, made = {r.experiment.plan for r in runs}, {r.experiment.plan for r in runs if not r.without_recording}
        fact = {r.experiment.plan: r for r in runs if "recorded" in r.values}
        of = str(len(asked)) if made == asked else f"{len(made)} of {len(asked)}"
        persons = len({plan.person for plan in asked})
        who = f"1 person, {len(asked)} cameras" if task == CAPTURED else f"{persons} simulated"
        cells = []
        for figure in _RECORDED:
            values = {(_person(r), (task, plan.repeat)): number(r, figure.name) for plan, r in fact.items()}
            cells.append(written_each(values, figure) if task == CAPTURED else written(interval(values), figure))
        rows.append((task, of, who, *cells))
    columns = ("kind", "recordings>", "persons", *(f"{figure.title}>" for figure in _RECORDED))
    note = (
        "Beyond reach: fraction of the time in which the target of the robot's wrist is too far away for the arm. If "
        f"a recording could not be made, it is missing for every method. {persons_note(results)}"
    )
    return Table("Recordings, the same for every method", columns, tuple(rows), note)


def persons_note(results: Results) -> str:
    """Return a sentence with the numbers of the simulated persons.

    It says whether the methods were developed with them.
    """
    seen = sorted({r.experiment.seed for r in results.all if r.experiment.task != CAPTURED})
    if not seen:
        return ""
    text = f"Persons {seen[0]} to {seen[-1]}." if len(seen) > 1 else f"Person {seen[0]}."
    return (
        text if seen[0] >= TEST else f"{text} Persons with numbers below {TEST} were used for developing the methods."
    )


def accuracy_table(results: Results, task: str) -> Table:
    """Return a table of how accurately each method follows the person's true motion in one kind of recording."""
    rows = []
    for name in results.methods:
        engaged = interval(results.values(name, [task], "engaged_fraction")).mean
        cells = _cells(results, name, task, ACCURACY)
        rows.append((METHODS[name].title, *cells, f"{100 * engaged:.0f}" if math.isfinite(engaged) else "–"))
    columns = ("method", *(f"{figure.title}>" for figure in ACCURACY), "engaged [%]>")
    note = f"{_CAPTURED_NOTE if task == CAPTURED else _MEANS_NOTE} {_ACCURACY_NOTE}"
    return Table(f"Accuracy, {task}", columns, tuple(rows), note)


def effort_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table of the times, the path length and the torques of each method."""
    return _figures(results, tasks, EFFORT, "Times, path, torques")


def smoothness_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table of the jerk, the spectral arc length and the smallest singular value of the Jacobian."""
    return _figures(results, tasks, SMOOTHNESS, "Smoothness and singularity")


def _figures(results: Results, tasks: Sequence[str], figures: Sequence[Figure], title: str) -> Table:
    rows = tuple(
        (METHODS[name].title, *(written(interval(results.values(name, tasks, f.name)), f) for f in figures))
        for name in results.methods
    )
    columns = ("method", *(f"{figure.title}>" for figure in figures))
    return Table(f"{title}: {', '.join(tasks)}", columns, rows, _MEANS_NOTE)


def torque_table(results: Results, tasks: Sequence[str], name: str, title: str) -> Table:
    """Return a table of one torque measure for each joint (Fig 3.6)."""
    rows = []
    for method in results.methods:
        found = [interval(results.values(method, tasks, name, joint)) for joint in range(7)]
        figure = Figure(name, "", digits=2)
        rows.append((METHODS[method].title, *(written(f, figure) for f in found)))
    columns = ("method", *(f"τ{joint + 1}>" for joint in range(7)))
    return Table(f"{title} [N m]: {', '.join(tasks)}", columns, tuple(rows), _MEANS_NOTE)


def limits_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table of the frames in which a joint exceeds a limit.

    Velocities and accelerations are finite differences of the joint positions.
    """
    rows = []
    for name in results.methods:
        made = [r for r in results.of(name, tasks) if not r.without_recording]
        runs = [r for r in made if not r.failure]
        clean = sum(number(r, "limit_violations") == 0 for r in runs)
        counts = [
            sum(int(r.value(f"{kind}_violations")) for r in runs) for kind in ("position", "velocity", "acceleration")
        ]
        ratios = [
            max((r.value(f"{kind}_ratio") for r in runs), default=math.nan) for kind in ("velocity", "acceleration")
        ]
        own = sum(int(r.value("failures")) for r in runs)
        row = (METHODS[name].title, f"{clean} of {len(made)}", *(str(n) for n in counts))
        rows.append((*row, *(f"{ratio:.2f}" for ratio in ratios), str(own)))
    heads = ("method", "recordings without any>", "position>", "velocity>", "acceleration>")
    columns = (*heads, "worst velocity>", "worst acceleration>", "faults found by the method>")
    note = (
        "Position, velocity, acceleration: number of frames in which a joint exceeds this limit. Worst velocity, "
        "worst acceleration: largest value divided by the limit. Faults found by the method: number of faults that "
        "the method itself reported and did not correct."
    )
    return Table(f"Limit violations: {', '.join(tasks)}", columns, tuple(rows), note)


def success_table(results: Results) -> Table:
    """Return a table of the closed-loop trials: success rate, and means over the successful trials."""
    rows = []
    for name in results.methods:
        runs = results.of(name, [LIVE])
        if not runs:
            continue
        done = [r for r in runs if r.values.get("success")]
        found = rate_interval(results.values(name, [LIVE], "success"))
        cells = []
        for figure in LOOP:
            values = {(r.experiment.seed, r.experiment.repeat): number(r, figure.name) for r in done}
            cells.append(written(interval(values), figure))
        why = count_failures([str(r.values.get("failure", r.failure) or "") for r in runs if r not in done])
        rate = (f"{len(done)} of {len(runs)}", f"{100 * found.low:.0f} to {100 * found.high:.0f}")
        rows.append((METHODS[name].title, *rate, *cells, why))
    columns = ("method", "stacked>", "95 % [%]>", *(f"{figure.title}>" for figure in LOOP), "failures")
    note = (
        "The interval of the success rate is a Wilson interval, with an effective number of trials. This number is "
        "smaller if the results differ more between persons. One more failure never raises the lower end of the "
        "interval. Time, path and torque are means over persons (95 % interval) in successful trials. "
        f"{persons_note(results)}"
    )
    return Table("Four cubes stacked, closed loop", columns, tuple(rows), note)
