"""The parts of the report's page behind the results: what was learnt, and how it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

from imitarm.demonstrations import Alignment, Finding
from imitarm.viewer import charts, plots
from imitarm.viewer.content import LearningSummary
from imitarm.viewer.markup import MM, facts, figure

WORDS: Final = {
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
"""The words of a report of reproductions in plain language."""


def learning_section(learning: LearningSummary) -> str:
    """Return what was shown, what was wrong with it, and how it became a skill."""
    figures = [
        figure(
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
            [c.held_out_rmse_mm / MM for c in tried],
            learning.n_components,
        )
        caption = (
            "More components always follow the recordings more closely. The number is chosen by the error on "
            "demonstrations that were left out of the learning; BIC and AIC weigh fit against size."
        )
        figures.append(figure(svg, "How many components?", caption))
    figures.append(_findings(learning.findings))
    if learning.alignment is not None:
        figures.append(_alignment(learning.alignment))
    if learning.details:
        figures.append(f'<div class="card"><h3>The skill</h3>{facts(learning.details)}</div>')
    return f'<section id="learning"><h2>What was learnt</h2><div class="columns">{"".join(figures)}</div></section>'


def _findings(findings: Sequence[Finding]) -> str:
    """Return what lint said, the worst first as it comes."""
    items = []
    for finding in findings:
        place = ", ".join(part for part in (finding.source, finding.place) if part)
        kind = "bad" if finding.severity == "error" else "aside"
        mark = f'<span class="mark {kind}">{escape(finding.severity)}</span> '
        words = f"{place}: {finding.message}" if place else finding.message
        remedy = f' <span class="soft">{escape(finding.remedy)}</span>' if finding.remedy else ""
        items.append(f"<li>{mark}{escape(words)}.{remedy}</li>")
    body = f'<ul class="plain">{"".join(items)}</ul>' if items else '<p class="soft">Nothing was found wrong.</p>'
    return f'<div class="card"><h3>Checked before learning</h3>{body}</div>'


def _alignment(alignment: Alignment) -> str:
    """Return what align changed: rows cut off, durations, shifts in time."""
    heads = ("Demonstration", "Rows kept", "Took [s]", "Moments shifted by at most [s]")
    rows = []
    columns = (alignment.kept_rows, alignment.durations, alignment.largest_shift)
    for i, (kept, took, shift) in enumerate(zip(*columns, strict=True)):
        cells = f"<td>{int(kept[0])} to {int(kept[1])}</td><td>{took:.2f}</td><td>{shift:.2f}</td>"
        title = f' title="{escape(alignment.demonstrations[i].source, quote=True)}"'
        rows.append(f'<tr><th scope="row"{title}>{i + 1}</th>{cells}</tr>')
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    return (
        f'<div class="card"><h3>Brought to one time</h3><div class="scroll"><table class="small">'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        f'<p class="caption">Rest at the beginning and the end was cut off, then each motion was stretched to '
        f"{alignment.duration:.2f} s by the method {escape(alignment.method)!r}. Positions were not changed.</p></div>"
    )


def provenance_section(provenance: Mapping[str, Any], words: Mapping[str, str]) -> str:
    """Return what is needed to do the same again, and the ``words`` that the page uses.

    Args:
        provenance: by name; values that are mappings become cards of their own.
        words: what each word on the page means.
    """
    plain = {key: value for key, value in provenance.items() if not isinstance(value, Mapping)}
    groups = [f'<div class="card"><h3>This run</h3>{facts(plain)}</div>'] if plain else []
    for key, value in provenance.items():
        if isinstance(value, Mapping):
            groups.append(f'<div class="card"><h3>{escape(str(key))}</h3>{facts(value)}</div>')
    again = f'<h2>How it was made</h2><div class="columns">{"".join(groups)}</div>' if groups else ""
    return (
        f'<section id="provenance">{again}<details class="card"><summary>The words on this page</summary>'
        f"{facts(words)}</details></section>"
    )
