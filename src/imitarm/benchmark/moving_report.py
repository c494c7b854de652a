"""Write the results of the moving benchmark as one HTML page with charts, tables, and playbacks.

The results do not contain the paths of the tool. To draw a motion, the report repeats the experiment, which gives the
same motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.moving import OURS, MovingExperiment, MovingResult
from imitarm.benchmark.moving_controls import CONTROLS
from imitarm.benchmark.moving_results import MovingResults
from imitarm.benchmark.moving_scenes import MovingCase, distances_in_time
from imitarm.benchmark.moving_tables import moving_tables
from imitarm.benchmark.moving_world import ToolRun
from imitarm.control_loop.observer import TrackedScene
from imitarm.errors import InputError
from imitarm.evaluation.intervals import wilson_interval
from imitarm.perception import ObstacleTracker
from imitarm.robots.world import add_obstacles
from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, canvas
from imitarm.viewer.page import Figure, Header, Key, Player, Tab, Tile, draw_page, render, shared_players
from imitarm.viewer.recording import FrameRecorder, Recording
from imitarm.viewer.scene3d import PathMark, playback_html

Array = NDArray[np.float64]

_PLAYED: Final = 6  # scenes that are drawn when none is named
_RATE: Final = 25.0  # [1/s] frames
_RESPONSE: Final = 0.25  # [m] gap below which Fig 5.10 links tool and obstacle
_WORDS: Final = {
    "Success": "The tool touches no obstacle and reaches the goal within twice the learned duration.",
    "Oracle": "A search in space and time. One oracle knows the true future motion of the obstacles, "
    "the other knows only the tracked obstacles, like the methods.",
    "RMSE": "Root mean square distance from the learned motion at equal times.",
    "NEES": "Normalised estimation error squared of a tracked position; its mean is 3 if the covariance is right.",
}


def write_moving_report(
    results: MovingResults,
    path: str | Path,
    *,
    provenance: Mapping[str, Any],
    scenes: Sequence[tuple[str, int, int]] = (),
) -> Path:
    """Write the page and return its path.

    Args:
        results: results of the benchmark.
        path: the file to write; its folder must exist.
        provenance: facts needed to repeat the benchmark.
        scenes: scenes to draw, as family, dimension and seed. If empty, the report draws failures of our methods and
            one success in each family, at most six scenes.

    Raises:
        InputError: when the file can't be written, a scene has no result, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: moving_report_html(results, provenance=provenance, scenes=scenes), path)


def moving_report_html(
    results: MovingResults,
    *,
    provenance: Mapping[str, Any],
    scenes: Sequence[tuple[str, int, int]] = (),
) -> str:
    """Return the whole page as HTML; for the arguments, see :func:`write_moving_report`."""
    tables = moving_tables(results)
    chosen = _named(results, scenes) if scenes else _chosen(results)
    shared, tabs = _tabs(chosen)
    rates = {row: results.of(row) for row in results.rows if row not in CONTROLS}
    tiles = [
        Tile(f"{100 * sum(r.success for r in found) / len(found):.1f}", "%", f"success of {row} in {len(found)} runs")
        for row, found in list(rates.items())[:5]
    ]
    first = next(iter(rates), None)
    good = first is not None and first.split(",")[0] in OURS
    verdict = (
        "no method was run"
        if first is None
        else f"{first} succeeds most often: in {tiles[0].value} % of {len(rates[first])} runs"
    )
    return render(
        "avoidance.html",
        Header("Avoidance among moving obstacles", verdict, good, "", tiles),
        data={"tables": [{"title": t.title, "columns": t.columns, "rows": t.rows, "note": t.note} for t in tables]},
        data_name="imitarm-moving.json",
        provenance=provenance,
        words=_WORDS,
        shared=shared,
        figures=[
            Figure(success_chart(results, f), f"Success: {f}", "Lines are 95 % intervals (Wilson).")
            for f in results.families()
        ],
        tables=[table.for_page() for table in tables],
        scenes=tabs,
    )


