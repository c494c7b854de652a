"""Compare a policy with baselines in placements of obstacles: acceptance, planning time and executed path."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imitarm.benchmark.placement_results import PlacementResult, Setup
from imitarm.benchmark.placement_tables import share
from imitarm.benchmark.tables import Table
from imitarm.errors import InputError

_STYLE_NOTE = (
    "Planning: processor time until the policy accepts or refuses a placement, over all placements. The other columns "
    "use only the motions that arrived. RMSE and deviation compare the path of the simulated arm with the mean of the "
    "demonstrations. They do not depend on the timing: dynamic time warping matches 200 points that are evenly spaced "
    "along each path. Deviation: largest Mahalanobis distance along the path, with the covariance of GMR plus (5 mm)² "
    "in every direction. Tilt: largest rotation of the tool away from the learned rotation at the nearest point of "
    "the learned path. Tilt limit 'default': acfra and rrt-connect-tilt allow two standard deviations of the "
    "demonstrated rotation, and rrt-connect allows any tilt."
)
_PAIR_NOTE = (
    "Each row includes only the placements that the baseline solves: the arm arrives and keeps the clearance. "
    "Accepted and solved: how many of these placements {policy} accepts and solves (Wilson's 95 % interval). A ratio "
    "is the median of {policy} divided by the median of the baseline. Planning times: medians over all placements of "
    "the row, including those that {policy} refuses. RMSE and deviation: medians over the placements that both "
    "policies solve."
)
_RMSE_TARGET, _DEVIATION_TARGET = 0.7, 0.5


class Variant(NamedTuple):
    """A policy, and the largest tilt of the tool that it may use [rad]; None: the default of the policy."""

    policy: str
    max_tilt: float | None

    @property
    def limit(self) -> str:
        """The largest tilt as text, in degrees."""
        return "default" if self.max_tilt is None else f"{np.degrees(self.max_tilt):.0f}°"


Place = tuple[Setup, int]
"""A placement, determined by a setup (skill and arm) and a seed."""


def comparison_tables(results: Iterable[PlacementResult], policy: str = "acfra") -> list[Table]:
    """Return two tables: one of all policies, and one that compares ``policy`` with each other policy.

    Args:
        results: results of at least two policies in the same placements.
        policy: name of the policy that is compared with all others.

    Raises:
        InputError: when there is no result of this policy, or of no other policy.
    """
    variants: dict[Variant, dict[Place, PlacementResult]] = {}
    for result in results:
        place = result.setup, result.seed
        variants.setdefault(Variant(result.policy, result.max_tilt), {})[place] = result
    own = [variant for variant in variants if variant.policy == policy]
    baselines = [variant for variant in variants if variant.policy != policy]
    if not own or not baselines:
        raise InputError(
            f"comparison: results of {policy!r} and of another policy are needed; run the placements with both policies"
        )
    rows = [_style_row(variant, list(variants[variant].values())) for variant in variants]
    skills = dict.fromkeys(setup.skill for found in variants.values() for setup, _ in found)
    groups = [tuple(skills), *((skill,) for skill in skills)] if len(skills) > 1 else [tuple(skills)]
    pairs = [_pair_row(a, variants[a], b, variants[b], group) for a in own for b in baselines for group in groups]
    titles = (
        "policy",
        "tilt limit",
        "placements>",
        "arrived",
        "RMSE, median [mm]>",
        "largest deviation, median [σ]>",
        "largest tilt, median [°]>",
        "planning, median [ms]>",
        "planning, 99th percentile [ms]>",
    )
    return [
        Table("Executed paths compared with the mean of the demonstrations", titles, tuple(rows), _STYLE_NOTE),
        Table(
            f"{policy} in the placements that a baseline solves",
            (
                f"tilt limit of {policy}",
                "baseline",
                "tilt limit of the baseline",
                "skill",
                "placements that the baseline solves>",
                f"accepted by {policy}",
                f"solved by {policy}",
                "ratio of planning times (target: below 1)",
                f"ratio of RMSE (target: at most {_RMSE_TARGET:g})",
                f"ratio of deviations (target: at most {_DEVIATION_TARGET:g})",
            ),
            tuple(row for row in pairs if row is not None),
            _PAIR_NOTE.format(policy=policy),
        ),
    ]


def _style_row(variant: Variant, results: Sequence[PlacementResult]) -> tuple[str, ...]:
    arrived = [result for result in results if result.arrived]
    times = [1e3 * result.computing for result in results]
    return (
        variant.policy,
        variant.limit,
        str(len(results)),
        share(len(arrived), len(results)),
        _median(arrived, lambda result: 1e3 * result.rmse),
        _median(arrived, lambda result: result.deviation),
        _median(arrived, lambda result: float(np.degrees(result.tilt))),
        f"{np.median(times):.0f}",
        f"{np.percentile(times, 99):.0f}",
    )


def _pair_row(
    own: Variant,
    of_own: dict[Place, PlacementResult],
    baseline: Variant,
    of_baseline: dict[Place, PlacementResult],
    skills: Sequence[str],
) -> tuple[str, ...] | None:
    """Return the comparison of two variants with some skills; None if the baseline solved no placement of both."""
    pairs = [
        (of_own[place], other)
        for place, other in of_baseline.items()
        if other.arrived and place in of_own and place[0].skill in skills
    ]
    if not pairs:
        return None
    both = [pair for pair in pairs if pair[0].arrived]
    return (
        own.limit,
        baseline.policy,
        baseline.limit,
        Path(skills[0]).stem if len(skills) == 1 else "all",
        str(len(pairs)),
        share(sum(one.accepted for one, _ in pairs), len(pairs)),
        share(len(both), len(pairs)),
        _ratio(pairs, lambda result: result.computing),
        _ratio(both, lambda result: result.rmse),
        _ratio(both, lambda result: result.deviation),
    )


def _median(results: Sequence[PlacementResult], measure: Callable[[PlacementResult], float]) -> str:
    return f"{np.median([measure(result) for result in results]):.1f}" if results else "-"


def _ratio(
    pairs: Sequence[tuple[PlacementResult, PlacementResult]], measure: Callable[[PlacementResult], float]
) -> str:
    """Return the ratio of the medians of a measure."""
    if not pairs:
        return "-"
    one, other = (float(np.median([measure(pair[k]) for pair in pairs])) for k in (0, 1))
    return f"{one / other:.2f}" if other > 0.0 else "-"
