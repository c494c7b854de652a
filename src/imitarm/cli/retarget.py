"""``imitarm retarget``: a person's motion becomes a robot's, a demonstration to learn from, and a report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.motions import Truth
from imitarm.capture.recording import slowed
from imitarm.capture.skeleton import SIDES, Skeleton
from imitarm.cli.driven import with_driven
from imitarm.cli.following import FAR, MOSTLY, Following, remedy
from imitarm.cli.gathering import source_help
from imitarm.cli.merit import TARGET_FAR, TARGET_LAG, TARGET_RMS, judged
from imitarm.cli.outputs import check_outputs
from imitarm.cli.person import person_of
from imitarm.cli.screen import remark, say, show_table, watched, working
from imitarm.cli.trial import provenance
from imitarm.errors import InputError, TaskFailedError
from imitarm.evaluation.driving import drive as drive_run
from imitarm.evaluation.seen_arm import seen_arm
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_file import ARMS, TOOLS
from imitarm.retarget import RETARGETERS, Correspondence, Retargeter, Retargeting
from imitarm.retarget.calibration import Calibration
from imitarm.retarget.correspondence import Orientation
from imitarm.retarget.engagement import SEEN_FOR
from imitarm.retarget.fitting import fit_motion
from imitarm.scene import Scene, load_scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer.retarget_content import Measure, MethodResult, RetargetReport

EPILOG = f"""\
examples:
  imitarm retarget wave.csv --fit --out wave_sawyer.csv --report wave.html
  imitarm retarget wave.csv --robot panda --tool gripper --calibration calibration.json --scene cups.yaml
  imitarm retarget dance.csv --side left --trim 2 8 --pace 0.5 --orientation fixed
  imitarm retarget wave.csv --fit --pace 0.5 --drive
  imitarm retarget synthetic:7 --method all --report compare.html
  imitarm learn wave_*.csv --task wave --out wave.json

