"""The arguments with which commands read demonstrations, and reading them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from imitarm.cli.robot_options import add_robot_options
from imitarm.cli.screen import say, show_table
from imitarm.demonstrations import Finding, RawDemonstration, files_of, lint, read_raw
from imitarm.demonstrations.finding import SEVERITIES
from imitarm.demonstrations.reader import LENGTH_UNITS, QUATERNION_ORDERS, TIME_UNITS
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

_COLOURS = {"error": "red", "warning": "yellow", "note": ""}


def add_reading_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files and all that they may leave unsaid."""
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="demonstrations (CSV, text, NPY, NPZ), or folders of them"
    )
    unsaid = parser.add_argument_group("what files may leave unsaid")
    unsaid.add_argument("--units", choices=LENGTH_UNITS, help="of lengths; default: as the file says, else m")
    unsaid.add_argument("--time-units", choices=TIME_UNITS, help="of time stamps; default: as the file says, else s")
    unsaid.add_argument(
        "--duration", type=float, metavar="S", help="seconds each motion took, if it has no time stamps"
    )
    unsaid.add_argument("--rate", type=float, metavar="HZ", help="samples a second, if it has no time stamps")
    unsaid.add_argument(
        "--quaternion-order", choices=QUATERNION_ORDERS, default="wxyz", help="of unnamed columns; default: wxyz"
    )
    add_robot_options(parser, default=None)  # else recordings of another arm would be compared with Sawyer


def read_and_lint(
    arguments: argparse.Namespace, arm: ArmModel | None, *, task: str = "", repair: bool = False
) -> tuple[list[RawDemonstration], list[Finding]]:
    """Read every file and check what was read; a file that can't be read is a finding too.

    Args:
        arguments: those of :func:`add_reading_arguments`.
        arm: the arm that was recorded.
        task: what is shown.
        repair: drop broken rows before checking.

    Raises:
        InputError: when there are no files, or an option is wrong for all of them.
    """
    raw: list[RawDemonstration] = []
    unreadable: list[Finding] = []
    for path in files_of(arguments.files):
        try:
            read = read_raw(
                path,
                units=arguments.units,
                time_units=arguments.time_units,
                duration=arguments.duration,
                rate=arguments.rate,
                quaternion_order=arguments.quaternion_order,
                task=task,
            )
            raw += [RawDemonstration.of(one.demonstration(arm, repair=True)) for one in read] if repair else read
        except InputError as error:
            message, _, remedy = str(error).removeprefix(path).lstrip(":, ").rpartition("; ")
            unreadable.append(Finding("error", "unreadable", message or remedy, path, remedy=remedy if message else ""))
    return raw, unreadable + (lint(raw, arm=arm) if raw else [])


def show_findings(raw: Sequence[RawDemonstration], findings: Sequence[Finding]) -> None:
    """Print the findings as a table, and how many there are of each kind."""
    if findings:
        show_table(
            ["", "demonstration", "place", "code", "finding", "remedy"],
            [(f.severity, f.source or "all", f.place, f.code, f.message, f.remedy) for f in findings],
            styles=[_COLOURS[f.severity] for f in findings],
        )
    counts = [(sum(f.severity == severity for f in findings), severity) for severity in SEVERITIES]
    say(", ".join(_number(n, what) for n, what in [(len(raw), "demonstration"), *counts]))


def _number(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
