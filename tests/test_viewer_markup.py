from __future__ import annotations

import json
import math

import pytest

from imitarm.viewer.markup import facts, figure, mark, number, scene_id, script_text


def test_numbers_have_their_unit_and_what_is_not_known_is_a_dash() -> None:
    assert number(math.nan) == number(math.inf) == number(-math.inf) == "–"
    assert number(2.345, 1, "mm") == "2.3\N{NO-BREAK SPACE}mm"
    assert number(-0.5, 2) == "-0.50"


def test_anchors_are_readable_and_unique_by_number() -> None:
    assert scene_id(0, "Two boxes!") == "scene-1-two-boxes"
    assert scene_id(1, "…") == "scene-2-x" != scene_id(2, "…")


@pytest.mark.parametrize("text", ["</script>", "<!-- <script>", "a\u2028b", 'quote " and \\ and \r\n'])
def test_script_text_cant_end_its_element_and_comes_back_whole(text: str) -> None:
    inside = script_text(text)
    assert "<" not in inside and "\r" not in inside
    assert json.loads(inside) == text


def test_text_from_outside_is_escaped_everywhere() -> None:
    evil = '<b>&"'
    for html in (facts({evil: evil}), figure("<svg></svg>", evil, evil), mark(True, evil, ""), mark(False, "", evil)):
        assert "<b>" not in html and "&lt;b&gt;&amp;" in html


def test_no_drawing_is_no_card() -> None:
    assert figure("", "title", "caption") == ""
