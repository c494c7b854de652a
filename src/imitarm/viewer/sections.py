"""The parts of the report's page, each a function from results to HTML; all text from outside is escaped here."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, Final

import numpy as np

from imitarm.viewer import charts, palette, plots
from imitarm.viewer.content import LearningSummary, Report, SceneResult

_MM: Final = 1000.0  # [mm/m], and [ms/s]
_WORDS: Final = {
    "Demonstration": "One recording of a person showing the motion: here, by guiding the arm's tool.",
    "Learnt path": "What all demonstrations have in common. It is what the robot does when nothing is in the way.",
    "Gaussian component": "One of the pieces that the learnt motion is made of, drawn as an ellipse that holds 95 % of "
    "what was shown there. A small ellipse means that everybody did the same: precision matters there.",
    "Adaptation (ACFRA)": "Only the components that are near an obstacle are moved. Everywhere else the robot does "
    "exactly what it was shown.",
    "Tolerance": "How far a path may be from the learnt one and still look like the demonstrations: two standard "
    "deviations to each side.",
    "Clearance": "The smallest distance between any part of the arm or its tool and any obstacle. It is measured in "
    "the simulator while the arm moves, with the real shapes, not taken from the plan.",
    "RMSE": "Root mean square error: how far the path is from the demonstrations on average, with large differences "
    "counting more. Going around an obstacle makes it larger, as it should.",
    "Rated torque": "The torque that a joint's motor can give for a long time. Staying below it means that a real arm "
    "could do this motion.",
}


def number(value: float, digits: int = 1, unit: str = "") -> str:
    """Write a number with its unit; what is not known or endless becomes a dash."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}{chr(0xA0) + unit if unit else ''}"


def _mark(good: bool, yes: str, no: str) -> str:
    return f'<span class="mark {"good" if good else "bad"}">{escape("✓ " + yes if good else "✗ " + no)}</span>'


def _facts(pairs: Mapping[str, Any]) -> str:
    rows = (f"<dt>{escape(str(key))}</dt><dd>{escape(str(value))}</dd>" for key, value in pairs.items())
    return f'<dl class="facts">{"".join(rows)}</dl>'


def _figure(svg: str, title: str, caption: str) -> str:
    """Put a drawing on a card; nothing when there is no drawing."""
    if not svg:
        return ""
    return (
        f'<figure class="card"><h3>{escape(title)}</h3>{svg}'
        f'<figcaption class="caption">{escape(caption)}</figcaption></figure>'
    )


def scene_id(index: int, scene: SceneResult) -> str:
    """Return the anchor of a scene: unique by its number, readable by its name."""
    return f"scene-{index + 1}-" + (re.sub(r"[^a-z0-9]+", "-", scene.name.lower()).strip("-") or "x")


def header(report: Report) -> str:
    """Return title, verdict and the four numbers that matter most."""
    scenes = report.scenes
    obstructed = [s for s in scenes if s.scene.obstacles]
    clear = sum(s.rollout is not None and not s.contact for s in obstructed)
    asked = min((s.asked_clearance for s in obstructed), default=math.nan)
    unmoved = [s.unmoved_share for s in obstructed if not math.isnan(s.unmoved_share)]
    planning = [s.adaptation.compute_time for s in obstructed if s.adaptation is not None]
    tiles = [
        (f"{clear}<small> of {len(obstructed)}</small>", "scenes with obstacles passed without contact"),
        (
            f"{number(_MM * report.min_clearance)}<small> mm</small>",
            f"smallest measured distance to an obstacle (asked: {number(_MM * asked, 0, 'mm')})",
        ),
        (
            f"{number(100 * float(np.mean(unmoved)) if unmoved else math.nan, 0)}<small> %</small>",
            "of the learnt motion's components left exactly as shown",
        ),
        (
            f"{number(_MM * float(np.median(planning)) if planning else math.nan)}<small> ms</small>",
            "to plan around the obstacles (median)",
        ),
    ]
    cards = "".join(f'<div class="card"><dt>{escape(label)}</dt><dd>{value}</dd></div>' for value, label in tiles)
    summary = f"<p>{escape(report.summary)}</p>" if report.summary else ""
    return (
        f"<header><h1>{escape(report.title)}</h1>"
        f'<p class="verdict {"good" if report.passed else "bad"}"><span>{"✓" if report.passed else "✗"} '
        f"{escape(report.verdict)}</span></p>{summary}"
        f'<dl class="tiles">{cards if obstructed else ""}</dl></header>'
    )


