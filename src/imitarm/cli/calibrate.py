"""``imitarm calibrate``: measure limbs, locate the sensor, choose scale and orientation, and save all in one file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from imitarm.capture.skeleton import JOINT, SkeletonSource, Tracking
from imitarm.capture.sources import followed, is_live, open_source
from imitarm.cli.outputs import check_outputs
from imitarm.cli.person import add_side_and_person, add_source, gather
from imitarm.cli.robot_options import add_robot_options, load_robot
from imitarm.cli.screen import remark, say, show_table
from imitarm.errors import InputError, TaskFailedError
from imitarm.files.table import read_table
from imitarm.retarget.calibration import (
    ANCHORS,
    LEAST_PAIRS,
    Anchor,
    Calibration,
    SensorFit,
    fit_sensor_to_base,
    suggested_scale,
)
from imitarm.retarget.correspondence import Orientation
from imitarm.retarget.limbs import ACCEPTED, LimbLengths, measure_limbs

Word = TypeVar("Word", bound=str)

EPILOG = """\
examples:
  imitarm calibrate limbs wave.csv --side left
  imitarm calibrate sensor pairs.csv
  imitarm calibrate clutch --robot sawyer --anchor shoulder --orientation upright

Each step adds its result to the calibration file and leaves the rest of the file unchanged.
"""

_PAIRS = ("sensor_x", "sensor_y", "sensor_z", "base_x", "base_y", "base_z")
_ORIENTATIONS: dict[Orientation, str] = {
    "hand": "the tool rotates as the hand does",
    "upright": "the tool rotates with the hand about the vertical axis only",
    "fixed": "the tool does not rotate",
}
_ANCHORS: dict[Anchor, str] = {
    "shoulder": "the robot's arm is stretched when your arm is stretched; uses the robot's whole "
    "workspace, but is less precise than 'object'",
    "object": "the tool moves 1 cm when the hand moves 1 cm; for objects that you and the robot both have in front "
    "of you",
}
_TRIES = 3
_STILL = 0.015  # [m] largest standard deviation of a hand that is held still, with the camera's noise
_SEEN = 0.5  # least fraction of frames with the hand
_LEAST_FRAMES = 5
_STEPS = (
    "1. Stand 1.5 to 3 m in front of the sensor and face it. No other person may be in view.",
    "2. Hold the {side} arm away from the body with a bent elbow, and let nothing hide the arm from the sensor.",
    "3. Move the arm slowly during the measurement.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    kinds = parser.add_subparsers(dest="what", metavar="WHAT", required=True, title="steps")
    limbs = kinds.add_parser("limbs", help="measure the lengths of upper arm and forearm")
    add_source(limbs)
    limbs.add_argument(
        "--seconds",
        type=float,
        default=5.0,
        metavar="S",
        help="duration of the measurement with a live source; default: 5",
    )
    sensor = kinds.add_parser(
        "sensor", help="locate the sensor in the robot's base frame, from points that your hand touches"
    )
    sensor.add_argument(
        "pairs", nargs="?", metavar="PAIRS", help=f"table of points in both frames: {', '.join(_PAIRS)} [m]"
    )
    add_source(sensor, "--source", "guided calibration: source that measures the hand; ")
    sensor.add_argument(
        "--points", metavar="FILE", help="guided calibration: file of points, x y z in the base frame [m]"
    )
    sensor.add_argument(
        "--seconds",
        type=float,
        default=1.0,
        metavar="S",
        help="guided calibration: duration for each point; default: 1",
    )
    clutch = kinds.add_parser("clutch", help="choose scale and orientation; asks for values that are not given")
    add_robot_options(clutch)
    clutch.add_argument("--scale", type=float, metavar="RHO", help="tool motion divided by hand motion")
    clutch.add_argument("--anchor", choices=ANCHORS, help="suggest a scale: " + _listed(_ANCHORS))
    clutch.add_argument("--orientation", choices=get_args(Orientation), help=_listed(_ORIENTATIONS))
    for one in (limbs, sensor):
        add_side_and_person(one)
    for one in (limbs, sensor, clutch):
        one.add_argument(
            "--out", type=Path, default=Path("calibration.json"), metavar="FILE", help="default: calibration.json"
        )


def _listed(choices: Mapping[Any, str]) -> str:
    return "; ".join(f"{name}: {what}" for name, what in choices.items())


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the result and its accuracy, and write it to the file.

    Raises:
        InputError: when an option or a file is wrong, or the points can't be used.
        TaskFailedError: when the measurement is not accurate enough.
    """
    out: Path = arguments.out
    read = (("source", "SOURCE"), ("pairs", "PAIRS"), ("points", "--points"), ("robot", "--robot"), ("tool", "--tool"))
    inputs = [(said, getattr(arguments, name, None)) for name, said in read]
    check_outputs([("--out", out)], inputs, force=True)  # the file is added to
    before = Calibration.load(out) if out.exists() else Calibration()
    after = {"limbs": _limbs, "sensor": _sensor, "clutch": _clutch}[arguments.what](arguments, before)
    after.save(out)
    say(f"wrote {out}")
    return 0


