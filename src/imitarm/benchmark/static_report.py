"""Write the results of the static benchmark as one HTML page with charts, tables, and playbacks of failures.

The results do not contain the planned paths. To draw a path, the report plans it again, which gives the same path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.controls import CONTROLS
from imitarm.benchmark.static import StaticResult
from imitarm.benchmark.static_comparison import times_by_task
from imitarm.benchmark.static_scenes import StaticCase
from imitarm.benchmark.static_tables import N_TASKS, OURS, StaticResults, is_success, place, row_name
from imitarm.benchmark.tables import Table
from imitarm.errors import InputError
from imitarm.evaluation.intervals import wilson_interval
from imitarm.robots.world import add_obstacles
from imitarm.trajectory import Trajectory
from imitarm.viewer import maps, palette
from imitarm.viewer.canvas import INK, canvas
from imitarm.viewer.page import Figure, Header, Key, Player, Tab, Tile, draw_page, render, shared_players
from imitarm.viewer.recording import FrameRecorder, Recording
from imitarm.viewer.scene3d import PathMark, playback_html

Array = NDArray[np.float64]

_COLOURS: Final = (
    *(palette.ADAPTED, palette.MEASURED, palette.UNMOVED, palette.DEMONSTRATION, palette.MOVED),
    *(palette.NOMINAL, palette.OBSTACLE, palette.LIMIT),
)
_MARKERS: Final = "osD^vP*X<>hd"
_PLAYED: Final = 6  # failures that are drawn when none is named
_RATE: Final = 25.0  # [1/s] frames
_WORDS: Final = {
    "Success": "The path touches no obstacle and meets start, goal and contact point. Within the limits of speed and "
    "acceleration, the motion takes at most twice the learned duration.",
    "Oracle": "An independent search that decides which scenes have a solution.",
    "RMSE": "Root mean square distance from the learned path at equal fractions of the durations.",
    "SPARC": "Spectral arc length of the speed: the closer to 0, the smoother the motion.",
    "LDLJ": "Logarithmic dimensionless jerk: the closer to 0, the smoother the motion.",
}


def write_static_report(
    results: StaticResults,
    tables: Sequence[Table],
    path: str | Path,
    *,
    provenance: Mapping[str, Any],
    scenes: Sequence[tuple[str, int, int]] = (),
) -> Path:
    """Write the page and return its path.

    Args:
        results: results of the benchmark.
        tables: tables that the command also prints.
        path: the file to write; its folder must exist.
        provenance: facts needed to repeat the benchmark.
        scenes: scenes to draw, as family, dimension and seed. If empty, the report draws one failure of each method, at
            most six.

    Raises:
        InputError: when the file can't be written, a scene has no result, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: static_report_html(results, tables, provenance=provenance, scenes=scenes), path)


def static_report_html(
    results: StaticResults,
    tables: Sequence[Table],
    *,
    provenance: Mapping[str, Any],
    scenes: Sequence[tuple[str, int, int]] = (),
) -> str:
    """Return the whole page as HTML; for the arguments, see :func:`write_static_report`."""
    chosen = _named(results, scenes) if scenes else _failures(results)
    shared, tabs = _tabs(chosen)
    found = results.of(OURS, results.solvable)
    good = sum(map(is_success, found))
    verdict = f"{OURS} succeeds in {good} of {len(found)} scenes" if found else f"{OURS} was not run"
    rates = {
        row: sum(map(is_success, of)) / len(of)
        for row in results.rows
        if row not in CONTROLS and (of := results.of(row, results.solvable))
    }
    best = sorted(rates, key=lambda row: -rates[row])[:5]
    tiles = [Tile(f"{100 * rates[row]:.1f}", "%", f"success of {row}") for row in best]
    return render(
        "avoidance.html",
        Header("Avoidance in static scenes", verdict, bool(found) and good == len(found), "", tiles),
        data={"tables": [{"title": t.title, "columns": t.columns, "rows": t.rows, "note": t.note} for t in tables]},
        data_name="imitarm-static.json",
        provenance=provenance,
        words=_WORDS,
        shared=shared,
        figures=_figures(results),
        tables=[table.for_page() for table in tables],
        scenes=tabs,
    )


