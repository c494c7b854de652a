"""Self-contained HTML pages: the data that the templates show, the 3-D players, and writing the file.

The templates are in ``templates/``. Jinja escapes every text in a page. The content security policy of the page forbids
every network request, so the browser itself ensures that the page works offline. Each 3-D player is an iframe that is
created when the reader scrolls to it. The code that all players share is stored once.
"""

from __future__ import annotations

import base64
import errno
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from imitarm.errors import InputError, TaskFailedError

MM: Final = 1000.0  # [mm/m], and [ms/s]


@dataclass(frozen=True)
class Tile:
    """A number in the header of a page: its ``value`` as text, its ``unit``, and its meaning (``label``)."""

    value: str
    unit: str
    label: str


@dataclass(frozen=True)
class Header:
    """The header of a page: title, verdict, summary and the most important numbers.

    Attributes:
        title: title of the page.
        verdict: the result in one line.
        good: whether the result is good (green) or not (red).
        summary: one or two sentences; may be empty.
        tiles: the most important numbers.
    """

    title: str
    verdict: str
    good: bool
    summary: str = ""
    tiles: Sequence[Tile] = ()


@dataclass(frozen=True)
class Figure:
    """A drawing (``svg``) with ``title`` and ``caption``. If ``svg`` is empty, the page does not show the figure."""

    svg: str
    title: str
    caption: str


@dataclass(frozen=True)
class Key:
    """One entry of a player's legend: the ``colour`` of a line, or of an ellipsoid (``blob``), and its ``label``."""

    colour: str
    label: str
    blob: bool = False


@dataclass(frozen=True)
class Player:
    """A 3-D player.

    Attributes:
        title: title for screen readers.
        own: the part of the 3-D page that differs from the other players' pages; see :func:`shared_players`.
        keys: entries of the player's legend.
    """

    title: str
    own: str
    keys: Sequence[Key]


@dataclass(frozen=True)
class Tab:
    """One tab: ``anchor`` (unique in the page), ``title``, and ``content`` for the template."""

    anchor: str
    title: str
    content: Any


def render(
    template: str,
    header: Header,
    *,
    data: Mapping[str, Any],
    data_name: str,
    provenance: Mapping[str, Any],
    words: Mapping[str, str],
    shared: tuple[str, str] | None = None,
    **context: Any,
) -> str:
    """Return a whole page.

    Args:
        template: file in ``templates/`` that extends ``page.html``.
        header: header of the page.
        data: the numbers on the page in SI units, ready for JSON; a button on the page saves them.
        data_name: file name under which the browser saves ``data``.
        provenance: facts that are needed to repeat the run, by name; a value that is a mapping becomes a separate card.
        words: technical terms on the page, with their explanations.
        shared: the code that all 3-D players share, see :func:`shared_players`; None without players.
        context: further variables of the template.

    Raises:
        InputError: when jinja2 is not installed.
    """
    numbers = base64.b64encode(json.dumps(data, indent=2, allow_nan=False).encode()).decode()
    page: str = (
        _environment()
        .get_template(template)
        .render(
            header=header,
            data=numbers,
            data_name=data_name,
            provenance=provenance,
            words=words,
            shared=shared,
            **context,
        )
    )
    return page


@cache
def _environment() -> Any:
    """Return Jinja's environment with the templates of this package."""
    try:
        import jinja2  # noqa: PLC0415 (an extra)
        from markupsafe import Markup  # noqa: PLC0415 (comes with jinja2)
    except ImportError as error:
        raise InputError(
            "reports need jinja2, which is not installed; install it with: pip install 'imitarm[report]'"
        ) from error
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("imitarm.viewer"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["script_text"] = lambda value: Markup(script_text(value))
    return environment


def number(value: float, digits: int = 1, unit: str = "") -> str:
    """Return a number with its unit; NaN and infinity become a dash."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}{chr(0xA0) + unit if unit else ''}"


def script_text(value: Any) -> str:
    """Return ``value`` as JSON for a script element; no text in it can close the element or open a comment."""
    return json.dumps(value, ensure_ascii=False).replace("<", "\\u003c").replace(">", "\\u003e")


def anchor(kind: str, index: int, name: str) -> str:
    """Return an anchor for links, made unique by a number and readable by a name."""
    return f"{kind}-{index + 1}-" + (re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "x")


def shared_players(pages: Mapping[str, str]) -> tuple[tuple[str, str] | None, dict[str, str]]:
    """Split 3-D pages into a beginning and an end that all pages share, and a middle part for each page.

    Most of each 3-D page is the code of the player. Storing this code only once makes a report with five players five
    times smaller.

    Args:
        pages: 3-D pages by name.

    Returns:
        A pair: the shared beginning and end (None when there are no pages), and the middle part of each page by name.
    """
    if not pages:
        return None, {}
    texts = list(pages.values())
    head = _common_start(texts)
    rest = [text[len(head) :] for text in texts]
    tail = _common_start([text[::-1] for text in rest])[::-1]
    own = (text[: len(text) - len(tail)] for text in rest)
    return (head, tail), dict(zip(pages, own, strict=True))


def _common_start(texts: list[str]) -> str:
    """Return the longest common beginning of all ``texts``."""
    low, high = 0, min(map(len, texts))
    while low < high:
        middle = (low + high + 1) // 2
        if all(text.startswith(texts[0][:middle]) for text in texts):
            low = middle
        else:
            high = middle - 1
    return texts[0][:low]


def check_writable(path: str | Path) -> Path:
    """Check that a page can be written to a path, before time is spent on drawing the page.

    Returns:
        The absolute path.

    Raises:
        InputError: when the path is a folder, or its folder is missing or cannot be written to.
    """
    target = Path(path).expanduser().absolute()
    if target.is_dir():
        raise InputError(f"report {target}: is a folder; name a file in this folder, such as {target / 'report.html'}")
    if not target.parent.is_dir():
        raise InputError(f"report {target}: there is no folder {target.parent}; create it first")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"report {target}: no permission to write to the folder; choose another folder")
    return target


def draw_page(draw: Callable[[], str], path: str | Path) -> Path:
    """Write a page as one HTML file that needs no other file.

    The path is checked before anything is drawn. If writing fails, an older page at this path stays intact.

    Args:
        draw: function that returns the page.
        path: path of the file to write; its folder must exist.

    Returns:
        The absolute path of the file.

    Raises:
        InputError: when the file cannot be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    target = check_writable(path)
    page = draw().encode("utf-8", "replace")  # a file name in the page may hold bytes that are not UTF-8
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        part.write_bytes(page)
        part.replace(target)
    except OSError as error:
        part.unlink(missing_ok=True)
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        raise (TaskFailedError if full else InputError)(
            f"report {target}: cannot be written ({error.strerror or error}); free some space or choose another path"
        ) from error
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return target
