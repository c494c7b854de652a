from __future__ import annotations

import io
import os
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from imitarm.errors import InputError, TaskFailedError
from take_picture import small_enough, take_picture

FAKE = """
    #!{python}
    # Behaves like a browser as far as it is asked: tells where it listens, answers, shows a red page.
    import base64, io, json, sys, pathlib
    from PIL import Image
    from websockets.sync.server import serve

    profile = pathlib.Path(next(a for a in sys.argv if a.startswith("--user-data-dir=")).partition("=")[2])
    log, size = pathlib.Path({log!r}).open("a"), [10, 10]

    def answer(socket):
        for text in socket:
            ask = json.loads(text)
            method, given = ask["method"], ask["params"]
            print(method, given.get("url", ""), ask.get("sessionId", ""), file=log, flush=True)
            result = {{}}
            if method == "Target.getTargets":
                result = {{"targetInfos": [{{"type": "other", "targetId": "a"}}, {{"type": "page", "targetId": "b"}}]}}
            elif method == "Target.attachToTarget":
                result = {{"sessionId": "session of " + given["targetId"]}}
            elif method == "Emulation.setDeviceMetricsOverride":
                size[:] = given["width"], given["height"]
            elif method == "Page.navigate" and "broken" in given["url"]:
                socket.send(json.dumps({{"id": ask["id"], "error": {{"message": "out of memory"}}}}))
                continue
            elif method == "Page.captureScreenshot":
                picture = io.BytesIO()
                Image.new("RGB", tuple(size), (255, 0, 0)).save(picture, "PNG")
                result = {{"data": base64.b64encode(picture.getvalue()).decode()}}
            socket.send(json.dumps({{"method": "Some.event", "params": {{}}}}))
            socket.send(json.dumps({{"id": ask["id"], "result": result}}))

    with serve(answer, "127.0.0.1", 0) as server:
        port = server.socket.getsockname()[1]
        (profile / "DevToolsActivePort").write_text(f"{{port}}\\n/devtools/browser/x")
        server.serve_forever()
"""


@pytest.fixture
def browser(tmp_path: Path) -> Path:
    command = tmp_path / "browser"
    command.write_text(textwrap.dedent(FAKE).lstrip().format(python=sys.executable, log=str(tmp_path / "log")))
    command.chmod(0o755)
    return command


@pytest.mark.skipif(os.name == "nt", reason="the simulated browser is a Unix script")
def test_the_page_is_opened_at_its_anchor_and_the_picture_saved(tmp_path: Path, browser: Path) -> None:
    page = tmp_path / "a report.html"
    page.write_text("<p>hello</p>")
    target = take_picture(page, tmp_path / "p.png", anchor="results", size=(64, 48), seconds=0.0, browser=str(browser))
    with Image.open(target) as image:
        assert image.size == (64, 48) and image.convert("RGB").getpixel((5, 5)) == (255, 0, 0)
    log = (tmp_path / "log").read_text()
    assert f"Page.navigate {page.as_uri()}#results session of b" in log
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a report.html", "browser", "log", "p.png"]


@pytest.mark.skipif(os.name == "nt", reason="the simulated browser is a Unix script")
def test_a_browser_that_fails_is_reported_and_the_old_picture_stays(tmp_path: Path, browser: Path) -> None:
    page, target = tmp_path / "broken.html", tmp_path / "p.png"
    page.write_text("<p>hello</p>")
    target.write_bytes(b"old")
    with pytest.raises(TaskFailedError, match="out of memory"):
        take_picture(page, target, seconds=0.0, browser=str(browser))
    with pytest.raises(TaskFailedError, match="ended with status 1"):
        take_picture(page, target, seconds=0.0, browser="false")
    assert target.read_bytes() == b"old"


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    with pytest.raises(InputError, match="write the report first"):
        take_picture(page, tmp_path / "p.png")
    page.write_text("x")
    with pytest.raises(InputError, match="there is no folder"):
        take_picture(page, tmp_path / "missing" / "p.png")
    with pytest.raises(InputError, match="no browser found"):
        take_picture(page, tmp_path / "p.png", browser="no-such-browser")


def test_colours_are_reduced_until_the_file_issmall_enough() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "PNG")
    whole = len(small_enough(file.getvalue(), 10**6))
    assert len(small_enough(file.getvalue(), whole - 1)) < whole
    with pytest.raises(TaskFailedError, match="ask for a smaller size"):
        small_enough(file.getvalue(), 100)