# --- charts --------------------------------------------------------------------------------------------------------


def _figures(results: StaticResults) -> list[Figure]:
    lines = "Lines are 95 % intervals (Wilson)."
    found = [
        Figure(success_chart(results, family), f"Success: {place(family)}", lines) for family in results.families()
    ]
    found.append(
        Figure(obstacles_chart(results), "Success by the number of obstacles", "Only scenes that have a solution.")
    )
    for name, unit, title in (
        ("plan_seconds", "time to compute [s]", "Fig 4.9: time to compute"),
        ("duration", "time to complete [s]", "Fig 4.9: time to complete"),
    ):
        found.append(Figure(tasks_chart(results, name, unit), title, "Medians over the successful plans in each task."))
    return found


def success_chart(results: StaticResults, family: tuple[str, int]) -> str:
    """Draw the rate of success of each method in one family."""
    rates = []
    for row in results.rows:
        found = results.of(row, lambda s: results.solvable(s) and results.usual(s) and s[:2] == family)
        if found:
            rates.append((row, sum(map(is_success, found)), len(found)))
    if not rates:
        return ""
    height = 0.62 + 0.2 * len(rates)
    name = f"success-{family[0]}-{family[1]}"
    with canvas(name, f"Rate of success of each method in {place(family)}", (5.5, height)) as drawing:
        axes = drawing.axes(1.75, 0.45, 5.35, height - 0.08)
        for i, (_, good, of) in enumerate(reversed(rates)):
            low, high = wilson_interval(good, of)
            share = good / of
            axes.barh(i, 100 * share, 0.7, color=_COLOURS[0])
            spread = 100 * np.maximum([[share - low], [high - share]], 0.0)
            axes.errorbar(100 * share, i, xerr=spread, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
        axes.set_yticks(range(len(rates)), [row for row, *_ in reversed(rates)])
        axes.set_xlim(0.0, 103.0)
        axes.set_xlabel("success [%]")
        axes.grid(axis="y", visible=False)
    return drawing.svg


def obstacles_chart(results: StaticResults) -> str:
    """Draw the rate of success of each method against the number of obstacles."""
    numbers = sorted({int(r.value("n_obstacles")) for r in results.all if math.isfinite(r.value("n_obstacles"))})
    rows = [row for row in results.rows if row not in CONTROLS]
    if len(numbers) < 2 or not rows:
        return ""
    size = (5.5, 2.6 + 0.1 * len(rows))
    with canvas("obstacles", "Rate of success by the number of obstacles", size) as drawing:
        axes = drawing.axes(0.6, 0.5 + 0.1 * len(rows), 5.35, size[1] - 0.1)
        for i, row in enumerate(rows):
            counts: dict[int, list[bool]] = {n: [] for n in numbers}
            for r in results.of(row, lambda s: results.solvable(s) and results.usual(s)):
                counts[int(r.value("n_obstacles"))].append(is_success(r))
            known = [n for n in numbers if counts[n]]
            shares = [100 * float(np.mean(counts[n])) for n in known]
            look = {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % len(_MARKERS)], "ms": 4, "lw": 1.2}
            axes.plot(known, shares, label=row, **look)
        axes.set_ylim(-3.0, 103.0)
        axes.set_xlabel("number of obstacles")
        axes.set_ylabel("success [%]")
        drawing.legend(3)
    return drawing.svg


def tasks_chart(results: StaticResults, name: str, unit: str) -> str:
    """Draw the time ``name`` (a measure of the results) of each method in each task T1 to T8.

    Computing times are drawn on a logarithmic scale.
    """
    found = times_by_task(results, name)
    if not found:
        return ""
    size = (5.5, 2.6 + 0.1 * len(found))
    with canvas(f"tasks-{name.replace('_', '-')}", f"{unit} of each sweeping task", size) as drawing:
        axes = drawing.axes(0.95, 0.5 + 0.1 * len(found), 5.35, size[1] - 0.1)
        for i, (row, medians) in enumerate(found.items()):
            look = {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % len(_MARKERS)], "ms": 4, "lw": 1.2}
            axes.plot(range(N_TASKS), medians, label=row, **look)
        if name == "plan_seconds":
            axes.set_yscale("log")
        axes.set_xticks(range(N_TASKS), [f"T{i + 1}" for i in range(N_TASKS)])
        axes.set_ylabel(unit)
        drawing.legend(3)
    return drawing.svg


