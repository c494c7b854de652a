from __future__ import annotations

import sys
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.viewer.canvas import INK, canvas, thin, thin_extremes


def draw(name: str, description: str = "a line") -> str:
    with canvas(name, description, (3.0, 2.0)) as drawing:
        axes = drawing.axes(0.5, 0.5, 2.9, 1.9)
        axes.plot([0.0, 1.0], [0.0, 2.0], "o-", label="line", clip_on=True)
        axes.set_xlabel("time [s]")
        drawing.legend(1)
    return drawing.svg


def test_a_drawing_is_one_element_that_follows_the_pages_colour() -> None:
    svg = draw("one")
    root = ElementTree.fromstring(svg)
    assert root.tag == "svg" and root.get("viewBox") and root.get("width") is None
    assert "currentColor" in svg and INK not in svg
    assert "time [s]" in "".join(root.itertext())
    assert "http" not in svg


def test_two_drawings_share_no_id_and_refer_to_their_own() -> None:
    ids = []
    for name in ("first", "second chart"):
        root = ElementTree.fromstring(draw(name))
        own = [element.get("id") for element in root.iter() if element.get("id")]
        assert len(own) == len(set(own))
        used = {element.get("href") for element in root.iter() if element.get("href")}
        assert used and used <= {f"#{i}" for i in own}
        ids += own
    assert len(ids) == len(set(ids))


def test_the_same_input_gives_the_same_drawing() -> None:
    assert draw("x") == draw("x")


def test_a_description_is_escaped() -> None:
    hostile = '"><script>alert(1)</script>'
    assert ElementTree.fromstring(draw("x", hostile)).get("aria-label") == hostile


def test_a_missing_library_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"pip install 'imitarm\[report\]'"):
        draw("x")


def test_settings_of_the_caller_are_left_alone() -> None:
    before = matplotlib.rcParams["font.size"]
    draw("x")
    assert matplotlib.rcParams["font.size"] == before


@given(n=st.integers(1, 3000), most=st.integers(2, 400))
@settings(max_examples=50, deadline=None)
def test_thin_keeps_the_ends_and_the_order(n: int, most: int) -> None:
    kept = thin(n, most)
    assert len(kept) <= max(most, 1) and kept[0] == 0 and kept[-1] == n - 1
    assert np.all(np.diff(kept) > 0)


@given(seed=st.integers(0, 1000), n=st.integers(2, 3000))
@settings(max_examples=50, deadline=None)
def test_thin_extremes_loses_no_peak(seed: int, n: int) -> None:
    values = np.random.default_rng(seed).normal(size=n)
    kept = thin_extremes(values, 100)
    assert len(kept) <= 102
    assert values[kept].min() == values.min() and values[kept].max() == values.max()