The robot begins at its home, or with --fit where all of a recorded motion is in its reach; the tool stays there until
the person has been seen for half a second, then it follows the hand. The demonstration is cut to what followed.
The first line says whether the tool followed its target: not when it was more than {100 * FAR:.0f} cm from it (RMS), or
that far for over {100 * MOSTLY:.0f} % of the time. What it did is written all the same, with a warning.
Exit status 1 when the person was never seen for long enough, so that nothing was followed.
"""

PERIOD = 0.01  # [s] of control


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    parser.add_argument("source", metavar="SOURCE", help=source_help())
    parser.add_argument(
        "--robot", default="sawyer", metavar="NAME", help=f"{', '.join(ARMS)} or a file; default: sawyer"
    )
    parser.add_argument("--tool", metavar="NAME", help=f"{', '.join(TOOLS)} or an MJCF file")
    parser.add_argument("--method", choices=(*RETARGETERS, "all"), default="modern", help="default: modern")
    parser.add_argument(
        "--drive", action="store_true", help="let the simulated robot do it, drives and all, and measure"
    )
    parser.add_argument("--scene", type=Path, metavar="FILE", help="obstacles that 'modern' keeps clear of (YAML)")
    person = parser.add_argument_group("the person")
    person.add_argument("--side", choices=SIDES, help="the arm; default: as the calibration says, else right")
    person.add_argument("--person", type=int, metavar="N", help="of several; default: the one seen most, or first")
    person.add_argument("--calibration", type=Path, metavar="FILE", help="as 'imitarm calibrate' writes it")
    person.add_argument("--seconds", type=float, metavar="S", help="how long; default: to the end, or till Ctrl-C")
    person.add_argument("--trim", type=float, nargs=2, metavar=("A", "B"), help="only from A to B seconds")
    person.add_argument("--pace", type=float, default=1.0, metavar="SHARE", help="slow the motion, e.g. to 0.5 of it")
    follow = parser.add_argument_group("what follows what")
    follow.add_argument(
        "--scale", type=float, metavar="RHO", help="robot's motion over person's; default: as calibrated, else 1"
    )
    follow.add_argument(
        "--orientation",
        choices=get_args(Orientation),
        help="how the tool turns: as the hand, about the vertical only, or not; default: as calibrated, else upright",
    )
    follow.add_argument(
        "--fit", action="store_true", help="begin where all of the motion is in reach, at --scale or less if it must be"
    )
    output = parser.add_argument_group("output")
    output.add_argument("--task", default="", metavar="WORDS", help="what is shown, kept in the demonstration")
    output.add_argument("--out", type=Path, metavar="FILE", help="the demonstration (CSV); one a method with 'all'")
    output.add_argument("--force", action="store_true", help="replace files that are there")
    output.add_argument("--keep-waiting", action="store_true", help="keep what was before and after the following")
    output.add_argument("--report", type=Path, metavar="FILE", help="a page with person and robot side by side (HTML)")


@dataclass(frozen=True, eq=False)
class _Setting:
    """What all methods are given: the arm, where it begins, what follows what, what is in the way."""

    arm: ArmModel
    q: NDArray[np.float64]
    correspondence: Correspondence
    scene: Scene


def run(arguments: argparse.Namespace) -> int:
    """Retarget, say how good it is, write; see the module.

    Raises:
        InputError: when an option, the source or a place to write to is wrong.
        TaskFailedError: when nothing was followed.
        UnreachableError: when a motion is to be fitted and can't be.
    """
    names = list(RETARGETERS) if arguments.method == "all" else [arguments.method]
    files = _places(arguments, names)
    arm = ArmModel.load(arguments.robot, tool=arguments.tool)
    correspondence = _correspondence(arguments)
    scene = Scene() if arguments.scene is None else load_scene(arguments.scene)
    scene.check()
    skeletons, findings, truth = person_of(arguments, correspondence.side)
    setting = _setting(arguments, arm, correspondence, scene, skeletons)
    done = [_retargeted(name, setting, skeletons, truth, drive=arguments.drive) for name in names]
    for _, following in done:
        say(following.verdict())
    _show([result for result, _ in done])
    for result, _ in done:
        for note in result.notes:
            remark(f"{result.title}: {note}")
    hint = remedy(done[0][1], skeletons, setting.correspondence, fitted=arguments.fit, pace=arguments.pace)
    if hint and done[0][1].engagements:
        remark(f"warning: {hint}")
    if not any(following.engagements for _, following in done):
        raise TaskFailedError(
            f"{arguments.source}: the {correspondence.side} arm was never seen for {SEEN_FOR:g} s on end, so nothing "
            "was followed and nothing is written; keep it in view, or choose the other by --side"
        )
    source = f"{Path(arguments.source).name}, {correspondence.side} arm"
    for name, (result, following) in zip(names, done, strict=True):
        if name in files and following.engagements:
            _demonstration(result.run, arguments.task, f"{source}, {name}", arguments.keep_waiting).save(files[name])
            say(f"wrote {files[name]}")
    if arguments.report is not None:
        say(f"wrote {_written_report(arguments, setting, skeletons, findings, done, hint)}")
    return 0


def _places(arguments: argparse.Namespace, names: Sequence[str]) -> dict[str, Path]:
    """Return for each method the file of its demonstration, and find out now what would only fail after the work."""
    slowed((), arguments.pace)
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    out: Path | None = arguments.out
    files: dict[str, Path] = {}
    if out is not None:
        one = len(names) == 1 or out.is_dir()  # which is refused
        files = {name: out if one else out.with_name(f"{out.stem}_{name}{out.suffix}") for name in names}
    inputs = [
        ("SOURCE", arguments.source),
        *((f"--{name}", getattr(arguments, name)) for name in ("calibration", "scene", "robot", "tool")),
    ]
    outputs = [*(("--out", path) for path in files.values()), ("--report", arguments.report)]
    check_outputs(outputs, inputs, force=arguments.force)
    return files


def _correspondence(arguments: argparse.Namespace) -> Correspondence:
    """Return what follows what: what was said, else what was calibrated, else the usual."""
    calibration = Calibration() if arguments.calibration is None else Calibration.load(arguments.calibration)
    found = calibration.correspondence()
    if calibration.orientation is None:  # a camera sees the hand's turning badly
        found = replace(found, orientation="upright")
    if arguments.side is not None and arguments.side != found.side:
        if found.lengths is not None:
            remark(f"the calibration is about the {found.side} arm; the {arguments.side} arm's lengths are learnt anew")
        found = replace(found, side=arguments.side, lengths=None)
    if arguments.scale is not None:
        found = replace(found, scale=arguments.scale)
    if arguments.orientation is not None:
        found = replace(found, orientation=arguments.orientation)
    return found


def _setting(
    arguments: argparse.Namespace,
    arm: ArmModel,
    correspondence: Correspondence,
    scene: Scene,
    skeletons: Sequence[Skeleton],
) -> _Setting:
    """Return what the methods are given; with ``--fit`` the start and the scale that the motion needs."""
    if not arguments.fit:
        return _Setting(arm, arm.home, correspondence, scene)
    duration = skeletons[-1].time - skeletons[0].time
    times = np.arange(SEEN_FOR, max(duration, SEEN_FOR) + PERIOD, PERIOD)  # before that nothing is followed
    with working("looking for a start from which all of the motion is in reach"):
        wrist = seen_arm(skeletons, times, correspondence).wrist
        fit = fit_motion(arm, wrist, wrist[0], scale=correspondence.scale)
    if fit.scale < correspondence.scale:
        remark(f"scale {fit.scale:.2f} instead of {correspondence.scale:.2f}, so that all of the motion is in reach")
    return _Setting(arm, fit.q, replace(correspondence, scale=fit.scale), scene)


def _retargeted(
    name: str, setting: _Setting, skeletons: Sequence[Skeleton], truth: Truth | None, *, drive: bool
) -> tuple[MethodResult, Following]:
    """Let one method retarget the recording, and measure what it made of it."""
    retargeter: Retargeter = RETARGETERS[name](setting.arm, setting.correspondence, dt=PERIOD, scene=setting.scene)
    duration = max(skeletons[-1].time - skeletons[0].time, PERIOD)
    with watched(f"retargeting by {name}", lambda: retargeter.latest.time / duration):
        made = retargeter.run(skeletons, setting.q)
    result, following = judged(made, skeletons, setting.correspondence, truth)
    if drive:
        shares = [0.0]
        with watched(f"driving {setting.arm.name}", lambda: shares[-1]):
            result = with_driven(result, drive_run(made, setting.scene, shares.append))
    return result, following


def _demonstration(made: Retargeting, task: str, source: str, whole: bool) -> Demonstration:
    """Return what was followed as a demonstration, from 0 s; with ``whole`` the waiting before and after it, too."""
    led = np.flatnonzero(made.engaged)
    first, last = (0, len(made.times) - 1) if whole else (max(int(led[0]) - 1, 0), int(led[-1]))
    part = slice(first, max(last, first + 1) + 1)
    joints = made.joints[part]
    trajectory = Trajectory(made.times[part] - made.times[first], *made.arm.tool_path(joints))
    return Demonstration(trajectory, joints, task, source, made.arm.joint_names)


def _show(results: Sequence[MethodResult]) -> None:
    """Print the figures of merit, a column for each method."""
    rows = []
    for measures in zip(*(result.measures for result in results), strict=True):
        one: Measure = measures[0]
        cells = [f"{m.value:.{m.digits}f}" if np.isfinite(m.value) else "-" for m in measures]
        rows.append((f"{one.label} [{one.unit}]", *cells))
    arm = results[0].run.arm.name
    show_table(["measured", *(f"{result.title}>" for result in results)], rows, title=f"on {arm}, every {PERIOD:g} s")


def _written_report(
    arguments: argparse.Namespace,
    setting: _Setting,
    skeletons: Sequence[Skeleton],
    findings: Sequence[str],
    done: Sequence[tuple[MethodResult, Following]],
    hint: str,
) -> Path:
    """Write the report and return where."""
    from imitarm.viewer.retarget_report import write_retarget_report  # noqa: PLC0415 (only when it is asked for)

    (result, following), arm, correspondence = done[0], setting.arm, setting.correspondence
    with working("drawing the report"):
        return write_retarget_report(
            RetargetReport(
                title=f"{arguments.task or Path(arguments.source).stem} on {arm.name}",
                methods=[one for one, _ in done],
                skeletons=skeletons,
                correspondence=correspondence,
                verdict=following.verdict(),
                good=following.good,
                tiles=[
                    *(m for m in result.measures if m.label in _TILES),
                    Measure(
                        "joint positions, velocities or accelerations beyond a limit", following.broken, "frames", 0
                    ),
                ],
                scene=setting.scene,
                summary=f"The {correspondence.side} arm of a person, {Path(arguments.source).name}, moves the tool of "
                f"{arm.name}: "
                f"10 cm of the hand are {10 * correspondence.scale:.1f} cm of the tool, which turns "
                f"{_TURNS[correspondence.orientation]}." + (f" {hint[0].upper()}{hint[1:]}." if hint else ""),
                findings=findings,
                provenance=provenance(
                    robot=arm.name,
                    start=", ".join(f"{angle:.3f}" for angle in setting.q) + " rad",
                    scale=f"{correspondence.scale:.3f}",
                    orientation=correspondence.orientation,
                ),
            ),
            arguments.report,
        )


_TILES = (TARGET_RMS, TARGET_FAR, TARGET_LAG)  # the measures that matter most
_TURNS = {"hand": "as the hand does", "upright": "with the hand about the vertical only", "fixed": "not at all"}
