"""``imitarm benchmark real-time``: how often the control loop is too late beside simulation, camera and tracker."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from imitarm.benchmark.moving_arm import ROBOTS
from imitarm.benchmark.provenance import origin
from imitarm.benchmark.real_time import run_real_time
from imitarm.benchmark.real_time_results import RealTimeResult, draw_histogram, write_page
from imitarm.benchmark.real_time_world import RealTimeSetup
from imitarm.cli.benchmark_options import add_fill, place_of, report_tables
from imitarm.cli.outputs import check_outputs
from imitarm.cli.screen import remark, say
from imitarm.errors import InputError
from imitarm.policies import POLICIES

_DEFAULT = RealTimeSetup()


def add_real_time(parsers: Any) -> None:
    """Add the parser of the command."""
    parser = parsers.add_parser(
        "real-time", help="measure how often the control loop is too late beside simulation, camera and tracker"
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=_DEFAULT.duration,
        metavar="S",
        help="duration of the measurement; default: 60",
    )
    parser.add_argument(
        "--rate", type=float, default=_DEFAULT.rate, metavar="HZ", help="control periods per second; default: 1000"
    )
    parser.add_argument("--policy", choices=POLICIES, default=_DEFAULT.policy, metavar="NAME", help="default: rcamo")
    parser.add_argument("--robot", choices=ROBOTS, default=_DEFAULT.robot, help="default: sawyer")
    parser.add_argument(
        "--seed", type=int, default=_DEFAULT.seed, metavar="N", help="seed of the obstacles; default: 0"
    )
    parser.add_argument(
        "--rows", type=int, default=_DEFAULT.rows, metavar="N", help="rows of the camera's images; default: 150"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write all measured times (JSON)")
    parser.add_argument(
        "--saved", type=Path, metavar="FILE", help="show a result that --out has written, and measure nothing"
    )
    parser.add_argument("--figure", type=Path, metavar="FILE", help="write the histogram as a picture (PNG)")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a page with tables and histogram (HTML)")
    parser.add_argument("--force", action="store_true", help="replace the files of --out and --figure")
    add_fill(parser)
    parser.set_defaults(benchmark=_run)


def _run(arguments: argparse.Namespace) -> int:
    """Measure, print the tables, and write files; return 1 when the arm touched something."""
    place = place_of(arguments, "real-time")
    outputs = [("--out", arguments.out), ("--figure", arguments.figure), ("--report", arguments.report)]
    inputs = [("--fill", arguments.fill), ("--saved", arguments.saved)]
    check_outputs(outputs, inputs, force=arguments.force)
    if arguments.saved is None:
        result = _measured(arguments)
    elif arguments.out is not None:
        raise InputError("--out can't be used with --saved, because nothing is measured")
    else:
        result = RealTimeResult.read(arguments.saved)
    if arguments.out is not None:
        result.write(arguments.out)
        say(f"wrote {arguments.out}")
    report_tables(result.tables(), place, [result.code])
    if result.contacts:
        say(f"touched: {', '.join(result.contacts)}")
    if arguments.figure is not None:
        draw_histogram(result, arguments.figure)
        say(f"wrote {arguments.figure}")
    if arguments.report is not None:
        from imitarm.cli.run_scene import provenance  # noqa: PLC0415 (draws: needs an extra)

        say(f"wrote {write_page(result, arguments.report, provenance(results=origin([result.code])))}")
    return int(bool(result.contacts))


def _measured(arguments: argparse.Namespace) -> RealTimeResult:
    """Run the four processes. Nothing is drawn on the screen meanwhile, because drawing would take processor time."""
    setup = RealTimeSetup(
        arguments.duration, arguments.rate, arguments.policy, arguments.robot, arguments.seed, arguments.rows
    )
    return run_real_time(
        setup,
        on_started=lambda: remark(f"four processes were started; the measurement takes {setup.duration:g} s"),
    )
