"""The part of the report's page that shows scene by scene: 3-D playback, figures, numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, Final

import numpy as np

from imitarm.viewer import charts, palette, plots
from imitarm.viewer.content import Report, SceneResult
from imitarm.viewer.markup import MM, facts, figure, mark, number, scene_id
from imitarm.viewer.panels import Key, Panel, player_card, tabbed

_KEYS: Final = (
    Key(palette.NOMINAL, "learnt path"),
    Key(palette.ADAPTED, "adapted path"),
    Key(palette.MEASURED, "path of the robot's tool, measured"),
    Key(palette.UNMOVED, "component, unmoved", blob=True),
    Key(palette.MOVED, "component, moved", blob=True),
)


def scenes_section(report: Report, players: Mapping[str, str]) -> str:
    """Return one tab for each scene: 3-D playback, figures, numbers.

    Args:
        report: what to show.
        players: for each scene's name, what makes its 3-D page different from the others'.
    """
    if not report.scenes:
        return ""
    first = next((i for i, scene in enumerate(report.scenes) if scene.scene.obstacles), 0)
    panels = [
        Panel(scene_id(i, scene.name), scene.title, _scene(i, scene, players.get(scene.name)))
        for i, scene in enumerate(report.scenes)
    ]
    return f'<section id="scenes"><h2>Scene by scene</h2>{tabbed(panels, "Scenes", first)}</section>'


def _scene(index: int, scene: SceneResult, player: str | None) -> str:
    verdict = mark(scene.success and not scene.contact, "done", "contact" if scene.contact else "not done")
    words = " ".join(text for text in (scene.caption, scene.reason) if text)
    parts = [f"<h3>{escape(scene.title)} {verdict}</h3>", f"<p>{escape(words)}</p>" if words else ""]
    if player is not None:
        parts.append(player_card(f"3-D playback: {scene.title}", player, _KEYS))
    parts.append(f'<div class="columns">{"".join(_scene_figures(index, scene))}</div>')
    return "".join(parts)


def _scene_figures(index: int, scene: SceneResult) -> Iterable[str]:
    adaptation, rollout, key = scene.adaptation, scene.rollout, f"s{index + 1}"
    if adaptation is not None:
        svg = plots.adaptation(
            adaptation.nominal,
            adaptation.trajectory,
            scene=scene.scene,
            clearance=scene.asked_clearance,
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
            yield figure(
                svg,
                "Around the obstacles",
                "The path of the tool's point. What the tool sweeps over, dotted, must stay outside of the dashed "
                "lines. Arrows show where components were moved.",
            )
            lengths = np.linalg.norm(adaptation.displacement, axis=1)
            svg = charts.displacement(lengths, adaptation.moved, name=f"{key}-moved")
            yield figure(svg, "Which components were moved", "Each bar is one piece of the motion, from start to end.")
        else:
            yield figure(svg, "The learnt path", "The path of the tool's point: nothing is in the way.")
    if rollout is not None:
        times = rollout.trajectory.times - rollout.trajectory.times[0]
        svg = charts.clearance(times, rollout.clearance, scene.asked_clearance, name=f"{key}-clearance")
        yield figure(
            svg, "Clearance over time", "Measured by the simulator between the shapes of arm, tool and obstacles."
        )
        if scene.torque_limits is not None:
            names, limits = scene.joint_names, scene.torque_limits
            svg = charts.torques(times, rollout.torques, limits, joint_names=names, name=f"{key}-torques")
            yield figure(
                svg, "Joint torques", "Dashed: the rated torque. The number is the highest torque as a share of it."
            )
    yield f'<div class="card"><h3>All numbers</h3>{facts(_scene_facts(scene))}</div>'


def _scene_facts(scene: SceneResult) -> dict[str, Any]:
    values: dict[str, Any] = {
        "Obstacles": "; ".join(o.name or o.kind for o in scene.scene.obstacles) or "none",
        "Smallest clearance, measured": number(MM * scene.min_clearance, 2, "mm"),
        "Asked clearance": number(MM * scene.asked_clearance, 1, "mm"),
        "RMSE to the demonstrations": number(MM * scene.rmse, 2, "mm"),
    }
    if scene.adaptation is not None:
        a = scene.adaptation
        farthest = float(np.linalg.norm(a.displacement, axis=1).max(initial=0.0))
        values |= {
            "Method": a.method,
            "Certified clearance of the plan": number(MM * a.certified_clearance, 2, "mm"),
            "Tool in the plan": _tool(scene),
            "Components moved": f"{int(np.sum(a.moved))} of {len(a.moved)}",
            "Farthest component": number(MM * farthest, 1, "mm"),
            "Adaptation time": number(MM * a.compute_time, 3, "ms"),
        }
    if scene.rollout is not None:
        values["Motion time"] = number(scene.rollout.trajectory.duration, 2, "s")
        values["Path length of the tool"] = number(scene.rollout.trajectory.path_length, 3, "m")
        values["Highest torque, of the rated"] = number(100 * scene.peak_torque_share, 1, "%")
        values["How the motion ended"] = scene.rollout.reason or (
            "finished" if scene.rollout.success else "not finished"
        )
    return values | dict(scene.details)


def _tool(scene: SceneResult) -> str:
    """Say in words how the plan saw the tool."""
    spheres = scene.tool
    reach = float((np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]).max())
    if reach == 0.0:
        return "a point"
    many = "one sphere" if len(spheres) == 1 else f"{len(spheres)} spheres"
    return f"{many}, at most {number(MM * reach, 0, 'mm')} from its point"
