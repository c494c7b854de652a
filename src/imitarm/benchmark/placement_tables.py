"""Tables of placements: outcomes and times, late arrivals, and a comparison with plans for the tool alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imitarm.benchmark.placement_results import PlacementResult
from imitarm.benchmark.placements import CLEARANCE, OUTCOMES
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import median_ratio, wilson_interval

LATE = 1.5  # times the duration of the skill
_RATIO_TARGET = 1.1


def placement_tables(results: Sequence[PlacementResult]) -> list[Table]:
    """Return the tables of outcomes, of late arrivals, and of the RMSE compared with a plan for the tool alone.

    A table without rows is left out.
    """
    return [_outcomes(results), *(table for table in (_late(results), _beside_the_tool(results)) if table.rows)]


def _outcomes(results: Sequence[PlacementResult]) -> Table:
    """Return one row for each policy: the frequency of each outcome, the smallest clearance, and times."""
    rows = []
    for policy in dict.fromkeys(result.policy for result in results):
        own = [result for result in results if result.policy == policy]
        counts = [sum(result.outcome == outcome for result in own) for outcome in OUTCOMES]
        accepted, arrived = len(own) - counts[1], [result for result in own if result.arrived]
        nearest = [1e3 * r.clearance for r in arrived if np.isfinite(r.clearance)]
        times = [[1e3 * r.planning for r in own if r.accepted == accepts] for accepts in (True, False)]
        rows.append(
            (
                policy,
                str(len(own)),
                share(accepted, len(own)),
                share(counts[0], accepted),
                *map(str, counts[2:]),
                share(sum(result.duration <= LATE for result in arrived), accepted),
                f"{min(nearest):.1f}" if nearest else "-",
                *(f"{np.median(t):.0f}" if t else "-" for t in times),
            )
        )
    headings = (
        "policy",
        "placements>",
        "accepted",
        "arrived (of the accepted placements)",
        *(f"{name}>" for name in OUTCOMES[2:]),
    )
    return Table(
        "Placements of one to three obstacles on the learned path",
        (
            *headings,
            f"arrived within {LATE:g} times the learned duration (of the accepted placements)",
            "smallest clearance of the motions that arrived [mm]>",
            "time to plan, median [ms]>",
            "time to refuse, median [ms]>",
        ),
        tuple(rows),
        f"Every part of the simulated arm must keep {1e3 * CLEARANCE:.0f} mm of clearance. Intervals: Wilson, 95 %.",
    )


def _late(results: Sequence[PlacementResult]) -> Table:
    """Return one row for each motion that arrived late, the slowest first."""
    late = sorted((r for r in results if r.arrived and r.duration > LATE), key=lambda r: -r.duration)
    return Table(
        f"Placements in which the arm arrived after more than {LATE:g} times the learned duration",
        ("policy", "skill", "robot", "seed>", "duration divided by the learned duration>"),
        tuple((r.policy, Path(r.setup.skill).stem, r.setup.robot, str(r.seed), f"{r.duration:.2f}") for r in late),
        "Some plans begin with a motion to another start posture. The duration includes this motion.",
    )


def _beside_the_tool(results: Sequence[PlacementResult]) -> Table:
    """Return a table of the RMSE of each policy and of a plan for the tool alone, for all skills and for each skill."""
    rows = []
    for policy in dict.fromkeys(result.policy for result in results):
        both = [r for r in results if r.policy == policy and r.arrived and math.isfinite(r.tool_rmse)]
        skills = dict.fromkeys(Path(result.setup.skill).stem for result in both)
        groups = [("all", list(both))] if len(skills) > 1 else []
        groups += [(skill, [r for r in both if Path(r.setup.skill).stem == skill]) for skill in skills]
        for name, group in groups:
            ours, theirs = [r.rmse for r in group], [r.tool_rmse for r in group]
            ratio, low, high = median_ratio(ours, theirs)
            medians = (f"{1e3 * np.median(values):.1f}" for values in (ours, theirs))
            rows.append((policy, name, str(len(group)), *medians, f"{ratio:.3f} ({low:.3f} to {high:.3f})"))
    return Table(
        "Distance from the demonstrations, compared with a plan for the tool alone",
        (
            "policy",
            "skill",
            "placements that both plans solve>",
            "RMSE of the whole arm, median [mm]>",
            "RMSE of the tool alone, median [mm]>",
            f"ratio of the medians (target: at most {_RATIO_TARGET:g})",
        ),
        tuple(rows),
        "Whole arm: the path that the simulated arm executed. Tool alone: the path that ACFRA plans in the same scene "
        "between the same ends, if only the tool must keep the clearance. RMSE: root mean square distance between the "
        "path and the mean of the demonstrations, at 200 points that are evenly spaced along each path and matched by "
        "dynamic time warping. Intervals: paired bootstrap over placements, 95 %.",
    )


def share(count: int, of: int) -> str:
    """Return a text with a count, its percentage of ``of``, and the 95 % Wilson interval; "-" if ``of`` is 0."""
    if not of:
        return "-"
    low, high = wilson_interval(count, of)
    return f"{count} ({100 * count / of:.1f} %, {100 * low:.1f} to {100 * high:.1f})"
