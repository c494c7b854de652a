"""A picture of a report, for a README or a slide, taken by a Chromium browser that is installed on this machine.

The browser is asked over its DevTools protocol, because 3-D drawings need real time, which its own screenshot option
does not give them.
"""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from imitarm.errors import InputError, TaskFailedError

_BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
_COLOURS: Final = (256, 128, 64, 32)  # fewer and fewer, until the file is small enough
_PATIENCE: Final = 120.0  # [s] for a browser to begin, and for it to answer: drawing without a graphics card is slow
_OPTIONS: Final = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # draws without a graphics card
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--remote-debugging-port=0",
)


def take_picture(
    page: str | Path,
    target: str | Path,
    *,
    anchor: str = "scenes",
    size: tuple[int, int] = (1240, 820),
    seconds: float = 15.0,
    max_bytes: int = 250_000,
    browser: str | None = None,
) -> Path:
    """Open a report in a browser without a window and save what it shows as a PNG file.

    Args:
        page: the report.
        target: the PNG file to write; its folder must exist.
        anchor: the part of the page to show: ``"scenes"``, ``"results"``, ``"learning"`` or a scene's anchor, which is
            behind its link in the table of results.
        size: width and height [pixel].
        seconds: how long to wait for the 3-D playback before the picture is taken [s].
        max_bytes: colours are reduced until the file is not larger.
        browser: the browser's command; None looks for Chromium, Chrome and Edge.

    Returns:
        Where the picture was written, absolute.

    Raises:
        InputError: when the page, the folder or a browser is missing.
        TaskFailedError: when the browser gave no picture, or it can't be made small enough.
    """
    source, picture = Path(page).absolute(), Path(target).absolute()
    if not source.is_file():
        raise InputError(f"picture: there is no page {source}; write the report first")
    if not picture.parent.is_dir():
        raise InputError(f"picture {picture}: there is no folder {picture.parent}; make it first")
    command = next((path for name in ([browser] if browser else _BROWSERS) if (path := shutil.which(name))), None)
    if command is None:
        raise InputError(f"picture: no browser found ({browser or ', '.join(_BROWSERS)}); install Chromium or name one")
    with _browser(command) as ask:
        ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
        ask("Page.navigate", url=f"{source.as_uri()}#{anchor}")
        time.sleep(seconds)
        shot = base64.b64decode(ask("Page.captureScreenshot", format="png")["data"])
    aside = picture.with_name(f".{picture.name}.part")
    aside.write_bytes(_small_enough(shot, max_bytes))
    aside.replace(picture)
    return picture


@contextmanager
def _browser(command: str) -> Iterator[Any]:
    """Run a browser with one page and give a function that asks the page something; end it afterwards."""
    from websockets.exceptions import WebSocketException  # noqa: PLC0415 (comes with viser, an extra)
    from websockets.sync.client import connect  # noqa: PLC0415

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        arguments = [*_OPTIONS, f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen([command, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            with connect(_address(process, Path(profile)), max_size=None, open_timeout=_PATIENCE) as socket:
                yield _Page(socket).ask
        except (OSError, TimeoutError, WebSocketException) as error:
            raise TaskFailedError(f"picture: {command} gave no picture ({error})") from error
        finally:
            process.terminate()
            process.wait(timeout=30.0)


def _address(process: subprocess.Popen[bytes], profile: Path) -> str:
    """Return where the browser listens: it writes its port and path into a file of its profile."""
    told = profile / "DevToolsActivePort"
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end and process.poll() is None:
        lines = told.read_text(encoding="utf-8").split() if told.is_file() else []
        if len(lines) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        time.sleep(0.05)
    raise TimeoutError("it did not begin" if process.poll() is None else f"it ended with status {process.returncode}")


class _Page:
    """One page of a browser, attached to over the browser's own connection."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._number = socket, 0
        self._session: dict[str, str] = {}
        pages = [t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self.ask("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a request and return its answer; what else the browser has to say is left out."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters, **self._session}))
        end = time.monotonic() + _PATIENCE
        while True:
            answer = json.loads(self._socket.recv(timeout=end - time.monotonic()))
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise OSError(f"{method}: {answer['error']['message']}")
                result: dict[str, Any] = answer["result"]
                return result


def _small_enough(shot: bytes, max_bytes: int) -> bytes:
    """Return the picture as PNG, with fewer colours when it is too large."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib, an extra)

    with Image.open(io.BytesIO(shot)) as image:
        full = image.convert("RGB")
    for colours in (None, *_COLOURS):
        file = io.BytesIO()
        (full if colours is None else full.quantize(colours)).save(file, "PNG", optimize=True)
        if file.tell() <= max_bytes:
            return file.getvalue()
    raise TaskFailedError(f"picture: {file.tell()} bytes with {_COLOURS[-1]} colours; ask for a smaller size")
