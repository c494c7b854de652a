"""Arguments for all commands that read demonstrations, and a function that reads the files with these arguments."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import replace

from imitarm.cli.robot_options import add_robot_options
from imitarm.cli.screen import say, show_table
from imitarm.demonstrations import READERS, Finding, RawDemonstration, files_of, lint, read_raw
from imitarm.demonstrations.raw import SEVERITIES
from imitarm.demonstrations.reading import LENGTH_UNITS, QUATERNION_ORDERS, TIME_UNITS
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

_COLOURS = {"error": "red", "warning": "yellow", "note": ""}
_ARGUMENT = re.compile(
    r"\b(?P<name>units|time_units|duration|rate|quaternion_order|repair|thin|arm)="
    r"(?P<value>ArmModel\.load\((?P<arm>[^)]*)\)|'[^']*'|\"[^\"]*\"|[\w.]+)"
)


def add_reading_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument for files, and options for values that the files do not state, such as units."""
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help=f"demonstrations, or folders of them; formats: {', '.join(READERS)}"
    )
    unsaid = parser.add_argument_group("values that the files do not state")
    unsaid.add_argument("--units", choices=LENGTH_UNITS, help="unit of lengths; default: what the file states, else m")
    unsaid.add_argument(
        "--time-units", choices=TIME_UNITS, help="unit of time stamps; default: what the file states, else s"
    )
    unsaid.add_argument(
        "--duration", type=float, metavar="S", help="duration of each motion in seconds, for files without time stamps"
    )
    unsaid.add_argument("--rate", type=float, metavar="HZ", help="samples per second, for files without time stamps")
    unsaid.add_argument(
        "--quaternion-order",
        choices=QUATERNION_ORDERS,
        help="order of quaternion columns without names; default: what the file states, else wxyz",
    )
    parser.add_argument("--thin", action="store_true", help="drop rows that only repeat the previous row")
    parser.add_argument(
        "--all", action="store_true", help="list every finding; default: one row for each kind of finding"
    )
    add_robot_options(parser, default=None)  # else recordings of another arm would be compared with Sawyer


def as_options(text: str) -> str:
    """Rewrite arguments of ``read`` in a message as command-line options: ``units="mm"`` as ``--units mm``."""

    def option(match: re.Match[str]) -> str:
        if match["name"] == "arm":
            return f"--robot {(match['arm'] or match['value']).strip(chr(39) + chr(34))}"
        name = "--" + match["name"].replace("_", "-")
        return name if match["value"] == "True" else f"{name} {match['value'].strip(chr(39) + chr(34))}"

    return re.sub(r"\btime_units\b", "--time-units", _ARGUMENT.sub(option, text))


def read_and_lint(
    arguments: argparse.Namespace, arm: ArmModel | None, *, task: str = "", repair: bool = False
) -> tuple[list[RawDemonstration], list[Finding]]:
    """Read and check every file, and return demonstrations and findings; a file that can't be read is a finding too.

    Args:
        arguments: arguments added by :func:`add_reading_arguments`.
        arm: robot arm with which the demonstrations were recorded; None: checks against an arm are left out.
        task: name of the task.
        repair: whether to drop invalid rows before the checks.

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
                thin=arguments.thin,
            )
            raw += [_repaired(one, arm) for one in read] if repair else read
        except InputError as error:
            message, _, remedy = str(error).removeprefix(path).lstrip(":, ").rpartition("; ")
            unreadable.append(Finding("error", "unreadable", message or remedy, path, remedy=remedy if message else ""))
    return raw, unreadable + (lint(raw, arm=arm) if raw else [])


def _repaired(raw: RawDemonstration, arm: ArmModel | None) -> RawDemonstration:
    """Return a copy without invalid rows, but with the notes of the reader."""
    repaired = RawDemonstration.of(raw.demonstration(arm, repair=True))
    return replace(repaired, notes=raw.notes, unread_rotation=raw.unread_rotation)


def show_findings(raw: Sequence[RawDemonstration], findings: Sequence[Finding], *, every: bool = False) -> None:
    """Print a table of the findings, and the number of findings of each severity.

    Args:
        raw: the demonstrations that were read.
        findings: findings about these demonstrations.
        every: whether to print one row for each finding. Otherwise, one row is printed for each kind of finding, with
            the number of findings of this kind.
    """
    groups = [[f] for f in findings] if every else _kinds(findings)
    if findings:
        show_table(
            ["", "demonstration", "place", "code", "finding", "remedy"],
            [_row(group) for group in groups],
            styles=[_COLOURS[group[0].severity] for group in groups],
        )
    counts = [(sum(f.severity == severity for f in findings), severity) for severity in SEVERITIES]
    say(", ".join(_number(n, what) for n, what in [(len(raw), "demonstration"), *counts]))


def _kinds(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Return the findings grouped by their code; files that can't be read are grouped by their message."""
    kinds: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        message = finding.message if finding.code == "unreadable" else ""
        kinds.setdefault((finding.severity, finding.code, message), []).append(finding)
    return list(kinds.values())


def _row(group: Sequence[Finding]) -> tuple[str, ...]:
    first = group[0]
    sources = list(dict.fromkeys(finding.source for finding in group))
    where = first.source or "all"
    if len(sources) > 1:
        where += f" and {_number(len(sources) - 1, 'other')}"
    message = first.message if len(group) == 1 else f"{len(group)} findings of this kind; the first: {first.message}"
    return first.severity, where, first.place, first.code, as_options(message), as_options(first.remedy)


def _number(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
