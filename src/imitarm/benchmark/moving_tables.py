"""Tables of the moving benchmark: success, quality of the motions, tracking, contacts, and claims of the thesis."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imitarm.benchmark.arm_oracle import ORACLES
from imitarm.benchmark.moving import OURS, MovingResult
from imitarm.benchmark.moving_controls import CONTROLS
from imitarm.benchmark.moving_measures import OUTCOMES, limits_kept
from imitarm.benchmark.moving_results import MovingResults
from imitarm.benchmark.static_comparison import mcnemar, signed_rank
from imitarm.benchmark.static_measures import MAX_ACCELERATION, MAX_SPEED, NEAR
from imitarm.benchmark.static_tables import mean, percentile, rate
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import bootstrap, holm

FEW, MANY = ("M1", "M2", "M3", "M4", "M5", "M7", "M9"), ("M6", "M8", "M10")
"""``FEW``: families with one moving obstacle. ``MANY``: families with several."""
READINGS = {
    "RCAMO": ("rcamo", "rcamo-certified"),
    "DMP+AT": ("dmp-potential", "dmp-steering"),
    "DMP+ANN": ("dmp-ann",),
    "GMM+DMP": ("gmm-dmp",),
    "GMM+IRL": ("gmm-irl",),
}
"""For each method in Figs 5.7 and 5.11 of the thesis, our interpretations of this method."""
_LISTED = 12  # contacts in a table
_FORESEEN, _CAUSAL = ORACLES


def moving_tables(results: MovingResults) -> list[Table]:
    """Return all tables. The tables of the tool without an arm come before the tables of each arm."""
    arms = [setting for setting in results.settings if setting != "tool"]
    found = _tool_tables(results.in_setting("tool")) if "tool" in results.settings else []
    for setting in arms:
        own = results.in_setting(setting)
        for table in (success_table(own), family_table(own), causes_table(own)):
            note = f"The whole {setting} in the simulator, with the safety filter. {_ARM_NOTE}" if table.note else ""
            found.append(replace(table, title=f"{setting}: {table.title}", note=note))
    return [table for table in found if table.rows]


_ARM_NOTE = (
    "Clearance and contacts are those of the whole arm. The method 'no-avoidance' follows the learned motion, which "
    "only the safety filter changes.  Intervals: Wilson."
)


def _tool_tables(results: MovingResults) -> list[Table]:
    found = [success_table(results), family_table(results), quality_table(results)]
    found += [rmse_table(results, FEW, "Fig 5.7 of the thesis: RMSE with one moving obstacle")]
    found += [rmse_table(results, MANY, "Fig 5.11 of the thesis: RMSE with several moving obstacles")]
    found += [
        claims_table(results),
        paired_table(results),
        causal_table(results),
        sensor_table(results),
        tracking_table(results),
    ]
    return [*found, causes_table(results), contacts_table(results)]


def success_table(results: MovingResults) -> Table:
    """Return a table of the rate of success and the number of each other outcome, over all families."""
    rows = []
    for row in results.rows:
        found = results.of(row)
        kept = sum(r.outcome == "success" for r in found)
        counts = Counter(r.outcome for r in found)
        near = [r.value("clearance") for r in found if r.success]
        rows.append(
            (
                row,
                str(len(found)),
                rate(sum(r.success for r in found), len(found)),
                rate(kept, len(found)),
                *(str(counts[name]) for name in OUTCOMES[2:]),
                percentile(near, 5, 1e3),
                percentile([r.value("step_median") for r in found], 50, 1e3, 2),
                percentile([r.value("step_p99") for r in found], 50, 1e3, 2),
            )
        )
    columns = (
        "method",
        "runs>",
        "success % (95 %)>",
        "keeps the clearance % (95 %)>",
        *(f"{name}>" for name in OUTCOMES[2:]),
        "clearance of successes, 5th percentile [mm]>",
        "time per step, median [ms]>",
        "time per step, 99th percentile [ms]>",
    )
    broken = sum(not limits_kept(dict(r.values)) for r in results.all)
    note = (
        "Success: the tool touches no obstacle, and comes within 5 mm of the goal in at most twice the learned "
        f"duration. The tool is limited to {MAX_SPEED:g} m/s and {MAX_ACCELERATION:g} m/s^2; {broken} runs exceed "
        "these limits. Intervals: Wilson. Time per step: medians, over the runs, of the median and the 99th "
        "percentile of each run."
    )
    return Table("Success among moving obstacles", columns, tuple(rows), note)


def family_table(results: MovingResults) -> Table:
    """Return a table of the rates of success in each family."""
    families = results.families()
    rows = []
    for row in results.rows:
        cells = []
        for family in families:
            found = results.of(row, family)
            cells.append(rate(sum(r.success for r in found), len(found)))
        rows.append((row, *cells))
    counts = {family: len({s for s in results.by_scene if s[0] == family}) for family in families}
    note = "Scenes: " + ", ".join(f"{n} of {family}" for family, n in counts.items()) + "."
    solved = _solved(results)
    if solved:
        parts = ", ".join(f"{good} of {of} in {family}" for family, (good, of) in solved.items())
        note += f" Number of scenes that the oracle with the true future motion solves: {parts}."
    columns = ("method", *(f"{family}>" for family in families))
    return Table("Success % (95 %) in each family", columns, tuple(rows), note)


def _solved(results: MovingResults) -> dict[str, tuple[int, int]]:
    found = {}
    for family in results.families():
        oracle = results.of(_FORESEEN, family)
        if oracle:
            found[family] = (sum(r.success for r in oracle), len(oracle))
    return found


def quality_table(results: MovingResults) -> Table:
    """Return a table of the measures of the successful motions."""
    rows = []
    for row in results.rows:
        good = [r for r in results.of(row) if r.success]
        if not good:
            continue
        rows.append(
            (
                row,
                str(len(good)),
                mean([r.value("rmse") for r in good], 1e3),
                mean([r.value("rmse_unaffected") for r in good], 1e3),
                mean([r.value("path_rmse") for r in good], 1e3),
                mean([r.value("duration_ratio") for r in good], 1.0, 3),
                percentile([r.value("stall") for r in good], 95, 1.0, 2),
                mean([r.value("length_ratio") for r in good], 1.0, 3),
                mean([r.value("sparc") for r in good], 1.0, 2),
                mean([r.value("ldlj") for r in good], 1.0, 2),
            )
        )
    columns = (
        "method",
        "successes>",
        "RMSE [mm]>",
        "RMSE, unaffected samples [mm]>",
        "RMSE of the path [mm]>",
        "duration / learned>",
        "longest stall, 95th percentile [s]>",
        "length / learned>",
        "SPARC>",
        "LDLJ>",
    )
    note = (
        "Each row includes only the scenes in which its method succeeds. These scenes differ between methods, so "
        "compare methods in the table of paired comparisons instead. RMSE: root mean square distance from the learned "
        "motion at equal times. RMSE, unaffected samples: RMSE over the samples at which the tool of the learned "
        f"motion is farther than {100 * NEAR:.0f} cm from every obstacle. RMSE of the path: root mean square distance "
        "from the nearest point of the learned path."
    )
    return Table("Quality of the successful motions", columns, tuple(rows), note)


def rmse_table(results: MovingResults, families: Sequence[str], title: str) -> Table:
    """Return a table of the RMSE of the methods that the thesis compares, in the given families of scenes."""
    rows = []
    for name, methods in READINGS.items():
        for row in results.rows:
            if row.split(",")[0] not in methods:
                continue
            found = [r for f in families for r in results.of(row, f)]
            good = [1e3 * r.value("rmse") for r in found if r.success]
            if not found:
                continue
            low, high = bootstrap(good) if len(good) > 1 else (math.nan, math.nan)
            spread = f"{np.mean(good):.1f} ({low:.1f} to {high:.1f})" if good else "–"
            rows.append((name, row, rate(len(good), len(found)), spread))
    note = f"Families {', '.join(families)}. RMSE: mean over the successes, 95 % bootstrap interval."
    return Table(title, ("thesis", "ours", "success % (95 %)>", "RMSE [mm]>"), tuple(rows), note)


def _paired(results: MovingResults, row: str, other: str, families: Sequence[str]) -> tuple[int, int, int, list[float]]:
    """Return the number of scenes, those that only each row solves, and differences of RMSE where both succeed [m]."""
    pairs = [
        (found[row], found[other])
        for scene, found in results.by_scene.items()
        if scene[0] in families and row in found and other in found
    ]
    first, second = (
        sum(a.success and not b.success for a, b in pairs),
        sum(b.success and not a.success for a, b in pairs),
    )
    both = [a.value("rmse") - b.value("rmse") for a, b in pairs if a.success and b.success]
    return len(pairs), first, second, both


def paired_table(results: MovingResults) -> Table:
    """Return a table that compares our most successful method with each other method in the same scenes."""
    ours = next((row for row in results.rows if row in OURS), None)
    if ours is None:
        return Table("Paired comparison", (), ())
    others = [row for row in results.rows if row != ours and row not in CONTROLS]
    found = [(row, *_paired(results, ours, row, results.families())) for row in others]
    success = holm([mcnemar(first, second) for _, _, first, second, _ in found])
    quality = holm([signed_rank(np.array(both)) for *_, both in found])
    rows = []
    for (row, scenes, first, second, both), p, q in zip(found, success, quality, strict=True):
        middle = f"{1e3 * np.mean(both):+.1f}" if both else "–"
        rows.append((row, str(scenes), str(first), str(second), _p(p), str(len(both)), middle, _p(q)))
    columns = (
        "method",
        "scenes>",
        f"only {ours} succeeds>",
        "only the other succeeds>",
        "p>",
        "both succeed>",
        f"RMSE of {ours} minus the other [mm]>",
        "p>",
    )
    note = (
        "The first p is that of McNemar's exact test of the successes. The second p is that of Wilcoxon's signed-rank "
        "test of the RMSE. Holm's method corrects both for the number of methods."
    )
    return Table(f"{ours} and each other method in the same scenes", columns, tuple(rows), note)


def causal_table(results: MovingResults) -> Table:
    """Return a table that compares our most successful method with the causal oracle in the same scenes, by family."""
    ours = next((row for row in results.rows if row in OURS), None)
    if ours is None or _CAUSAL not in results.rows:
        return Table("Causal oracle", (), ())
    rows = []
    for family in results.families():
        scenes, first, second, both = _paired(results, ours, _CAUSAL, [family])
        if scenes:
            rows.append((family, str(scenes), str(len(both) + first), str(len(both) + second)))
    columns = ("family", "scenes>", f"{ours} succeeds>", f"{_CAUSAL} succeeds>")
    return Table(f"{ours} and the causal oracle in the same scenes", columns, tuple(rows))


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def claims_table(results: MovingResults) -> Table:
    """Return a table of claims of thesis Chapter 5 and of checks of the benchmark itself, with their results."""
    rows = [
        _claim(
            results, "DMP+AT has a smaller RMSE than RCAMO with one moving obstacle (Fig 5.7)", FEW, ("DMP+AT",), -1
        ),
        _claim(
            results,
            "RCAMO has the smallest RMSE with several moving obstacles (Fig 5.11)",
            MANY,
            ("DMP+AT", "DMP+ANN", "GMM+DMP", "GMM+IRL"),
            1,
        ),
        _success_claim(results, "RCAMO is robust with one moving obstacle (Section 5.4)", FEW),
        _success_claim(results, "RCAMO is robust with several moving obstacles (Section 5.4)", MANY),
    ]
    for name, most in (("aims-at-obstacle", 0.0), ("no-avoidance", 0.02)):
        found = results.of(name)
        good = sum(r.success for r in found)
        text = f"check: {name} succeeds in at most {100 * most:.0f} % of the runs"
        held = "–" if not found else "yes" if good <= most * len(found) else "no"
        rows.append((text, rate(good, len(found)) if found else "not run", held))
    return Table("Claims of the thesis, and checks", ("claim or check", "found", "held?"), tuple(rows))


def _best(results: MovingResults, name: str, families: Sequence[str]) -> str | None:
    """Return the most successful of our interpretations of a thesis method in these families; None if none was run."""
    there = [row for row in results.rows if row.split(",")[0] in READINGS[name]]
    return max(
        there, key=lambda row: sum(r.success for family in families for r in results.of(row, family)), default=None
    )


def _claim(
    results: MovingResults, text: str, families: Sequence[str], others: Sequence[str], sign: int
) -> tuple[str, str, str]:
    """Compare the RMSE of RCAMO with that of other methods.

    ``sign`` is 1 if the thesis claims a smaller RMSE of RCAMO.
    """
    ours = "rcamo" if "rcamo" in results.rows else None
    parts, held = [], []
    for name in others:
        row = _best(results, name, families)
        if ours is None or row is None:
            continue
        scenes, first, second, both = _paired(results, ours, row, families)
        if not scenes:
            continue
        p = signed_rank(np.array(both)) if both else 1.0
        difference = float(np.mean(both)) if both else math.nan
        middle = (
            f"{1e3 * difference:+.1f} mm in {len(both)} scenes in which both succeed (p {_p(p)})"
            if both
            else "both succeed in 0 scenes"
        )
        parts.append(
            f"RMSE of {ours} minus {row}: {middle}. Only {ours} succeeds in {first} scenes, only {row} in {second}."
        )
        held.append(p < 0.05 and sign * difference < 0.0)
    if not parts:
        return text, "not run", "–"
    verdict = "yes" if all(held) else "in part" if any(held) else "no"
    return text, " ".join(parts), verdict


def _success_claim(results: MovingResults, text: str, families: Sequence[str]) -> tuple[str, str, str]:
    parts = []
    good = False
    for row in ("rcamo", "rcamo-certified"):
        found = [r for family in families for r in results.of(row, family)]
        if found:
            n = sum(r.success for r in found)
            parts.append(f"{row} {rate(n, len(found))} %")
            good = good or n >= 0.95 * len(found)
    return text, "; ".join(parts) if parts else "not run", "–" if not parts else "yes" if good else "no"


def sensor_table(results: MovingResults) -> Table:
    """Return a table of the rates of success for each sensor. The table is empty if all runs used the same sensor."""
    sensors = sorted({results.sensor_of(r) for r in results.all})
    if len(sensors) < 2:
        return Table("Success by sensor", (), ())
    rows = []
    for noise, rate_, latency, dropout, occlusions in sensors:
        same = (noise, rate_, latency, dropout, occlusions)
        cells = []
        for row in results.rows:
            found = [r for r in results.of(row) if results.sensor_of(r) == same]
            cells.append(rate(sum(r.success for r in found), len(found)))
        name = (f"{1e3 * noise:g}", f"{rate_:g}", f"{1e3 * latency:g}", f"{100 * dropout:g}", f"{occlusions:g}")
        rows.append((*name, *cells))
    heads = ("noise [mm]>", "rate [Hz]>", "latency [ms]>", "dropout [%]>", "occlusions [1/s]>")
    return Table("Success % (95 %) by sensor", (*heads, *(f"{row}>" for row in results.rows)), tuple(rows))


def tracking_table(results: MovingResults) -> Table:
    """Return a table of the tracker's errors in each family. These errors do not depend on the method."""
    rows = []
    for family in results.families():
        found = next((of for row in results.rows if (of := results.of(row, family))), [])
        rows.append(
            (
                family,
                mean([r.value("position_error") for r in found], 1e3),
                mean([r.value("velocity_error") for r in found], 1e3, 0),
                mean([r.value("nees") for r in found], 1.0, 2),
                mean([r.value("switches") for r in found], 1.0, 2),
                mean([100 * r.value("unseen") for r in found]),
            )
        )
    columns = (
        "family",
        "position error [mm]>",
        "velocity error [mm/s]>",
        "NEES (3 is right)>",
        "new track numbers of tracked obstacles per run>",
        "time without a track [%]>",
    )
    note = (
        "Errors of the positions and velocities that the tracker predicts for the present time. Means over the runs "
        "of one method."
    )
    return Table("Tracked obstacles", columns, tuple(rows), note)