def table_section(report: Report, download: str) -> str:
    """Return the table of all scenes; ``download`` is a link to the same numbers as data."""
    extra = list(dict.fromkeys(key for scene in report.scenes for key in scene.details))
    heads = [
        "Scene",
        "Obstacles",
        "Result",
        "Smallest clearance, measured [mm]",
        "Asked [mm]",
        "RMSE to the demonstrations [mm]",
        "Components unmoved",
        "Adaptation time [ms]",
        "Highest torque, of the rated",
        *extra,
    ]
    rows = []
    for i, scene in enumerate(report.scenes):
        adaptation, count = scene.adaptation, len(scene.scene.obstacles)
        kept = "–"
        if adaptation is not None:
            total = len(adaptation.moved)
            kept = f"{total - int(np.sum(adaptation.moved))} of {total} ({number(100 * scene.unmoved_share, 0, '%')})"
        cells = [
            str(count),
            _mark(scene.success and not scene.contact, "done", "contact" if scene.contact else "not done"),
            number(_MM * scene.min_clearance),
            number(_MM * scene.asked_clearance, 0) if count else "–",
            number(_MM * scene.rmse),
            escape(kept),
            number(_MM * adaptation.compute_time, 2) if adaptation is not None else "–",
            number(100 * scene.peak_torque_share, 0, "%"),
            *(escape(str(scene.details.get(key, "–"))) for key in extra),
        ]
        link = f'<th scope="row"><a href="#{scene_id(i, scene)}">{escape(scene.title)}</a></th>'
        rows.append(f"<tr>{link}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    return (
        '<section id="results"><h2>Results</h2><div class="card wide"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        '<p class="caption">Clearance is measured in the simulator between the real shapes of arm, tool and obstacles '
        "at every step. RMSE compares the measured path with the demonstrations, also where it had to leave them.</p>"
        f"<p>{download}</p></section>"
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
    tabs, panels = [], []
    for i, scene in enumerate(report.scenes):
        anchor, chosen = scene_id(i, scene), "true" if i == first else "false"
        tabs.append(
            f'<button type="button" role="tab" id="tab-{anchor}" aria-controls="{anchor}" aria-selected="{chosen}">'
            f"{escape(scene.title)}</button>"
        )
        panels.append(
            f'<section class="scene" role="tabpanel" id="{anchor}" aria-labelledby="tab-{anchor}">'
            f"{_scene(i, scene, players.get(scene.name))}</section>"
        )
    return (
        '<section id="scenes"><h2>Scene by scene</h2>'
        f'<div role="tablist" aria-label="Scenes">{"".join(tabs)}</div>{"".join(panels)}</section>'
    )


def _scene(index: int, scene: SceneResult, player: str | None) -> str:
    verdict = _mark(scene.success and not scene.contact, "done", "contact" if scene.contact else "not done")
    words = " ".join(text for text in (scene.caption, scene.reason) if text)
    parts = [f"<h3>{escape(scene.title)} {verdict}</h3>", f"<p>{escape(words)}</p>" if words else ""]
    if player is not None:
        parts.append(_player(scene, player))
    parts.append(f'<div class="columns">{"".join(_scene_figures(index, scene))}</div>')
    return "".join(parts)


def _player(scene: SceneResult, player: str) -> str:
    legend = (
        ("", palette.NOMINAL, "learnt path"),
        ("", palette.ADAPTED, "adapted path"),
        ("", palette.MEASURED, "path of the robot's tool, measured"),
        ("blob", palette.UNMOVED, "component, unmoved"),
        ("blob", palette.MOVED, "component, moved"),
    )
    items = "".join(
        f'<li><i class="{kind}" style="{"background" if kind else "color"}:{colour}"></i>{label}</li>'
        for kind, colour, label in legend
    )
    return (
        f'<div class="card player" data-title="{escape(f"3-D playback: {scene.title}", quote=True)}">'
        '<button type="button">Show in 3-D</button>'
        "<noscript>The 3-D playback needs JavaScript.</noscript>"
        f'<script type="application/json">{script_text(player)}</script></div>'
        f'<ul class="legend">{items}</ul><p class="caption">Drag to turn, right-drag to shift, scroll to come nearer. '
        "The bar below the picture stops, winds and slows down the playback.</p>"
    )


def _scene_figures(index: int, scene: SceneResult) -> Iterable[str]:
    adaptation, rollout, key = scene.adaptation, scene.rollout, f"s{index + 1}"
    if adaptation is not None:
        svg = plots.adaptation(
            adaptation.nominal,
            adaptation.trajectory,
            scene=scene.scene,
            keep_away=scene.asked_clearance + scene.tool_radius,
            tolerance=adaptation.tolerance,
            means=adaptation.means,
            covariances=adaptation.covariances,
            displacement=adaptation.displacement,
            moved=adaptation.moved,
            measured=rollout.trajectory if rollout is not None else None,
            name=f"{key}-paths",
        )
        yield _figure(
            svg,
            "Around the obstacles",
            "The path of the middle of the tool. It stays outside of the dashed lines: the asked clearance plus the "
            "tool's radius. Arrows show where components were moved.",
        )
        lengths = np.linalg.norm(adaptation.displacement, axis=1)
        svg = charts.displacement(lengths, adaptation.moved, name=f"{key}-moved")
        yield _figure(svg, "Which components were moved", "Each bar is one piece of the motion, from start to end.")
    if rollout is not None:
        times = rollout.trajectory.times - rollout.trajectory.times[0]
        svg = charts.clearance(times, rollout.clearance, scene.asked_clearance, name=f"{key}-clearance")
        yield _figure(
            svg, "Clearance over time", "Measured by the simulator between the shapes of arm, tool and obstacles."
        )
        if scene.torque_limits is not None:
            names, limits = scene.joint_names, scene.torque_limits
            svg = charts.torques(times, rollout.torques, limits, joint_names=names, name=f"{key}-torques")
            yield _figure(
                svg, "Joint torques", "Dashed: the rated torque. The number is the highest torque as a share of it."
            )
    yield f'<div class="card"><h3>All numbers</h3>{_facts(_scene_facts(scene))}</div>'


def _scene_facts(scene: SceneResult) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "Obstacles": "; ".join(o.name or o.kind for o in scene.scene.obstacles) or "none",
        "Smallest clearance, measured": number(_MM * scene.min_clearance, 2, "mm"),
        "Asked clearance": number(_MM * scene.asked_clearance, 1, "mm"),
        "RMSE to the demonstrations": number(_MM * scene.rmse, 2, "mm"),
    }
    if scene.adaptation is not None:
        a = scene.adaptation
        farthest = float(np.linalg.norm(a.displacement, axis=1).max(initial=0.0))
        facts |= {
            "Method": a.method,
            "Certified clearance of the plan": number(_MM * a.certified_clearance, 2, "mm"),
            "Tool radius in the plan": number(_MM * scene.tool_radius, 1, "mm"),
            "Components moved": f"{int(np.sum(a.moved))} of {len(a.moved)}",
            "Farthest component": number(_MM * farthest, 1, "mm"),
            "Adaptation time": number(_MM * a.compute_time, 3, "ms"),
        }
    if scene.rollout is not None:
        facts["Motion time"] = number(scene.rollout.trajectory.duration, 2, "s")
        facts["Path length of the tool"] = number(scene.rollout.trajectory.path_length, 3, "m")
        facts["Highest torque, of the rated"] = number(100 * scene.peak_torque_share, 1, "%")
        facts["How the motion ended"] = scene.rollout.reason or (
            "finished" if scene.rollout.success else "not finished"
        )
    return facts | dict(scene.details)


