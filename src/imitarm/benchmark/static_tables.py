"""Tables of the static benchmark: scenes, success, refusals, quality of the paths, and computing time.

A method with tuned options has its own row. The rate of success counts only scenes that have a solution.
:func:`scenes_table` states how many scenes are excluded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.controls import CONTROLS
from imitarm.benchmark.static import StaticExperiment, StaticResult
from imitarm.benchmark.static_measures import AT_GOAL, MAX_ACCELERATION, MAX_SPEED, NEAR, SLACK, SUCCESSES
from imitarm.benchmark.static_tuning import tuned_options
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import wilson_interval

Array = NDArray[np.float64]
Scene = tuple[str, int, int, int, str]  # family, dimension, seed, number of teachers, file of the skill

OURS = "acfra"
ORACLE = "oracle"
POSSIBLE, IMPOSSIBLE, UNDECIDED = "possible", "impossible", "undecided"
TASKS_FAMILY, N_TASKS = "S7", 8
"""The family of the sweeping tasks T1 to T8, and the number of these tasks. A seed s gives the task with number 1 + s
modulo 8."""


def _largest_miss(result: StaticResult) -> float:
    """Return the largest distance of a path from its start, its goal and its contact point [m]; NaN counts as 0."""
    names = ("start_error", "goal_error", "contact_error")
    return max((e for name in names if not math.isnan(e := result.value(name))), default=0.0)


def row_name(experiment: StaticExperiment) -> str:
    """Return the name of the table row of an experiment: the method, and whether its options are tuned."""
    if not experiment.options:
        return experiment.method
    if experiment.options == tuned_options(experiment.method):
        return f"{experiment.method}, tuned"
    options = ", ".join(f"{name}={value}" for name, value in experiment.options)
    return f"{experiment.method}, {options}"


class StaticResults:
    """Results of many experiments, by scene and by row of the tables.

    Args:
        results: the results. If an experiment has several results, the last result counts.

    Attributes:
        all: all results.
        rows: names of the table rows; the methods that check the benchmark come last.
        by_scene: for each scene, the result of each table row (a method with its options).
    """

    def __init__(self, results: Iterable[StaticResult]) -> None:
        self.by_scene: dict[Scene, dict[str, StaticResult]] = {}
        for result in results:
            self.by_scene.setdefault(result.experiment.scene, {})[row_name(result.experiment)] = result
        self.by_scene = dict(sorted(self.by_scene.items()))
        self.all = [result for rows in self.by_scene.values() for result in rows.values()]
        names = sorted({name for rows in self.by_scene.values() for name in rows})
        order = [name for name in names if name.split(",")[0] == OURS]
        order += [name for name in names if name not in order and name not in CONTROLS]
        self.rows = (*order, *(name for name in CONTROLS if name in names))

    @cached_property
    def answers(self) -> dict[Scene, str]:
        """For each scene, whether a solution exists: "possible", "impossible" or "undecided".

        The answer is that of the oracle. Without the oracle, the construction of the scene may give the answer.
        Otherwise the answer is "possible" if a method succeeded, and "undecided" if no method succeeded.
        """
        found = {}
        for scene, rows in self.by_scene.items():
            oracle = rows.get(ORACLE)
            built = next(iter(rows.values())).values.get("must_refuse")
            if oracle is not None:
                found[scene] = str(oracle.values.get("answer", UNDECIDED))
            elif built is not None:
                found[scene] = IMPOSSIBLE if built else POSSIBLE
            else:
                solved = any(r.outcome == "success" for r in rows.values())
                found[scene] = POSSIBLE if solved else UNDECIDED
        return found

    def beyond_proof(self, *, exact: bool) -> list[StaticResult]:
        """Return the successes in scenes for which the oracle proved that no path keeps the clearance.

        The proof is valid for paths that pass exactly through start, goal and contact point. A success may miss these
        points by up to 5 mm. Therefore only a success that passes exactly through them contradicts the oracle.

        Args:
            exact: True: return the successes that pass exactly through these points. False: return the other successes.
        """
        found = [r for r in self.all if r.outcome == "success" and self.answers[r.experiment.scene] == IMPOSSIBLE]
        return [r for r in found if exact == (_largest_miss(r) <= SLACK)]

    def families(self) -> list[tuple[str, int]]:
        """Return the families with their dimensions."""
        return list(dict.fromkeys(scene[:2] for scene in self.by_scene))

    def of(self, row: str, wanted: Callable[[Scene], bool]) -> list[StaticResult]:
        """Return the results of a row in the scenes for which the function ``wanted`` returns True."""
        return [rows[row] for scene, rows in self.by_scene.items() if row in rows and wanted(scene)]

    def solvable(self, scene: Scene) -> bool:
        """Return whether a scene is known to have a solution."""
        return self.answers[scene] == POSSIBLE

    @cached_property
    def main_teachers(self) -> int:
        """The number of teachers that most scenes have."""
        counts = [scene[3] for scene in self.by_scene]
        return max(set(counts), key=counts.count)

    @cached_property
    def only_files(self) -> bool:
        """Whether the skills of all scenes come from files."""
        return all(scene[4] for scene in self.by_scene)

    def usual(self, scene: Scene) -> bool:
        """Return whether the scene counts in the tables that do not vary teachers or skills.

        A scene counts if its skill has :attr:`main_teachers` teachers. A scene with a skill from a file counts only if
        there are no other scenes.
        """
        return scene[3] == self.main_teachers and (self.only_files or not scene[4])


def is_success(result: StaticResult) -> bool:
    """Return whether a result counts as success."""
    return result.outcome in SUCCESSES


def rate(count: int, of: int) -> str:
    """Return a rate in percent with its Wilson interval (95 %)."""
    if not of:
        return "–"
    low, high = wilson_interval(count, of)
    return f"{100 * count / of:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def mean(values: Sequence[float], factor: float = 1.0, digits: int = 1) -> str:
    """Return the mean of the finite values as text, multiplied by ``factor``."""
    known = [v for v in values if math.isfinite(v)]
    return f"{factor * float(np.mean(known)):.{digits}f}" if known else "–"


def percentile(values: Sequence[float], q: float, factor: float = 1.0, digits: int = 1) -> str:
    """Return the percentile ``q`` of the finite values as text, multiplied by ``factor``."""
    known = [v for v in values if math.isfinite(v)]
    return f"{factor * float(np.percentile(known, q)):.{digits}f}" if known else "–"


def place(family: tuple[str, int] | None) -> str:
    """Return a family and its dimension as text, such as "S1, 2-D"; "all" for None."""
    return "all" if family is None else f"{family[0]}, {family[1]}-D"


def scenes_table(results: StaticResults) -> Table:
    """Return a table of the number of scenes of each family, and of the scenes that have a solution."""
    rows = []
    for family in [*results.families(), None]:
        scenes = [s for s in results.by_scene if results.usual(s) and family in (None, s[:2])]
        counts = [sum(results.answers[s] == a for s in scenes) for a in (POSSIBLE, IMPOSSIBLE, UNDECIDED)]
        mixed = [results.by_scene[s] for s in scenes]
        others = sum(
            results.answers[s] == UNDECIDED and any(r.outcome == "success" for r in rows_.values())
            for s, rows_ in zip(scenes, mixed, strict=True)
        )
        rows.append((place(family), *map(str, (len(scenes), *counts, others))))
    wrong, missing = (
        [
            f"{row_name(r.experiment)} in {place(r.experiment.scene[:2])}, seed {r.experiment.seed}"
            for r in results.beyond_proof(exact=exact)
        ]
        for exact in (True, False)
    )
    checked = sum(ORACLE in rows_ for rows_ in results.by_scene.values())
    verdict = (
        "If the oracle proves that a scene is impossible, no path exactly through start, goal and contact point keeps "
        "the clearance."
    )
    if wrong:
        verdict = f"The oracle is wrong. A method solves a scene that the oracle calls impossible: {'; '.join(wrong)}."
    if missing:
        verdict += (
            f" A path that misses these points by up to {1e3 * AT_GOAL:.0f} mm counts as a success. Such a path keeps "
            f"the clearance in an impossible scene: {'; '.join(missing)}."
        )
    note = (
        f"The oracle was run in {checked} of {len(results.by_scene)} scenes. In all other scenes, the construction of "
        "the scene or a path that keeps the clearance may show that the scene is possible. The rates of success count "
        f"only possible scenes. {verdict}"
    )
    columns = ("family", "scenes>", "possible>", "impossible>", "undecided>", "undecided, but solved by a method>")
    return Table("Scenes", columns, tuple(rows), note)


def success_table(results: StaticResults, families: Sequence[tuple[str, int] | None] = (None,)) -> Table:
    """Return a table of the rates of success in the scenes that have a solution.

    Args:
        results: the results.
        families: families with their dimensions, one group of rows for each; None stands for all families.
    """
    rows = []
    for family in families:
        for row in results.rows:
            found = results.of(
                row,
                lambda s, f=family: results.solvable(s) and results.usual(s) and f in (None, s[:2]),  # type: ignore[misc]
            )
            if found:
                rows.append((place(family), row, *_success_cells(found)))
    columns = (
        "family",
        "method",
        "scenes>",
        "success % (95 %)>",
        "keeps the clearance % (95 %)>",
        *(f"{name}>" for name in _OTHERS),
        "clearance of successes, 5th percentile [mm]>",
    )
    note = (
        "A path succeeds if it touches nothing at 4000 points and meets start, goal and contact point within 5 mm. "
        f"With at most {MAX_SPEED:g} m/s and {MAX_ACCELERATION:g} m/s^2, the motion must take at most twice the "
        "learned duration. Intervals: Wilson."
    )
    return Table("Success" if tuple(families) == (None,) else "Success in each family", columns, tuple(rows), note)


def _success_cells(found: Sequence[StaticResult]) -> tuple[str, ...]:
    good = [r for r in found if is_success(r)]
    return (
        str(len(found)),
        rate(len(good), len(found)),
        rate(sum(r.outcome == "success" for r in found), len(found)),
        *(str(sum(r.outcome == name for r in found)) for name in _OTHERS),
        percentile([r.value("clearance") for r in good], 5, 1e3),
    )


_OTHERS = ("contact", "missed goal", "late", "limit", "refused", "failed")


def refusals_table(results: StaticResults) -> Table:
    """Return a table of the right and the wrong refusals of each method."""
    rows = []
    for row in results.rows:
        if row == ORACLE:
            continue
        hard = results.of(row, lambda s: results.answers[s] == IMPOSSIBLE and results.usual(s))
        easy = results.of(row, lambda s: results.solvable(s) and results.usual(s))
        right, wrong = (sum(r.outcome == "refused" for r in found) for found in (hard, easy))
        open_ = results.of(row, lambda s: results.answers[s] == UNDECIDED and results.usual(s))
        touched = sum(r.outcome == "contact" for r in hard)
        rows.append(
            (
                row,
                str(len(hard)),
                rate(right, len(hard)),
                str(touched),
                rate(wrong, len(easy)),
                f"{sum(r.outcome == 'refused' for r in open_)} of {len(open_)}",
            )
        )
    columns = (
        "method",
        "impossible scenes>",
        "refused, rightly % (95 %)>",
        "contact in impossible scenes>",
        "refused, but possible % (95 %)>",
        "refused undecided scenes>",
    )
    return Table(
        "Refusals", columns, tuple(rows), "A method that never refuses also moves the tool in impossible scenes."
    )


def checked_refusals_table(results: StaticResults, row: str = OURS) -> Table:
    """Return a table of the refusals of one method in each family. The oracle has checked each refusal.

    Args:
        results: the results. They must include the oracle in every scene that the method refused.
        row: the method.
    """
    rows, doubtful = [], []
    for family in [*results.families(), None]:
        found = results.of(row, lambda s, f=family: results.usual(s) and f in (None, s[:2]))  # type: ignore[misc]
        refused = [r.experiment.scene for r in found if r.outcome == "refused"]
        checks = [results.by_scene[s][ORACLE] for s in refused if ORACLE in results.by_scene[s]]
        answers = [str(check.values.get("answer")) for check in checks]
        counts = [answers.count(kind) for kind in (IMPOSSIBLE, POSSIBLE, UNDECIDED)]
        seconds = [check.value("plan_cpu") for check in checks]
        if family is not None:
            doubtful += [
                f"{place(family)}, seed {check.experiment.seed} ({kind})"
                for check, kind in zip(checks, answers, strict=True)
                if kind != IMPOSSIBLE
            ]
        largest = f"{max(seconds):.2f}" if seconds else "–"
        rows.append(
            (
                place(family),
                *map(str, (len(found), len(refused), *counts)),
                rate(counts[0], len(refused)),
                percentile(seconds, 50, 1e3, 1),
                largest,
            )
        )
    columns = (
        "family",
        "scenes>",
        "refused>",
        "right>",
        "wrong>",
        "undecided>",
        "right % (95 %)>",
        "oracle, median [ms]>",
        "oracle, longest [s]>",
    )
    note = (
        f"The oracle checked every refusal of {row}. Right: the oracle proves that no path exists. Wrong: the oracle "
        "finds a path. Undecided: the oracle finds neither a proof nor a path. Oracle: processor time of one scene. "
        f"Refusals that are not right: {'; '.join(doubtful) or 'none'}."
    )
    return Table(f"Refusals of {row}", columns, tuple(rows), note)


def quality_table(results: StaticResults) -> Table:
    """Return a table of the quality of the successful paths of each method."""
    rows = []
    for row in results.rows:
        found = results.of(row, lambda s: results.solvable(s) and results.usual(s))
        good = [r for r in found if is_success(r)]

        def column(name: str, good: list[StaticResult] = good) -> list[float]:
            return [r.value(name) for r in good]

        rows.append(
            (
                row,
                f"{len(good)} of {len(found)}",
                mean(column("rmse"), 1e3),
                mean(column("rmse_unaffected"), 1e3),
                mean(column("path_rmse"), 1e3),
                mean(column("deviation")),
                mean(column("unmoved"), 100, 0),
                mean(column("length_ratio"), 1, 3),
                mean(column("duration_ratio"), 1, 3),
                mean(column("sparc"), 1, 2),
                mean(column("ldlj"), 1, 2),
                mean(column("torque_rms"), 1, 2),
            )
        )
    columns = (
        "method",
        "successes>",
        "RMSE [mm]>",
        "RMSE, unaffected samples [mm]>",
        "RMSE of the path [mm]>",
        "largest deviation [sigma]>",
        "components unmoved [%]>",
        "length>",
        "duration>",
        "SPARC>",
        "LDLJ>",
        "torque RMS [N m]>",
    )
    note = (
        "Means over the successes of each method. The methods succeed in different scenes; the paired comparison uses "
        "common scenes. RMSE: root mean square distance between planned and learned path at equal fractions of their "
        "durations (thesis Eq 4.9, with the square root). Unaffected samples: samples of the learned path at which "
        f"the tool is farther than {1e2 * NEAR:.0f} cm from every obstacle. RMSE of the path: distance from each "
        "sample of the learned path to the nearest point of the planned path. Length and duration are divided by "
        "those of the learned path."
    )
    return Table("Quality of the successful paths", columns, tuple(rows), note)


def time_table(results: StaticResults) -> Table:
    """Return a table of the computing time and the memory that each method needs for one path."""
    rows = []
    for row in results.rows:
        found = results.of(row, results.usual)

        def column(name: str, found: list[StaticResult] = found) -> list[float]:
            return [r.value(name) for r in found]

        refused = [r.value("plan_seconds") for r in found if r.outcome == "refused"]
        rows.append(
            (
                row,
                str(len(found)),
                percentile(column("plan_seconds"), 50, 1e3, 2),
                percentile(column("plan_seconds"), 99, 1e3, 1),
                percentile(column("plan_cpu"), 50, 1e3, 2),
                percentile(refused, 50, 1e3, 2),
                percentile(column("build_seconds"), 50, 1e3, 2),
                percentile(column("peak_memory"), 50, 1e-3, 0),
            )
        )
    columns = (
        "method",
        "plans>",
        "time, median [ms]>",
        "time, 99th percentile [ms]>",
        "processor time, median [ms]>",
        "time of a refusal, median [ms]>",
        "construction, median [ms]>",
        "peak memory, median [kB]>",
    )
    note = (
        "Time: the time that a method needs to plan one whole path. This time does not include the construction of the "
        "policy, imports, the training of networks and cost functions, or computations that a process makes only once "
        "for a skill. Peak memory: largest memory that Python allocates in a separate run."
    )
    return Table("Computing time", columns, tuple(rows), note)


def obstacles_table(results: StaticResults) -> Table:
    """Return a table of the rate of success by the number of obstacles."""
    solvable = [s for s in results.by_scene if results.solvable(s) and results.usual(s)]
    counts = {s: int(next(iter(results.by_scene[s].values())).value("n_obstacles")) for s in solvable}
    numbers = sorted(set(counts.values()))
    rows = []
    for row in results.rows:
        cells = []
        for n in numbers:
            found = results.of(row, lambda s, n=n: counts.get(s) == n)  # type: ignore[misc]
            cells.append(rate(sum(map(is_success, found)), len(found)))
        rows.append((row, *cells))
    return Table(
        "Success by the number of obstacles, % (95 %)",
        ("method", *(f"{n}>" for n in numbers)),
        tuple(rows),
        "All scenes of all families that have a solution.",
    )
