from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from imitarm import ArmModel, Scene, Sphere
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError
from imitarm.retarget import RETARGETERS, Correspondence
from imitarm.viewer import retarget_charts
from imitarm.viewer.retarget_report import (
    Measure,
    MethodResult,
    PlainTable,
    RetargetReport,
    retarget_report_html,
    retargeting_frames,
    write_retarget_report,
)
from test_viewer_report import Page
from test_viewer_scene3d import messages

ARM = ArmModel.load("sawyer", tool="gripper")
FOLLOW = Correspondence(orientation="fixed", scale=0.5)
SKELETONS = list(SyntheticSource.from_seed(1, duration=4.0))
RUNS = {name: RETARGETERS[name](ARM, FOLLOW).run(SKELETONS) for name in ("modern", "thesis")}


def make_method(name: str, **changes: object) -> MethodResult:
    measures = (
        Measure("following", 90.0 if name == "modern" else 80.0, "%", 0, "more"),
        Measure("beyond a limit", float(name == "thesis"), "frames", 0, "less", fault=True),
        Measure("unknown", float("nan"), "mm"),
    )
    table = PlainTable("Torques", ("Joint", "Mean"), (("j0", "1.23"),), "By inverse dynamics.")
    return replace(MethodResult(name, name, RUNS[name], measures, [table], ["it stopped for 1 s"]), **changes)


def make_report(*names: str, **changes: object) -> RetargetReport:
    report = RetargetReport(
        "A wave", [make_method(n) for n in names], SKELETONS, FOLLOW, "follows", True, [Measure("lag", 40.0, "ms", 0)]
    )
    return replace(report, provenance={"command": "imitarm retarget x"}, findings=["one gap"], **changes)


@pytest.fixture(scope="module")
def html() -> str:
    return retarget_report_html(make_report("modern", "thesis", scene=Scene(None, [Sphere((0.8, 0.4, 0.2), 0.1)])))


