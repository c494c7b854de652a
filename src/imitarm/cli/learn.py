"""``imitarm learn``: learn a skill from files of demonstrations, and write the skill to a file."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from imitarm.cli.outputs import check_outputs
from imitarm.cli.reading import add_reading_arguments, as_options, read_and_lint, show_findings
from imitarm.cli.robot_options import load_optional_robot, robot_files
from imitarm.cli.screen import remark, say, show_table, working
from imitarm.demonstrations import Alignment, compute_alignment, files_of, group_by_path
from imitarm.demonstrations.align import METHODS
from imitarm.errors import InputError, TaskFailedError
from imitarm.skills import FitQuality, PoorFitWarning, Skill
from imitarm.skills.mixture_fitting import NUMBERS
from imitarm.trajectory import Demonstration

EPILOG = """\
examples:
  imitarm learn sweep_*.csv --task sweep --out sweep.json
  imitarm learn pouring.npy --task pour --out pour.json --units cm --duration 10
  imitarm learn recordings/ --task insert --robot sawyer --components 8

The demonstrations are read, checked (as by 'imitarm lint') and aligned.
Then the skill is learned and compared with the demonstrations.
If a check finds an error, no file is written and the exit status is 2.
If the skill does not reproduce the motion, no file is written and the exit status is 1.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_reading_arguments(parser)
    parser.add_argument("--repair", action="store_true", help="drop rows with invalid numbers or times")
    parser.add_argument(
        "--each-path",
        action="store_true",
        help="if the demonstrations take different paths from the same start to the same goal, learn one skill for "
        "each path, and number the skill files",
    )
    parser.add_argument(
        "--allow-errors", action="store_true", help="learn and write the skill even if the checks find errors"
    )
    learning = parser.add_argument_group("learning")
    learning.add_argument("--task", default="", metavar="NAME", help="name of the task, stored in the skill")
    learning.add_argument("--align", choices=METHODS, default="dtw", help="method of alignment; default: dtw")
    learning.add_argument(
        "--samples", type=int, metavar="N", help="samples per aligned demonstration; default: 200, more for long paths"
    )
    learning.add_argument(
        "--components", type=_components, default="auto", metavar="K", help="number of Gaussians; default: auto"
    )
    output = parser.add_argument_group("output")
    output.add_argument(
        "--out", type=Path, default=Path("skill.json"), metavar="FILE", help="skill file to write; default: skill.json"
    )
    output.add_argument("--force", action="store_true", help="replace an existing skill file")


