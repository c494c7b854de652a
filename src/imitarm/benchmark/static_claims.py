"""Check the claims of thesis Chapter 4 against the results of the static benchmark, and check the benchmark itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from imitarm.benchmark.static_comparison import (
    PRINTED,
    READINGS,
    common_seeds,
    numbers_of_teachers,
    p_value,
    paired_table,
    pairings,
    printed_table,
    skills_table,
    task_of,
    teachers_table,
    times_table,
)
from imitarm.benchmark.static_tables import (
    IMPOSSIBLE,
    OURS,
    TASKS_FAMILY,
    Scene,
    StaticResults,
    is_success,
    obstacles_table,
    quality_table,
    rate,
    refusals_table,
    scenes_table,
    success_table,
    time_table,
)
from imitarm.benchmark.tables import Table

_TOY = 0.02  # rate of success of "no avoidance" above which the scenes are void
_LEVEL = 0.05  # of significance
_FEWEST = 6  # common successes; with fewer, the signed-rank test can't be significant

Found = tuple[str, str]
"""Two texts: the measured values, and whether the claim holds ("yes", "no", "in part" or "–")."""
_NOT_RUN: Found = ("not run", "–")


def cost_law(results: StaticResults, row: str = OURS) -> tuple[float, float, int]:
    """Return how the processor time depends on the number of obstacles: exponent, standard error, and number of plans.

    The power law ``time = a n^b`` is fitted to the logarithms by least squares. Here n is the number of obstacles, and
    b is the exponent.
    """
    found = [r for r in results.of(row, results.usual) if r.value("plan_cpu") > 0.0 and r.value("n_obstacles") >= 1.0]
    x = np.log([r.value("n_obstacles") for r in found])
    y = np.log([r.value("plan_cpu") for r in found])
    if len(found) < 3 or not np.ptp(x) > 0.0:
        return math.nan, math.nan, len(found)
    slope, offset = np.polyfit(x, y, 1)
    left = y - slope * x - offset
    error = math.sqrt(float(left @ left) / (len(x) - 2) / float(((x - x.mean()) ** 2).sum()))
    return float(slope), error, len(found)


def claims_table(results: StaticResults) -> Table:
    """Return a table of claims of the thesis and of checks of the benchmark itself, each with its result."""
    rows = [(claim, *evaluate(results)) for claim, evaluate in _CLAIMS]
    note = (
        f"A claim holds if the results of all compared methods support it. An RMSE difference is the RMSE of {OURS} "
        "minus that of the other method, over the scenes in which both succeed. It counts if there are at least "
        f"{_FEWEST} such scenes, and if its p-value after Holm's correction is below {_LEVEL:g}. The results with "
        "tuned options count; without tuned options, those with default options count."
    )
    return Table("Claims of the thesis, and checks", ("claim or check", "found", "held?"), tuple(rows), note)


def _best_row(results: StaticResults, method: str) -> str:
    tuned = f"{method}, tuned"
    return tuned if tuned in results.rows else method if method in results.rows else ""


def _theirs(results: StaticResults, columns: Sequence[str] = tuple(PRINTED)) -> list[str]:
    names = [name for column in columns if column != "ACFRA" for name in READINGS[column]]
    return [row for name in names if (row := _best_row(results, name))]


def _compared(
    results: StaticResults, columns: Sequence[str], wanted: Callable[[Scene], bool], *, better: bool
) -> Found:
    """Compare the RMSE of :data:`OURS` with methods of the thesis.

    ``better`` is True if the thesis claims a smaller RMSE of :data:`OURS`.
    """
    rows = _theirs(results, columns)
    found = [p for p in pairings(results, lambda s: results.usual(s) and wanted(s)) if p.row in rows]
    if not found:
        return _NOT_RUN
    parts, held = [], []
    for p in found:
        alone = f"only {OURS} succeeds in {p.only_ours}, only the other in {p.only_other}."
        if not p.both:
            parts.append(f"{p.row}: both succeed in 0 scenes, {alone}")
            continue
        text = f"both succeed in {p.both} scenes, {alone}"
        parts.append(f"{p.row}: {text} RMSE difference {1e3 * p.difference:+.1f} mm (p {p_value(p.p_rmse)}).")
        if p.both >= _FEWEST:
            held.append((p.difference < 0.0) == better and p.p_rmse < _LEVEL)
    return " ".join(parts), _verdict(held)


def _verdict(held: Sequence[bool]) -> str:
    return "–" if not held else "yes" if all(held) else "in part" if any(held) else "no"


def _n_obstacles(results: StaticResults, scene: Scene) -> int:
    return int(next(iter(results.by_scene[scene].values())).value("n_obstacles"))


def _two_obstacles(results: StaticResults) -> Found:
    return _compared(results, ("DMP+AT", "DMP+ANN"), lambda s: _n_obstacles(results, s) == 2, better=False)


def _more_obstacles(results: StaticResults) -> Found:
    return _compared(results, tuple(PRINTED), lambda s: _n_obstacles(results, s) > 2, better=True)


def _tasks(results: StaticResults) -> Found:
    return _compared(results, tuple(PRINTED), lambda s: bool(task_of(s)), better=True)


def _scaling(results: StaticResults) -> Found:
    """DMP+AT can't scale: its rate of success falls from few to many obstacles, more than that of ours."""
    parts, rates = [], {}
    for row in filter(None, [_best_row(results, OURS), *_theirs(results, ("DMP+AT",))]):
        good, of = [0, 0], [0, 0]
        for r in results.of(row, lambda s: results.solvable(s) and results.usual(s)):
            n = r.value("n_obstacles")
            if n != 3.0:
                good[n > 3.0] += is_success(r)
                of[n > 3.0] += 1
        if all(of):
            rates[row] = good[0] / of[0] - good[1] / of[1]
            parts.append(
                f"{row}: success {rate(good[0], of[0])} % with at most 2 obstacles, {rate(good[1], of[1])} % with "
                "at least 4"
            )
    ours = rates.pop(_best_row(results, OURS), math.nan)
    return ("; ".join(parts) or "not run"), _verdict([loss > ours for loss in rates.values()])


