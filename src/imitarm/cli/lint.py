"""``imitarm lint``: list the faults of demonstrations."""

from __future__ import annotations

import argparse

from imitarm.cli.reading import add_reading_arguments, read_and_lint, show_findings
from imitarm.cli.robot_options import load_optional_robot

EPILOG = """\
examples:
  imitarm lint demo_1.csv demo_2.csv
  imitarm lint pouring.npy --units cm --duration 10
  imitarm lint recordings/ --robot sawyer --tool gripper

The exit status is 2 if any finding is an error, and 0 if all findings are warnings or notes.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_reading_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; return 2 if any finding is an error."""
    raw, findings = read_and_lint(arguments, load_optional_robot(arguments))
    show_findings(raw, findings, every=arguments.all)
    return 2 if any(finding.severity == "error" for finding in findings) else 0
