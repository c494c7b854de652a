"""The mapping benchmark's paired comparisons: ``modern`` against each other method in every measure of the tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from imitarm.benchmark.experiment import LIVE
from imitarm.benchmark.mapping_methods import METHODS
from imitarm.benchmark.mapping_tables import ACCURACY, EFFORT, LED, LOOP, SMOOTHNESS, TORQUES, Figure, Results
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import Comparison, compare, holm

OURS = "modern"
COMPARED = (
    *(*ACCURACY, LED, *TORQUES, *EFFORT),
    Figure("broken_limits", "frames beyond a limit", digits=0),
    *SMOOTHNESS,
)
"""What ``modern`` is compared with the others in: all that the tables of accuracy, effort, torque and smoothness have,
and the frames that break a limit."""
STACKED = Figure("success", "stacked [%]", 100.0, 0, more=True)
LIVE_COMPARED = (STACKED, *LOOP, TORQUES[1], EFFORT[4], EFFORT[6])
"""The same with the loop closed; all but the rate is of the trials in which both succeeded."""


def _compared(results: Results, tasks: Sequence[str]) -> Iterator[tuple[Figure, str, Comparison, float]]:
    """Give measure, rival, ``modern`` less the rival, and p after Holm's correction within the measure."""
    rivals = [name for name in results.methods if name != OURS and results.of(name, tasks)]
    if not results.of(OURS, tasks):
        return
    for figure in LIVE_COMPARED if tasks == [LIVE] else COMPARED:
        ours = results.values(OURS, tasks, figure.name)
        found = [compare(ours, results.values(name, tasks, figure.name)) for name in rivals]
        for name, comparison, p in zip(rivals, found, holm([c.p for c in found]), strict=True):
            yield figure, name, comparison, p


def comparison_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return ``modern`` against each other method, paired over the same recordings, or the same trials."""
    rows = [
        (_titled(figure), METHODS[name].title, *_difference(comparison, figure), f"{p:.3f}")
        for figure, name, comparison, p in _compared(results, tasks)
    ]
    columns = ("measure", f"{OURS} less", "difference (95 %)>", "relative [%]>", "pairs>", "p, Holm>")
    note = (
        "↑: more is better; else less. Persons are resampled; p by sign flips of the persons' differences, corrected "
        "within each measure. Pairs: where both have a number."
    )
    return Table(f"Paired comparison: {', '.join(tasks)}", columns, tuple(rows), note)


def rivals_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return where another method is better than ``modern``: in each kind of recording, and with the loop closed."""
    rows = []
    for task in [*tasks, LIVE]:
        for figure, name, comparison, p in _compared(results, [task]):
            sign, found = -1.0 if figure.more else 1.0, comparison.difference
            often = figure is STACKED and found.mean < 0.0
            if often or (found.excludes_zero and sign * found.mean > 0.0):
                cells = _difference(comparison, figure)
                rows.append((task, _titled(figure), METHODS[name].title, *cells, f"{p:.3f}"))
    columns = ("recordings", "measure", "better", f"{OURS} less it (95 %)>", "relative [%]>", "pairs>", "p, Holm>")
    note = (
        f"Of all measures that are compared, those whose interval says that {OURS} is worse, whatever p says, and "
        "every method that stacked more often. ↑: more is better; else less."
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
    if high > low:  # when all persons differ by the same, as rates of 0 and 100 % do, it says nothing of others
        text += f" ({low:+.{figure.digits}f} to {high:+.{figure.digits}f})"
    share = f"{100 * comparison.relative:+.0f}" if math.isfinite(comparison.relative) else "–"
    return text, share, f"{found.used} of {found.of}"
