"""What the thesis reports of this experiment (Table 3.1, Figs 3.6 to 3.8), and whether it held here."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.experiment import LIVE
from imitarm.benchmark.mapping_methods import METHODS
from imitarm.benchmark.mapping_tables import Figure, Results, written
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import Comparison, Values, bootstrap, compare, holm, interval
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

PATH = np.array([7.03, 7.43, 9.04, 9.26, 8.72, 9.53, 6.4, 8.36, 9.32, 10.24])
"""Table 3.1, path length, in its unit, "cm.10", which is not explained."""
TORQUES = np.array(
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
"""Table 3.1, mean joint torque of its ten experiments, shape (10, 7) [N m]."""
TIME = np.array([22.23, 18.43, 17.72, 19.2, 15.82, 14.21, 13.03, 9.01, 9.31, 12.42])
"""Table 3.1, execution time [s]."""

ME = ("thesis", "modern")
"""What stands for the thesis's own method: its equations put right, and what we would use instead."""
RIVALS = ("m1", "m2", "m3")
_TORQUE = Figure("mean_torque", "mean torque [N m]", digits=2)
_PATH = Figure("path_length", "path [m]", digits=2)


def printed_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return Table 3.1 beside ours: means over its ten experiments, over our persons."""
    arm = ArmModel.load("sawyer", tool="gripper")
    rows = [("thesis, printed", *(_spread(column) for column in TORQUES.T), f"{_spread(PATH)} cm.10", _spread(TIME))]
    rated = ["–" if not math.isfinite(t) else f"{t:g}" for t in arm.max_torque]
    rows.append(("rated by the robot's maker", *rated, "", ""))
    for name in results.methods:
        torques = [written(interval(results.values(name, tasks, "mean_torque", joint)), _TORQUE) for joint in range(7)]
        path = written(interval(results.values(name, tasks, "path_length")), _PATH)
        time = written(interval(_times(results, name)), Figure("time", "", digits=0))
        rows.append((METHODS[name].title, *torques, f"{path} m" if path != "–" else path, time))
    columns = ("", *(f"τ{joint + 1} [N m]>" for joint in range(7)), "path>", "time [s]>")
    over = int(np.sum(TORQUES.mean(axis=0) > arm.max_torque))
    note = (
        f"Means (95 % interval). Ours: torques and path of the replayed recordings ({', '.join(tasks)}), time of the "
        f"closed loop where it succeeded. {over} of the 7 printed means are above what the joints are rated for, so "
        "they can't be mean torques of a Sawyer's joints."
    )
    return Table("Table 3.1 of the thesis, and ours", columns, tuple(rows), note)


def _spread(column: Array) -> str:
    low, high = bootstrap(column)
    return f"{column.mean():.2f} ({low:.2f} to {high:.2f})"


def _times(results: Results, method: str) -> Values:
    """Return the time of each closed-loop trial; nan where it failed."""
    return results.values(method, [LIVE], "time")


def claims_table(results: Results, tasks: Sequence[str]) -> Table:
    """Return what the thesis claims, and whether it held: with its method put right, and with ours."""
    rows = []
    for claim, judge in CLAIMS:
        cells: list[str] = []
        for me in ME:
            cells += judge(results, me, tasks) if me in results.methods else ("–", "not run")
        rows.append((claim, *cells))
    columns = ("the thesis says", "thesis, corrected", "held?", "modern", "held?")
    note = (
        "Me less the rival, paired. yes: against every rival the 95 % interval is on the claimed side and p, "
        "corrected, below 0.05; no: against one of them on the other side; not shown: neither. Times are compared "
        "where both succeeded."
    )
    return Table("What the thesis claims, and what held", columns, tuple(rows), note)


Judged = tuple[str, str]


def verdict(comparisons: Sequence[Comparison], wanted: float) -> str:
    """Return whether a claim held against all rivals.

    A difference counts when its interval excludes zero and its probability, corrected for the number of rivals, is
    below 0.05; two persons alone can't show anything.

    Args:
        comparisons: Me less each rival.
        wanted: the sign that the claim says the differences have, -1 or 1.
    """
    corrected = holm([c.p for c in comparisons])
    shown = [
        c.difference.mean * wanted if c.difference.excludes_zero and p < 0.05 else 0.0
        for c, p in zip(comparisons, corrected, strict=True)
    ]
    if any(sign < 0.0 for sign in shown):
        return "no"
    return "yes" if shown and all(sign > 0.0 for sign in shown) else "not shown"


def _against(pairs: Sequence[tuple[str, Values, Values]], wanted: float) -> Judged:
    """Judge Me against rivals: name, Me's numbers, theirs."""
    found = [(name, compare(ours, theirs)) for name, ours, theirs in pairs]
    texts = [
        f"{METHODS[name].title} {100 * c.relative:+.0f} %" if math.isfinite(c.relative) else f"{METHODS[name].title} –"
        for name, c in found
    ]
    return ", ".join(texts) or "–", verdict([c for _, c in found], wanted)


