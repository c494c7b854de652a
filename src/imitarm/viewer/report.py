"""One self-contained HTML page that tells what a run did: it opens offline and asks nothing of any network.

The page's own content security policy forbids every outside request, so that the promise is kept by the browser too.
The headline comes first, then the table, then everything else. Each scene's 3-D player is an iframe that is made when
its tab is looked at; what all players have in common is stored once.
"""

from __future__ import annotations

import base64
import errno
import json
import os
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np

from imitarm.errors import InputError, TaskFailedError
from imitarm.viewer import palette
from imitarm.viewer.background import learning_section, provenance_section
from imitarm.viewer.content import Report, SceneResult
from imitarm.viewer.data import as_data
from imitarm.viewer.markup import script_text
from imitarm.viewer.scene3d import ComponentMark, PathMark, playback_html
from imitarm.viewer.scene_sections import scenes_section
from imitarm.viewer.sections import header, table_section

_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; worker-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)


def write_report(report: Report, path: str | Path) -> Path:
    """Write a report as one HTML file that needs nothing else.

    The page is written aside and renamed at the end, so an older report stays whole when something goes wrong.

    Args:
        report: what to tell.
        path: the file to write; its folder must exist.

    Returns:
        Where it was written, absolute.

    Raises:
        InputError: when the folder is missing or can't be written, or the libraries that draw are not installed.
        TaskFailedError: when the disk is full.
    """
    target = Path(path).expanduser().absolute()
    _check_writable(target)
    page = report_html(report)
    try:
        _replace(target, page)
    except OSError as error:
        full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        raise (TaskFailedError if full else InputError)(
            f"report {target}: can't be written ({error.strerror or error}); make room or choose another place"
        ) from error
    return target


def report_html(report: Report) -> str:
    """Return the whole page.

    Args:
        report: what to tell.

    Raises:
        InputError: when the libraries that draw are not installed.
    """
    head, middles, tail = _shared(
        {scene.name: _playback(scene) for scene in report.scenes if scene.recording is not None}
    )
    data = json.dumps(as_data(report), indent=2, allow_nan=False).encode()
    link = base64.b64encode(data).decode()
    download = (
        f'<a class="button" download="imitarm-report.json" href="data:application/json;base64,{link}">'
        "Download the numbers (JSON, SI units)</a>"
    )
    folder = files("imitarm.viewer")
    style, script = (folder.joinpath(name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    body = [
        header(report),
        "<main>",
        table_section(report, download),
        scenes_section(report, middles),
        learning_section(report.learning) if report.learning is not None else "",
        provenance_section(report),
        "</main>",
        "<footer>Made by imitarm. This page is complete: it needs no network and sends nothing.</footer>",
        f'<script type="application/json" id="player-shared">{script_text([head, tail])}</script>' if middles else "",
        f"<script>{script}</script>",
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}</title>\n"
        "<script>document.documentElement.classList.add('js')</script>\n"
        f"<style>{style}</style>\n</head>\n<body>\n" + "\n".join(part for part in body if part) + "\n</body>\n</html>\n"
    )


def _playback(scene: SceneResult) -> str:
    """Return the 3-D page of a scene: its recording with the paths and the components around it."""
    assert scene.recording is not None
    paths, components = [], []
    if scene.adaptation is not None:
        a = scene.adaptation
        paths += [
            PathMark("learnt path", a.nominal.positions, palette.NOMINAL, 0.004),
            PathMark("adapted path", a.trajectory.positions, palette.ADAPTED, 0.006),
        ]
        for k, moved in enumerate(a.moved):
            name, mean = f"component {k + 1}", a.means[k] + a.displacement[k]
            components.append(ComponentMark(name, mean, a.covariances[k], palette.MOVED if moved else palette.UNMOVED))
    if scene.rollout is not None:
        lifted = scene.rollout.trajectory.positions + np.array(
            [0.0, 0.0, 0.004]
        )  # [m] or two equal lines would flicker
        paths.append(PathMark("measured path", lifted, palette.MEASURED, 0.003))
    return playback_html(scene.recording, paths=paths, components=components)


def _shared(pages: dict[str, str]) -> tuple[str, dict[str, str], str]:
    """Split pages into what they begin with, what each has of its own, and what they end with.

    The players' code is most of each page; stored once, a page for five scenes is four fifths smaller.
    """
    if not pages:
        return "", {}, ""
    texts = list(pages.values())
    head = _common_start(texts)
    rest = [text[len(head) :] for text in texts]
    tail = _common_start([text[::-1] for text in rest])[::-1]
    own = (text[: len(text) - len(tail)] for text in rest)
    return head, dict(zip(pages, own, strict=True)), tail


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


def _check_writable(target: Path) -> None:
    """Say at once, before anything is drawn, that a place can't be written to."""
    if target.is_dir():
        raise InputError(f"report {target}: is a folder; name a file in it, such as {target / 'report.html'}")
    if not target.parent.is_dir():
        raise InputError(f"report {target}: there is no folder {target.parent}; make it first")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"report {target}: the folder may not be written to; choose another one")


def _replace(target: Path, text: str) -> None:
    """Write ``text`` beside ``target`` and rename it at the end; nothing is left behind when that fails."""
    aside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(text.encode("utf-8", "replace"))  # a file name may hold what is no text
        aside.replace(target)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
