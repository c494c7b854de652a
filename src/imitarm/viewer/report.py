"""The report of a run as one HTML page: a 3-D playback and figures for each scene, and the learned skill.

The page is drawn from ``templates/report.html``; :mod:`~imitarm.viewer.content` defines its content.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from imitarm.viewer import charts, maps, palette
from imitarm.viewer.content import CERTIFICATE_VOID, LearningSummary, Report, SceneResult, as_data
from imitarm.viewer.page import (
    MM,
    Figure,
    Header,
    Key,
    Player,
    Tab,
    Tile,
    anchor,
    draw_page,
    number,
    render,
    shared_players,
)
from imitarm.viewer.recording import AHEAD
from imitarm.viewer.scene3d import ComponentMark, PathMark, playback_html

_KEYS: Final = (
    Key(palette.NOMINAL, "learned path"),
    Key(palette.ADAPTED, "adapted path"),
    Key(palette.MEASURED, "measured path of the tool"),
    Key(palette.UNMOVED, "component, not moved", blob=True),
    Key(palette.MOVED, "component, moved", blob=True),
    Key(palette.PREDICTED, f"tracked obstacle, predicted for {AHEAD:g} s later, with 95 % uncertainty", blob=True),
)
_WORDS: Final = {
    "Demonstration": "One recording of a motion demonstrated by a person, here by guiding the arm's tool by hand.",
    "Learned path": "The mean of all demonstrations. The robot follows the learned path if no obstacle is in the way.",
    "Gaussian component": "The learned motion consists of Gaussian components, which follow one another along the "
    "path. Each component is drawn as an ellipse that contains 95 % of the demonstrated positions in this part of the "
    "motion. Where the ellipse is small, all demonstrations agree, and the task needs precision.",
    "Adaptation (ACFRA)": "The method ACFRA moves only the components near an obstacle. Everywhere else the robot "
    "follows the learned path.",
    "Tolerance": "The distance from the learned path within which most demonstrations lie: two standard deviations of "
    "the demonstrations to each side. A path within the tolerance resembles the demonstrations.",
    "Clearance": "The smallest distance between any part of the arm or its tool and any obstacle. The simulator "
    "measures this distance between the exact shapes while the arm moves; the value is not taken from the plan.",
    "Certified clearance": "A guaranteed lower bound of the distance to any obstacle on the whole planned path. If "
    "only the path of the tool was planned, the bound holds only for the tool. If the motion of the whole arm was "
    "planned, the bound holds for every moving part of the arm.",
    "RMSE": "Root mean square distance between the measured path and the demonstrations. The distance is larger where "
    "the path has to go around an obstacle.",
    "Rated torque": "The torque that the drive of a joint can deliver continuously. A real arm can execute a motion "
    "whose torques stay below their rated values.",
}


def write_report(report: Report, path: str | Path) -> Path:
    """Write a report to one HTML file with :func:`~imitarm.viewer.page.draw_page` and return its absolute path.

    Args:
        report: content of the page.
        path: path of the file to write; its folder must exist.

    Raises:
        InputError: when the file cannot be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: report_html(report), path)


def report_html(report: Report) -> str:
    """Return the whole page.

    Args:
        report: content of the page.

    Raises:
        InputError: when the drawing libraries are not installed.
    """
    shared, own = shared_players(
        {scene.name: _playback(scene) for scene in report.scenes if scene.recording is not None}
    )
    extra = list(dict.fromkeys(key for scene in report.scenes for key in scene.details))
    heads = (
        *("Scene", "Obstacles", "Result", "Smallest measured clearance [mm]", "Required clearance [mm]"),
        *("RMSE to the demonstrations [mm]", "Components not moved", "Adaptation time [ms]"),
        *("Highest torque / rated torque", *extra),
    )
    scenes = [
        Tab(
            anchor("scene", i, scene.name),
            scene.title,
            {
                "result": scene,
                "cells": [*_cells(scene), *(str(scene.details.get(key, "–")) for key in extra)],
                "text": _sentences(scene.caption, "" if scene.success else scene.reason),
                "player": Player(f"3-D playback: {scene.title}", own[scene.name], _keys(scene))
                if scene.name in own
                else None,
                "figures": list(_scene_figures(f"s{i + 1}", scene)),
                "facts": _scene_facts(scene),
            },
        )
        for i, scene in enumerate(report.scenes)
    ]
    return render(
        "report.html",
        _header(report),
        data=as_data(report),
        data_name="imitarm-report.json",
        provenance=report.provenance,
        words=_WORDS,
        shared=shared,
        heads=heads,
        scenes=scenes,
        first=next((i for i, scene in enumerate(report.scenes) if scene.scene.obstacles), 0),
        learning=report.learning,
        learning_figures=list(_learning_figures(report.learning)) if report.learning is not None else [],
    )


