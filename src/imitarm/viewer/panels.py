"""What every report is made of: the headline, tabs, and the 3-D players in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from imitarm.viewer.markup import script_text


@dataclass(frozen=True)
class Panel:
    """What is behind one tab: ``anchor`` unique in the page, ``title`` on the tab, ``body`` as HTML."""

    anchor: str
    title: str
    body: str


@dataclass(frozen=True)
class Key:
    """One colour of a player's legend: a line, or a ``blob``."""

    colour: str
    label: str
    blob: bool = False


def heading(title: str, verdict: str, good: bool, summary: str, tiles: Sequence[tuple[str, str]]) -> str:
    """Return title, verdict and the few numbers that matter most.

    Args:
        title: of the page.
        verdict: the result in one line.
        good: whether it is a good one.
        summary: a sentence or two; may be empty.
        tiles: values, as HTML, and what they are.
    """
    cards = "".join(f'<div class="card"><dt>{escape(label)}</dt><dd>{value}</dd></div>' for value, label in tiles)
    return (
        f"<header><h1>{escape(title)}</h1>"
        f'<p class="verdict {"good" if good else "bad"}"><span>{"✓" if good else "✗"} {escape(verdict)}</span></p>'
        f"{f'<p>{escape(summary)}</p>' if summary else ''}"
        f'<dl class="tiles">{cards}</dl></header>'
    )


def tabbed(panels: Sequence[Panel], label: str, first: int = 0) -> str:
    """Return tabs with what is behind them; without JavaScript all of it is shown.

    Args:
        panels: in their order.
        label: what the tabs are, for readers that do not see them.
        first: the one that is shown first.
    """
    tabs, bodies = [], []
    for i, panel in enumerate(panels):
        chosen = "true" if i == first else "false"
        tabs.append(
            f'<button type="button" role="tab" id="tab-{panel.anchor}" aria-controls="{panel.anchor}" '
            f'aria-selected="{chosen}">{escape(panel.title)}</button>'
        )
        bodies.append(
            f'<section class="scene" role="tabpanel" id="{panel.anchor}" aria-labelledby="tab-{panel.anchor}">'
            f"{panel.body}</section>"
        )
    return f'<div role="tablist" aria-label="{escape(label, quote=True)}">{"".join(tabs)}</div>{"".join(bodies)}'


def player_card(title: str, own: str, keys: Sequence[Key]) -> str:
    """Return a 3-D player with its legend.

    Args:
        title: for readers that do not see it.
        own: what its page has of its own, see :func:`imitarm.viewer.page.shared_players`.
        keys: what the colours mean.
    """
    items = "".join(
        f'<li><i class="{"blob" if key.blob else ""}" style="{"background" if key.blob else "color"}:{key.colour}"></i>'
        f"{escape(key.label)}</li>"
        for key in keys
    )
    return (
        f'<div class="card player" data-title="{escape(title, quote=True)}">'
        '<button type="button">Show in 3-D</button>'
        "<noscript>The 3-D playback needs JavaScript.</noscript>"
        f'<script type="application/json">{script_text(own)}</script></div>'
        f'<ul class="legend">{items}</ul><p class="caption">Drag to turn, right-drag to shift, scroll to come nearer. '
        "The bar below the picture stops, winds and slows down the playback.</p>"
    )
