"""``imitarm retarget``: convert a person's motion to a robot motion, save it as a demonstration, and write a report."""

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
from imitarm.cli.outputs import check_outputs
from imitarm.cli.person import add_source, person_of
from imitarm.cli.robot_options import add_robot_options, load_robot, robot_files
from imitarm.cli.run_scene import provenance
from imitarm.cli.screen import remark, say, show_table, watched, working
from imitarm.errors import InputError, TaskFailedError
from imitarm.evaluation.execution import Execution, execute_on_robot
from imitarm.evaluation.run_evaluation import FAR, FAR_FRACTION, RunEvaluation, TargetTracking, evaluate_run
from imitarm.evaluation.tracking import seen_arm
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence, Retargeter, Retargeting
from imitarm.retarget.calibration import Calibration
from imitarm.retarget.correspondence import Orientation
from imitarm.retarget.engagement import SEEN_FOR, EngagementState
from imitarm.retarget.fitting import fit_motion
from imitarm.scene import Scene, load_scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer.retarget_report import (
    Measure,
    MethodResult,
    PlainTable,
    RetargetReport,
    write_retarget_report,
)

EPILOG = f"""\
examples:
  imitarm retarget wave.csv --fit --out wave_sawyer.csv --report wave.html
  imitarm retarget wave.csv --robot panda --tool gripper --calibration calibration.json --scene cups.yaml
  imitarm retarget dance.csv --side left --trim 2 8 --pace 0.5 --orientation fixed
  imitarm retarget wave.csv --fit --pace 0.5 --drive
  imitarm retarget synthetic:7 --method all --report compare.html
  imitarm learn wave_1.csv wave_2.csv wave_3.csv --task wave --out wave.json

The robot starts at its home posture, or with --fit at a posture from which the whole recorded motion is within reach.
When the camera has seen the person's arm for half a second, the robot's tool begins to follow the hand.
The demonstration contains only the time in which the tool followed the person.
The first line of the output says whether the tool followed its target closely enough.
"Closely enough" means an RMS distance of at most {100 * FAR:.0f} cm between tool and target.
In addition, the distance may exceed {100 * FAR:.0f} cm for at most {100 * FAR_FRACTION:.0f} % of the time.
If the tool did not follow its target, the files are written, with a warning.
If the camera never saw the person's arm for half a second, the robot did not move, and the exit status is 1.
"""

PERIOD = 0.01  # [s] control period


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_source(parser)
    add_robot_options(parser)
    parser.add_argument(
        "--method", choices=(*RETARGETERS, "all"), default="modern", help="retargeting method; default: modern"
    )
    parser.add_argument(
        "--drive", action="store_true", help="let the simulated robot execute the motion, and measure the execution"
    )
    parser.add_argument("--scene", type=Path, metavar="FILE", help="obstacles that the method 'modern' avoids (YAML)")
    person = parser.add_argument_group("the person")
    person.add_argument("--side", choices=SIDES, help="arm of the person; default: as calibrated, else right")
    person.add_argument(
        "--person",
        type=int,
        metavar="N",
        help="number of the person, if there are several; default: in a recording, the person in the most frames; "
        "otherwise the first person",
    )
    person.add_argument("--calibration", type=Path, metavar="FILE", help="file written by 'imitarm calibrate'")
    person.add_argument(
        "--seconds", type=float, metavar="S", help="duration; default: to the end of the source, or until Ctrl-C"
    )
    person.add_argument("--trim", type=float, nargs=2, metavar=("A", "B"), help="use only the part from A to B seconds")
    person.add_argument(
        "--pace", type=float, default=1.0, metavar="FACTOR", help="slow the motion down, e.g. 0.5: half as fast"
    )
    follow = parser.add_argument_group("correspondence")
    follow.add_argument(
        "--scale",
        type=float,
        metavar="FACTOR",
        help="robot motion divided by the person's motion; default: as calibrated, else 1",
    )
    follow.add_argument(
        "--orientation",
        choices=get_args(Orientation),
        help="rotation of the tool: like the hand, only about the vertical axis, or none; default: as calibrated, else "
        "upright",
    )
    follow.add_argument(
        "--fit",
        action="store_true",
        help="choose a start from which the whole motion is within reach; reduces --scale if necessary",
    )
    output = parser.add_argument_group("output")
    output.add_argument("--task", default="", metavar="WORDS", help="name of the task, saved in the demonstration")
    output.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the demonstration (CSV); with '--method all', one file per method",
    )
    output.add_argument("--force", action="store_true", help="overwrite existing files")
    output.add_argument(
        "--keep-waiting", action="store_true", help="also keep the time before and after the robot followed the person"
    )
    output.add_argument(
        "--report", type=Path, metavar="FILE", help="write a page with person and robot side by side (HTML)"
    )


