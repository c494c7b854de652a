"""Compare the method ``modern`` with every other method, and check the claims of the thesis against the results."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.experiment import LIVE, METHODS
from imitarm.benchmark.mapping_tables import (
    ACCURACY,
    EFFORT,
    ENGAGED,
    LOOP,
    SMOOTHNESS,
    TORQUES,
    Figure,
    Results,
    written,
)
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import Comparison, Values, bootstrap, compare, holm, interval
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

OURS = "modern"
COMPARED = (
    *(*ACCURACY, ENGAGED, *TORQUES, *EFFORT),
    Figure("limit_violations", "frames beyond a limit", digits=0),
    *SMOOTHNESS,
)
"""The measures in which ``modern`` is compared with the other methods in the recordings. These are all measures of
accuracy, effort, torque and smoothness, and the number of frames that exceed a limit."""
STACKED = Figure("success", "stacked [%]", 100.0, 0, more=True)
LIVE_COMPARED = (STACKED, *LOOP, TORQUES[1], EFFORT[4], EFFORT[6])
"""The measures that are compared in the closed-loop trials.

The success rate uses all trials; all other measures use only trials in which both methods succeeded.
"""


def _compared(results: Results, tasks: Sequence[str]) -> Iterator[tuple[Figure, str, Comparison, float]]:
    """Yield one comparison of ``modern`` for each measure and each other method.

    Each comparison consists of the measure, the name of the other method, the difference (``modern`` minus the other
    method), and the p-value after Holm's correction for the number of other methods.
    """
    baselines = [name for name in results.methods if name != OURS and results.of(name, tasks)]
    if not results.of(OURS, tasks):
        return
    for figure in LIVE_COMPARED if tasks == [LIVE] else COMPARED:
        ours = results.values(OURS, tasks, figure.name)
        found = [compare(ours, results.values(name, tasks, figure.name)) for name in baselines]
        for name, comparison, p in zip(baselines, found, holm([c.p for c in found]), strict=True):
            yield figure, name, comparison, p


def comparison_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table that compares ``modern`` with every other method on the same recordings or trials."""
    rows = [
        (_titled(figure), METHODS[name].title, *_difference(comparison, figure), f"{p:.3f}")
        for figure, name, comparison, p in _compared(results, tasks)
    ]
    columns = ("measure", f"{OURS} minus", "difference (95 %)>", "relative [%]>", "pairs>", "p, Holm>")
    note = (
        "↑ marks measures for which a larger value is better. For all other measures, a smaller value is better. The "
        "intervals are bootstrap intervals over the persons. The p-value is that of a sign-flip test over the "
        "persons. Holm's method corrects each p-value for the number of methods that are compared in the measure. "
        "Pairs: recordings or trials for which both methods have a value."
    )
    return Table(f"Paired comparison: {', '.join(tasks)}", columns, tuple(rows), note)