def success_chart(results: MovingResults, family: str) -> str:
    """Draw the rate of success of each method in one family."""
    rates = [
        (row, sum(r.success for r in found), len(found)) for row in results.rows if (found := results.of(row, family))
    ]
    if not rates:
        return ""
    height = 0.62 + 0.2 * len(rates)
    with canvas(f"success-{family}", f"Rate of success of each method in {family}", (5.5, height)) as drawing:
        axes = drawing.axes(1.75, 0.45, 5.35, height - 0.08)
        for i, (_, good, of) in enumerate(reversed(rates)):
            low, high = wilson_interval(good, of)
            part = good / of
            axes.barh(i, 100 * part, 0.7, color=palette.ADAPTED)
            spread = 100 * np.maximum([[part - low], [high - part]], 0.0)
            axes.errorbar(100 * part, i, xerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
        axes.set_yticks(range(len(rates)), [row for row, *_ in reversed(rates)])
        axes.set_xlim(0.0, 103.0)
        axes.set_xlabel("success [%]")
        axes.grid(axis="y", visible=False)
    return drawing.svg


def responses_chart(case: MovingCase, run: ToolRun, name: str) -> str:
    """Draw the paths of tool and obstacles from above, as in thesis Fig 5.10.

    Lines link tool and obstacle where their gap is below 25 cm.
    """
    learned = case.skill.nominal(np.linspace(0.0, case.skill.duration_, 200)).positions
    places = np.array([case.truth.poses(float(t))[0] for t in run.times])
    near = distances_in_time(case.truth, run.times, run.positions) - case.tool_spheres[0, 3] < _RESPONSE
    with canvas(name, "Paths of the tool and of the obstacles, seen from above", (5.5, 3.6)) as drawing:
        left, bottom, right, top = 0.6, 0.75, 5.35, 3.5  # [in]
        axes = drawing.axes(left, bottom, right, top)
        axes.plot(*learned[:, :2].T, color=palette.NOMINAL, lw=1.2, label="learned path")
        for i in range(places.shape[1]):
            there = near[i] if near[i].any() else np.zeros(len(near[i]), dtype=bool)
            axes.plot(*places[np.abs(places[:, i]).max(axis=1) < 5.0, i, :2].T, color=palette.OBSTACLE, lw=1.2)
            for k in np.flatnonzero(there)[::5]:
                axes.plot(*np.stack([run.positions[k, :2], places[k, i, :2]]).T, color=INK, lw=0.5)
        axes.plot([], [], color=palette.OBSTACLE, lw=1.2, label="obstacle")
        axes.plot(*run.positions[:, :2].T, color=palette.ADAPTED, lw=1.6, label="tool")
        low, high = learned[:, :2].min(axis=0) - 0.3, learned[:, :2].max(axis=0) + 0.3
        size = np.array([right - left, top - bottom])
        half = 0.5 * float(((high - low) / size).max()) * size  # the same scale along both axes
        axes.set_xlim(*(0.5 * (low + high) + half * [[-1.0], [1.0]])[:, 0])
        axes.set_ylim(*(0.5 * (low + high) + half * [[-1.0], [1.0]])[:, 1])
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        drawing.legend(3)
    return drawing.svg


def recording_of(experiment: MovingExperiment, case: MovingCase, run: ToolRun) -> Recording:
    """Return a recording for the playback: the tool, the true obstacles and the predictions of the tracker."""
    spec = mujoco.MjSpec()
    add_obstacles(spec, case.truth.scene)
    tool = spec.worldbody.add_body(name="tool", mocap=True)
    for x, y, z, radius in case.tool_spheres:
        size, colour = [float(radius), 0.0, 0.0], [0.0, 0.45, 0.7, 0.6]
        tool.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=[x, y, z], rgba=colour)
    model = spec.compile()
    data = mujoco.MjData(model)
    observe = TrackedScene(case.truth, experiment.sensor, ObstacleTracker("imm", rotations=True))
    recorder = FrameRecorder(model, rate=_RATE)
    for k in range(0, len(run.times), 4):
        time = float(run.times[k])
        positions, quaternions = case.truth.poses(time)
        n = len(positions)
        data.mocap_pos[:n], data.mocap_quat[:n] = positions, quaternions
        data.mocap_pos[n] = run.positions[k]
        mujoco.mj_kinematics(model, data)
        recorder.note(data, time, scene=observe(time))
    return recorder.recording()


def _named(results: MovingResults, scenes: Sequence[tuple[str, int, int]]) -> list[MovingResult]:
    chosen = []
    for scene in scenes:
        rows = results.by_scene.get(scene)
        if rows is None:
            raise InputError(
                f"{scene[0]}, {scene[1]}-D, seed {scene[2]}: there is no result of this scene; run the benchmark with "
                "this seed"
            )
        chosen += [rows[row] for row in results.rows if row in rows and row not in CONTROLS]
    return chosen


def _chosen(results: MovingResults) -> list[MovingResult]:
    """Return failures of our methods first, and then one success in each family; at most six results."""
    ours = [row for row in results.rows if row.split(",")[0] in OURS] or results.rows[:1]
    found = [r for row in ours for r in results.of(row) if not r.success][: _PLAYED // 2]
    for family in results.families():
        found += [r for r in results.of(ours[0], family) if r.success][:1] if ours else []
    return found[:_PLAYED]


def _tabs(chosen: Sequence[MovingResult]) -> tuple[tuple[str, str] | None, list[Tab]]:
    pages, contents = {}, {}
    for i, result in enumerate(chosen):
        case, run = result.experiment.moved()
        nominal = case.skill.nominal(np.linspace(0.0, case.skill.duration_, 200))
        key = f"scene-{i + 1}"
        pages[key] = playback_html(
            recording_of(result.experiment, case, run),
            paths=[
                PathMark("learned path", nominal.positions, palette.NOMINAL, 0.003),
                PathMark("path of the tool", run.positions, palette.ADAPTED, 0.004),
            ],
        )
        contents[key] = (result, responses_chart(case, run, f"{key}-map"))
    shared, own = shared_players(pages)
    keys = [
        Key(palette.NOMINAL, "learned path"),
        Key(palette.ADAPTED, "path of the tool"),
        Key(palette.PREDICTED, "predicted obstacle, 0.3 s ahead", blob=True),
    ]
    tabs = []
    for key, (result, svg) in contents.items():
        e = result.experiment
        title = f"{MovingResults.row_of(result)}: {e.family}, {e.dimension}-D, seed {e.seed}"
        facts = {"Outcome": result.outcome, "Reason": result.reason or "–"}
        caption = "Seen from above. Black lines link tool and obstacle where their gap is below 25 cm (Fig 5.10)."
        content = {
            "facts": facts,
            "figure": Figure(svg, "Paths of tool and obstacles", caption),
            "player": Player(title, own[key], keys),
        }
        tabs.append(Tab(key, title, content))
    return shared, tabs
