"""The report on a retargeted recording: an HTML page with person and robot side by side, figures and measures.

The page is drawn from ``templates/retarget.html``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.retarget import Correspondence, Retargeting
from imitarm.robots.world import add_obstacles, arm_world
from imitarm.scene import Scene
from imitarm.viewer import palette, retarget_charts
from imitarm.viewer.content import plain
from imitarm.viewer.page import Figure, Header, Key, Player, Tab, Tile, draw_page, number, render, shared_players
from imitarm.viewer.person import PersonMark
from imitarm.viewer.recording import FrameRecorder, Recording
from imitarm.viewer.scene3d import PathMark, playback_html
from imitarm.viewer.stage import Camera, body_parts, points_to_see

PLAYER_KEYS: Final = (
    Key(palette.DEMONSTRATION, "the person's arm and the target of the tool"),
    Key(palette.ADAPTED, "path of the robot's tool"),
)
"""Legend of the 3-D player that shows a person beside a robot."""

_PERSON_PLACE: Final = (0.0, 1.35)  # [m] of the person in the base frame, to the left of the robot
_VIEW: Final = (1.0, -0.42, 0.36)  # direction towards the camera: person and robot are seen from the front
_FLOOR: Final = -0.75  # [m] height of the floor in the base frame: the robot stands on a pedestal
_FINGER_TIME: Final = 0.25  # [s] for the fingers to open or close
_WORDS: Final = {
    "Retargeting": "The motion of a person's arm, measured by a camera, is converted to a motion of a robot arm. "
    "The robot's tool follows the hand. If the method supports it, the robot's elbow follows the person's elbow.",
    "Target": "The desired position of the tool. The target starts at the tool's position when the robot begins to "
    "follow the person. The target then moves by the displacement of the hand, multiplied by the scale.",
    "Following, coasting, holding, stopped": "Following: the camera sees the person's arm, and the tool follows the "
    "hand. Coasting: the camera lost the arm up to 0.1 s ago, and the motion continues with decaying velocity. "
    "Holding: the camera lost the arm 0.1 to 0.3 s ago, and the target stands still. Stopped: the camera lost the arm "
    "more than 0.3 s ago. The robot follows again after the camera has seen the arm for 0.5 s.",
    "Frames beyond a limit": "Control periods in which a joint exceeds a limit of position, velocity or "
    "acceleration. The velocities and accelerations are computed from the commanded joint positions.",
    "Smallest singular value": "The smallest ratio of tool speed to joint speed, over all directions of motion. A "
    "value near 0 means that the arm is almost stretched or folded. In some direction, even a slow motion of the tool "
    "then needs fast joints.",
    "Torque": "The torque that the motion needs, computed by inverse dynamics without friction. A part of the torque "
    "holds the weight of the arm.",
}


@dataclass(frozen=True)
class Measure:
    """One value of the table that compares the methods.

    Attributes:
        label: label of the value in the table.
        value: value in ``unit``; NaN when unknown.
        unit: unit of the value in the table.
        digits: number of decimals.
        better: whether a smaller value (``"less"``) or a larger value (``"more"``) is better; ``""``: not defined.
        fault: whether a value above 0 is a fault; faults are marked in red.
    """

    label: str
    value: float
    unit: str = ""
    digits: int = 1
    better: Literal["less", "more", ""] = ""
    fault: bool = False


@dataclass(frozen=True)
class PlainTable:
    """A table of text cells with a title, headings and a caption."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """The result of one method on a recording.

    Attributes:
        name: short name, unique in the report.
        title: title of the tab.
        run: the retargeted motion.
        measures: values for the table of measures; all methods must have the same measures in the same order.
        tables: further tables for the tab of this method.
        notes: remarks about this run for the reader, one sentence each.
        caption: one sentence that describes the method.
        clock: time in the person's recording that corresponds to each sample of the run, counted from the first
            skeleton, shape (n,) [s]. None: equal to the times of the run.
    """

    name: str
    title: str
    run: Retargeting
    measures: Sequence[Measure] = ()
    tables: Sequence[PlainTable] = ()
    notes: Sequence[str] = ()
    caption: str = ""
    clock: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class RetargetReport:
    """One recording of a person and the results of one or more methods.

    Attributes:
        title: title of the page.
        methods: results of one or more methods; the header of the page describes the first one.
        skeletons: skeletons of the person, as the methods received them.
        correspondence: settings of the mapping from the person's motion to the robot's motion.
        verdict: the result in one line.
        good: whether the result is good.
        tiles: the most important measures.
        scene: obstacles around the robot.
        summary: one or two sentences that introduce the page.
        findings: faults that were found in the recording, and corrections of the recording, one sentence each.
        provenance: facts needed to repeat the run, by name.

    Raises:
        InputError: when there is no method or no skeleton, a name is used twice, or the methods have different
            measures.
    """

    title: str
    methods: Sequence[MethodResult]
    skeletons: Sequence[Skeleton]
    correspondence: Correspondence
    verdict: str
    good: bool
    tiles: Sequence[Measure] = ()
    scene: Scene = field(default_factory=Scene)
    summary: str = ""
    findings: Sequence[str] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [method.name for method in self.methods]
        if not names or not self.skeletons:
            raise InputError("RetargetReport: needs at least one method and one skeleton")
        if len(set(names)) < len(names):
            raise InputError(f"RetargetReport: method names must be unique, got {names}")
        labels = [[measure.label for measure in method.measures] for method in self.methods]
        if any(own != labels[0] for own in labels):
            raise InputError("RetargetReport: all methods must have the same measures in the same order")


def write_retarget_report(report: RetargetReport, path: str | Path) -> Path:
    """Write a report to one HTML file with :func:`~imitarm.viewer.page.draw_page` and return its absolute path.

    Args:
        report: content of the page.
        path: path of the file to write; its folder must exist.

    Raises:
        InputError: when the file cannot be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: retarget_report_html(report), path)


