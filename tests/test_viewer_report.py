from __future__ import annotations

import base64
import json
import math
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.demonstrations import Finding
from imitarm.errors import InputError, TaskFailedError
from imitarm.scene import Scene, Sphere
from imitarm.viewer import Report, report, report_html, write_report
from imitarm.viewer.recording import Prediction
from viewer_samples import make_learning, make_recording, make_report, make_result

VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """Reads a page and notes its elements, ids, text and scripts; raises when tags are not balanced."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] = (self.scripts[-1][0], self.scripts[-1][1] + data)
        elif not self.open or self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def html() -> str:
    return report_html(make_report(recording=make_recording(seconds=0.4), scenes=2))


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_the_page_is_well_formed_and_ids_are_unique(page: Page) -> None:
    ids = [a["id"] for _, a in page.elements if a.get("id")]
    assert len(ids) == len(set(ids)) > 100
    tags = [tag for tag, _ in page.elements]
    assert [tags.count(tag) for tag in ("html", "head", "body", "main", "header", "h1", "title")] == [1] * 7
    for _, attributes in page.elements:  # every reference within the page has its target
        for key in ("href", "aria-controls", "aria-labelledby"):
            target = attributes.get(key) or ""
            if key != "href" or target.startswith("#"):
                assert not target or target.removeprefix("#") in ids


def test_nothing_outside_is_asked_for_and_the_browser_enforces_it(html: str, page: Page) -> None:
    for tag, attributes in page.elements:
        for key in ("src", "href", "data", "action", "poster", "srcset", "xlink:href"):
            value = attributes.get(key)
            assert value is None or value.startswith(("#", "data:")), f"<{tag} {key}={value[:60]!r}>"
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)
    assert style and "url(" not in style[1] and "@import" not in style[1]
    policy = next(a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'") and "http" not in policy


def test_the_headline_comes_first_then_the_table_then_the_scenes(page: Page) -> None:
    text = page.text
    places = [
        text.index(words)
        for words in ("2 of 2 scenes", "Results", "Scene by scene", "What was learned", "How to reproduce")
    ]
    assert places == sorted(places)


def test_every_figure_and_number_is_there(page: Page) -> None:
    assert [a.get("class") for tag, a in page.elements if tag == "svg"].count("figure") == 2 + 2 * 4 + 2 + 0
    for words in ("22.0", "31.2", "4 of 7", "57 %", "1.34", "6 of 6", "imitarm demo --seed 0", "numpy", "Seed"):
        assert words in page.text.replace("\N{NO-BREAK SPACE}", " ")
    for words in (
        "the arm stands still for 0.31 s",
        "Align cuts it off",
        "Alignment in time",
        "stretched in time to 4.00 s",
    ):
        assert words in page.text


def test_each_scene_has_a_player_and_their_common_code_is_stored_once(html: str, page: Page) -> None:
    players = [text for attributes, text in page.scripts if attributes.get("type") == "application/json"]
    head, tail = json.loads(players.pop())
    assert len(players) == 3
    for own in players:
        whole = head + json.loads(own) + tail
        assert whole.startswith("<!doctype html>") and whole.rstrip().endswith("</html>")
        assert whole.count("__VISER_EMBED_DATA__=") == 1
    assert len(html) < len(head) + 1_000_000


def test_one_scene_alone_has_a_whole_player() -> None:
    page = Page(report_html(Report("x", [make_result(recording=make_recording(seconds=0.0))])))
    own, shared = (json.loads(t) for a, t in page.scripts if a.get("type") == "application/json")
    assert (shared[0] + own + shared[1]).count("__VISER_EMBED_DATA__=") == 1


def test_the_numbers_can_be_taken_along(page: Page) -> None:
    link = next(a["href"] for _, a in page.elements if a.get("download"))
    assert link is not None
    data = json.loads(base64.b64decode(link.removeprefix("data:application/json;base64,")))
    assert [scene["name"] for scene in data["scenes"]] == ["free", "scene 1", "scene 2"]


def test_hostile_text_stays_text() -> None:
    evil = "</script><script>alert('&')</script><img src=x onerror=alert(1)>\""
    base = make_learning()
    learning = replace(
        base,
        findings=[Finding("error", "gap", evil, evil, 3, remedy=evil)],
        details={evil: evil},
        alignment=replace(base.alignment, method=evil),
    )
    result = make_result(
        evil,
        reason=evil,
        caption=evil,
        details={evil: evil},
        joint_names=(evil,) * 7,
        scene=Scene(None, (Sphere((0.57, 0.0, 0.06), 0.05, name=evil),)),
        recording=make_recording(seconds=0.0),
    )
    page = Page(report_html(Report(evil, [result], evil, learning, {evil: evil, "more": {evil: evil}})))
    assert not any(tag == "img" or "onerror" in attributes for tag, attributes in page.elements)
    assert len(page.scripts) == 4  # js mark, one player, what players share, the page's own
    assert page.text.count("alert('&')") > 20


def test_an_undrawable_report_still_tells() -> None:
    refused = make_result(
        "refused", success=False, rollout=None, adaptation=None, rmse=math.nan, reason="box 1 covers the goal"
    )
    page = Page(report_html(Report("x", [refused])))
    assert "✗ not done" in page.text and "Box 1 covers the goal." in page.text
    assert "–" in page.text
    assert "no scene was run" in Page(report_html(Report("x", []))).text


def test_writing_replaces_the_old_report_and_leaves_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    target.write_text("old")
    assert write_report(Report("New one", [make_result()]), target) == target
    assert "New one" in target.read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_old_report_stays_when_writing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "report.html"
    target.write_text("old")

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(TaskFailedError, match="No space left on device"):
        write_report(Report("x", []), target)
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_a_place_that_cant_be_written_is_told_before_anything_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "report_html", lambda _: pytest.fail("drawn in vain"))
    with pytest.raises(InputError, match="there is no folder"):
        write_report(Report("x", []), tmp_path / "missing" / "report.html")
    with pytest.raises(InputError, match="is a folder"):
        write_report(Report("x", []), tmp_path)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match="no permission to write"):
        write_report(Report("x", []), tmp_path / "report.html")


def test_names_that_are_no_text_do_not_stop_the_report(tmp_path: Path) -> None:
    name = os.fsdecode(b"sweep_\xff.csv")  # a file name that is not UTF-8
    learning = replace(make_learning(), findings=[Finding("note", "idle", "rests", name)])
    target = write_report(Report("x", [], learning=learning), tmp_path / "report.html")
    assert "sweep_?.csv" in target.read_text(encoding="utf-8")


def test_a_plan_of_the_whole_arm_is_not_described_as_one_sphere() -> None:
    result, arm = replace(make_result(), tool_radius=0.058, tool_spheres=None), ArmModel.load("sawyer")
    assert "one sphere" in Page(report_html(replace(make_report(scenes=1), scenes=[result]))).text
    object.__setattr__(result.adaptation, "arm_plan", SimpleNamespace(path=SimpleNamespace(arm=arm)))
    text = Page(report_html(replace(make_report(scenes=1), scenes=[result]))).text
    assert "one sphere" not in text
    assert f"{len(arm.cover.radii)} spheres, which contain every moving part of the arm" in text


def test_the_legend_names_only_what_is_drawn() -> None:
    recording = make_recording(seconds=0.2)
    planned = {key.label for key in report._keys(make_result(recording=recording))}
    assert "adapted path" in planned and not any("predicted" in label for label in planned)
    n = len(recording)
    ball = Prediction("ball", np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(3, 0.1))
    tracked = make_result(recording=replace(recording, predictions=(ball,)), adaptation=None)
    seen = {key.label for key in report._keys(tracked)}
    assert any("predicted" in label for label in seen) and {"learned path", "measured path of the tool"} < seen
    assert not any("component" in label or "adapted" in label for label in seen)