# --- limbs


def _limbs(arguments: argparse.Namespace, before: Calibration) -> Calibration:
    going_on = is_live(arguments.source)
    side = arguments.side
    with followed(open_source(arguments.source), person=arguments.person) as source:
        if going_on:
            for step in _STEPS:
                remark(step.format(side=side))
        for left in reversed(range(_TRIES if going_on else 1)):
            if going_on:
                ask(f"Press Enter to measure for {arguments.seconds:g} s")
            taken, _ = gather(source, arguments.seconds if going_on else None, "measuring", live=going_on)
            try:
                lengths = measure_limbs(taken, side)
                if lengths.accepted:
                    break
                fault = (
                    f"limb lengths: the standard error is {1e3 * lengths.standard_error:.0f} mm, but at most "
                    f"{1e3 * ACCEPTED:.0f} mm are accepted; measure for longer, in better light"
                )
            except InputError as error:
                fault = str(error)
            if left == 0:
                raise TaskFailedError(f"{fault}. Nothing was written")
            remark(f"{fault}. Try again:")
    _show_limbs(lengths, side)
    if before.lengths is not None and before.side != side:
        remark(f"the {before.side} arm's lengths were in the file; they are replaced by those of the {side} arm")
    return replace(before, side=side, lengths=lengths)


def _show_limbs(lengths: LimbLengths, side: str) -> None:
    error = 1e2 * lengths.standard_error
    show_table(
        ["limbs", f"{side} arm"],
        [
            ("upper arm", f"{1e2 * lengths.upper_arm:.1f} cm, standard deviation {1e2 * lengths.spread[0]:.1f} cm"),
            ("forearm", f"{1e2 * lengths.forearm:.1f} cm, standard deviation {1e2 * lengths.spread[1]:.1f} cm"),
            ("standard error", f"{error:.2f} cm from {lengths.n_frames} frames"),
        ],
    )


# --- sensor


def _sensor(arguments: argparse.Namespace, before: Calibration) -> Calibration:
    guided = arguments.source is not None or arguments.points is not None
    if guided == (arguments.pairs is not None):
        raise InputError("sensor: give either PAIRS, or --source and --points for a guided calibration")
    fit = _guided(arguments) if guided else fit_sensor_to_base(*_read_pairs(arguments.pairs))
    _show_sensor(fit)
    if not fit.accepted:
        raise TaskFailedError(f"sensor calibration: {fit.notes()[-1]}. Nothing was written")
    return replace(before, sensor_to_base=fit.sensor_to_base, sensor_rms=fit.rms)


def _read_pairs(path: str) -> tuple[list[list[float]], list[list[float]]]:
    """Return the points of a table of pairs: in the sensor's frame and in the robot's base frame."""
    values = _columns(path, _PAIRS)
    return [row[:3] for row in values], [row[3:] for row in values]