@dataclass(frozen=True, eq=False)
class _Setting:
    """The input that all methods share: robot arm, start posture, relation between person and robot, and obstacles."""

    arm: ArmModel
    q: NDArray[np.float64]
    correspondence: Correspondence
    scene: Scene


def run(arguments: argparse.Namespace) -> int:
    """Retarget a recording, print measures of the result, and write the files.

    Raises:
        InputError: when an option, the source or an output path is wrong.
        TaskFailedError: when the person was never seen for long enough to move the robot.
        UnreachableError: when ``--fit`` finds no start from which the whole motion is within reach.
    """
    names = list(RETARGETERS) if arguments.method == "all" else [arguments.method]
    files = _output_files(arguments, names)
    arm = load_robot(arguments)
    correspondence = _correspondence(arguments)
    scene = Scene() if arguments.scene is None else load_scene(arguments.scene)
    scene.check()
    skeletons, findings, truth = person_of(arguments, correspondence.side)
    setting = _setting(arguments, arm, correspondence, scene, skeletons)
    done = [_retargeted(name, setting, skeletons, truth, drive=arguments.drive) for name in names]
    for _, tracking in done:
        say(tracking.verdict())
    _show([result for result, _ in done])
    for result, _ in done:
        for note in result.notes:
            remark(f"{result.title}: {note}")
    hint = suggestion(done[0][1], skeletons, setting.correspondence, fitted=arguments.fit, pace=arguments.pace)
    if hint and done[0][1].engagements:
        remark(f"warning: {hint}")
    if not any(tracking.engagements for _, tracking in done):
        raise TaskFailedError(
            f"{arguments.source}: the {correspondence.side} arm was never seen for {SEEN_FOR:g} s without a gap, so "
            "the robot did not move and nothing is written; keep the arm in view, or choose the other arm with --side"
        )
    source = f"{Path(arguments.source).name}, {correspondence.side} arm"
    for name, (result, tracking) in zip(names, done, strict=True):
        if name in files and tracking.engagements:
            _demonstration(result.run, arguments.task, f"{source}, {name}", arguments.keep_waiting).save(files[name])
            say(f"wrote {files[name]}")
    if arguments.report is not None:
        say(f"wrote {_written_report(arguments, setting, skeletons, findings, done, hint)}")
    return 0


def _output_files(arguments: argparse.Namespace, names: Sequence[str]) -> dict[str, Path]:
    """Return the file of the demonstration for each method.

    All options are also checked here, because a wrong option would otherwise cause a failure only after the run.
    """
    slowed((), arguments.pace)
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    out: Path | None = arguments.out
    files: dict[str, Path] = {}
    if out is not None:
        one = len(names) == 1 or out.is_dir()  # a folder is refused below
        files = {name: out if one else out.with_name(f"{out.stem}_{name}{out.suffix}") for name in names}
    inputs = [
        ("SOURCE", arguments.source),
        *((f"--{name}", getattr(arguments, name)) for name in ("calibration", "scene")),
        *robot_files(arguments),
    ]
    outputs = [*(("--out", path) for path in files.values()), ("--report", arguments.report)]
    check_outputs(outputs, inputs, force=arguments.force)
    return files


