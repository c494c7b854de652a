"""A report of retargetings as one self-contained HTML page: a person and a robot side by side, figures, numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from imitarm.viewer import palette, retarget_charts
from imitarm.viewer.background import provenance_section
from imitarm.viewer.data import plain
from imitarm.viewer.markup import figure, number
from imitarm.viewer.page import data_link, draw_page, page_html, shared_players
from imitarm.viewer.panels import Key, Panel, heading, player_card, tabbed
from imitarm.viewer.person import PersonMark
from imitarm.viewer.retarget_content import Measure, MethodResult, PlainTable, RetargetReport
from imitarm.viewer.retarget_frames import FLOOR, retargeting_frames
from imitarm.viewer.scene3d import PathMark, playback_html
from imitarm.viewer.stage import Camera, body_parts, points_to_see

_PLACE: Final = (0.0, 1.35)  # [m] where the person stands in the base frame: at the robot's left
_VIEW: Final = (1.0, -0.42, 0.36)  # from where the camera looks: both are seen from the front
_KEYS: Final = (
    Key(palette.DEMONSTRATION, "the person's arm, and where the tool should go"),
    Key(palette.ADAPTED, "path of the robot's tool"),
)
_WORDS: Final = {
    "Retargeting": "What a person's arm does, seen by a camera, becomes what a robot's arm does: its tool follows the "
    "hand, and where the method can, its elbow follows the elbow.",
    "Target": "Where a method wants the tool to be: where it was when the person took hold, and from then on as far "
    "away as the hand has gone, times the scale.",
    "Following, coasting, holding, stopped": "What is done while the arm is seen; for a tenth of a second without a "
    "sight of it; until three tenths; and after that, until the person has been seen for half a second.",
    "Frames beyond a limit": "Counted from the joints' positions alone, in every control period: what the drives of a "
    "real arm would be asked for.",
    "Singular value": "How well the arm can still move its tool in the worst direction. Near 0 it is stretched or "
    "folded, and small motions of the tool need fast joints.",
    "Torque": "What the motion takes by the arm's own inertias, without friction; the part that only holds the weight "
    "is there when nothing moves.",
}


def write_retarget_report(report: RetargetReport, path: str | Path) -> Path:
    """Write a report of retargetings by :func:`~imitarm.viewer.page.draw_page` and return where it is.

    Args:
        report: what to tell.
        path: the file to write; its folder must exist.

    Raises:
        InputError: when it can't be written there, or the libraries that draw are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: retarget_report_html(report), path)


def retarget_report_html(report: RetargetReport) -> str:
    """Return the whole page.

    Args:
        report: what to tell.

    Raises:
        InputError: when the libraries that draw are not installed.
    """
    shared, own = shared_players({method.name: playback(report, method) for method in report.methods})
    tiles = [
        (f"{number(tile.value, tile.digits)}<small> {escape(tile.unit)}</small>", tile.label) for tile in report.tiles
    ]
    panels = [
        Panel(f"method-{i + 1}", method.title, _method(method, own[method.name], f"m{i + 1}"))
        for i, method in enumerate(report.methods)
    ]
    sections = [
        _results(report, data_link(_as_data(report), "imitarm-retargeting.json")),
        f'<section id="scenes"><h2>Side by side</h2>{tabbed(panels, "Methods")}</section>',
        _recording(report),
        provenance_section(report.provenance, _WORDS),
    ]
    return page_html(
        report.title, heading(report.title, report.verdict, report.good, report.summary, tiles), sections, shared
    )


def playback(report: RetargetReport, method: MethodResult, *, dark: bool = False) -> str:
    """Return the 3-D page in which the person and the robot move side by side, with one bar for both.

    Args:
        report: whose person and scene.
        method: whose robot.
        dark: dark controls and background.
    """
    run = method.run
    recording = retargeting_frames(run, report.scene)
    times = recording.times if method.clock is None else np.interp(recording.times, run.times, method.clock)
    person = PersonMark.beside(
        report.skeletons,
        times,
        report.correspondence.sensor_to_base,
        side=report.correspondence.side,
        place=_PLACE,
        floor=FLOOR,
    )
    paths = [PathMark("path of the tool", run.arm.tool_path(run.joints)[0], palette.ADAPTED, 0.006)]
    aimed = np.asarray(np.isfinite(run.targets[0]).all(axis=1))
    followed = [(first, last) for first, last in retarget_charts.stretches(aimed) if aimed[first] and last > first]
    for i, (first, last) in enumerate(followed):
        positions = run.targets[0][first : last + 1]
        paths.append(PathMark(f"target {i + 1}", positions, palette.DEMONSTRATION, 0.004))
    near = [*(path.positions for path in paths), person.points_to_see]
    camera = Camera.around(points_to_see(recording, body_parts(recording.model), near), direction=_VIEW)
    return playback_html(recording, paths=paths, persons=[person], camera=camera, dark=dark)