def better_methods_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table of the measures in which another method is better than ``modern``."""
    rows = []
    for task in [*tasks, LIVE]:
        for figure, name, comparison, p in _compared(results, [task]):
            sign, found = -1.0 if figure.more else 1.0, comparison.difference
            often = figure is STACKED and found.mean < 0.0
            if often or (found.excludes_zero and sign * found.mean > 0.0):
                cells = _difference(comparison, figure)
                rows.append((task, _titled(figure), METHODS[name].title, *cells, f"{p:.3f}"))
    columns = (
        "recordings",
        "measure",
        "better method",
        f"{OURS} minus the better method (95 %)>",
        "relative [%]>",
        "pairs>",
        "p, Holm>",
    )
    note = (
        f"The table lists every measure in which the 95 % interval shows that {OURS} is worse, even if the p-value is "
        f"large. It also lists every method that stacked the cubes more often than {OURS}, even if the interval "
        "includes zero. ↑ marks measures for which a larger value is better. For all other measures, a smaller value "
        "is better."
    )
    return Table(f"Where another method is better than {OURS}", columns, tuple(rows), note)


def _titled(figure: Figure) -> str:
    return f"{figure.title} ↑" if figure.more else figure.title


def _difference(comparison: Comparison, figure: Figure) -> tuple[str, str, str]:
    found = comparison.difference
    if not math.isfinite(found.mean):
        return "–", "–", f"0 of {found.of}"
    most = 1.0 if figure is STACKED else math.inf  # two rates are no farther apart
    low, mean, high = (figure.factor * min(max(v, -most), most) for v in (found.low, found.mean, found.high))
    text = f"{mean:+.{figure.digits}f}"
    if high > low:  # when all persons differ by the same, as rates of 0 and 100 % do, there is no interval
        text += f" ({low:+.{figure.digits}f} to {high:+.{figure.digits}f})"
    relative = f"{100 * comparison.relative:+.0f}" if math.isfinite(comparison.relative) else "–"
    return text, relative, f"{found.used} of {found.of}"


PRINTED_PATH = np.array([7.03, 7.43, 9.04, 9.26, 8.72, 9.53, 6.4, 8.36, 9.32, 10.24])
"""Path lengths of the ten experiments of thesis Table 3.1, in the unit "cm.10". The thesis does not explain this
unit."""
PRINTED_TORQUES = np.array(
    [
        [13.035, 13.58, 23.45, 18.42, 11.03, 20.45, 28.08],
        [22.52, 19.86, 22.33, 17.03, 10.23, 23.52, 41.8],
        [32.39, 13.87, 18.88, 19.09, 10.99, 26.08, 21.14],
        [16.985, 15.21, 16.35, 22.97, 12.57, 29.83, 33.44],
        [9.085, 14.33, 8.93, 24.31, 12.93, 26.56, 21.14],
        [12.28, 17.33, 20.93, 20.23, 13.39, 20.48, 20.35],
        [25.83, 18.22, 17.58, 20.23, 19.34, 14.16, 25.31],
        [16.99, 14.33, 18.43, 21.43, 18.23, 22.08, 30.94],
        [18.14, 15.8, 17.8, 22.12, 11.53, 13.44, 29.01],
        [27.44, 12.3, 24.6, 24.08, 14.43, 17.12, 30.1],
    ]
)
"""Mean torque of each joint in the ten experiments of thesis Table 3.1, shape (10, 7) [N m]."""
PRINTED_TIME = np.array([22.23, 18.43, 17.72, 19.2, 15.82, 14.21, 13.03, 9.01, 9.31, 12.42])
"""Execution times of the ten experiments of thesis Table 3.1 [s]."""

ME = ("thesis", "modern")
"""The methods for which the claims about the thesis's method Me are checked. ``thesis`` is Me with corrected equations,
and ``modern`` is the method of this library."""
BASELINES = ("m1", "m2", "m3")
_TORQUE_FIGURE = Figure("mean_torque", "mean torque [N m]", digits=2)
_PATH_FIGURE = Figure("path_length", "path [m]", digits=2)


def printed_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table of thesis Table 3.1 (means over its ten experiments) and of our results (means over persons)."""
    arm = ArmModel.load("sawyer", tool="gripper")
    rows = [
        (
            "thesis, printed",
            *(_spread(column) for column in PRINTED_TORQUES.T),
            f"{_spread(PRINTED_PATH)} cm.10",
            _spread(PRINTED_TIME),
        )
    ]
    rated = ["–" if not math.isfinite(t) else f"{t:g}" for t in arm.max_torque]
    rows.append(("rated by the manufacturer", *rated, "", ""))
    for name in results.methods:
        torques = [
            written(interval(results.values(name, tasks, "mean_torque", joint)), _TORQUE_FIGURE) for joint in range(7)
        ]
        path = written(interval(results.values(name, tasks, "path_length")), _PATH_FIGURE)
        time = written(interval(_times(results, name)), Figure("time", "", digits=0))
        rows.append((METHODS[name].title, *torques, f"{path} m" if path != "–" else path, time))
    columns = ("", *(f"τ{joint + 1} [N m]>" for joint in range(7)), "path>", "time [s]>")
    over = int(np.sum(PRINTED_TORQUES.mean(axis=0) > arm.max_torque))
    note = (
        "Values are means (95 % interval). In the rows of our methods, torques and path come from the recordings "
        f"({', '.join(tasks)}). The time comes from the closed-loop trials that succeeded. In the thesis, {over} of "
        "the 7 printed means exceed the rated torques of the joints, so they can't be mean torques of a Sawyer's "
        "joints."
    )
    return Table("Table 3.1 of the thesis, and our values", columns, tuple(rows), note)


def _spread(column: Array) -> str:
    low, high = bootstrap(column)
    return f"{column.mean():.2f} ({low:.2f} to {high:.2f})"


def _times(results: Results, method: str) -> Values:
    """Return the time of each closed-loop trial; nan for a trial that failed."""
    return results.values(method, [LIVE], "time")


def claims_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return a table that shows whether the thesis's claims hold for the methods in :data:`ME`."""
    rows = []
    for claim, evaluate in CLAIMS:
        cells: list[str] = []
        for me in ME:
            cells += evaluate(results, me, tasks) if me in results.methods else ("–", "not run")
        rows.append((claim, *cells))
    columns = ("the thesis claims", "thesis, corrected", "held?", "modern", "held?")
    note = (
        "A percentage is the difference between the method of the column and the baseline, relative to the baseline. "
        "A difference counts if its 95 % interval excludes zero and its corrected p-value is below 0.05. The result "
        'is "yes" if the differences from all baselines count and have the claimed sign. The result is "no" if at '
        'least one difference counts and has the opposite sign. All other results are "not shown". Times are compared '
        "only in trials in which the method and the baseline both succeeded."
    )
    return Table("Claims of the thesis, and results", columns, tuple(rows), note)


Verdict = tuple[str, str]
"""The measured values as text, and the verdict: "yes", "no", "not shown" or "not run"."""