def _header(report: Report) -> Header:
    """Return title, verdict and the most important numbers; numbers that no scene has are left out."""
    obstructed = [scene for scene in report.scenes if scene.scene.obstacles]
    clear = sum(scene.rollout is not None and not scene.contact for scene in obstructed)
    required = min((scene.required_clearance for scene in obstructed), default=math.nan)
    unmoved = [scene.unmoved_fraction for scene in obstructed if not math.isnan(scene.unmoved_fraction)]
    planning = [scene.adaptation.compute_time for scene in obstructed if scene.adaptation is not None]
    tiles = [
        Tile(str(clear), f"of {len(obstructed)}", "scenes with obstacles were free of contact"),
        Tile(
            number(MM * report.min_clearance),
            "mm",
            f"smallest measured clearance (required: {number(MM * required, 0, 'mm')})",
        ),
    ]
    if unmoved:
        share = number(100 * float(np.mean(unmoved)), 0)
        tiles.append(Tile(share, "%", "of the components of the learned motion were not moved"))
    if planning:
        median = number(MM * float(np.median(planning)))
        tiles.append(Tile(median, "ms", "computing time to plan the path around the obstacles (median)"))
    return Header(report.title, report.verdict, report.passed, report.summary, tuple(tiles) if obstructed else ())


def _cells(scene: SceneResult) -> Iterator[str]:
    """Yield the cells of a scene in the table of results, except for the name, the obstacles and the outcome."""
    adaptation = scene.adaptation
    yield number(MM * scene.min_clearance)
    yield number(MM * scene.required_clearance, 0) if scene.scene.obstacles else "–"
    yield number(MM * scene.rmse)
    if adaptation is None:
        yield from ("–", "–")
    else:
        total = len(adaptation.moved)
        fraction = number(100 * scene.unmoved_fraction, 0, "%")
        yield f"{total - int(np.sum(adaptation.moved))} of {total} ({fraction})"
        yield number(MM * adaptation.compute_time, 2)
    yield number(100 * scene.peak_torque_ratio, 0, "%")


def _sentences(*texts: str) -> str:
    """Join texts, each as one sentence; empty texts are left out."""
    return " ".join(f"{text[0].upper()}{text[1:].rstrip('.')}." for text in texts if text)


def _playback(scene: SceneResult) -> str:
    """Return the 3-D page of a scene, which plays the recording and shows the paths and the Gaussian components."""
    assert scene.recording is not None
    paths, components = [], []
    if scene.adaptation is not None:
        a = scene.adaptation
        paths += [
            PathMark("learned path", a.nominal.positions, palette.NOMINAL, 0.004),
            PathMark("adapted path", a.trajectory.positions, palette.ADAPTED, 0.006),
        ]
        for k, moved in enumerate(a.moved):
            name, mean = f"component {k + 1}", a.means[k] + a.displacement[k]
            components.append(ComponentMark(name, mean, a.covariances[k], palette.MOVED if moved else palette.UNMOVED))
    elif scene.nominal is not None:
        paths.append(PathMark("learned path", scene.nominal.positions, palette.NOMINAL, 0.004))
    if scene.rollout is not None:
        lift = np.array([0.0, 0.0, 0.004])  # [m] where two paths coincide, the picture would flicker
        paths.append(PathMark("measured path", scene.rollout.trajectory.positions + lift, palette.MEASURED, 0.003))
    return playback_html(scene.recording, paths=paths, components=components)


def _keys(scene: SceneResult) -> tuple[Key, ...]:
    """Return the legend of the 3-D playback: only what is drawn in this scene."""
    absent = set()
    if scene.recording is None or not scene.recording.predictions:
        absent.add(palette.PREDICTED)
    if scene.adaptation is None:
        absent |= {palette.ADAPTED, palette.UNMOVED, palette.MOVED}
    return tuple(key for key in _KEYS if key.colour not in absent)


