"""The parts of the report's page that come first: the headline and the table."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from imitarm.viewer.content import Report
from imitarm.viewer.markup import MM, mark, number, scene_id
from imitarm.viewer.panels import heading


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
            f"{number(MM * report.min_clearance)}<small> mm</small>",
            f"smallest measured distance to an obstacle (asked: {number(MM * asked, 0, 'mm')})",
        ),
        (
            f"{number(100 * float(np.mean(unmoved)) if unmoved else math.nan, 0)}<small> %</small>",
            "of the learnt motion's components left exactly as shown",
        ),
        (
            f"{number(MM * float(np.median(planning)) if planning else math.nan)}<small> ms</small>",
            "to plan around the obstacles (median)",
        ),
    ]
    return heading(report.title, report.verdict, report.passed, report.summary, tiles if obstructed else ())


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
            mark(scene.success and not scene.contact, "done", "contact" if scene.contact else "not done"),
            number(MM * scene.min_clearance),
            number(MM * scene.asked_clearance, 0) if count else "–",
            number(MM * scene.rmse),
            escape(kept),
            number(MM * adaptation.compute_time, 2) if adaptation is not None else "–",
            number(100 * scene.peak_torque_share, 0, "%"),
            *(escape(str(scene.details.get(key, "–"))) for key in extra),
        ]
        link = f'<th scope="row"><a href="#{scene_id(i, scene.name)}">{escape(scene.title)}</a></th>'
        rows.append(f"<tr>{link}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    return (
        '<section id="results"><h2>Results</h2><div class="card wide"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        '<p class="caption">Clearance is measured in the simulator between the real shapes of arm, tool and obstacles '
        "at every step. RMSE compares the measured path with the demonstrations, also where it had to leave them.</p>"
        f"<p>{download}</p></section>"
    )