def retarget_report_html(report: RetargetReport) -> str:
    """Return the whole page.

    Args:
        report: content of the page.

    Raises:
        InputError: when the drawing libraries are not installed.
    """
    shared, own = shared_players({method.name: playback(report, method) for method in report.methods})
    tiles = [Tile(number(tile.value, tile.digits), tile.unit, tile.label) for tile in report.tiles]
    methods = [
        Tab(
            f"method-{i + 1}",
            method.title,
            {
                "result": method,
                "player": Player(f"Person and robot: {method.title}", own[method.name], PLAYER_KEYS),
                "figures": list(_figures(method.run, f"m{i + 1}")),
            },
        )
        for i, method in enumerate(report.methods)
    ]
    return render(
        "retarget.html",
        Header(report.title, report.verdict, report.good, report.summary, tiles),
        data=_as_data(report),
        data_name="imitarm-retargeting.json",
        provenance=report.provenance,
        words=_WORDS,
        shared=shared,
        methods=methods,
        rows=[_row(measures) for measures in zip(*(method.measures for method in report.methods), strict=True)],
        states=Figure(
            retarget_charts.states([(method.name, method.run) for method in report.methods]),
            "States over time",
            "The table of measures contains the fraction of the time that each method spent in each state.",
        ),
        findings=report.findings,
    )


def playback(report: RetargetReport, method: MethodResult, *, dark: bool = False) -> str:
    """Return a 3-D page that plays the motions of person and robot side by side.

    Args:
        report: report with the person and the scene.
        method: result with the motion of the robot.
        dark: whether controls and background are dark.
    """
    run = method.run
    recording = retargeting_frames(run, report.scene)
    times = recording.times if method.clock is None else np.interp(recording.times, run.times, method.clock)
    person = PersonMark.beside(
        report.skeletons,
        times,
        report.correspondence.sensor_to_base,
        side=report.correspondence.side,
        place=_PERSON_PLACE,
        floor=_FLOOR,
    )
    paths = [PathMark("path of the tool", run.arm.tool_path(run.joints)[0], palette.ADAPTED, 0.006)]
    known = np.asarray(np.isfinite(run.targets[0]).all(axis=1))
    followed = [(first, last) for first, last in retarget_charts.stretches(known) if known[first] and last > first]
    for i, (first, last) in enumerate(followed):
        positions = run.targets[0][first : last + 1]
        paths.append(PathMark(f"target {i + 1}", positions, palette.DEMONSTRATION, 0.004))
    near = [*(path.positions for path in paths), person.points_to_see]
    camera = Camera.around(points_to_see(recording, body_parts(recording.model), near), direction=_VIEW)
    return playback_html(recording, paths=paths, persons=[person], camera=camera, dark=dark)


