"""``imitarm calibrate``: the person's limbs, the sensor's place, the clutch; step by step, into one file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from imitarm.capture.sources import followed, live, open_source
from imitarm.cli.gathering import add_side_and_person, gather, source_help
from imitarm.cli.guiding import ask, choose, touched_points
from imitarm.cli.outputs import check_outputs
from imitarm.cli.robot_options import add_robot_options, load_robot
from imitarm.cli.screen import remark, say, show_table
from imitarm.errors import InputError, TaskFailedError
from imitarm.files.table import read_table
from imitarm.retarget.calibration import ANCHORS, Anchor, Calibration, suggested_scale
from imitarm.retarget.correspondence import Orientation
from imitarm.retarget.limbs import ACCEPTED, LimbLengths, measure_limbs
from imitarm.retarget.sensor import SensorFit, fit_sensor_to_base

EPILOG = """\
examples:
  imitarm calibrate limbs wave.csv --side left --out left.json
  imitarm calibrate sensor pairs.csv
  imitarm calibrate clutch --robot sawyer --anchor shoulder --orientation upright

Each adds to the calibration file what it measures and leaves the rest of it as it is.
"""

_PAIRS = ("sensor_x", "sensor_y", "sensor_z", "base_x", "base_y", "base_z")
_ORIENTATIONS: dict[Orientation, str] = {
    "hand": "the tool turns as the hand does",
    "upright": "the tool turns with the hand about the vertical only",
    "fixed": "the tool does not turn",
}
_ANCHORS: dict[Anchor, str] = {
    "shoulder": "your stretched arm is the robot's stretched arm: all of its workspace, coarser",
    "object": "a centimetre is a centimetre: for work on things you both have before you",
}
_TRIES = 3
_STEPS = (
    "1. Stand 1.5 to 3 m before the sensor, facing it, alone in the picture.",
    "2. Hold the {side} arm away from the body, the elbow bent, nothing before it.",
    "3. Move it slowly while it is measured.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    kinds = parser.add_subparsers(dest="what", metavar="WHAT", required=True, title="what")
    limbs = kinds.add_parser("limbs", help="measure upper arm and forearm")
    limbs.add_argument("source", metavar="SOURCE", help=source_help())
    limbs.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of a live source; default: 5")
    sensor = kinds.add_parser("sensor", help="find where the sensor is, from points that were touched")
    sensor.add_argument(
        "pairs", nargs="?", metavar="PAIRS", help=f"table of points in both frames: {', '.join(_PAIRS)} [m]"
    )
    sensor.add_argument("--source", metavar="SOURCE", help="guided: measure the hand with this source")
    sensor.add_argument("--points", metavar="FILE", help="guided: points in the robot's base frame, x y z [m]")
    sensor.add_argument("--seconds", type=float, default=1.0, metavar="S", help="guided: of each point; default: 1")
    clutch = kinds.add_parser("clutch", help="choose scale and turning; asks for what is not given")
    add_robot_options(clutch)
    clutch.add_argument("--scale", type=float, metavar="RHO", help="robot's motion over person's motion")
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
    """Measure, say how well it is known, write.

    Raises:
        InputError: when an option or a file is wrong, or the points can't be used.
        TaskFailedError: when what was measured is not good enough to be kept.
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
    going_on = live(arguments.source)
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
                    f"limb lengths: known to {1e3 * lengths.standard_error:.0f} mm only, "
                    f"{1e3 * ACCEPTED:.0f} mm are needed; measure for longer, in better light"
                )
            except InputError as error:
                fault = str(error)
            if left == 0:
                raise TaskFailedError(f"{fault}. Nothing was written")
            remark(f"{fault}. Once more:")
    _show_limbs(lengths, side)
    if before.lengths is not None and before.side != side:
        remark(f"the {before.side} arm's lengths were in the file; it is now about the {side} arm")
    return replace(before, side=side, lengths=lengths)