def causes_table(results: MovingResults) -> Table:
    """Return a table of the number of contacts of each method, by cause."""
    causes = sorted({c["cause"] for r in results.all for c in r.values.get("contacts", ())})
    rows = []
    for row in results.rows:
        found = [c for r in results.of(row) for c in r.values.get("contacts", ())]
        counts = Counter(c["cause"] for c in found)
        away = sum(c["tool_speed"] is not None and c["tool_speed"] <= 0.0 for c in found)
        rows.append((row, str(len(found)), *(str(counts[c]) for c in causes), str(away)))
    columns = (
        "method",
        "contacts>",
        *(f"{cause}>" for cause in causes),
        "contacts in which the tool stands or moves away>",
    )
    return Table("Contacts by cause", columns, tuple(rows) if causes else ())


def contacts_table(results: MovingResults) -> Table:
    """Return a table with one row for each contact of our methods."""
    rows = []
    for row in results.rows:
        if row.split(",")[0] not in OURS:
            continue
        for result in results.of(row):
            rows += [_contact(result, row, contact) for contact in result.values.get("contacts", ())]
    note = "" if len(rows) <= _LISTED else f"The first {_LISTED} of {len(rows)} contacts."
    columns = (
        "method",
        "scene",
        "obstacle",
        "time [s]>",
        "speed of the obstacle towards the tool [m/s]>",
        "speed of the tool towards the obstacle [m/s]>",
        "braking",
        "status",
        "cause",
        "outcome of the oracle with the true future",
        "outcome of the oracle with the tracked obstacles",
    )
    oracles = [{r.experiment.scene: r.outcome for r in results.of(name)} for name in (_FORESEEN, _CAUSAL)]
    full = [(*cells, *(oracle.get(scene, "not run") for oracle in oracles)) for scene, cells in rows[:_LISTED]]
    return Table("Contacts of our methods", columns, tuple(full), note)


def _contact(
    result: MovingResult, row: str, contact: dict[str, object]
) -> tuple[tuple[str, int, int], tuple[str, ...]]:
    e = result.experiment
    return e.scene, (
        row,
        f"{e.family}, {e.dimension}-D, seed {e.seed}",
        str(contact["obstacle"]),
        f"{contact['time']:.2f}",
        f"{contact['obstacle_speed']:.2f}",
        f"{contact['tool_speed']:.2f}",
        "yes" if contact["braking"] else "no",
        str(contact["status"]),
        str(contact["cause"]),
    )
