"""Measure how computing time and success depend on the number of obstacles and on the number of the tool's spheres.

The scenes have 1 to 20 obstacles near the path of the packaged sweep. The first obstacle is on the path. Some scenes
may have no solution. Spheres cover the tool, so that distances to the tool can be computed.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.families import CLEARANCE, SIMPLE, random_obstacle
from imitarm.benchmark.static import build
from imitarm.benchmark.static_measures import measure, outcome
from imitarm.benchmark.static_scenes import StaticCase
from imitarm.benchmark.static_tables import percentile, rate
from imitarm.benchmark.tables import Table
from imitarm.demonstrations import align, read
from imitarm.errors import ImitarmError, InfeasibleError
from imitarm.policies.adaptation import NOT_DOWN
from imitarm.scene import Obstacle, Scene
from imitarm.skills.skill import Skill
from imitarm.tasks import DEMONSTRATIONS

Array = NDArray[np.float64]

OBSTACLES = (1, 2, 4, 8, 12, 20)
SPHERES = (1, 2, 4, 8, 16)
_FEW = 2  # obstacles in the scenes with more spheres
_RADIUS, _LENGTH = 0.015, 0.10  # [m] of the spheres, and of the tool that they cover
_AWAY = 0.12  # [m] standard deviation of the obstacles' centres about the path, except for the first
_FREE = 0.02  # [m] beyond the required clearance, that obstacles leave to the tool at start and goal
_DRAWS = 2000


@dataclass(frozen=True)
class Plan:
    """The result of one plan in a scene with a given number of obstacles or spheres.

    Attributes:
        n: number of obstacles or spheres.
        seconds: processor time of the plan [s].
        outcome: see :data:`~imitarm.benchmark.static_measures.OUTCOMES`.
    """

    n: int
    seconds: float
    outcome: str


@lru_cache(maxsize=1)
def _sweep() -> Skill:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an axis that does not move, which is no matter here
        return Skill(n_components=8).fit(align(read(DEMONSTRATIONS)))


def scaling_case(n_obstacles: int, n_spheres: int, seed: int) -> StaticCase:
    """Return a scene with the given numbers of obstacles and spheres.

    A larger number of obstacles only adds obstacles.
    """
    skill, rng = _sweep(), np.random.default_rng([41, seed])
    path = skill.nominal(np.linspace(0.0, skill.duration_, 400)).positions
    free = _RADIUS + _LENGTH + CLEARANCE + _FREE
    made: list[Obstacle] = []
    for _ in range(_DRAWS):
        spread = _AWAY if made else 0.01
        centre = path[rng.integers(100, 300)] + spread * rng.normal(size=3)
        obstacle = random_obstacle(rng, centre, planar=False, kinds=SIMPLE)
        if obstacle.signed_distance(path[[0, -1]]).min() >= free:
            made.append(obstacle)
        if len(made) == n_obstacles:
            break
    along = np.linspace(0.0, -_LENGTH, n_spheres)
    spheres = np.column_stack([np.zeros((n_spheres, 2)), along, np.full(n_spheres, _RADIUS)])
    return StaticCase("scaling", 3, seed, skill, Scene(None, tuple(made)), spheres, CLEARANCE, NOT_DOWN, (), None)


def plan_once(method: str, case: StaticCase, n: int) -> Plan:
    """Plan a path with a method in a scene, and return its processor time and outcome."""
    policy = build(method, case)
    began = time.process_time()
    try:
        plan = policy.plan_motion(case.scene)
        spent = time.process_time() - began
        return Plan(n, spent, outcome(case, measure(case, plan.trajectory))[0])
    except InfeasibleError:
        return Plan(n, time.process_time() - began, "refused")
    except (ImitarmError, ArithmeticError, ValueError, LookupError, np.linalg.LinAlgError):
        return Plan(n, time.process_time() - began, "failed")


def exponent(plans: Sequence[Plan]) -> tuple[float, float]:
    """Return the exponent b of the power law ``time = a n^b``, and its standard error."""
    known = [p for p in plans if p.seconds > 0.0]
    x, y = np.log([p.n for p in known]), np.log([p.seconds for p in known])
    if len(known) < 3 or not np.ptp(x) > 0.0:
        return math.nan, math.nan
    slope, offset = np.polyfit(x, y, 1)
    left = y - slope * x - offset
    return float(slope), math.sqrt(float(left @ left) / (len(x) - 2) / float(((x - x.mean()) ** 2).sum()))


def scaling_tables(
    methods: Sequence[str], seeds: Sequence[int], on_done: Callable[[int, int], None] | None = None
) -> list[Table]:
    """Return two tables of time and success: one by the number of obstacles, and one by the number of spheres.

    Args:
        methods: names of the methods.
        seeds: seeds of the scenes.
        on_done: function that is called after each plan, with the number of finished plans and the number of all plans.
    """
    cases = [[scaling_case(n, 1, seed) for n in OBSTACLES for seed in seeds]]
    cases.append([scaling_case(_FEW, n, seed) for n in SPHERES for seed in seeds])
    numbers = [[n for n in many for _ in seeds] for many in (OBSTACLES, SPHERES)]
    total, done, tables = len(methods) * sum(map(len, cases)), 0, []
    for what, many, group, ns in zip(("obstacles", "spheres"), (OBSTACLES, SPHERES), cases, numbers, strict=True):
        rows = []
        for method in methods:
            plan_once(method, group[0], 1)  # what is computed once for a skill is not timed
            plans = []
            for n, case in zip(ns, group, strict=True):
                plans.append(plan_once(method, case, n))
                done += 1
                if on_done is not None:
                    on_done(done, total)
            rows.append((method, *_cells(plans, many)))
        columns = ("method", *(f"{n}>" for n in many), "exponent (standard error)>")
        note = (
            "Median processor time of a plan [ms], and in brackets the rate of success in percent with its Wilson "
            "interval. A power law, time = a n^b, is fitted to all plans of the row. Here n is the number at the top "
            "of the column, and b is the exponent."
        )
        title = f"Time and success by the number of {what}, {len(seeds)} scenes for each number"
        tables.append(Table(title, columns, tuple(rows), note))
    return tables


def _cells(plans: Sequence[Plan], numbers: Sequence[int]) -> list[str]:
    cells = []
    for n in numbers:
        own = [p for p in plans if p.n == n]
        good = sum(p.outcome in {"success", "too near"} for p in own)
        cells.append(f"{percentile([p.seconds for p in own], 50, 1e3)} [{rate(good, len(own))}]")
    slope, error = exponent(plans)
    return [*cells, f"{slope:.2f} ({error:.2f})"]
