"""Compare the methods of the static benchmark with one another, and with Table 4.1 and Fig 4.9 of the thesis."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.controls import CONTROLS
from imitarm.benchmark.static import StaticResult
from imitarm.benchmark.static_tables import (
    IMPOSSIBLE,
    N_TASKS,
    ORACLE,
    OURS,
    POSSIBLE,
    TASKS_FAMILY,
    Scene,
    StaticResults,
    is_success,
    mean,
    place,
    rate,
)
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import bootstrap, holm

Array = NDArray[np.float64]

PRINTED = {
    "DMP+AT": (0.0121, 0.0230, 0.0223, 0.0130, 0.0316, 0.0321, 0.0270, 0.0169),
    "DMP+ANN": (0.0107, 0.0258, 0.0212, 0.0110, 0.0310, 0.0312, 0.0283, 0.0200),
    "GMM+DMP": (0.0125, 0.0250, 0.0225, 0.0130, 0.0332, 0.0311, 0.0280, 0.0172),
    "GMM+IRL": (0.0123, 0.0242, 0.0226, 0.0180, 0.0318, 0.0312, 0.0265, 0.0170),
    "ACFRA": (0.0128, 0.0215, 0.0210, 0.0100, 0.0330, 0.0286, 0.0262, 0.0200),
}
"""RMSE of the tasks T1 to T8, as printed in thesis Table 4.1. The thesis states no unit."""
READINGS = {
    "DMP+AT": ("dmp-steering", "dmp-potential"),
    "DMP+ANN": ("dmp-ann",),
    "GMM+DMP": ("gmm-dmp",),
    "GMM+IRL": ("gmm-irl",),
    "ACFRA": ("acfra", "acfra-mapf", "acfra-literal"),
}
"""For each method in Table 4.1 of the thesis, our interpretations of this method."""


@dataclass(frozen=True)
class Pairing:
    """Comparison of :data:`OURS` with another method in the same scenes.

    Attributes:
        row: name of the other method's row.
        scenes: number of scenes in which both were run.
        only_ours: number of scenes in which only :data:`OURS` succeeds.
        only_other: number of scenes in which only the other method succeeds.
        p_success: p-value of McNemar's exact test of the successes.
        both: number of scenes in which both methods succeed.
        difference: mean difference of the RMSE, :data:`OURS` minus the other method, over the scenes in which both
            succeed [m]; nan if there is no such scene.
        low: lower end of the 95 % interval of ``difference`` [m].
        high: upper end of the 95 % interval of ``difference`` [m].
        p_rmse: p-value of Wilcoxon's signed-rank test of the RMSE.
    """

    row: str
    scenes: int
    only_ours: int
    only_other: int
    p_success: float
    both: int
    difference: float
    low: float
    high: float
    p_rmse: float


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the p-value of McNemar's exact test of two methods."""
    n, k = only_first + only_second, min(only_first, only_second)
    if n == 0:
        return 1.0
    terms = [math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) - n * math.log(2.0) for i in range(k + 1)]
    return min(1.0, 2.0 * math.fsum(map(math.exp, terms)))


def signed_rank(differences: Array) -> float:
    """Return the p-value of Wilcoxon's signed-rank test of paired differences; 1 if all differences are 0."""
    from scipy.stats import wilcoxon  # noqa: PLC0415 (takes long to import)

    nonzero = differences[differences != 0.0]
    return float(wilcoxon(nonzero).pvalue) if len(nonzero) else 1.0


def pairing(results: StaticResults, row: str, wanted: Callable[[Scene], bool]) -> Pairing:
    """Compare :data:`OURS` with another method in those of the wanted scenes that have a solution."""
    pairs = [
        (rows[OURS], rows[row])
        for scene, rows in results.by_scene.items()
        if OURS in rows and row in rows and results.solvable(scene) and wanted(scene)
    ]
    won = [(is_success(ours), is_success(other)) for ours, other in pairs]
    only_ours, only_other = sum(a and not b for a, b in won), sum(b and not a for a, b in won)
    differences = np.array(
        [a.value("rmse") - b.value("rmse") for (a, b), both in zip(pairs, won, strict=True) if all(both)]
    )
    low, high = bootstrap(differences) if 0 < len(differences) <= _BOOTSTRAP else _normal(differences)
    middle = float(differences.mean()) if len(differences) else math.nan
    return Pairing(
        row,
        len(pairs),
        only_ours,
        only_other,
        mcnemar(only_ours, only_other),
        len(differences),
        middle,
        low,
        high,
        signed_rank(differences),
    )


