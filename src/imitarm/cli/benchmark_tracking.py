"""``imitarm benchmark tracking``: test the tracker and its safety margins on real motion."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from imitarm.benchmark.provenance import code_version, origin
from imitarm.benchmark.tracked_motions import recorded_motions
from imitarm.benchmark.tracking import SENSOR, tracking_tables
from imitarm.benchmark.tracking_margins import margin_table
from imitarm.cli.benchmark_options import add_fill, place_of, report_tables
from imitarm.cli.outputs import check_outputs
from imitarm.cli.screen import remark, say
from imitarm.errors import InputError


def add_tracking(parsers: Any) -> None:
    """Add the parser of the command."""
    parser = parsers.add_parser(
        "tracking",
        help="test the tracker and its safety margins on real motion (thesis Fig 5.9)",
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="folder of real recordings, with the subfolders mocap_arm and mocap_trolley",
    )
    parser.add_argument(
        "--windows",
        type=int,
        default=5000,
        metavar="N",
        help="number of short synthetic motions that test the margins; default: 5000",
    )
    parser.add_argument(
        "--noise", type=float, default=5.0, metavar="MM", help="standard deviation of detected positions; default: 5"
    )
    parser.add_argument(
        "--dropout", type=float, default=20.0, metavar="%", help="percentage of missed detections; default: 20"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the sensor; default: 0")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a page with figures (HTML)")
    add_fill(parser)
    parser.set_defaults(benchmark=_run)


def _run(arguments: argparse.Namespace) -> int:
    """Print the tables, and write files."""
    place = place_of(arguments, "tracking")
    check_outputs([("--report", arguments.report)], [("--fill", arguments.fill)])
    if arguments.windows < 200:
        raise InputError(f"--windows must be at least 200, got {arguments.windows}")
    try:
        sensor = replace(SENSOR, noise=1e-3 * arguments.noise, dropout=0.01 * arguments.dropout, seed=arguments.seed)
    except InputError as error:
        raise InputError(f"--noise, --dropout or --seed: {error}") from error
    motions = [] if arguments.data is None else recorded_motions(arguments.data)
    if not motions:
        remark("real motion is left out, because it needs real recordings; name their folder with --data")
    tables = tracking_tables(motions, sensor) if motions else []
    tables.append(margin_table(arguments.windows, motions, sensor, arguments.seed))
    report_tables(tables, place, [code_version()])
    if arguments.report is not None:
        from imitarm.benchmark.tracking_report import write_tracking_report  # noqa: PLC0415 (draws: needs an extra)
        from imitarm.cli.run_scene import provenance  # noqa: PLC0415

        facts = provenance(results=origin([code_version()]))
        say(f"wrote {write_tracking_report(motions, tables, arguments.report, sensor=sensor, provenance=facts)}")
    return 0