def learning_section(learning: LearningSummary) -> str:
    """Return what was shown, what was wrong with it, and how it became a skill."""
    figures = [
        _figure(
            plots.demonstrations(learning.demonstrations, learning.means, learning.covariances, learning.predicted),
            f"{len(learning.demonstrations)} demonstrations, {learning.n_components} components",
            "Where the lines lie together the task asks for precision, and the ellipses are small.",
        )
    ]
    if learning.candidates:
        tried = learning.candidates
        svg = charts.selection(
            [c.n_components for c in tried],
            [c.bic for c in tried],
            [c.aic for c in tried],
            [c.held_out_rmse_mm / _MM for c in tried],
            learning.n_components,
        )
        caption = (
            "More components always follow the recordings more closely. The number is chosen by the error on "
            "demonstrations that were left out of the learning; BIC and AIC weigh fit against size."
        )
        figures.append(_figure(svg, "How many components?", caption))
    figures.append(_notes("Checked before learning", learning.findings, "Nothing was wrong with the recordings."))
    figures.append(_notes("Changed before learning", learning.alignment, "Nothing was changed."))
    if learning.details:
        figures.append(f'<div class="card"><h3>The skill</h3>{_facts(learning.details)}</div>')
    return f'<section id="learning"><h2>What was learnt</h2><div class="columns">{"".join(figures)}</div></section>'


def _notes(title: str, lines: Iterable[str], otherwise: str) -> str:
    items = "".join(f"<li>{escape(str(line))}</li>" for line in lines)
    body = f'<ul class="plain">{items}</ul>' if items else f'<p class="soft">{escape(otherwise)}</p>'
    return f'<div class="card"><h3>{escape(title)}</h3>{body}</div>'


def provenance_section(report: Report) -> str:
    """Return the words that the page uses, and what is needed to do the same again."""
    plain = {key: value for key, value in report.provenance.items() if not isinstance(value, Mapping)}
    groups = [f'<div class="card"><h3>This run</h3>{_facts(plain)}</div>'] if plain else []
    for key, value in report.provenance.items():
        if isinstance(value, Mapping):
            groups.append(f'<div class="card"><h3>{escape(str(key))}</h3>{_facts(value)}</div>')
    again = f'<h2>How it was made</h2><div class="columns">{"".join(groups)}</div>' if groups else ""
    return (
        f'<section id="provenance">{again}<details class="card"><summary>The words on this page</summary>'
        f"{_facts(_WORDS)}</details></section>"
    )


def script_text(value: Any) -> str:
    """Return ``value`` as JSON that can stand in a script element: it can't close it, nor open a comment."""
    return json.dumps(value, ensure_ascii=False).replace("<", "\\u003c").replace(">", "\\u003e")