def retargeting_frames(run: Retargeting, scene: Scene | None = None, *, rate: float = 25.0) -> Recording:
    """Return the poses of all bodies of the robot at its commanded joint positions, for the 3-D playback.

    Args:
        run: the retargeted motion.
        scene: obstacles to draw, at their initial poses.
        rate: frames per second [1/s].
    """
    spec = arm_world(run.arm, floor=_FLOOR)
    add_obstacles(spec, Scene() if scene is None else scene)
    model = spec.compile()
    data = mujoco.MjData(model)
    frames = FrameRecorder(model, rate=rate)
    fingers = [j for j in range(model.njnt) if model.joint(j).name.startswith("tool/")]
    addresses, ranges = model.jnt_qposadr[fingers], model.jnt_range[fingers]
    opening, dt = 1.0 - float(run.closed[0]), float(run.times[1] - run.times[0])  # 1: open, 0: closed
    for time, q, closed in zip(run.times, run.joints, run.closed, strict=True):
        data.qpos[:] = run.arm.posture(model, q)
        opening = float(np.clip(opening + (-dt if closed else dt) / _FINGER_TIME, 0.0, 1.0))
        data.qpos[addresses] = ranges[:, 0] + opening * (ranges[:, 1] - ranges[:, 0])
        mujoco.mj_kinematics(model, data)
        frames.note(data, float(time))
    return frames.recording()


def _row(measures: tuple[Measure, ...]) -> dict[str, Any]:
    """Return a row of the table of measures, in which the best value and faults are marked."""
    first = measures[0]
    known = [round(m.value, m.digits) for m in measures if math.isfinite(m.value)]
    best = None
    if len(measures) > 1 and first.better and len(set(known)) > 1:
        best = min(known) if first.better == "less" else max(known)
    cells = [
        {
            "text": number(m.value, m.digits),
            "fault": m.fault and m.value > 0.0,
            "best": math.isfinite(m.value) and round(m.value, m.digits) == best,
        }
        for m in measures
    ]
    return {"label": f"{first.label} [{first.unit}]" if first.unit else first.label, "cells": cells}


def _figures(run: Retargeting, key: str) -> Iterator[Figure]:
    """Yield the figures of a run; ``key`` makes their names unique in the page."""
    path = run.arm.tool_path(run.joints)[0]
    yield Figure(
        retarget_charts.tool(run, path, name=f"{key}-tool"),
        "Tool and target",
        "The target is shown while the robot follows the person. The lag of the method and the limits of the arm cause "
        "the distance between tool and target.",
    )
    yield Figure(
        retarget_charts.velocities(run, name=f"{key}-velocities"),
        "Joint velocities",
        "Joint velocities are computed from the joint positions. The dashed line is the limit. The number above "
        "each chart is the highest velocity, as a percentage of the limit.",
    )
    yield Figure(
        retarget_charts.joints(run, name=f"{key}-joints"),
        "Joint positions",
        "The dashed lines are the position limits of each joint.",
    )
    yield Figure(
        retarget_charts.accelerations(run, name=f"{key}-accelerations"),
        "Joint accelerations",
        "Joint accelerations are computed from the joint positions. The dashed line is the limit. The number above "
        "each chart is the highest acceleration, as a percentage of the limit.",
    )
    if run.arm.landmarks is not None:
        points = np.array([run.arm.sew_points(q) for q in run.joints])
        yield Figure(
            retarget_charts.elbow(run, points, name=f"{key}-elbow"),
            "Direction of the upper arm",
            "Robot and person start in different postures. Therefore, compare the changes of the two directions, not "
            "their values. An upward angle of 90° means straight up; a leftward angle of 90° means straight left.",
        )


def _as_data(report: RetargetReport) -> dict[str, Any]:
    """Return the report's numbers as plain values, ready for JSON; unknown numbers become None."""
    methods = [
        {
            "name": method.name,
            "arm": method.run.arm.name,
            "measures": [{"label": m.label, "value": m.value, "unit": m.unit} for m in method.measures],
            "notes": list(method.notes),
        }
        for method in report.methods
    ]
    data: dict[str, Any] = plain(
        {
            "title": report.title,
            "verdict": report.verdict,
            "good": report.good,
            "methods": methods,
            "findings": list(report.findings),
            "provenance": dict(report.provenance),
        }
    )
    return data
