from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from imitarm.scene import Scene, Sphere
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer import plots
from imitarm.viewer.views import Grid, View


def text_of(svg: str) -> str:
    return " ".join(" ".join(ElementTree.fromstring(svg).itertext()).split())


@pytest.mark.parametrize(
    ("spans", "view"),
    [
        ((0.5, 0.2, 0.0), View(0, 1)),
        ((0.2, 0.8, 0.1), View(1, 0)),
        ((0.6, 0.1, 0.5), View(0, 2)),
        ((0.1, 0.6, 0.5), View(1, 2)),
    ],
)
def test_the_view_shows_the_two_axes_that_matter(spans: tuple[float, float, float], view: View) -> None:
    corners = np.array([[0.0, 0.0, 0.0], spans])
    assert View.best(corners) == view
    assert view.depth not in (view.across, view.up)
    np.testing.assert_array_equal(view.of(corners)[1], [spans[view.across], spans[view.up]])


def test_seen_from_above_x_up_means_y_to_the_left() -> None:
    assert View(1, 0).leftwards and not View(0, 1).leftwards and not View(1, 2).leftwards


def test_the_footprint_is_the_cut_at_the_paths_height() -> None:
    ball = Scene(None, (Sphere((0.0, 0.0, 0.05), 0.05),))
    grid = Grid(View(0, 1), np.linspace(-0.1, 0.1, 161), np.linspace(-0.08, 0.08, 129))
    distance = grid.distance(ball, 0, np.array([0.08]))
    inside = distance < 0.0
    radius = np.hypot(grid.across[None, :], grid.up[:, None])
    assert radius[inside].max() == pytest.approx(0.04, abs=0.002)
    assert radius[~inside].min() == pytest.approx(0.04, abs=0.002)


def test_a_flat_map_is_stretched_and_says_so_only_where_distances_do_not_matter() -> None:
    flat = Trajectory([0.0, 1.0, 2.0], [[0.0, 0.0, 0.0], [0.5, 0.01, 0.0], [1.0, 0.0, 0.0]])
    shown = plots.demonstrations([Demonstration(flat)], np.zeros((1, 3)), 1e-4 * np.eye(3)[None])
    assert re.search(r"seen from above; y is stretched \d\.\d times", text_of(shown))
    assert "stretched" not in text_of(plots.adaptation(flat, flat))