def _correspondence(arguments: argparse.Namespace) -> Correspondence:
    """Return the person's arm, the scale and the orientation with which the robot follows the person.

    A value comes from the options, else from the calibration, else from the defaults.
    """
    calibration = Calibration() if arguments.calibration is None else Calibration.load(arguments.calibration)
    found = calibration.correspondence()
    if calibration.orientation is None:  # a camera sees the hand's rotation poorly
        found = replace(found, orientation="upright")
    if arguments.side is not None and arguments.side != found.side:
        if found.lengths is not None:
            remark(f"the calibration is of the {found.side} arm; the {arguments.side} arm is measured again")
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
    """Return the input for the methods; ``--fit`` chooses start and scale so that the motion is within reach."""
    if not arguments.fit:
        return _Setting(arm, arm.home, correspondence, scene)
    duration = skeletons[-1].time - skeletons[0].time
    times = np.arange(SEEN_FOR, max(duration, SEEN_FOR) + PERIOD, PERIOD)  # the robot follows only after that
    with working("searching for a start from which the whole motion is within reach"):
        wrist = seen_arm(skeletons, times, correspondence).wrist
        fit = fit_motion(arm, wrist, wrist[0], scale=correspondence.scale)
    if fit.scale < correspondence.scale:
        remark(f"scale {fit.scale:.2f} instead of {correspondence.scale:.2f}, so that the whole motion is within reach")
    return _Setting(arm, fit.q, replace(correspondence, scale=fit.scale), scene)


def _retargeted(
    name: str, setting: _Setting, skeletons: Sequence[Skeleton], truth: Truth | None, *, drive: bool
) -> tuple[MethodResult, TargetTracking]:
    """Let one method retarget the recording, and measure the result."""
    retargeter: Retargeter = RETARGETERS[name](setting.arm, setting.correspondence, dt=PERIOD, scene=setting.scene)
    duration = max(skeletons[-1].time - skeletons[0].time, PERIOD)
    with watched(f"retargeting by {name}", lambda: retargeter.latest.time / duration):
        made = retargeter.run(skeletons, setting.q)
    evaluation, execution = evaluate_run(made, skeletons, setting.correspondence, truth), None
    if drive:
        fractions = [0.0]
        with watched(f"executing on {setting.arm.name}", lambda: fractions[-1]):
            execution = execute_on_robot(made, setting.scene, fractions.append)
    return _result(name, evaluation, execution), evaluation.tracking


def _result(name: str, evaluation: RunEvaluation, execution: Execution | None) -> MethodResult:
    """Return the content of the report for one method."""
    run = evaluation.run
    measures, notes = _measures(evaluation), list(evaluation.warnings)
    if execution is not None:
        measures += _execution_measures(execution)
        notes += _execution_notes(execution)
    return MethodResult(
        name=name,
        title=run.title or name,
        run=run,
        measures=measures,
        tables=[_torques(evaluation)],
        notes=notes,
        caption=run.caption,
        clock=run.shown_times,
    )


def _demonstration(made: Retargeting, task: str, source: str, whole: bool) -> Demonstration:
    """Return a demonstration of the time in which the robot followed the person, or of the whole run if ``whole``."""
    engaged = np.flatnonzero(made.engaged)
    first, last = (0, len(made.times) - 1) if whole else (max(int(engaged[0]) - 1, 0), int(engaged[-1]))
    part = slice(first, max(last, first + 1) + 1)
    joints = made.joints[part]
    trajectory = Trajectory(made.times[part] - made.times[first], *made.arm.tool_path(joints))
    return Demonstration(trajectory, joints, task, source, made.arm.joint_names)


TARGET_RMS = "RMS distance of the tool to its own target"
TARGET_FAR = f"tool farther than {1e2 * FAR:.0f} cm from its own target"
TARGET_LAG = "lag of the tool behind its own target"
_TILES = (TARGET_RMS, TARGET_FAR, TARGET_LAG)  # the measures that matter most
_DEGREES = 180.0 / np.pi


