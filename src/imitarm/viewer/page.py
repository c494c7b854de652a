"""A self-contained HTML page: its frame, its look, its 3-D players, and writing it to a file.

The page's own content security policy forbids every outside request, so that the promise to need no network is kept by
the browser too. Each 3-D player is an iframe that is made when it is looked at; what all players have in common is
stored once.
"""

from __future__ import annotations

import base64
import errno
import json
import os
from collections.abc import Callable, Iterable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from imitarm.errors import InputError, TaskFailedError
from imitarm.viewer.markup import script_text

_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; worker-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)


def page_html(title: str, header: str, sections: Iterable[str], players: tuple[str, str] | None = None) -> str:
    """Return a whole page.

    Args:
        title: of the page.
        header: its first part, HTML.
        sections: the others in their order, HTML; empty ones are left out.
        players: what all 3-D players begin and end with, see :func:`shared_players`; None: there are none.
    """
    folder = files("imitarm.viewer")
    style, script = (folder.joinpath(name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    shared = "" if players is None else script_text(list(players))
    body = [
        header,
        "<main>",
        *sections,
        "</main>",
        "<footer>Made by imitarm. This page is complete: it needs no network and sends nothing.</footer>",
        f'<script type="application/json" id="player-shared">{shared}</script>' if shared else "",
        f"<script>{script}</script>",
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n"
        "<script>document.documentElement.classList.add('js')</script>\n"
        f"<style>{style}</style>\n</head>\n<body>\n" + "\n".join(part for part in body if part) + "\n</body>\n</html>\n"
    )


def data_link(data: Mapping[str, Any], name: str) -> str:
    """Return a link under which the page's numbers can be saved.

    Args:
        data: plain values in SI units, ready for JSON.
        name: of the file.
    """
    link = base64.b64encode(json.dumps(data, indent=2, allow_nan=False).encode()).decode()
    return (
        f'<a class="button" download="{escape(name, quote=True)}" href="data:application/json;base64,{link}">'
        "Download the numbers (JSON, SI units)</a>"
    )


def shared_players(pages: Mapping[str, str]) -> tuple[tuple[str, str] | None, dict[str, str]]:
    """Split 3-D pages into what they begin and end with, and what each has of its own.

    The players' code is most of each page; stored once, a page with five players is four fifths smaller.

    Args:
        pages: by name.

    Returns:
        beginning and end, None when there are no pages; and for each name what is between.
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
    """Return the longest text that all ``texts`` begin with (one text begins with all of itself)."""
    low, high = 0, min(map(len, texts))
    while low < high:
        middle = (low + high + 1) // 2
        if all(text.startswith(texts[0][:middle]) for text in texts):
            low = middle
        else:
            high = middle - 1
    return texts[0][:low]


def check_writable(path: str | Path) -> Path:
    """Say at once, before anything is drawn, that a place can't be written to.

    Returns:
        The place, absolute.

    Raises:
        InputError: when it is a folder, or its folder is missing or can't be written.
    """
    target = Path(path).expanduser().absolute()
    if target.is_dir():
        raise InputError(f"report {target}: is a folder; name a file in it, such as {target / 'report.html'}")
    if not target.parent.is_dir():
        raise InputError(f"report {target}: there is no folder {target.parent}; make it first")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"report {target}: the folder may not be written to; choose another one")
    return target


def draw_page(draw: Callable[[], str], path: str | Path) -> Path:
    """Write a report as one HTML file that needs nothing else.

    The place is looked at before anything is drawn. The page is written aside and renamed at the end, so an older
    report stays whole when something goes wrong.

    Args:
        draw: returns the page.
        path: the file to write; its folder must exist.

    Returns:
        Where it was written, absolute.

    Raises:
        InputError: when the folder is missing or can't be written, or the libraries that draw are not installed.
        TaskFailedError: when the disk is full.
    """
    target = check_writable(path)
    write_page(draw(), target)
    return target


def write_page(page: str, target: Path) -> None:
    """Write a page aside and rename it at the end, so that an older one stays whole when something goes wrong.

    Raises:
        TaskFailedError: when the disk is full.
        InputError: when it can't be written for another reason.
    """
    aside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(page.encode("utf-8", "replace"))  # a file name may hold what is no text
        aside.replace(target)
    except OSError as error:
        aside.unlink(missing_ok=True)
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        raise (TaskFailedError if full else InputError)(
            f"report {target}: can't be written ({error.strerror or error}); make room or choose another place"
        ) from error
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
