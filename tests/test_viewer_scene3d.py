from __future__ import annotations

import base64
import re
import socket
import sys
import threading
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

from imitarm.errors import InputError, TaskFailedError
from imitarm.viewer import Camera, ComponentMark, PathMark, playback_html
from imitarm.viewer.recording import Prediction
from viewer_samples import make_path, make_recording


def messages(page: str) -> tuple[float, list[tuple[float, dict[str, Any]]]]:
    """The duration [s] and the timed messages that a page plays."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    data = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=int.from_bytes(data[:8], "little"))
    played = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    return played["durationSeconds"], played["messages"]


@pytest.fixture(scope="module")
def page() -> str:
    path = make_path()
    marks = [ComponentMark("a/b", path.positions[50], np.diag([4e-4, 1e-3, 1e-9]), "#d55e00")]
    return playback_html(
        make_recording(seconds=2.0, crumbs=24), paths=[PathMark("learnt", path.positions)], components=marks
    )


def test_every_frame_of_the_recording_is_played_at_its_time(page: str) -> None:
    duration, played = messages(page)
    assert duration == pytest.approx(2.0 + 1.5)
    turned = {t for t, m in played if m["type"] == "SetOrientationMessage" and t > 0.0}
    assert len(turned) == 50
    np.testing.assert_allclose(sorted(turned), 0.04 * np.arange(1, 51), atol=1e-9)


def test_only_what_moves_is_sent_again(page: str) -> None:
    _, played = messages(page)
    moved = {m["name"] for t, m in played if t > 0.0 and m["type"] in ("SetPositionMessage", "SetOrientationMessage")}
    assert moved and not any("box" in name or "cone" in name or "world" in name for name in moved)
    batched = [m for t, m in played if t > 0.0 and m["type"] == "SceneNodeUpdateMessage"]
    assert {name for m in batched for name in m["updates"]} == {"batched_positions"}  # the crumb slides, none turns


def test_bodies_paths_and_components_are_drawn(page: str) -> None:
    _, played = messages(page)
    nodes = {m["name"]: m for t, m in played if "props" in m}
    assert any(name.endswith(" link|0/0") for name in nodes)  # a slash in a body's name makes no child
    assert "/paths/learnt" in nodes
    assert nodes["/components/a|b"]["props"]["opacity"] < 1.0
    sizes = nodes["/components/a|b"]["props"]["scale"]
    np.testing.assert_allclose(sorted(sizes), [1e-3, np.sqrt(7.815 * 4e-4), np.sqrt(7.815 * 1e-3)], rtol=1e-3)
    meshes = [
        m["props"]["color"] for name, m in nodes.items() if name.startswith("/bodies/") and m["type"] == "MeshMessage"
    ]
    assert len(meshes) == 2 * 7 + 1 + 6  # links and joints, brush, furniture and obstacles; the crumbs are a batch
    assert not any(red == blue and green == 0 for red, green, blue in meshes)  # the collision geoms are magenta


def test_predicted_obstacles_are_drawn_while_they_are_tracked() -> None:
    recording = make_recording(seconds=0.4)
    n = len(recording)
    positions = np.linspace([0.0, 0.0, 0.5], [0.5, 0.0, 0.5], n)
    positions[:2] = np.nan
    covariances = np.linspace(1e-4, 4e-4, n)[:, None, None] * np.eye(3)
    ball = Prediction("ball", positions, covariances, np.full(3, 0.1))
    _, played = messages(playback_html(replace(recording, predictions=(ball,))))
    node = next(m for _, m in played if m.get("name") == "/predictions/0 ball" and "props" in m)
    np.testing.assert_allclose(node["props"]["scale"], 0.1 + np.sqrt(7.815e-4), atol=1e-3)
    about = [(t, m) for t, m in played if m.get("name") == "/predictions/0 ball"]
    shown = [(t, m["visible"]) for t, m in about if m["type"] == "SetSceneNodeVisibilityMessage"]
    assert shown[-1][1] and shown[-1][0] == pytest.approx(recording.times[2])
    assert len({t for t, m in about if m["type"] == "SetPositionMessage"}) >= n - 3
    scales = [m["updates"]["scale"] for _, m in about if m["type"] == "SceneNodeUpdateMessage"]
    np.testing.assert_allclose(scales[-1], 0.1 + np.sqrt(7.815 * 4e-4), atol=1e-3)


def test_the_page_asks_nothing_of_the_network(page: str) -> None:
    shell = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", shell)


def test_a_given_camera_is_used() -> None:
    camera = Camera((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), 0.5)
    duration, played = messages(playback_html(make_recording(seconds=0.0), camera=camera, dark=True))
    assert duration == 0.0  # one frame is a still picture
    found = {m["type"]: m for _, m in played}
    assert list(found["SetCameraPositionMessage"]["position"]) == [1.0, 2.0, 3.0]
    assert list(found["SetCameraLookAtMessage"]["look_at"]) == [0.1, 0.2, 0.3]


def test_nothing_is_printed_and_nothing_keeps_running(capsys: pytest.CaptureFixture[str]) -> None:
    before = {thread.name for thread in threading.enumerate()}
    playback_html(make_recording(seconds=0.0))
    assert capsys.readouterr().out == ""
    left = [t for t in threading.enumerate() if t.name not in before and "ThreadPool" not in t.name]
    assert not left


def test_a_missing_library_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'imitarm\[report\]'"):
        playback_html(make_recording(seconds=0.0))


def test_a_machine_without_ports_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> socket.socket:
        raise OSError("not permitted")

    monkeypatch.setattr(socket, "create_server", refuse)
    with pytest.raises(TaskFailedError, match=r"cannot open a port on 127\.0\.0\.1"):
        playback_html(make_recording(seconds=0.0))