def verdict(comparisons: Sequence[Comparison], sign: float) -> str:
    """Return whether a claimed difference from every baseline is confirmed: "yes", "no" or "not shown".

    A difference counts if its interval excludes zero and its p-value, corrected for the number of baselines, is below
    0.05. With only two persons, p is never below 0.05, so no claim can be confirmed.

    Args:
        comparisons: one comparison with each baseline (evaluated method minus baseline).
        sign: sign that the differences should have according to the claim, -1 or 1.
    """
    corrected = holm([c.p for c in comparisons])
    shown = [
        c.difference.mean * sign if c.difference.excludes_zero and p < 0.05 else 0.0
        for c, p in zip(comparisons, corrected, strict=True)
    ]
    if any(side < 0.0 for side in shown):
        return "no"
    return "yes" if shown and all(side > 0.0 for side in shown) else "not shown"


def _against(pairs: Sequence[tuple[str, Values, Values]], sign: float) -> Verdict:
    """Compare Me with baselines; ``pairs`` holds each baseline's name, the values of Me, and the baseline's values."""
    found = [(name, compare(ours, theirs)) for name, ours, theirs in pairs]
    texts = [
        f"{METHODS[name].title} {100 * c.relative:+.0f} %" if math.isfinite(c.relative) else f"{METHODS[name].title} –"
        for name, c in found
    ]
    return ", ".join(texts) or "–", verdict([c for _, c in found], sign)


def _less(name: str) -> Callable[[Results, str, Sequence[str]], Verdict]:
    def evaluate(results: Results, me: str, tasks: Sequence[str]) -> Verdict:
        ours = results.values(me, tasks, name)
        baselines = [baseline for baseline in BASELINES if baseline in results.methods]
        return _against([(baseline, ours, results.values(baseline, tasks, name)) for baseline in baselines], -1.0)

    return evaluate


def _quicker(results: Results, me: str, _: Sequence[str]) -> Verdict:
    baselines = [baseline for baseline in BASELINES if results.of(baseline, [LIVE])]
    text, held = _against([(baseline, _times(results, me), _times(results, baseline)) for baseline in baselines], -1.0)
    return (text, held) if baselines else ("–", "not run")


def _two_leads(results: Results, me: str, tasks: Sequence[str]) -> Verdict:
    """Evaluate the claim that M2 has the smallest torque of all methods and takes the longest time."""
    others = [name for name in (me, "m1", "m3") if name in results.methods]
    if "m2" not in results.methods or not results.of("m2", [LIVE]):
        return "–", "not run"
    torque = results.values("m2", tasks, "mean_torque")
    first, least = _against([(o, torque, results.values(o, tasks, "mean_torque")) for o in others], -1.0)
    second, longest = _against([(o, _times(results, "m2"), _times(results, o)) for o in others], 1.0)
    both = "no" if "no" in {least, longest} else "yes" if least == longest == "yes" else "not shown"
    return f"torque: {first}; time: {second}", both


def _farther_from_singular(results: Results, me: str, _: Sequence[str]) -> Verdict:
    """Evaluate the claim that singularities are avoided: the smallest singular value is larger than with M3."""
    if not results.tasks(["edge"]) or "m3" not in results.methods:
        return "–", "not run"
    ours, theirs = (results.values(name, ["edge"], "least_singular") for name in (me, "m3"))
    text, held = _against([("m3", ours, theirs)], 1.0)
    mean = interval(ours).mean
    return f"{mean:.3f}; {text}", held


def _rated(results: Results, me: str, tasks: Sequence[str]) -> Verdict:
    """Evaluate the claim on mean torques: the mean torque of each joint is within the printed interval."""
    inside = 0
    for joint, column in enumerate(PRINTED_TORQUES.T):
        low, high = bootstrap(column)
        inside += low <= interval(results.values(me, tasks, "mean_torque", joint)).mean <= high
    return f"{inside} of 7 joints within the printed interval", "yes" if inside == 7 else "no"


def _like_printed_time(results: Results, me: str, _: Sequence[str]) -> Verdict:
    found = interval(_times(results, me))
    if not math.isfinite(found.mean):
        return "–", "not run" if found.of == 0 else "no"
    low, high = bootstrap(PRINTED_TIME)
    return f"{found.mean:.0f} s, {found.used} of {found.of} stacked", "yes" if low <= found.mean <= high else "no"


_MEANS = PRINTED_TORQUES.mean(axis=0).tolist()
CLAIMS: Sequence[tuple[str, Callable[[Results, str, Sequence[str]], Verdict]]] = (
    ("less torque than M1, M2, M3 (Fig 3.6)", _less("mean_torque")),
    ("a shorter path than M1, M2, M3, by up to 5 % (Fig 3.7)", _less("path_length")),
    ("shorter time than M1, M2, M3 (Fig 3.8)", _quicker),
    ("M2 has the smallest torque, but takes the longest time (text beside Fig 3.7)", _two_leads),
    (
        "at the edge of reach, the arm stays farther from singularities than with M3",
        _farther_from_singular,
    ),
    (f"mean torques of {min(_MEANS):.0f} to {max(_MEANS):.0f} N m at every joint (Table 3.1)", _rated),
    (f"four cubes stacked in {PRINTED_TIME.mean():.1f} s (Table 3.1)", _like_printed_time),
)
"""The claims of the thesis, and the functions that evaluate them."""
