"""``imitarm learn``: from files of demonstrations to a skill file."""

from __future__ import annotations

import argparse
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from imitarm.cli.outputs import check_outputs
from imitarm.cli.reading import add_reading_arguments, as_options, read_and_lint, show_findings
from imitarm.cli.robot_options import load_optional_robot, robot_files
from imitarm.cli.screen import remark, say, show_table, working
from imitarm.demonstrations import Alignment, compute_alignment, files_of
from imitarm.demonstrations.align import METHODS
from imitarm.errors import InputError
from imitarm.skills import Skill

EPILOG = """\
examples:
  imitarm learn sweep_*.csv --task sweep --out sweep.json
  imitarm learn pouring.npy --task pour --out pour.json --units cm --duration 10
  imitarm learn recordings/ --task insert --robot sawyer --components 8

The demonstrations are read, checked (as by 'imitarm lint') and aligned, and a skill is learned from them. Nothing is
written when a check finds an error.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_reading_arguments(parser)
    parser.add_argument("--repair", action="store_true", help="drop rows that are invalid or late")
    parser.add_argument("--allow-errors", action="store_true", help="learn although the check finds errors")
    learning = parser.add_argument_group("learning")
    learning.add_argument("--task", default="", metavar="NAME", help="name of the task, kept in the skill")
    learning.add_argument("--align", choices=METHODS, default="dtw", help="how to align; default: dtw")
    learning.add_argument(
        "--samples", type=int, default=200, metavar="N", help="samples of each aligned motion; default: 200"
    )
    learning.add_argument(
        "--components", type=_components, default="auto", metavar="K", help="Gaussians; default: auto"
    )
    output = parser.add_argument_group("output")
    output.add_argument("--out", type=Path, default=Path("skill.json"), metavar="FILE", help="default: skill.json")
    output.add_argument("--force", action="store_true", help="replace an existing skill file")


def _components(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither 'auto' nor a number above 0")


def run(arguments: argparse.Namespace) -> int:
    """Read, check, align, learn, save; return 2 when the check finds an error.

    Raises:
        InputError: when an option, a file or the place for the skill is wrong.
    """
    inputs = [*(("FILE", file) for file in files_of(arguments.files)), *robot_files(arguments)]
    check_outputs([("--out", arguments.out)], inputs, force=arguments.force)
    arm = load_optional_robot(arguments)
    raw, findings = read_and_lint(arguments, arm, task=arguments.task, repair=arguments.repair)
    show_findings(raw, findings, every=arguments.all)
    if any(finding.severity == "error" for finding in findings) and not arguments.allow_errors:
        raise InputError("not learned: fix the errors above (--repair drops invalid rows, --allow-errors ignores them)")
    try:
        demonstrations = [one.demonstration(arm) for one in raw]
    except InputError as error:
        raise InputError(as_options(str(error))) from error
    with working("aligning"):
        alignment = compute_alignment(demonstrations, n=arguments.samples, method=arguments.align)
    with working("learning: choosing the number of components"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        notes = [str(finding) for finding in findings] + alignment.notes()
        skill = Skill(arguments.components).fit(
            alignment.demonstrations, notes=notes, date=datetime.now(UTC).date().isoformat()
        )
    for text in dict.fromkeys(str(warning.message) for warning in caught):
        remark(f"warning: {text}")
    skill.save(arguments.out)
    _show(skill, alignment)
    say(f"wrote {arguments.out}")
    return 0


def _show(skill: Skill, alignment: Alignment) -> None:
    """Print the numbers of components that were tried, and the skill."""
    gmr = skill.gmr_
    if gmr.selection_:
        show_table(
            ["components>", "BIC>", "AIC>", "held-out error [mm]>", "bias [mm]>", ""],
            [
                (
                    str(tried.n_components),
                    f"{tried.bic:.0f}",
                    f"{tried.aic:.0f}",
                    *("" if np.isnan(x) else f"{x:.2f}" for x in (tried.held_out_rmse_mm, tried.bias_rmse_mm)),
                    "chosen" if tried.n_components == gmr.n_components_ else "",
                )
                for tried in gmr.selection_
            ],
            title="number of components",
        )
    times = np.linspace(0.0, gmr.duration_, 200)
    spread = 1e3 * np.sqrt(np.trace(skill.tolerance(times), axis1=1, axis2=2))
    positions = np.stack([one.trajectory.positions for one in alignment.demonstrations])
    mean = np.asarray(gmr.predict(alignment.demonstrations[0].trajectory.times)[0])
    rmse = 1e3 * np.sqrt(np.mean(np.sum((positions - mean) ** 2, axis=2)))
    start, goal = (
        " ".join(f"{100 * x:.1f}" for x in pose.position.round(3) + 0.0) for pose in (skill.start_, skill.goal_)
    )
    show_table(
        ["skill", skill.task_ or "unnamed"],
        [
            ("demonstrations", str(skill.n_demonstrations_)),
            ("duration", f"{skill.duration_:.2f} s"),
            ("largest time shift in alignment", f"{alignment.largest_shift.max():.2f} s"),
            ("components", str(gmr.n_components_)),
            ("orientation", "learned" if gmr.has_orientation_ else "not in the demonstrations"),
            ("start, goal", f"{start} cm, {goal} cm"),
            ("distance to the demonstrations", f"{rmse:.1f} mm (root mean square)"),
            ("tolerance along the motion", f"{spread.min():.1f} to {spread.max():.1f} mm"),
        ],
    )