# --- playback of chosen scenes -------------------------------------------------------------------------------------


def _named(results: StaticResults, scenes: Sequence[tuple[str, int, int]]) -> list[StaticResult]:
    chosen = []
    for scene in scenes:
        rows = next((rows for s, rows in results.by_scene.items() if s[:3] == tuple(scene)), None)
        if rows is None:
            raise InputError(
                f"{place(scene[:2])}, seed {scene[2]}: there is no result of this scene; run the benchmark with this "
                "seed"
            )
        chosen += [rows[row] for row in results.rows if row in rows and row not in CONTROLS]
    return chosen


def _failures(results: StaticResults) -> list[StaticResult]:
    """Return one failure of each method, the failures of ours first."""
    found = []
    for row in results.rows:
        if row not in CONTROLS:
            bad = [r for r in results.of(row, results.solvable) if not is_success(r)]
            found += bad[: _PLAYED // 2 if row == OURS else 1]
    return found[:_PLAYED]


def _tabs(chosen: Sequence[StaticResult]) -> tuple[tuple[str, str] | None, list[Tab]]:
    pages, contents = {}, {}
    for i, result in enumerate(chosen):
        case, plan = result.experiment.planned()
        nominal = case.skill.nominal(np.linspace(0.0, case.skill.duration_, case.n_samples), None, case.scene.goal)
        path = nominal if plan is None else plan.trajectory
        key = f"scene-{i + 1}"
        pages[key] = playback_html(
            recording_of(case, path),
            paths=[
                PathMark("learned path", nominal.positions, palette.NOMINAL, 0.003),
                *([] if plan is None else [PathMark("planned path", path.positions, palette.ADAPTED, 0.004)]),
            ],
        )
        svg = maps.adaptation(
            nominal, path, scene=case.scene, clearance=case.clearance, tool_spheres=case.tool_spheres, name=f"{key}-map"
        )
        contents[key] = (result, svg)
    shared, own = shared_players(pages)
    keys = [Key(palette.NOMINAL, "learned path"), Key(palette.ADAPTED, "planned path")]
    tabs = []
    for key, (result, svg) in contents.items():
        e = result.experiment
        title = f"{row_name(e)}: {place((e.family, e.dimension))}, seed {e.seed}"
        facts = {"Outcome": result.outcome, "Reason": result.reason or "–"}
        caption = (
            "Dashed lines: required clearance around the obstacles. If the method refused the scene, the learned path "
            "is drawn."
        )
        player = Player(title, own[key], keys)
        content = {"facts": facts, "figure": Figure(svg, "Learned and planned path", caption), "player": player}
        tabs.append(Tab(key, title, content))
    return shared, tabs


def recording_of(case: StaticCase, path: Trajectory) -> Recording:
    """Return a recording for the playback, in which the tool moves along a path among the obstacles."""
    spec = mujoco.MjSpec()
    add_obstacles(spec, case.scene)
    tool = spec.worldbody.add_body(name="tool", mocap=True)
    for x, y, z, radius in case.tool_spheres:
        size, colour = [max(float(radius), 1e-3), 0.0, 0.0], [0.0, 0.45, 0.7, 0.6]
        tool.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=[x, y, z], rgba=colour)
    model = spec.compile()
    data = mujoco.MjData(model)
    recorder = FrameRecorder(model, rate=_RATE)
    body = int(model.body("tool").mocapid[0])
    times = np.arange(path.times[0], path.times[-1] + 0.5 / _RATE, 1.0 / _RATE)
    positions, quaternions = path.at(times)
    for i, time in enumerate(times):
        data.mocap_pos[body] = positions[i]
        if quaternions is not None:
            data.mocap_quat[body] = quaternions[i]
        mujoco.mj_kinematics(model, data)
        recorder.note(data, float(time))
    return recorder.recording()
