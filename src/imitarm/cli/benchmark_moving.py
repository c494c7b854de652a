"""``imitarm benchmark moving``: run and compare the avoidance methods among moving obstacles."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any

from imitarm.benchmark.moving import WORLDS, MovingExperiment, default_methods, run_experiment
from imitarm.benchmark.moving_arm import OBSERVERS, ROBOTS
from imitarm.benchmark.moving_results import RESULTS, MovingResults
from imitarm.benchmark.moving_scenes import FAMILIES
from imitarm.benchmark.moving_tables import family_table, moving_tables, success_table
from imitarm.benchmark.person_arm import DATA, has_recordings
from imitarm.benchmark.provenance import code_version, origin
from imitarm.benchmark.static_scenes import SPLITS
from imitarm.cli.benchmark_options import (
    Actions,
    add_fill,
    add_saved,
    add_workers,
    place_of,
    report_tables,
    run_with_progress,
    scenes_to_play,
    workers_of,
)
from imitarm.cli.outputs import check_outputs
from imitarm.cli.screen import remark, say
from imitarm.control_loop.observer import SensorModel
from imitarm.errors import InputError

_FOLDER = Path("benchmark-moving")
_RECORDED = "M10"
_WITH_ARM = "moving (whole arm)"  # in a document, the place of results that are all with an arm


def add_moving(parsers: Any) -> None:
    """Add the parser of the command."""
    moving = parsers.add_parser(
        "moving", help="compare avoidance methods among moving obstacles (thesis Figs 5.7, 5.11)"
    )
    first, end = SPLITS["test"]
    moving.add_argument(
        "--families", nargs="+", choices=FAMILIES, metavar="NAME", help=f"default: {' '.join(FAMILIES)}"
    )
    moving.add_argument(
        "--world",
        nargs="+",
        choices=WORLDS,
        default=["tool"],
        metavar="NAME",
        help="tool: the tool alone (the default); "
        + "; ".join(f"{robot}: the whole simulated arm with its {tool}" for robot, tool in ROBOTS.items()),
    )
    moving.add_argument(
        "--observer",
        choices=OBSERVERS,
        default=OBSERVERS[0],
        help="sensor: the positions of the obstacles, with noise (the default); "
        "camera: two simulated depth cameras, only with --world sawyer panda",
    )
    moving.add_argument(
        "--dimensions", nargs="+", type=int, choices=(2, 3), help="dimensions of the world 'tool'; default: 2 3"
    )
    moving.add_argument(
        "--count",
        type=int,
        default=100,
        metavar="N",
        help="number of scenes of each family in each dimension; default: 100",
    )
    moving.add_argument(
        "--first", type=int, default=first, metavar="N", help=f"first seed; {first} to {end - 1} are for tests"
    )
    moving.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"policies and reference methods; default: {' '.join(default_methods())}",
    )
    for name, default, unit, text in (
        ("noise", 5.0, "MM", "standard deviation of the measured positions of obstacles"),
        ("rate", 30.0, "HZ", "measurements per second"),
        ("latency", 33.0, "MS", "delay of the measured positions"),
        ("dropout", 0.0, "PERCENT", "probability that an obstacle is missed in a frame"),
        ("occlusions", 0.0, "HZ", "number of occlusions per second; each lasts 0.5 s"),
    ):
        moving.add_argument(
            f"--{name}", nargs="+", type=float, default=[default], metavar=unit, help=f"{text}; default: {default:g}"
        )
    moving.add_argument(
        "--out", type=Path, default=_FOLDER, metavar="DIR", help=f"folder of results; default: {_FOLDER}"
    )
    add_saved(moving)
    add_workers(moving)
    moving.set_defaults(benchmark=_run)
    actions = moving.add_subparsers(
        action=Actions, metavar="ACTION", title="actions; if none is given, the experiments are run"
    )
    comparison = actions.add_parser("compare", help="print the tables of saved results")
    comparison.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="folders of results")
    comparison.add_argument("--report", type=Path, metavar="FILE", help="write a page with figures and playback (HTML)")
    comparison.add_argument(
        "--play", nargs="+", default=[], metavar="FAMILY,DIMENSION,SEED", help="scenes to draw, e.g. M3,3,2004"
    )
    add_fill(comparison)
    comparison.set_defaults(benchmark=_compare)


def experiments_of(arguments: argparse.Namespace) -> list[MovingExperiment]:
    """Return the experiments that the options describe; experiments in the same scene follow one another.

    Raises:
        InputError: when an option is out of range, or when the recordings for the family M10 (scenes from recorded
            motions) are missing.
    """
    if arguments.count < 1 or arguments.first < 0:
        raise InputError(
            f"--count must be at least 1 and --first at least 0, got {arguments.count} and {arguments.first}"
        )
    if arguments.dimensions and "tool" not in arguments.world:
        raise InputError("--dimensions applies only to --world tool; the worlds with an arm have 3 dimensions")
    families = list(arguments.families or FAMILIES)
    if not arguments.families and not has_recordings():
        families.remove(_RECORDED)
        remark(f"{_RECORDED} is left out, because it needs real recordings; name their folder in {DATA}")
    sensors = list(
        itertools.product(
            [1e-3 * n for n in arguments.noise],
            arguments.rate,
            [1e-3 * n for n in arguments.latency],
            [0.01 * n for n in arguments.dropout],
            arguments.occlusions,
        )
    )
    for sensor in sensors:
        try:
            SensorModel(*sensor)
        except InputError as error:
            raise InputError(f"--noise, --rate, --latency, --dropout or --occlusions: {error}") from error
    seeds = range(arguments.first, arguments.first + arguments.count)
    found = [
        MovingExperiment(family, dimension, seed, method, (), world, *sensor, arguments.observer)
        for seed in seeds
        for family in families
        for world in arguments.world
        for dimension in (arguments.dimensions or [2, 3] if world == "tool" else [3])
        for sensor in sensors
        for method in arguments.methods or default_methods(world)
    ]
    return list(dict.fromkeys(found))


def _run(arguments: argparse.Namespace) -> int:
    """Run the experiments; print the rates of success."""
    wanted, workers = experiments_of(arguments), workers_of(arguments)
    store = RESULTS.store(arguments.out, reuse=arguments.reuse)
    done = run_with_progress("moving", wanted, run_experiment, store, workers, fresh=arguments.fresh)
    results = MovingResults(done.outcomes)
    for setting in results.settings:
        own = results.in_setting(setting)
        report_tables([success_table(own), family_table(own)], None, [code_version()])
    say(done.summary)
    say(f"compare the methods: imitarm benchmark moving compare {arguments.out}")
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    """Print the tables of saved results, and write files."""
    check_outputs([("--report", arguments.report)], [("--fill", arguments.fill)], new_folders=True)
    chosen = scenes_to_play(arguments, "M3,3,2004")
    found = RESULTS.read_folders(arguments.folders)
    results, versions = MovingResults(found), [r.code for r in found]
    place = place_of(arguments, "moving" if "tool" in results.settings else _WITH_ARM)
    if set(versions) != {code_version()}:
        remark(origin(versions))
    report_tables(moving_tables(results), place, versions)
    if arguments.report is not None:
        from imitarm.benchmark.moving_report import write_moving_report  # noqa: PLC0415 (draws: needs an extra)
        from imitarm.cli.run_scene import provenance  # noqa: PLC0415

        facts = provenance(results=origin(versions), experiments=len(found))
        say(f"wrote {write_moving_report(results, arguments.report, provenance=facts, scenes=chosen)}")
    return 0