def _three_digits(value: float) -> str:
    """Return a number with three significant digits and without an exponent, such as 1420 or 7.43."""
    return f"{float(f'{value:.3g}'):.6g}"


def _cheaper(name: str, unit: str, factor: float) -> Callable[[StaticResults], Found]:
    def evaluate(results: StaticResults) -> Found:
        ours = [r.value(name) for r in results.of(OURS, results.usual) if math.isfinite(r.value(name))]
        if not ours:
            return _NOT_RUN
        base = float(np.median(ours))
        parts, held = [f"{OURS}: {_three_digits(factor * base)} {unit}"], []
        for row in _theirs(results):
            values = [r.value(name) for r in results.of(row, results.usual) if math.isfinite(r.value(name))]
            if values:
                parts.append(f"{row}: {_three_digits(factor * float(np.median(values)))} {unit}")
                held.append(base < float(np.median(values)))
        return f"medians: {'; '.join(parts)}", _verdict(held)

    return evaluate


def _completion(results: StaticResults) -> Found:
    ours = [r.value("duration_ratio") for r in results.of(OURS, results.usual) if is_success(r)]
    if not ours:
        return _NOT_RUN
    parts, held = [f"{OURS}: {np.mean(ours):.3f}"], []
    for row in _theirs(results):
        values = [r.value("duration_ratio") for r in results.of(row, results.usual) if is_success(r)]
        if values:
            parts.append(f"{row}: {np.mean(values):.3f}")
            held.append(float(np.mean(ours)) < float(np.mean(values)) - 1e-3)
    return f"mean duration of the successful motions divided by the learned duration: {'; '.join(parts)}", _verdict(
        held
    )


def _local(results: StaticResults) -> Found:
    ours = [r for r in results.of(OURS, results.usual) if is_success(r)]
    known = [r.value("rmse_unaffected") for r in ours if math.isfinite(r.value("rmse_unaffected"))]
    if not known:
        return _NOT_RUN
    unmoved = 100 * float(np.mean([r.value("unmoved") for r in ours]))
    parts = [
        f"{OURS}: RMSE of unaffected samples {1e3 * np.mean(known):.1f} mm, {unmoved:.0f} % of the components in place."
    ]
    held = []
    for row in _theirs(results):
        pairs = [
            (rows[OURS].value("rmse_unaffected"), rows[row].value("rmse_unaffected"))
            for scene, rows in results.by_scene.items()
            if OURS in rows
            and row in rows
            and results.usual(scene)
            and is_success(rows[OURS])
            and is_success(rows[row])
        ]
        both = np.array([p for p in pairs if np.isfinite(p).all()])
        if len(both):
            parts.append(
                f"{row}: {1e3 * both[:, 1].mean():.1f} mm, against {1e3 * both[:, 0].mean():.1f} mm of {OURS} in the "
                f"same {len(both)} scenes."
            )
            held.append(bool(both[:, 0].mean() < both[:, 1].mean()))
    return " ".join(parts), _verdict(held)


