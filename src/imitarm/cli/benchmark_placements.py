"""``imitarm benchmark placements`` and ``comparison``: policies on a simulated arm with randomly placed obstacles."""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

from imitarm.benchmark import placement_comparison, placements
from imitarm.benchmark.placement_results import Setup, load_results
from imitarm.benchmark.placement_tables import placement_tables
from imitarm.cli.benchmark_options import add_fill, place_of, report_tables
from imitarm.cli.robot_options import DEFAULT_ROBOT
from imitarm.cli.screen import progress_bar, say
from imitarm.errors import InputError
from imitarm.kinematics.arm_file import ARMS, TOOLS
from imitarm.policies import POLICIES
from imitarm.validation import finite_number


def add_placements(parsers: Any) -> None:
    """Add the parsers of the two commands."""
    placed = parsers.add_parser(
        "placements", help="compare policies on a simulated arm with randomly placed obstacles on the path"
    )
    placed.add_argument(
        "--skill",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="skill files; default: the skill 'sweep' of the package, with the brush as default tool",
    )
    arms = placed.add_mutually_exclusive_group()
    arms.add_argument(
        "--robot", metavar="NAME", help=f"{', '.join(sorted(ARMS))}, or a URDF or MJCF file; default: {DEFAULT_ROBOT}"
    )
    arms.add_argument("--robots", nargs="+", metavar="NAME", help="names of several arms, instead of --robot")
    placed.add_argument(
        "--tool", metavar="NAME", help=f"tool at the flange: {', '.join(sorted(TOOLS))}, or an MJCF file"
    )
    placed.add_argument("--policies", nargs="+", choices=POLICIES, default=["acfra"], metavar="NAME")
    placed.add_argument("--seeds", type=int, default=50, metavar="N", help="number of placements; default: 50")
    placed.add_argument("--first", type=int, default=2000, metavar="N", help="first seed; default: 2000")
    placed.add_argument("--jobs", type=int, default=1, metavar="N", help="number of processes; default: 1")
    placed.add_argument(
        "--list", action="store_true", help="also list each placement in which a policy did not reach the goal"
    )
    placed.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="append each result to this file (JSON lines); results that are already in it are not measured again",
    )
    placed.add_argument(
        "--reuse", action="store_true", help="use results in --out even if another version of the code measured them"
    )
    add_fill(placed)
    placed.add_argument(
        "--max-tilt", type=float, metavar="DEG", help="largest tilt of the tool; default: as in the demonstrations"
    )
    placed.set_defaults(benchmark=_placements)
    compared = parsers.add_parser(
        "comparison",
        help="read saved results, and compare one policy with each other policy where the other one succeeded",
    )
    compared.add_argument(
        "results", type=Path, nargs="+", metavar="RESULTS", help="files that 'placements --out' wrote"
    )
    compared.add_argument(
        "--policy", choices=POLICIES, default="acfra", metavar="NAME", help="policy to compare; default: acfra"
    )
    add_fill(compared)
    compared.set_defaults(benchmark=_comparison)


def _placements(arguments: argparse.Namespace) -> int:
    """Run the placements benchmark and print its table."""
    if arguments.seeds < 1 or arguments.first < 0 or arguments.jobs < 1:
        raise InputError("--seeds and --jobs must be at least 1, and --first at least 0")
    if arguments.out is not None and arguments.skill is None:
        raise InputError("--out needs --skill, because the default skill is not a file")
    if arguments.reuse and arguments.out is None:
        raise InputError("--reuse needs --out: name the file of the saved results")
    tilt = arguments.max_tilt
    if tilt is not None:
        tilt = math.radians(finite_number(tilt, "--max-tilt", "degrees", at_least=0.0))
    place = place_of(arguments, "placements")
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        skills, tool = arguments.skill, arguments.tool
        if skills is None:
            skills, tool = [placements.packaged_skill(Path(folder))], tool or "brush"
        robots = arguments.robots or [arguments.robot or DEFAULT_ROBOT]
        setups = [Setup(str(skill), arm, tool) for skill in skills for arm in robots]
        task = bar.add_task("reproducing", total=None)
        results = placements.run_placements(
            arguments.policies,
            setups,
            range(arguments.first, arguments.first + arguments.seeds),
            max_tilt=tilt,
            jobs=arguments.jobs,
            out=arguments.out,
            reuse=arguments.reuse,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )
    report_tables(placement_tables(results), place, [result.code for result in results])
    for result in results if arguments.list else []:
        if result.outcome != "arrived":
            where = f"{Path(result.setup.skill).stem}, {result.setup.robot}, seed {result.seed}"
            say(f"{result.policy}, {where}: {result.outcome}: {result.reason}")
    return 0


def _comparison(arguments: argparse.Namespace) -> int:
    """Compare a policy with the other policies, from saved results of placements, and print the comparison."""
    place = place_of(arguments, "comparison")
    results = list(load_results(arguments.results).values())
    tables_found = placement_comparison.comparison_tables(results, arguments.policy)
    report_tables(tables_found, place, [result.code for result in results])
    return 0