def _measures(evaluation: RunEvaluation) -> list[Measure]:
    """Return the measures in the units of the report."""
    run, m, tracking = evaluation.run, evaluation.metrics, evaluation.tracking
    hand = "true hand" if evaluation.truth_known else "hand as seen"
    return [
        Measure("duration", m.duration, "s", 2),
        *(Measure(s, 100.0 * float(np.mean(run.states == s)), "% of the time", 1) for s in EngagementState),
        Measure("robot began to follow", m.engagements, "times", 0),
        Measure(TARGET_RMS, 1e3 * m.target_rms, "mm", 1, "less"),
        Measure(TARGET_FAR, 1e2 * tracking.far_fraction, "% of the time", 1, "less"),
        Measure(TARGET_LAG, 1e3 * evaluation.target_lag, "ms", 0, "less"),
        Measure(f"RMS distance of the tool to the {hand}", 1e3 * m.tool_rms, "mm", 1, "less"),
        Measure("RMS distance of the tool to the hand, without lag", 1e3 * m.tool_rms_without_lag, "mm", 1, "less"),
        Measure(f"lag of the tool behind the {hand}", 1e3 * evaluation.hand_lag, "ms", 0),
        Measure("RMS error of the upper arm's direction", _DEGREES * m.elbow_direction_rms, "°", 1, "less"),
        Measure("a joint exceeds a position limit", m.position_violations, "frames", 0, "less", fault=True),
        Measure("a joint exceeds a velocity limit", m.velocity_violations, "frames", 0, "less", fault=True),
        Measure("a joint exceeds an acceleration limit", m.acceleration_violations, "frames", 0, "less", fault=True),
        Measure("highest velocity", 100.0 * m.velocity_ratio, "% of the limit", 0, "less"),
        Measure("highest acceleration", 100.0 * m.acceleration_ratio, "% of the limit", 0, "less"),
        Measure("jerk of the joints, RMS", m.joint_jerk_rms, "rad/s³", 0, "less"),
        Measure("smallest singular value", m.least_singular, "m/rad", 3, "more"),
        Measure("smallest distance between links", 1e3 * evaluation.link_distance, "mm", 0, "more"),
        Measure("path length of the tool", m.path_length, "m", 2),
        Measure("highest torque", 100.0 * m.peak_torque_ratio, "% of the rated", 0, "less"),
    ]


def _torques(evaluation: RunEvaluation) -> PlainTable:
    """Return a table with the torques of each joint."""
    run, m = evaluation.run, evaluation.metrics
    columns = (m.mean_torque, m.mean_gravity_torque, m.mean_motion_torque, m.rms_torque, run.arm.max_torque)
    rows = [
        (name, *(f"{value:.2f}" if np.isfinite(value) else "–" for value in values))
        for name, *values in zip(run.arm.joint_names, *columns, strict=True)
    ]
    return PlainTable(
        "Torques [N m]",
        ("Joint", "Mean", "Weight", "Motion", "RMS", "Rated"),
        tuple(rows),
        "Torques are computed by inverse dynamics, without friction. Weight: the torque that holds the arm against "
        "gravity. Motion: the remaining torque. The means are taken over absolute values, so weight and motion need "
        "not add up to "
        "the whole torque.",
    )


def _execution_measures(execution: Execution) -> list[Measure]:
    """Return the measurements on the simulated robot."""
    return [
        Measure("simulated: RMS position error of the worst joint", 1e3 * execution.error_rms, "mrad", 1, "less"),
        Measure("simulated: largest position error of a joint", 1e3 * execution.error_max, "mrad", 0, "less"),
        Measure("simulated: highest torque", 100.0 * execution.peak_torque_ratio, "% of the rated", 0, "less"),
        Measure("simulated: commands reduced by the robot's limits", execution.limited, "frames", 0, "less"),
    ]


def _execution_notes(execution: Execution) -> list[str]:
    """Return warnings about the simulated execution, one sentence each."""
    notes = []
    if np.isfinite(execution.clearance):
        notes.append(f"simulated: smallest distance of the arm to an obstacle {1e3 * execution.clearance:.0f} mm")
    if execution.touched:
        notes.append("simulated: touched " + ", ".join(execution.touched))
    if execution.fault:
        notes.append(f"simulated: the robot stopped itself after {execution.duration:.1f} s ({execution.fault})")
    return notes