def _teachers(results: StaticResults) -> Found:
    numbers = numbers_of_teachers(results)
    if len(numbers) < 2:
        return _NOT_RUN
    common, values = common_seeds(results), []
    for n in numbers:
        found = results.of(OURS, lambda s, n=n: s[3] == n and not s[4] and s[:3] in common)  # type: ignore[misc]
        values.append((n, sum(map(is_success, found)), len(found)))
    if any(not of for *_, of in values):
        return _NOT_RUN
    text = "; ".join(f"{n} teacher{'s' * (n > 1)}: success {rate(count, of)}" for n, count, of in values)
    return text, "yes" if values[-1][1] / values[-1][2] > values[0][1] / values[0][2] else "no"


def _all_shapes(results: StaticResults) -> Found:
    found = results.of(OURS, lambda s: s[0] == "S3" and results.solvable(s) and results.usual(s))
    good = sum(map(is_success, found))
    if not found:
        return _NOT_RUN
    return f"{OURS} in S3: {rate(good, len(found))}", "yes" if good == len(found) else "in part"


def _control(row: str, most: float) -> Callable[[StaticResults], Found]:
    def evaluate(results: StaticResults) -> Found:
        found = results.of(row, lambda s: results.answers[s] != IMPOSSIBLE)
        good = sum(map(is_success, found))
        if not found:
            return _NOT_RUN
        return rate(good, len(found)), "yes" if good <= most * len(found) else "no"

    return evaluate


def _beyond_oracle(results: StaticResults) -> Found:
    wrong = results.beyond_proof(exact=True)
    return f"{len(wrong)} results", "no" if wrong else "yes"


def _cost(results: StaticResults) -> Found:
    slope, error, n = cost_law(results)
    if not math.isfinite(slope):
        return _NOT_RUN
    return f"processor time ~ obstacles^{slope:.2f} (standard error {error:.2f}, {n} plans)", "–"


_CLAIMS: tuple[tuple[str, Callable[[StaticResults], Found]], ...] = (
    ("ACFRA has the smallest RMSE in most sweeping tasks (Table 4.1)", _tasks),
    ("DMP+AT and DMP+ANN have a smaller RMSE than ACFRA with two obstacles (Section 4.2)", _two_obstacles),
    ("ACFRA has a smaller RMSE than all other methods with more than two obstacles (Section 4.2)", _more_obstacles),
    ("DMP+AT does not scale to many obstacles", _scaling),
    ("ACFRA computes faster than the other methods (Fig 4.9)", _cheaper("plan_seconds", "ms", 1e3)),
    ("ACFRA completes the task faster than the other methods (Fig 4.9)", _completion),
    ("ACFRA needs less memory than the other methods (Section 4.3)", _cheaper("peak_memory", "kB", 1e-3)),
    ("ACFRA changes the path only where obstacles affect it (Section 4.2)", _local),
    ("one setting is enough for obstacles of all shapes", _all_shapes),
    (
        "ACFRA succeeds more often with a skill of several teachers than with a skill of one teacher (Section 4.2)",
        _teachers,
    ),
    ("how the computing time of ACFRA depends on the number of obstacles", _cost),
    ("check: a tool that aims at the obstacle never succeeds", _control("aims-at-obstacle", 0.0)),
    ("check: without avoidance, at most 2 % of the runs succeed", _control("no-avoidance", _TOY)),
    (
        "check: no result contradicts a proof of the oracle that no path exists",
        _beyond_oracle,
    ),
)


def static_tables(results: StaticResults) -> list[Table]:
    """Return all tables that have rows. The table of the claims comes first."""
    families = results.families()
    found = [claims_table(results)]
    if any(family == TASKS_FAMILY for family, _ in families):
        found += [printed_table(results), times_table(results)]
    found += [scenes_table(results), success_table(results), refusals_table(results), obstacles_table(results)]
    found += [success_table(results, families), quality_table(results), time_table(results), paired_table(results)]
    if len(numbers_of_teachers(results)) > 1:
        found.append(teachers_table(results))
    if any(scene[4] for scene in results.by_scene):
        found.append(skills_table(results))
    return [table for table in found if table.rows]