def _scene_figures(key: str, scene: SceneResult) -> Iterator[Figure]:
    """Yield the figures of a scene; ``key`` makes their names unique in the page."""
    adaptation, rollout = scene.adaptation, scene.rollout
    if adaptation is not None:
        svg = maps.adaptation(
            adaptation.nominal,
            adaptation.trajectory,
            scene=scene.scene,
            clearance=scene.required_clearance,
            tool_spheres=scene.tool,
            tolerance=adaptation.tolerance,
            means=adaptation.means,
            covariances=adaptation.covariances,
            displacement=adaptation.displacement,
            moved=adaptation.moved,
            measured=rollout.trajectory if rollout is not None else None,
            name=f"{key}-paths",
        )
        if scene.scene.obstacles:
            yield Figure(
                svg,
                "Path around the obstacles",
                "Path of the tool centre point. The tool sweeps the area inside the dotted line. "
                "This area must stay outside the dashed lines. Arrows show how far components were moved.",
            )
            lengths = np.linalg.norm(adaptation.displacement, axis=1)
            svg = charts.displacement(lengths, adaptation.moved, name=f"{key}-moved")
            yield Figure(svg, "Displacement of the components", "One bar for each component, in the order of time.")
        else:
            yield Figure(svg, "The learned path", "Path of the tool centre point. No obstacle is in the way.")
    if rollout is not None:
        times = rollout.trajectory.times - rollout.trajectory.times[0]
        svg = charts.clearance(times, rollout.clearance, scene.required_clearance, name=f"{key}-clearance")
        yield Figure(
            svg,
            "Clearance over time",
            "Smallest distance between the arm (with its tool) and any obstacle, measured in the simulator.",
        )
        if scene.torque_limits is not None:
            names, limits = scene.joint_names, scene.torque_limits
            svg = charts.torques(times, rollout.torques, limits, joint_names=names, name=f"{key}-torques")
            yield Figure(
                svg,
                "Joint torques",
                "The dashed lines are the rated torques. The number above each chart is the highest torque, as a "
                "percentage of the rated torque.",
            )


def _scene_facts(scene: SceneResult) -> dict[str, Any]:
    """Return all numbers and facts of a scene by name, for the table on its tab."""
    values: dict[str, Any] = {
        "Obstacles": "; ".join(o.name or o.kind for o in scene.scene.obstacles) or "none",
        "Smallest measured clearance": number(MM * scene.min_clearance, 2, "mm"),
        "Required clearance": number(MM * scene.required_clearance, 1, "mm"),
        "RMSE to the demonstrations": number(MM * scene.rmse, 2, "mm"),
    }
    if scene.adaptation is not None:
        a = scene.adaptation
        largest = float(np.linalg.norm(a.displacement, axis=1).max(initial=0.0))
        values |= {
            "Method": a.method,
            "Certified clearance": f"void: {CERTIFICATE_VOID}"
            if scene.certificate_void
            else number(MM * a.certified_clearance, 2, "mm"),
            "Tool model in the plan": _tool(scene),
            "Components moved": f"{int(np.sum(a.moved))} of {len(a.moved)}",
            "Largest displacement": number(MM * largest, 1, "mm"),
            "Adaptation time": number(MM * a.compute_time, 3, "ms"),
        }
        if getattr(a, "joints", None) is not None:
            values["Certified clearance holds for"] = "every moving part of the arm"
            values["Largest tilt of the tool"] = number(float(np.degrees(getattr(a, "tilt", 0.0))), 1, "degrees")
    if scene.rollout is not None:
        values["Duration of the motion"] = number(scene.rollout.trajectory.duration, 2, "s")
        values["Path length of the tool"] = number(scene.rollout.trajectory.path_length, 3, "m")
        values["Highest torque / rated torque"] = number(100 * scene.peak_torque_ratio, 1, "%")
        values["Outcome"] = scene.rollout.reason or ("finished" if scene.rollout.success else "not finished")
    return values | dict(scene.details)


def _tool(scene: SceneResult) -> str:
    """Return a description of the geometry by which the plan modelled the tool."""
    plan = getattr(scene.adaptation, "arm_plan", None)
    if plan is not None:
        return f"{len(plan.path.arm.cover.radii)} spheres, which contain every moving part of the arm and the tool"
    spheres = scene.tool
    reach = float((np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]).max())
    if reach == 0.0:
        return "a point"
    many = "one sphere" if len(spheres) == 1 else f"{len(spheres)} spheres"
    return f"{many}, all within {number(MM * reach, 0, 'mm')} of the tool centre point"


def _learning_figures(learning: LearningSummary) -> Iterator[Figure]:
    """Yield the figures of the demonstrations and of the choice of the number of components."""
    yield Figure(
        maps.demonstrations(learning.demonstrations, learning.means, learning.covariances, learning.predicted),
        f"{len(learning.demonstrations)} demonstrations, {learning.n_components} components",
        "Where the demonstrations agree, the ellipses are small, and the task needs precision.",
    )
    if learning.candidates:
        tried = learning.candidates
        svg = charts.selection(
            [c.n_components for c in tried],
            [c.bic for c in tried],
            [c.aic for c in tried],
            [c.held_out_rmse_mm / MM for c in tried],
            learning.n_components,
        )
        caption = (
            "More components always fit the recordings more closely. Therefore the number is chosen by the error on "
            "demonstrations that were held out of learning. The criteria BIC and AIC add a penalty for the number of "
            "parameters; lower values are better."
        )
        yield Figure(svg, "Number of components", caption)