def _columns(path: str, names: Sequence[str]) -> list[list[float]]:
    """Return the columns called ``names``; a table without column names must have exactly these columns."""
    table = read_table(path)
    if table.names is not None:
        lower = [name.lower() for name in table.names]
        missing = [name for name in names if name not in lower]
        if missing:
            raise InputError(f"{path}: has no column {missing[0]!r}; needed: {', '.join(names)}")
        return [[float(row[lower.index(name)]) for name in names] for row in table.values]
    if table.values.shape[1] != len(names):
        raise InputError(
            f"{path}, line {int(table.lines[0])}: {table.values.shape[1]} columns; needed: {', '.join(names)}"
        )
    return [[float(value) for value in row] for row in table.values]


def _guided(arguments: argparse.Namespace) -> SensorFit:
    """Let the user touch all points, then let the user touch points with a large residual again."""
    if arguments.source is None or arguments.points is None:
        raise InputError("sensor: a guided calibration needs both --source and --points")
    points = _columns(arguments.points, ("x", "y", "z"))
    with followed(open_source(arguments.source, realtime=True), person=arguments.person) as source:
        seen = touched_points(source, points, arguments.side, arguments.seconds)
        for _ in range(_TRIES):
            at = sorted(seen)
            fit = fit_sensor_to_base([seen[i] for i in at], [points[i] for i in at])
            if fit.suspect is None:
                break
            number = at[fit.suspect]
            remark(f"point {number + 1} is {1e2 * fit.residuals[fit.suspect]:.1f} cm off; touch this point again")
            seen |= touched_points(source, points, arguments.side, arguments.seconds, only=number)
    return fit


def _show_sensor(fit: SensorFit) -> None:
    x, y, z = 1e2 * fit.sensor_to_base.position
    show_table(
        ["sensor", "in the robot's base frame"],
        [
            ("position", f"{x:.1f} {y:.1f} {z:.1f} cm"),
            ("residuals of the points", f"{1e2 * fit.rms:.2f} cm (RMS), {1e2 * fit.residuals.max():.2f} at most"),
            (
                "error of the rotation",
                f"{57.29578 * fit.angle_error:.2f} degrees (condition number {fit.condition:.1f})",
            ),
        ],
    )
    for note in fit.notes():
        remark(f"note: {note}")


# --- clutch


def _clutch(arguments: argparse.Namespace, before: Calibration) -> Calibration:
    scale: float | None = arguments.scale
    anchor: Anchor | None = arguments.anchor
    if scale is not None and anchor is not None:
        raise InputError("clutch: --scale and --anchor both set the scale; give one of them")
    if scale is None:
        if anchor is None:
            remark("When you take control, the tool stays where it is. From then on, the tool follows your hand.")
            anchor = choose("How far should the tool move when the hand moves?", _ANCHORS)
        if anchor == "shoulder" and before.lengths is None:
            raise InputError(
                f"{arguments.out}: to match your reach to the robot's reach, 'shoulder' needs the lengths of your arm; "
                "run 'imitarm calibrate limbs SOURCE' first, or give --scale"
            )
        scale = 1.0
        if before.lengths is not None:
            scale = suggested_scale(load_robot(arguments), before.lengths, anchor)
    orientation: Orientation | None = arguments.orientation
    if orientation is None:
        orientation = choose("How should the tool rotate?", _ORIENTATIONS)
    after = replace(before, scale=float(scale), orientation=orientation)
    show_table(
        ["clutch", ""],
        [
            ("scale", f"{scale:.2f}: when the hand moves 10 cm, the tool moves {10 * scale:.1f} cm"),
            ("orientation", _ORIENTATIONS[orientation]),
        ],
    )
    return after


# --- questions, and points that are touched


def ask(question: str) -> str:
    """Show a question and return the answer in lower case.

    Raises:
        InputError: when the input has ended, so that nobody can answer.
    """
    remark(question)
    try:
        return input().strip().lower()
    except EOFError as error:
        raise InputError(
            "input ended before the question was answered; run the command in a terminal, or give the answers as "
            "options"
        ) from error