def _results(report: RetargetReport, download: str) -> str:
    """Return the figures of merit, a column for each method, and what each method was doing over time."""
    heads = "".join(
        f'<th scope="col"><a href="#method-{i + 1}">{escape(method.title)}</a></th>'
        for i, method in enumerate(report.methods)
    )
    rows = "".join(
        f'<tr><th scope="row">{escape(_with_unit(measures[0]))}</th>{"".join(_cells(measures))}</tr>'
        for measures in zip(*(method.measures for method in report.methods), strict=True)
    )
    caption = "The best of each row is in bold type." if len(report.methods) > 1 else ""
    bands = retarget_charts.states([(method.name, method.run) for method in report.methods])
    card = figure(bands, "What was done when", "The share of the time that the robot follows is in the table.")
    return (
        '<section id="results"><h2>Figures of merit</h2>'
        f'<div class="card wide"><table><thead><tr><th scope="col">Measured</th>{heads}</tr></thead>'
        f'<tbody>{rows}</tbody></table></div><p class="caption">{caption}</p>'
        f'<div class="columns">{card}</div><p>{download}</p></section>'
    )


def _with_unit(measure: Measure) -> str:
    return f"{measure.label} [{measure.unit}]" if measure.unit else measure.label


def _cells(measures: tuple[Measure, ...]) -> Iterator[str]:
    """Give the cells of a row: the best value bold, faults on red."""
    known = [round(m.value, m.digits) for m in measures if math.isfinite(m.value)]
    best = None
    if len(measures) > 1 and measures[0].better and len(set(known)) > 1:
        best = min(known) if measures[0].better == "less" else max(known)
    for measure in measures:
        text = number(measure.value, measure.digits)
        if measure.fault and measure.value > 0.0:
            text = f'<span class="mark bad">{text}</span>'
        elif math.isfinite(measure.value) and round(measure.value, measure.digits) == best:
            text = f"<strong>{text}</strong>"
        yield f"<td>{text}</td>"


def _method(method: MethodResult, player: str, key: str) -> str:
    """Return what is behind one tab: 3-D playback, figures, tables."""
    run = method.run
    path = run.arm.tool_path(run.joints)[0]
    notes = "".join(f"<li>{escape(note)}</li>" for note in method.notes)
    cards = [
        figure(
            retarget_charts.tool(run, path, name=f"{key}-tool"),
            "The tool and its target",
            "The target begins when the person has taken hold. What keeps the two apart is the method's own lag, and "
            "what the arm can't do.",
        ),
        figure(
            retarget_charts.velocities(run, name=f"{key}-velocities"),
            "Joint velocities",
            "From the positions alone. Dashed: the limit. The number is the highest velocity as a share of it.",
        ),
        figure(
            retarget_charts.joints(run, name=f"{key}-joints"), "Joint positions", "Dashed: how far each joint may turn."
        ),
        figure(
            retarget_charts.accelerations(run, name=f"{key}-accelerations"),
            "Joint accelerations",
            "From the positions alone. Dashed: the limit. The number is the highest acceleration as a share of it.",
        ),
    ]
    if run.arm.landmarks is not None:
        points = np.array([run.arm.sew_points(q) for q in run.joints])
        svg = retarget_charts.elbow(run, points, name=f"{key}-elbow")
        caption = (
            "Robot and person begin in postures of their own; what counts is that they move alike. 90° is straight up, "
            "or straight to the left."
        )
        cards.append(figure(svg, "The upper arms", caption))
    cards += [_table(table) for table in method.tables]
    return (
        f"<h3>{escape(method.title)} on {escape(run.arm.name)}</h3>"
        + (f"<p>{escape(method.caption)}</p>" if method.caption else "")
        + (f'<ul class="plain">{notes}</ul><br>' if notes else "")
        + player_card(f"Person and robot side by side: {method.title}", player, _KEYS)
        + f'<div class="columns">{"".join(cards)}</div>'
    )


def _table(table: PlainTable) -> str:
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in table.heads)
    rows = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>'
        for row in table.rows
    )
    return (
        f'<div class="card"><h3>{escape(table.title)}</h3><div class="scroll"><table class="small">'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        f'<p class="caption">{escape(table.caption)}</p></div>'
    )


def _recording(report: RetargetReport) -> str:
    """Return what was found in the recording and done to it."""
    items = "".join(f"<li>{escape(finding)}</li>" for finding in report.findings)
    body = f'<ul class="plain">{items}</ul>' if items else '<p class="soft">Nothing was found wrong.</p>'
    return f'<section id="recording"><h2>The recording</h2><div class="card">{body}</div></section>'


def _as_data(report: RetargetReport) -> dict[str, Any]:
    """Return the report's numbers as plain values, ready for JSON; what is not known is None."""
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
