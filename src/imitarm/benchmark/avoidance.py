"""``imitarm benchmark avoidance``: count in how many random scenes each method keeps the required clearance.

The benchmark interpolates each planned path at 4000 points, which are closer together than the samples of the plan. It
measures the clearance at these points.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.families import (
    CLEARANCE,
    TOOL_RADIUS,
    Case,
    covered_end,
    narrow_gap,
    sparse_clutter,
)
from imitarm.benchmark.tables import Table
from imitarm.evaluation.intervals import wilson_interval
from imitarm.policies.adaptation import ADAPTERS, adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.skills.gmm import DegenerateAxisWarning
from imitarm.skills.skill import Skill
from imitarm.tasks.habits import s_shaped_demonstrations

Array = NDArray[np.float64]

SLACK = 0.0005  # [m] a path may fall below the required clearance by so much
_DENSE = 4000
_COLUMNS = (
    *("", "scenes", "method", "right answer % (95 %)>", "collision-free %>", "least mm>", "RMSE mm>", "unmoved %>"),
    "ms>",
)


@dataclass(frozen=True)
class Outcome:
    """Result of one method in one scene.

    Attributes:
        accepted: whether the method accepts the scene and returns a path to execute.
        kept: whether the path keeps the required clearance (with 0.5 mm tolerance) at all evaluated points.
        collision_free: whether the path touches no obstacle at any evaluated point.
        clearance: smallest distance to an obstacle at the evaluated points [m].
        rmse: root mean square distance between the returned path and the learned path [m].
        unmoved: fraction of the Gaussian components that the method did not move.
        seconds: compute time [s].
    """

    accepted: bool
    kept: bool
    collision_free: bool
    clearance: float
    rmse: float
    unmoved: float
    seconds: float


def learn(*, planar: bool) -> tuple[Skill, Array]:
    """Learn an S-shaped reach with 8 Gaussian components; return the skill and its path, shape (400, 3) [m]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateAxisWarning)  # a planar reach has no spread in z, on purpose
        skill = Skill(n_components=8).fit(s_shaped_demonstrations(planar=planar))
    return skill, skill.gmr_.trajectory(400).positions


def evaluate(case: Case, adaptation: Adaptation) -> Outcome:
    """Measure the clearance and the error of an adapted path in its scene."""
    times = adaptation.trajectory.times
    points, _ = adaptation.trajectory.at(np.linspace(times[0], times[-1], _DENSE))
    clearance = float(np.min(case.scene.clearance(points))) - TOOL_RADIUS
    return Outcome(
        accepted=adaptation.feasible,
        kept=clearance >= CLEARANCE - SLACK,
        collision_free=clearance > 0.0,
        clearance=clearance,
        rmse=adaptation.rmse_to_nominal,
        unmoved=adaptation.unmoved_fraction,
        seconds=adaptation.compute_time,
    )


def run_family(skill: Skill, cases: Iterable[Case], method: str = "certified") -> list[Outcome]:
    """Adapt the path of a skill to each scene by one method, and return one outcome for each scene."""
    outcomes = []
    for case in cases:
        adaptation = adapt(
            skill, case.scene, method, tool_radius=TOOL_RADIUS, clearance=CLEARANCE, forbidden=case.forbidden
        )
        outcomes.append(evaluate(case, adaptation))
    return outcomes


def _families(path: Array, planar: bool) -> list[tuple[str, bool, Callable[[int], Case]]]:
    """Return the families of scenes: name, whether the scenes have a solution, and the function that makes a scene."""
    rows: list[tuple[str, bool, Callable[[int], Case]]] = [
        (f"{k} on the path", True, lambda s, k=k: sparse_clutter(s, path, n_obstacles=k, planar=planar))  # type: ignore[misc]
        for k in (1, 2, 3)
    ]
    rows.append(("start or goal covered", False, lambda s: covered_end(s, path, planar=planar)))
    if planar:
        rows.append(("gap wide enough", True, lambda s: narrow_gap(s, path, solvable=True)))
        rows.append(("gap too narrow", False, lambda s: narrow_gap(s, path, solvable=False)))
    return rows


def _row(dimension: str, family: str, solvable: bool, method: str, outcomes: Sequence[Outcome]) -> list[str]:
    right = sum(o.accepted and o.kept if solvable else not o.accepted for o in outcomes)
    low, high = wilson_interval(right, len(outcomes))
    done = [o for o in outcomes if o.accepted]
    return [
        dimension,
        family,
        method,
        f"{100 * right / len(outcomes):.1f} ({100 * low:.1f} to {100 * high:.1f})",
        f"{100 * np.mean([o.collision_free for o in outcomes]):.1f}",
        f"{1e3 * min(o.clearance for o in done):.2f}" if done else "-",
        f"{1e3 * np.mean([o.rmse for o in done]):.1f}" if done else "-",
        f"{100 * np.mean([o.unmoved for o in done]):.0f}" if done else "-",
        f"{1e3 * np.median([o.seconds for o in outcomes]):.1f}",
    ]


def success_table(
    seeds: int,
    first: int = 2000,
    methods: Sequence[str] = tuple(ADAPTERS),
    on_done: Callable[[int, int], None] | None = None,
) -> Table:
    """Run every method in random scenes of every family, and return the table of results.

    Args:
        seeds: number of scenes in each family.
        first: first seed; seeds from 2000 on are for testing.
        methods: names in :data:`imitarm.policies.adaptation.ADAPTERS`.
        on_done: function that is called after each table row, with the number of finished rows and the total number of
            rows.
    """
    rows: list[tuple[str, ...]] = []
    planned = [(planar, *learn(planar=planar)) for planar in (True, False)]
    total = sum(len(_families(path, planar)) for planar, _, path in planned) * len(methods)
    for planar, skill, path in planned:
        dimension = "2-D" if planar else "3-D"
        for family, solvable, make in _families(path, planar):
            cases = [make(first + i) for i in range(seeds)]
            for method in methods:
                outcomes = run_family(skill, cases, method)
                rows.append(tuple(_row(dimension, family, solvable, method, outcomes)))
                if on_done is not None:
                    on_done(len(rows), total)
    return Table(
        f"{seeds} scenes per row, {1e3 * CLEARANCE:.0f} mm required clearance, tool of {2e3 * TOOL_RADIUS:.0f} mm "
        "diameter",
        _COLUMNS,
        tuple(rows),
        "Right answer: the method solved the scene with the required clearance (tolerance 0.5 mm), or it refused a "
        "scene that can't be solved.",
    )