def _show_limbs(lengths: LimbLengths, side: str) -> None:
    error = 1e2 * lengths.standard_error
    show_table(
        ["limbs", f"{side} arm"],
        [
            ("upper arm", f"{1e2 * lengths.upper_arm:.1f} cm, single frames vary by {1e2 * lengths.spread[0]:.1f} cm"),
            ("forearm", f"{1e2 * lengths.forearm:.1f} cm, single frames vary by {1e2 * lengths.spread[1]:.1f} cm"),
            ("standard error", f"{error:.2f} cm from {lengths.n_frames} frames"),
        ],
    )


# --- sensor


def _sensor(arguments: argparse.Namespace, before: Calibration) -> Calibration:
    guided = arguments.source is not None or arguments.points is not None
    if guided == (arguments.pairs is not None):
        raise InputError("sensor: give either PAIRS, or --source and --points to be guided")
    fit = _guided(arguments) if guided else fit_sensor_to_base(*_read_pairs(arguments.pairs))
    _show_sensor(fit)
    if not fit.accepted:
        raise TaskFailedError(f"sensor calibration: {fit.notes()[-1]}. Nothing was written")
    return replace(before, sensor_to_base=fit.sensor_to_base, sensor_rms=fit.rms)


def _read_pairs(path: str) -> tuple[list[list[float]], list[list[float]]]:
    """Return the points of a table of pairs, in the sensor's and in the base frame."""
    values = _columns(path, _PAIRS)
    return [row[:3] for row in values], [row[3:] for row in values]


def _columns(path: str, names: Sequence[str]) -> list[list[float]]:
    """Return columns of a table, by their names where it has some."""
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
    """Let the user touch the points, and those once more that do not fit."""
    if arguments.source is None or arguments.points is None:
        raise InputError("sensor: to be guided, give both --source and --points")
    points = _columns(arguments.points, ("x", "y", "z"))
    with followed(open_source(arguments.source, realtime=True), person=arguments.person) as source:
        seen = touched_points(source, points, arguments.side, arguments.seconds)
        for _ in range(_TRIES):
            at = sorted(seen)
            fit = fit_sensor_to_base([seen[i] for i in at], [points[i] for i in at])
            if fit.suspect is None:
                break
            number = at[fit.suspect]
            remark(f"point {number + 1} is {1e2 * fit.residuals[fit.suspect]:.1f} cm off; touch it once more")
            seen |= touched_points(source, points, arguments.side, arguments.seconds, only=number)
    return fit


def _show_sensor(fit: SensorFit) -> None:
    x, y, z = 1e2 * fit.sensor_to_base.position
    show_table(
        ["sensor", "in the robot's base frame"],
        [
            ("position", f"{x:.1f} {y:.1f} {z:.1f} cm"),
            ("points missed by", f"{1e2 * fit.rms:.2f} cm (root mean square), at most {1e2 * fit.residuals.max():.2f}"),
            ("rotation known to", f"{57.29578 * fit.angle_error:.2f} degrees (condition {fit.condition:.1f})"),
        ],
    )
    for note in fit.notes():
        remark(f"note: {note}")


# --- clutch


def _clutch(arguments: argparse.Namespace, before: Calibration) -> Calibration:
    scale: float | None = arguments.scale
    anchor: Anchor | None = arguments.anchor
    if scale is not None and anchor is not None:
        raise InputError("clutch: --scale says it, --anchor suggests it; keep one")
    if scale is None:
        if anchor is None:
            remark("When you take hold, the tool stays where it is and from then on follows your hand.")
            anchor = choose("What should a motion of the hand be worth?", _ANCHORS)
        if anchor == "shoulder" and before.lengths is None:
            raise InputError(
                f"{arguments.out}: a scale for the whole reach needs your arm's lengths; say 'imitarm calibrate limbs "
                "SOURCE' first, or give --scale"
            )
        scale = 1.0
        if before.lengths is not None:
            scale = suggested_scale(load_robot(arguments), before.lengths, anchor)
    orientation: Orientation | None = arguments.orientation
    if orientation is None:
        orientation = choose("How should the tool turn?", _ORIENTATIONS)
    after = replace(before, scale=float(scale), orientation=orientation)
    show_table(
        ["clutch", ""],
        [
            ("scale", f"{scale:.2f}: 10 cm of the hand are {10 * scale:.1f} cm of the tool"),
            ("turning", _ORIENTATIONS[orientation]),
        ],
    )
    return after