def choose(question: str, choices: Mapping[Word, str]) -> Word:
    """Ask until the answer selects one choice, by its number or by the beginning of its name.

    Raises:
        InputError: when the input has ended, so that nobody can answer.
    """
    names = list(choices)
    for i, name in enumerate(names, start=1):
        question += f"\n  {i} {name}: {choices[name]}"
    while True:
        answer = ask(question)
        fitting = [n for i, n in enumerate(names, start=1) if answer and (n.startswith(answer) or answer == str(i))]
        if len(fitting) == 1:
            return fitting[0]
        question = f"{answer!r} is not a choice; type {', '.join(names)}, or a number"


def touched_points(
    source: SkeletonSource,
    points: Sequence[Sequence[float]],
    side: str,
    seconds: float,
    *,
    only: int | None = None,
) -> dict[int, list[float]]:
    """Ask the user to put a hand on the robot's tool at each of several points, and measure the hand's position.

    If the hand moved or was not seen, the measurement is repeated.

    Args:
        source: source that observes the hand, live or replayed in real time.
        points: points in the robot's base frame, shape (n, 3) [m].
        side: side of the hand.
        seconds: duration of each measurement [s].
        only: index of the single point to touch, from 0; None: all points.

    Returns:
        Positions of the hand in the sensor's frame, shape (3,) [m], by index of the point; skipped points are missing.

    Raises:
        InputError: when the user gives up, the source has ended, or fewer than four points were measured.
    """
    wanted = range(len(points)) if only is None else [only]
    if only is None:
        if len(points) < LEAST_PAIRS:
            raise InputError(f"sensor calibration: {len(points)} points, at least {LEAST_PAIRS} are needed; add more")
        remark(
            f"Move the robot's tool to each of the {len(points)} points, and there put the palm of your {side} "
            f"hand on the tool's tip."
        )
        remark("Keep the hand in view of the sensor. Hold still and press Enter. Type s to skip a point, q to quit.")
    seen: dict[int, list[float]] = {}
    for i in wanted:
        place = " ".join(f"{100 * value:.1f}" for value in points[i])
        while True:
            answer = ask(
                f"Point {i + 1} of {len(points)}: tool at {place} cm; put your hand on the tool and press Enter"
            )
            if answer == "q":
                raise InputError("sensor calibration: stopped by the user; nothing was written")
            if answer == "s":
                break
            hand, fault = _measured(source, side, seconds)
            if hand is not None:
                seen[i] = hand
                break
            if source.over:
                raise InputError(
                    f"sensor calibration: {source.name} ended before point {i + 1} was measured; use a live source"
                )
            remark(f"{fault}. Try again:")
    if only is None and len(seen) < LEAST_PAIRS:
        raise InputError(f"sensor calibration: {len(seen)} points were measured, at least {LEAST_PAIRS} are needed")
    return seen


def _measured(source: SkeletonSource, side: str, seconds: float) -> tuple[list[float] | None, str]:
    """Return the position of the hand (3,) [m] and an empty text; after a failed measurement, None and the reason."""
    while source.read(0.0) is not None:  # skeletons from before Enter
        pass
    taken, _ = gather(source, seconds, "measuring", live=True)
    index = JOINT[f"hand_{side}"]
    hands = np.array([s.positions[index] for s in taken if s.tracking[index] == Tracking.TRACKED])
    if len(hands) < max(_LEAST_FRAMES, _SEEN * len(taken)):
        return (
            None,
            f"the {side} hand was seen in only {len(hands)} of {len(taken)} frames; turn the hand towards the sensor",
        )
    spread = float(np.sqrt(np.var(hands, axis=0).max()))
    if spread > _STILL:
        return None, f"the hand moved by {100 * spread:.1f} cm; hold the hand still"
    return [float(x) for x in np.median(hands, axis=0)], ""
