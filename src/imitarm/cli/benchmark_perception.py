"""``imitarm benchmark perception``: evaluate the detection of obstacles in depth images."""

from __future__ import annotations

import argparse
from typing import Any

from imitarm.benchmark.perception import run_frames, tables
from imitarm.benchmark.perception_scenes import FAMILIES, MOST
from imitarm.benchmark.provenance import code_version
from imitarm.cli.benchmark_options import add_fill, place_of, report_tables
from imitarm.cli.screen import progress_bar
from imitarm.errors import InputError
from imitarm.perception import DepthNoise


def add_perception(parsers: Any) -> None:
    """Add the parser of the command."""
    parser = parsers.add_parser(
        "perception", help="compare obstacles detected in depth images with the true obstacles in the simulator"
    )
    parser.add_argument(
        "--count", type=int, default=105, metavar="N", help="number of scenes of each family; default: 105"
    )
    parser.add_argument("--first", type=int, default=2000, metavar="N", help="first seed; default: 2000")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES), metavar="NAME")
    parser.add_argument("--height", type=int, default=120, metavar="N", help="rows of the images; default: 120")
    parser.add_argument("--exact", action="store_true", help="use a camera without noise")
    add_fill(parser)
    parser.set_defaults(benchmark=_run)


def _run(arguments: argparse.Namespace) -> int:
    """Evaluate the scenes and print the tables."""
    if arguments.count < 1 or not 0 <= arguments.first <= MOST - arguments.count:
        raise InputError(f"--count must be at least 1, --first at least 0, and their sum at most {MOST}")
    if not 24 <= arguments.height <= 1080:
        raise InputError(f"--height must be from 24 to 1080, got {arguments.height}")
    place = place_of(arguments, "perception")
    with progress_bar() as bar:
        task = bar.add_task("detecting", total=None)
        frames = run_frames(
            arguments.count,
            arguments.first,
            families=list(dict.fromkeys(arguments.families)),
            noise=DepthNoise.none() if arguments.exact else None,
            height=arguments.height,
            on_done=lambda done, of: bar.update(task, completed=done, total=of),
        )
    report_tables(tables(frames), place, [code_version()])
    return 0
