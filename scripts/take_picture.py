"""Take a picture of a report page, for the documentation.

    python scripts/take_picture.py demo/report.html docs/images/report.png --anchor scene-4-boxes-and-cone --seconds 40

A Chromium browser must be installed on this machine. It is controlled by its DevTools protocol, because a 3-D playback
needs real time, and the browser's own screenshot option does not wait.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from imitarm.errors import ImitarmError, InputError, TaskFailedError

_BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
_COLOURS: Final = (256, 128, 64, 32)  # tried in this order until the file is small enough
_PATIENCE: Final = 120.0  # [s] to start a browser, and to answer: drawing without a graphics card is slow
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
    """Open a page in a headless browser and save what it shows as a PNG file.

    Args:
        page: the report.
        target: the PNG file to write; its folder must exist.
        anchor: the part of the page to show: ``"scenes"``, ``"results"``, ``"learning"``, or the anchor of a scene, to
            which the table of results links.
        size: width and height [pixel].
        seconds: how long the 3-D playback runs before the picture is taken [s].
        max_bytes: the number of colours is reduced until the file is not larger.
        browser: the command that starts the browser; None searches for Chromium, Chrome and Edge.

    Returns:
        The absolute path of the picture.

    Raises:
        InputError: when the page, the folder or a browser is missing.
        TaskFailedError: when the browser gives no picture, or the picture cannot be made small enough.
    """
    source, picture = Path(page).absolute(), Path(target).absolute()
    if not source.is_file():
        raise InputError(f"picture: there is no page {source}; write the report first")
    if not picture.parent.is_dir():
        raise InputError(f"picture {picture}: there is no folder {picture.parent}; create it first")
    command = next((path for name in ([browser] if browser else _BROWSERS) if (path := shutil.which(name))), None)
    if command is None:
        raise InputError(f"picture: no browser found ({browser or ', '.join(_BROWSERS)}); install Chromium or name one")
    with _browser(command) as ask:
        ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
        ask("Page.navigate", url=f"{source.as_uri()}#{anchor}")
        time.sleep(seconds)
        shot = base64.b64decode(ask("Page.captureScreenshot", format="png")["data"])
    aside = picture.with_name(f".{picture.name}.part")
    aside.write_bytes(small_enough(shot, max_bytes))
    aside.replace(picture)
    return picture


@contextmanager
def _browser(command: str) -> Iterator[Any]:
    """Run a browser with one page, give a function that sends requests to the page, and end the browser afterwards."""
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

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
    """Return the address at which the browser listens; it writes port and path to a file in its profile."""
    port_file = profile / "DevToolsActivePort"
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end and process.poll() is None:
        lines = port_file.read_text(encoding="utf-8").split() if port_file.is_file() else []
        if len(lines) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        time.sleep(0.05)
    raise TimeoutError("it did not start" if process.poll() is None else f"it ended with status {process.returncode}")


class _Page:
    """One page of a browser."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._number = socket, 0
        self._session: dict[str, str] = {}
        pages = [t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self.ask("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a request and return its answer; other messages of the browser are ignored."""
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


def small_enough(shot: bytes, max_bytes: int) -> bytes:
    """Return the picture as PNG, with fewer colours if it is too large."""
    from PIL import Image

    with Image.open(io.BytesIO(shot)) as image:
        full = image.convert("RGB")
    for colours in (None, *_COLOURS):
        file = io.BytesIO()
        (full if colours is None else full.quantize(colours)).save(file, "PNG", optimize=True)
        if file.tell() <= max_bytes:
            return file.getvalue()
    raise TaskFailedError(f"picture: {file.tell()} bytes with {_COLOURS[-1]} colours; ask for a smaller size")


def main() -> int:
    """Take the picture that the command line asks for."""
    parser = argparse.ArgumentParser(description="Take a picture of a report page.")
    parser.add_argument("page", type=Path)
    parser.add_argument("target", type=Path, help="PNG file")
    parser.add_argument("--anchor", default="scenes", help="part of the page; default: scenes")
    parser.add_argument("--seconds", type=float, default=15.0, help="how long the playback runs first; default: 15")
    arguments = parser.parse_args()
    try:
        print(take_picture(arguments.page, arguments.target, anchor=arguments.anchor, seconds=arguments.seconds))
    except ImitarmError as error:
        sys.stderr.write(f"{parser.prog}: error: {error}\n")
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