def _components(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither 'auto' nor a number above 0")


def run(arguments: argparse.Namespace) -> int:
    """Read, check and align the demonstrations, learn the skill, evaluate it, and save it.

    Raises:
        InputError: when an option, a file or the path of the skill file is not valid, or the check finds an error.
        TaskFailedError: when the skill does not reproduce the motion.
    """
    inputs = [*(("FILE", file) for file in files_of(arguments.files)), *robot_files(arguments)]
    check_outputs([("--out", arguments.out)], inputs, force=arguments.force)
    arm = load_optional_robot(arguments)
    raw, findings = read_and_lint(arguments, arm, task=arguments.task, repair=arguments.repair)
    show_findings(raw, findings, every=arguments.all)
    ignored = {"two-paths"} if arguments.each_path else set()
    if not arguments.allow_errors and any(f.severity == "error" and f.code not in ignored for f in findings):
        raise InputError("not learned: fix the errors above (--repair drops invalid rows, --allow-errors ignores them)")
    try:
        demonstrations = [one.demonstration(arm) for one in raw]
    except InputError as error:
        raise InputError(as_options(str(error))) from error
    groups = group_by_path(demonstrations) if arguments.each_path else [demonstrations]
    outputs = _numbered(arguments.out, len(groups))
    check_outputs([("--out", out) for out in outputs], inputs, force=arguments.force)
    notes = [str(finding) for finding in findings if finding.code not in ignored]
    learned = [_learn(group, arguments, notes) for group in groups]  # all of them before one is written
    for skill, out in zip(learned, outputs, strict=True):
        skill.save(out)
        say(f"wrote {out}")
    return 0


def _numbered(out: Path, n: int) -> list[Path]:
    """Return the names of ``n`` skill files: ``out`` itself, or ``out`` with -1, -2 and so on before its suffix."""
    return [out] if n == 1 else [out.with_stem(f"{out.stem}-{i + 1}") for i in range(n)]


def _learn(demonstrations: list[Demonstration], arguments: argparse.Namespace, notes: list[str]) -> Skill:
    """Align demonstrations, learn a skill from them, and print how well it reproduces them.

    Raises:
        TaskFailedError: when the skill does not reproduce the motion.
    """
    with working("aligning"):
        n = arguments.samples if arguments.samples is not None else _samples_needed(demonstrations)
        alignment = compute_alignment(demonstrations, n=n, method=arguments.align)
    with working("learning: choosing the number of components"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        skill = Skill(arguments.components).fit(
            alignment.demonstrations, notes=notes + alignment.notes(), date=datetime.now(UTC).date().isoformat()
        )
    for message in dict.fromkeys(str(w.message) for w in caught if not issubclass(w.category, PoorFitWarning)):
        remark(f"warning: {message}")
    quality = skill.fit_quality_
    assert quality is not None
    _show(skill, alignment, quality)
    if quality.suggestion and skill.gmr_.n_components_ > max(NUMBERS):
        remark(f"note: {quality.suggestion}")
    if not quality.faithful:
        problem = f"the skill does not reproduce the motion: {quality.problem}"
        if not arguments.allow_errors:
            raise TaskFailedError(f"no skill was written: {problem}; to write it anyway, use --allow-errors")
        remark(f"warning: {problem}")
    return skill


def _samples_needed(demonstrations: Sequence[Demonstration]) -> int:
    """Return the number of samples of each aligned demonstration.

    The extent of a path is the diagonal of the smallest box around the path. If no path is longer than 6 times its
    extent, the number is 200. Otherwise, the number grows in proportion to the largest ratio of path length to extent,
    up to 2000.
    """
    most = 1.0
    for one in demonstrations:
        motion = one.trajectory.resample(400)
        extent = float(np.linalg.norm(np.ptp(motion.positions, axis=0)))
        most = max(most, motion.path_length / (6.0 * extent) if extent > 0.0 else 1.0)
    return int(min(200.0 * most, 2000.0))


def _show(skill: Skill, alignment: Alignment, quality: FitQuality) -> None:
    """Print the tried numbers of components, the distance from the skill to each demonstration, and the skill."""
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
    show_table(
        ["demonstration", "root mean square [mm]>", "largest [mm]>", "at start [mm]>", "at goal [mm]>"],
        [
            (d.source or str(i + 1), *(f"{1e3 * x:.1f}" for x in (d.rms, d.largest, d.start, d.goal)))
            for i, d in enumerate(quality.distances)
        ],
        title="distance from the skill to each demonstration",
    )
    times = np.linspace(0.0, gmr.duration_, 200)
    spread = 1e3 * np.sqrt(np.trace(skill.tolerance(times), axis1=1, axis2=2))
    start, goal = (
        " ".join(f"{100 * x:.1f}" for x in pose.position.round(3) + 0.0) for pose in (skill.start_, skill.goal_)
    )
    rms = np.sqrt(np.mean([d.rms**2 for d in quality.distances]))
    bias, turns = max(quality.bias, quality.primitive_bias), gmr.has_orientation_
    show_table(
        ["skill", skill.task_ or "unnamed"],
        [
            ("demonstrations", str(skill.n_demonstrations_)),
            ("duration", f"{skill.duration_:.2f} s"),
            ("largest time shift in alignment", f"{alignment.largest_shift.max():.2f} s"),
            ("components", str(gmr.n_components_)),
            ("orientation", "learned" if turns else "not in the demonstrations"),
            ("start, goal", f"{start} cm, {goal} cm"),
            ("distance to the demonstrations", f"{1e3 * rms:.1f} mm (root mean square)"),
            (
                "distance to the mean demonstration (bias)",
                f"{1e3 * bias:.1f} mm, {100 * quality.relative_bias:.1f} % of extent",
            ),
            *([("bias of the rotation", f"{np.rad2deg(quality.rotation_bias):.2f} degrees")] if turns else []),
            ("tolerance along the motion", f"{spread.min():.1f} to {spread.max():.1f} mm"),
        ],
    )