_BOOTSTRAP = 2000  # scenes up to which the interval is a bootstrap interval; the bootstrap of more needs much memory


def _normal(differences: Array) -> tuple[float, float]:
    if len(differences) < 2:
        return math.nan, math.nan
    half = 1.96 * float(differences.std(ddof=1)) / math.sqrt(len(differences))
    return float(differences.mean()) - half, float(differences.mean()) + half


def pairings(results: StaticResults, wanted: Callable[[Scene], bool]) -> list[Pairing]:
    """Compare :data:`OURS` with every other method. The p-values are corrected by Holm's method."""
    others = [row for row in results.rows if row != OURS and row not in CONTROLS]
    found = [p for row in others if (p := pairing(results, row, wanted)).scenes]
    success, rmse = holm([p.p_success for p in found]), holm([p.p_rmse for p in found])
    return [replace(p, p_success=a, p_rmse=b) for p, a, b in zip(found, success, rmse, strict=True)]


def paired_table(results: StaticResults) -> Table:
    """Return a table that compares :data:`OURS` with each other method, over all families and in each family."""
    rows = []
    for family in [None, *results.families()]:
        for p in pairings(results, lambda s, f=family: results.usual(s) and f in (None, s[:2])):  # type: ignore[misc]
            counts = (str(p.scenes), str(p.only_ours), str(p.only_other), p_value(p.p_success), str(p.both))
            rows.append((place(family), p.row, *counts, _difference(p), p_value(p.p_rmse) if p.both else "–"))
    columns = (
        "family",
        f"{OURS} against",
        "scenes>",
        f"only {OURS} succeeds>",
        "only the other>",
        "p, Holm>",
        "both succeed>",
        f"RMSE of {OURS} minus RMSE of the other [mm] (95 %)>",
        "p, Holm>",
    )
    note = (
        "The first p-value is that of McNemar's exact test of the successes. The second p-value is that of Wilcoxon's "
        "signed-rank test of the RMSE, in the scenes in which both succeed. Holm's method corrects both for the "
        "number of methods."
    )
    return Table(f"Paired comparison with {OURS}", columns, tuple(rows), note)


def _difference(p: Pairing) -> str:
    if not p.both:
        return "–"
    text = f"{1e3 * p.difference:+.1f}"
    return f"{text} ({1e3 * p.low:+.1f} to {1e3 * p.high:+.1f})" if math.isfinite(p.low) else text


def p_value(value: float) -> str:
    """Return a p-value as text with three decimals."""
    return f"{value:.3f}" if value >= 0.001 else "< 0.001"


def task_of(scene: Scene) -> str:
    """Return the name of the sweeping task of a scene, such as "T1"; empty if the scene is not a sweeping task."""
    return f"T{scene[2] % N_TASKS + 1}" if scene[0] == TASKS_FAMILY else ""


def _in_tasks(results: StaticResults, row: str, task: str) -> list[StaticResult]:
    return results.of(row, lambda s: task_of(s) == task and results.usual(s))


def printed_table(results: StaticResults) -> Table:
    """Return a table of the RMSE in the sweeping tasks T1 to T8: the values of thesis Table 4.1 and ours."""
    tasks = [f"T{i + 1}" for i in range(N_TASKS)]
    rows = []
    for name, values in PRINTED.items():
        rows.append((f"{name}, printed", *(f"{v:.4f}" for v in values), f"{np.mean(values):.4f}"))
        for row in results.rows:
            if row.split(",")[0] not in READINGS[name]:
                continue
            cells, means = [], []
            for task in tasks:
                found = _in_tasks(results, row, task)
                good = [r.value("rmse") for r in found if is_success(r)]
                cells.append(f"{mean(good, 1.0, 4)} ({len(good)} of {len(found)})")
                means += [float(np.mean(good))] if good else []
            if any(not cell.endswith("of 0)") for cell in cells):
                rows.append((row, *cells, mean(means, 1.0, 4)))
    note = (
        "Printed: values of thesis Table 4.1, which states no unit, no number of failures and no spread. The thesis "
        "prints 0.224 as the average of DMP+ANN, which is ten times the mean of the printed values. All other rows: "
        "mean RMSE of the successes [m], and in brackets the number of scenes in which the method succeeded. In each "
        "scene, the obstacles of the task are moved a little. If a method fails in some scenes, its mean includes "
        "fewer scenes."
    )
    return Table(
        "RMSE in the sweeping tasks: Table 4.1 of the thesis, and our values",
        ("method", *(f"{t}>" for t in tasks), "average>"),
        tuple(rows),
        note,
    )


