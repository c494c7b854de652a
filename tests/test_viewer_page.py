from __future__ import annotations

import json
import math
import sys

import pytest

from imitarm.errors import InputError
from imitarm.viewer import page
from imitarm.viewer.page import Figure, Header, Tile, anchor, number, render, script_text
from test_viewer_report import Page


def rendered(**changes: object) -> str:
    values: dict[str, object] = {
        "data": {},
        "data_name": "x.json",
        "provenance": {},
        "words": {},
        "figures": [],
        "tables": [],
        "players": [],
    }
    return render("mapping.html", Header("title", "verdict", good=True), **(values | changes))  # type: ignore[arg-type]


def test_numbers_have_their_unit_and_unknown_ones_are_a_dash() -> None:
    assert number(math.nan) == number(math.inf) == number(-math.inf) == "–"
    assert number(2.345, 1, "mm") == "2.3\N{NO-BREAK SPACE}mm"
    assert number(-0.5, 2) == "-0.50"


def test_anchors_are_readable_and_unique_by_number() -> None:
    assert anchor("scene", 0, "Two boxes!") == "scene-1-two-boxes"
    assert anchor("scene", 1, "…") == "scene-2-x" != anchor("scene", 2, "…")


@pytest.mark.parametrize("text", ["</script>", "<!-- <script>", "a\u2028b", 'quote " and \\ and \r\n'])
def test_script_text_cannot_end_its_element_and_comes_back_whole(text: str) -> None:
    inside = script_text(text)
    assert "<" not in inside and "\r" not in inside
    assert json.loads(inside) == text
    scripts = Page(rendered(shared=(text, text))).scripts
    assert [json.loads(body) for kind, body in scripts if kind.get("type") == "application/json"] == [[text, text]]


def test_text_from_outside_is_escaped_everywhere() -> None:
    evil = '<b>&"'
    table = {"title": evil, "note": evil, "columns": [{"title": evil, "kind": ""}] * 2, "rows": [(evil, evil)]}
    html = rendered(
        data_name=evil,
        provenance={evil: evil, "more": {evil: evil}},
        words={evil: evil},
        figures=[Figure("<svg></svg>", evil, evil)],
        tables=[table],
    )
    head = render(
        "mapping.html",
        Header(evil, evil, good=False, summary=evil, tiles=[Tile(evil, evil, evil)]),
        **{key: {} for key in ("data", "provenance", "words", "figures", "tables", "players")},
        data_name="x",
    )
    for text, times in ((html, 15), (head, 7)):
        assert "<b>" not in text and text.count("&lt;b&gt;&amp;") == times


def test_a_figure_without_a_drawing_is_left_out() -> None:
    assert "a title" not in rendered(figures=[Figure("", "a title", "a caption")])
    assert "a title" in rendered(figures=[Figure("<svg></svg>", "a title", "a caption")])


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    page._environment.cache_clear()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(InputError, match=r"jinja2, which is not installed; .*imitarm\[report\]"):
        rendered()