def _less(name: str) -> Callable[[Results, str, Sequence[str]], Judged]:
    def judge(results: Results, me: str, tasks: Sequence[str]) -> Judged:
        ours = results.values(me, tasks, name)
        rivals = [rival for rival in RIVALS if rival in results.methods]
        return _against([(rival, ours, results.values(rival, tasks, name)) for rival in rivals], -1.0)

    return judge


def _quicker(results: Results, me: str, _: Sequence[str]) -> Judged:
    rivals = [rival for rival in RIVALS if results.of(rival, [LIVE])]
    text, held = _against([(rival, _times(results, me), _times(results, rival)) for rival in rivals], -1.0)
    return (text, held) if rivals else ("–", "not run")


def _two_leads(results: Results, me: str, tasks: Sequence[str]) -> Judged:
    """M2 has the least torque of all, and takes the longest."""
    others = [name for name in (me, "m1", "m3") if name in results.methods]
    if "m2" not in results.methods or not results.of("m2", [LIVE]):
        return "–", "not run"
    torque = results.values("m2", tasks, "mean_torque")
    first, least = _against([(o, torque, results.values(o, tasks, "mean_torque")) for o in others], -1.0)
    second, longest = _against([(o, _times(results, "m2"), _times(results, o)) for o in others], 1.0)
    both = "no" if "no" in {least, longest} else "yes" if least == longest == "yes" else "not shown"
    return f"torque: {first}; time: {second}", both


def _farther_from_singular(results: Results, me: str, _: Sequence[str]) -> Judged:
    """The least singular value at the edge of reach is larger than without treatment, M3."""
    if not results.tasks(["edge"]) or "m3" not in results.methods:
        return "–", "not run"
    ours, theirs = (results.values(name, ["edge"], "least_singular") for name in (me, "m3"))
    text, held = _against([("m3", ours, theirs)], 1.0)
    mean = interval(ours).mean
    return f"{mean:.3f}; {text}", held


def _rated(results: Results, me: str, tasks: Sequence[str]) -> Judged:
    """Mean torques as large as printed, joint by joint: within the printed interval."""
    inside = 0
    for joint, column in enumerate(TORQUES.T):
        low, high = bootstrap(column)
        inside += low <= interval(results.values(me, tasks, "mean_torque", joint)).mean <= high
    return f"{inside} of 7 joints within the printed interval", "yes" if inside == 7 else "no"


def _like_printed_time(results: Results, me: str, _: Sequence[str]) -> Judged:
    found = interval(_times(results, me))
    if not math.isfinite(found.mean):
        return "–", "not run" if found.of == 0 else "no"
    low, high = bootstrap(TIME)
    return f"{found.mean:.0f} s, {found.used} of {found.of} stacked", "yes" if low <= found.mean <= high else "no"


_MEANS = TORQUES.mean(axis=0).tolist()
CLAIMS: Sequence[tuple[str, Callable[[Results, str, Sequence[str]], Judged]]] = (
    ("less torque than M1, M2, M3 (Fig 3.6)", _less("mean_torque")),
    ("a shorter path than M1, M2, M3, by up to 5 % (Fig 3.7)", _less("path_length")),
    ("done in less time than M1, M2, M3 (Fig 3.8)", _quicker),
    ("M2 has the least torque, but takes longest (text beside Fig 3.7)", _two_leads),
    ("singularity is minimised: farther from it than M3 at the edge of reach", _farther_from_singular),
    (f"mean torques of {min(_MEANS):.0f} to {max(_MEANS):.0f} N m at every joint (Table 3.1)", _rated),
    (f"four cubes stacked in {TIME.mean():.1f} s (Table 3.1)", _like_printed_time),
)
"""What is claimed, and what judges it."""