def test_the_page_is_whole_and_asks_nothing_of_the_network(html: str) -> None:
    page = Page(html)
    ids = [a["id"] for _, a in page.elements if a.get("id")]
    assert len(ids) == len(set(ids))
    for tag, attributes in page.elements:
        for key in ("src", "href", "aria-controls", "aria-labelledby"):
            value = attributes.get(key)
            if value is None:
                continue
            if key.startswith("aria") or value.startswith("#"):
                assert value.removeprefix("#") in ids, f"<{tag} {key}={value}>"
            else:
                assert value.startswith("data:")
    policy = next(a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'") and "http" not in policy
    assert [a.get("class") for tag, a in page.elements if tag == "svg"].count("figure") == 1 + 2 * 5


def test_headline_table_players_and_numbers_come_in_this_order(html: str) -> None:
    text = Page(html).text
    places = [
        text.index(words) for words in ("follows", "Measures", "Person and robot", "The recording", "How to reproduce")
    ]
    assert places == sorted(places)
    for words in ("it stopped for 1 s", "one gap", "Torques", "1.23", "imitarm retarget x"):
        assert words in text
    row = re.search(r"<th scope=\"row\">following \[%\]</th>(.*?)</tr>", html)
    assert row and row[1] == "<td><strong>90</strong></td><td>80</td>"  # the best in bold
    row = re.search(r"<th scope=\"row\">beyond a limit \[frames\]</th>(.*?)</tr>", html)
    assert row and "<strong>0</strong>" in row[1] and 'class="mark bad">1<' in row[1]
    row = re.search(r"<th scope=\"row\">unknown \[mm\]</th>(.*?)</tr>", html)
    assert row and row[1] == "<td>–</td><td>–</td>"
    link = re.search(r'download="imitarm-retargeting.json" href="data:application/json;base64,([^"]+)"', html)
    assert link
    data = json.loads(base64.b64decode(link[1]))
    assert [m["name"] for m in data["methods"]] == ["modern", "thesis"]
    assert data["methods"][0]["measures"][2]["value"] is None


def test_each_method_has_a_player_with_the_person_beside_the_robot(html: str) -> None:
    *players, shared = (json.loads(t) for a, t in Page(html).scripts if a.get("type") == "application/json")
    assert len(players) == 2
    _, played = messages(shared[0] + players[0] + shared[1])
    nodes = {m["name"] for t, m in played if "props" in m}
    assert "/person/person head" in nodes and "/paths/path of the tool" in nodes and "/paths/target 1" in nodes
    assert any("obstacle" in name for name in nodes)
    camera = next(m for _, m in played if m["type"] == "SetCameraPositionMessage")
    assert camera["position"][0] > 1.0  # from the front


def test_the_robot_is_where_its_joints_say_and_its_gripper_closes() -> None:
    run = RUNS["modern"]
    closed = np.zeros(len(run.times), bool)
    closed[len(closed) // 2 :] = True
    recording = retargeting_frames(replace(run, closed=closed))
    assert recording.duration == pytest.approx(run.times[-1], abs=0.05)
    hand = recording.model.body("right_hand").id
    for frame in (0, len(recording) // 2, len(recording) - 1):
        q = run.joints[int(np.argmin(np.abs(run.times - recording.times[frame])))]
        np.testing.assert_allclose(recording.positions[frame, hand], ARM.forward_kinematics(q).position, atol=1e-9)
    left, right = (recording.positions[:, recording.model.body(f"tool/{side}_finger").id] for side in ("left", "right"))
    opening = np.linalg.norm(left - right, axis=1)
    assert opening[0] > 0.07 and opening[-1] < 1e-6


def test_the_band_of_states_has_all_of_them() -> None:
    run = RUNS["modern"]
    found = retarget_charts.stretches(run.states)
    assert found[0][0] == 0 and found[-1][1] == len(run.states) - 1
    for (_, end), (start, _) in pairwise(found):
        assert start == end + 1 and run.states[start] != run.states[end]
    svg = retarget_charts.states([("modern", run)])
    assert f"following {100 * np.mean(run.states == 'following'):.0f} %" in svg


def test_an_arm_that_was_never_seen_gives_no_elbow_chart_and_no_target() -> None:
    blind = replace(
        RUNS["modern"],
        elbows=np.full_like(RUNS["modern"].elbows, np.nan),
        targets=tuple(np.full_like(part, np.nan) for part in RUNS["modern"].targets),
    )
    assert retarget_charts.elbow(blind, np.ones((len(blind.times), 3, 3))) == ""
    page = retarget_report_html(make_report("modern", methods=[make_method("modern", run=blind)]))
    assert "Direction of the upper arm" not in page and "Tool and target" in page


def test_hostile_text_stays_text() -> None:
    evil = "</script><script>alert('&')</script><img src=x onerror=alert(1)>\""
    table = PlainTable(evil, (evil, evil), ((evil, evil),), evil)
    method = make_method("modern", title=evil, notes=[evil], caption=evil, tables=[table])
    page = Page(retarget_report_html(make_report("modern", title=evil, methods=[method], verdict=evil, summary=evil)))
    assert not any(tag == "img" or "onerror" in attributes for tag, attributes in page.elements)
    assert len(page.scripts) == 4


def test_what_can_not_be_a_report_is_told() -> None:
    with pytest.raises(InputError, match="at least one method"):
        make_report()
    with pytest.raises(InputError, match="unique"):
        make_report("modern", "modern")
    with pytest.raises(InputError, match="same measures"):
        make_report("modern", methods=[make_method("modern"), make_method("thesis", measures=())])


def test_writing_replaces_an_older_page_and_a_missing_folder_is_told_first(tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    target.write_text("old")
    assert write_retarget_report(make_report("modern"), target) == target
    assert "A wave" in target.read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    with pytest.raises(InputError, match="no folder"):
        write_retarget_report(make_report("modern"), tmp_path / "nowhere" / "page.html")
