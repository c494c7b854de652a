"""Figures of the thesis are drawn again by the script, and the pages show each of them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from draw_thesis_figures import FIGURES, main
from imitarm.errors import InputError

DOCS = Path(__file__).parents[1] / "docs"
QUICK = ["4.2", "4.3", "4.4", "4.5", "5.2", "5.3", "5.9"]  # without a simulation


def test_the_quick_figures_are_drawn(tmp_path):
    main([str(tmp_path), "--only", *QUICK])
    for number in QUICK:
        path = tmp_path / f"figure_{number.replace('.', '_')}.png"
        pixels = np.asarray(Image.open(path).convert("L"))
        assert path.stat().st_size <= 60_000
        assert pixels.shape[1] > 400 and pixels.std() > 10


def test_the_pages_show_every_figure_and_say_what_made_it():
    page = (DOCS / "chapter_4.md").read_text()
    every = "".join(path.read_text() for path in sorted(DOCS.glob("*.md")))
    shown = re.findall(r"images/figure_(\d_\d)\.png", every)
    assert sorted(number.replace("_", ".") for number in shown) == list(FIGURES)
    assert re.findall(r"^\| (4\.\d) \|", page, re.MULTILINE) == [number for number in FIGURES if number < "5"]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match="create it first"):
        main([str(tmp_path / "nowhere")])
