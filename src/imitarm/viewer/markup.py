"""Small pieces of HTML; all text from outside is escaped here."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from html import escape
from typing import Any, Final

MM: Final = 1000.0  # [mm/m], and [ms/s]


def number(value: float, digits: int = 1, unit: str = "") -> str:
    """Write a number with its unit; what is not known or endless becomes a dash."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}{chr(0xA0) + unit if unit else ''}"


def mark(good: bool, yes: str, no: str) -> str:
    """Write a word on green when it is good, else another one on red."""
    return f'<span class="mark {"good" if good else "bad"}">{escape("✓ " + yes if good else "✗ " + no)}</span>'


def facts(pairs: Mapping[str, Any]) -> str:
    """Write names with their values."""
    rows = (f"<dt>{escape(str(key))}</dt><dd>{escape(str(value))}</dd>" for key, value in pairs.items())
    return f'<dl class="facts">{"".join(rows)}</dl>'


def figure(svg: str, title: str, caption: str) -> str:
    """Put a drawing on a card; nothing when there is no drawing."""
    if not svg:
        return ""
    return (
        f'<figure class="card"><h3>{escape(title)}</h3>{svg}'
        f'<figcaption class="caption">{escape(caption)}</figcaption></figure>'
    )


def script_text(value: Any) -> str:
    """Return ``value`` as JSON that can stand in a script element: it can't close it, nor open a comment."""
    return json.dumps(value, ensure_ascii=False).replace("<", "\\u003c").replace(">", "\\u003e")


def scene_id(index: int, name: str) -> str:
    """Return the anchor of a scene: unique by its number, readable by its name."""
    return f"scene-{index + 1}-" + (re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "x")