def times_by_task(results: StaticResults, name: str, factor: float = 1.0) -> dict[str, list[float]]:
    """Return, for each row, the median of a measure over the successes in each task (for thesis Fig 4.9)."""
    found = {}
    for row in results.rows:
        if row in CONTROLS:
            continue
        medians = []
        for i in range(N_TASKS):
            good = [r.value(name) for r in _in_tasks(results, row, f"T{i + 1}") if is_success(r)]
            medians.append(factor * float(np.median(good)) if good else math.nan)
        if np.isfinite(medians).any():
            found[row] = medians
    return found


def times_table(results: StaticResults) -> Table:
    """Return a table for thesis Fig 4.9: the times to compute and to complete the tasks T1 to T8."""
    rows = []
    for what, name, factor in (("to compute [ms]", "plan_seconds", 1e3), ("to complete [s]", "duration", 1.0)):
        for row, found in times_by_task(results, name, factor).items():
            rows.append((what, row, *(f"{v:.2f}" if math.isfinite(v) else "–" for v in found)))
    columns = ("time", "method", *(f"T{i + 1}>" for i in range(N_TASKS)))
    note = "Medians over the successful plans. Fig 4.9 of the thesis does not say which of the two times it shows."
    return Table("Fig 4.9 of the thesis: time to compute and time to complete", columns, tuple(rows), note)


def numbers_of_teachers(results: StaticResults) -> list[int]:
    """Return the numbers of synthetic teachers that occur in the results, in ascending order."""
    return sorted({scene[3] for scene in results.by_scene if not scene[4]})


def teachers_table(results: StaticResults) -> Table:
    """Return a table of success and RMSE by the number of teachers, for methods that were run with all numbers."""
    numbers = numbers_of_teachers(results)
    common = common_seeds(results)
    rows = []
    for row in results.rows:
        cells = []
        for n in numbers:
            found = results.of(row, lambda s, n=n: s[3] == n and not s[4] and s[:3] in common)  # type: ignore[misc]
            good = [r for r in found if is_success(r)]
            if found:
                cells += [rate(len(good), len(found)), mean([r.value("rmse") for r in good], 1e3)]
        if len(cells) == 2 * len(numbers):
            rows.append((row, *cells))
    names = ["1 teacher" if n == 1 else f"{n} teachers" for n in numbers]
    columns = [c for name in names for c in (f"{name}: success % (95 %)>", f"{name}: RMSE [mm]>")]
    note = f"Results of the {len(common)} scenes that have a solution with every number of teachers."
    return Table("Number of teachers", ("method", *columns), tuple(rows), note)


def common_seeds(results: StaticResults) -> set[tuple[str, int, int]]:
    """Return the scenes that have a solution with every number of teachers, as family, dimension and seed."""
    own = [s for s in results.by_scene if not s[4] and results.solvable(s)]
    return set.intersection(*({s[:3] for s in own if s[3] == n} for n in numbers_of_teachers(results)))


def skills_table(results: StaticResults) -> Table:
    """Return a table of success, refusals and deviation for each skill from a file."""
    skills = sorted({scene[4] for scene in results.by_scene if scene[4]})
    rows = []
    for skill in skills:
        for row in results.rows:

            def having(answer: str, row: str = row, skill: str = skill) -> list[StaticResult]:
                return results.of(row, lambda s: s[4] == skill and results.answers[s] == answer)

            found, hard = having(POSSIBLE), having(IMPOSSIBLE)
            good = [r for r in found if is_success(r)]
            refused = [sum(r.outcome == "refused" for r in some) for some in (hard, found)]
            if found or hard:
                rows.append(
                    (
                        Path(skill).stem,
                        row,
                        str(len(found)),
                        rate(len(good), len(found)),
                        rate(sum(r.outcome == "success" for r in found), len(found)),
                        str(sum(r.outcome == "contact" for r in found)),
                        str(refused[1]),
                        f"{refused[0]} of {len(hard)}" if row != ORACLE else "–",
                        mean([r.value("rmse") for r in good], 1e3),
                        mean([r.value("deviation") for r in good]),
                    )
                )
    columns = (
        "skill",
        "method",
        "scenes with a solution>",
        "success % (95 %)>",
        "keeps the clearance % (95 %)>",
        "contact>",
        "refused>",
        "refused impossible scenes>",
        "mean RMSE of the successes [mm]>",
        "largest deviation [sigma]>",
    )
    note = (
        "This table counts only the scenes whose obstacles stand on the path of a skill from a file (option --skill). "
        "The other tables count these scenes only if there are no other scenes."
    )
    return Table("Skills from files", columns, tuple(rows), note)
