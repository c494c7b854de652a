from __future__ import annotations

from xml.etree import ElementTree

from imitarm.html_table import html_table


def cells(html: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(html).iter() if element.tag in {"th", "td", "b"}]


def test_a_row_for_each_value_and_none_for_what_is_not_known() -> None:
    html = html_table("Trajectory", {"samples": 12, "task": "", "rotation": None, "duration": "2 s"})
    assert cells(html) == ["Trajectory", "samples", "12", "duration", "2 s"]


def test_a_false_or_zero_value_is_shown() -> None:
    assert cells(html_table("a", {"clearance": 0.0, "success": False})) == ["a", "clearance", "0.0", "success", "False"]


def test_texts_are_escaped() -> None:
    nasty = "<script>alert('x') & \"y\"</script>"
    assert cells(html_table(nasty, {nasty: nasty})) == [nasty] * 3
    assert "<script>" not in html_table(nasty, {nasty: nasty})