_OTHER_MOVES_MORE = 2.0  # an arm whose wrist moves this many times as far as the other's is the one that shows the task


def suggestion(
    tracking: TargetTracking,
    skeletons: Sequence[Skeleton],
    correspondence: Correspondence,
    *,
    fitted: bool,
    pace: float,
) -> str:
    """If the tool did not follow its target, return the options to try, the most promising first; else an empty text.

    Args:
        tracking: how closely the tool followed its target in this run.
        skeletons: skeletons of the person.
        correspondence: arm, scale and orientation by which the method related the person to the robot.
        fitted: whether ``--fit`` was given.
        pace: value of ``--pace``.
    """
    if tracking.followed:
        return ""
    if tracking.near:  # the tool was near its target while the robot followed
        return (
            "nobody controlled the robot for most of the time: keep the arm in view, use --trim, or choose the "
            "arm with --side"
        )
    tries, side = [], SIDES[1 - SIDES.index(correspondence.side)]
    mine, other = _wrist_motion(skeletons, correspondence.side), _wrist_motion(skeletons, side)
    if other > _OTHER_MOVES_MORE * mine:
        moves = f"this wrist moves by {1e2 * other:.0f} cm, but the {correspondence.side} wrist by {1e2 * mine:.0f} cm"
        tries.append(f"--side {side} ({moves})")
    if correspondence.orientation != "fixed":
        tries.append("--orientation fixed (the tool need not rotate)")
    if not fitted:
        tries.append("--fit (starts the robot where the whole motion is within reach)")
    tries.append(f"--pace {0.5 * pace:.2g} (slower)")
    tries.append(f"--scale {0.5 * correspondence.scale:.2g} (smaller)")
    if mine / _OTHER_MOVES_MORE <= other <= _OTHER_MOVES_MORE * mine:
        tries.append(f"--side {side} (if the person demonstrates with the other arm)")
    return f"the tool did not follow its target: try {', '.join(tries)}"


def _wrist_motion(skeletons: Sequence[Skeleton], side: str) -> float:
    """Return the RMS distance of the wrist, relative to the shoulder, from its mean position [m]; 0 if never seen."""
    wrists = np.array([skeleton.arm(side).wrist - skeleton.arm(side).shoulder for skeleton in skeletons])
    seen = wrists[np.isfinite(wrists).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum((seen - seen.mean(axis=0)) ** 2, axis=1)))) if len(seen) else 0.0


def _show(results: Sequence[MethodResult]) -> None:
    """Print a table of the measures, with a column for each method."""
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
    done: Sequence[tuple[MethodResult, TargetTracking]],
    hint: str,
) -> Path:
    """Write the report and return its path."""
    (result, tracking), arm, correspondence = done[0], setting.arm, setting.correspondence
    with working("drawing the report"):
        return write_retarget_report(
            RetargetReport(
                title=f"{arguments.task or Path(arguments.source).stem} on {arm.name}",
                methods=[one for one, _ in done],
                skeletons=skeletons,
                correspondence=correspondence,
                verdict=tracking.verdict(),
                good=tracking.good,
                tiles=[
                    *(m for m in result.measures if m.label in _TILES),
                    Measure(
                        "joint positions, velocities or accelerations beyond a limit", tracking.violations, "frames", 0
                    ),
                ],
                scene=setting.scene,
                summary=f"The {correspondence.side} arm of a person ({Path(arguments.source).name}) moves the tool of "
                f"{arm.name}. When the hand moves by 10 cm, the tool moves by {10 * correspondence.scale:.1f} cm. "
                f"{_ORIENTATIONS[correspondence.orientation]}." + (f" {hint[0].upper()}{hint[1:]}." if hint else ""),
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


_ORIENTATIONS = {
    "hand": "The tool rotates with the hand",
    "upright": "The tool rotates with the hand, but only about the vertical axis",
    "fixed": "The tool keeps its orientation",
}
