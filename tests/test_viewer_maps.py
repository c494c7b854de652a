from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from imitarm.scene import Scene, Sphere
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer import maps, palette
from imitarm.viewer.maps import Grid, View
from viewer_samples import make_adaptation, make_learning, make_path, make_scene


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
    ball = Sphere((0.0, 0.0, 0.05), 0.05)
    grid = Grid(View(0, 1), np.linspace(-0.1, 0.1, 161), np.linspace(-0.08, 0.08, 129))
    distance = grid.distance_to(ball, np.array([0.08]))
    inside = distance < 0.0
    radius = np.hypot(grid.across[None, :], grid.up[:, None])
    assert radius[inside].max() == pytest.approx(0.04, abs=0.002)
    assert radius[~inside].min() == pytest.approx(0.04, abs=0.002)


def test_a_flat_map_is_stretched_and_says_so_only_where_distances_do_not_matter() -> None:
    flat = Trajectory([0.0, 1.0, 2.0], [[0.0, 0.0, 0.0], [0.5, 0.01, 0.0], [1.0, 0.0, 0.0]])
    shown = maps.demonstrations([Demonstration(flat)], np.zeros((1, 3)), 1e-4 * np.eye(3)[None])
    assert re.search(r"seen from above; y is stretched \d\.\d times", text_of(shown))
    assert "stretched" not in text_of(maps.adaptation(flat, flat))


def test_demonstrations_shows_every_demonstration_and_component() -> None:
    learning = make_learning()
    svg = maps.demonstrations(learning.demonstrations, learning.means, learning.covariances, learning.predicted)
    assert svg.count(f"stroke: {palette.DEMONSTRATION}") >= 5
    assert svg.count(f"fill: {palette.UNMOVED}") >= 7
    assert "seen from above" in text_of(svg) and "[m]" in text_of(svg)


def test_adaptation_shows_obstacles_paths_and_what_moved() -> None:
    a = make_adaptation()
    svg = maps.adaptation(
        a.nominal,
        a.trajectory,
        scene=make_scene(),
        clearance=0.05,
        tool_spheres=[[0.0, 0.0, 0.0, 0.02]],
        tolerance=a.tolerance,
        means=a.means,
        covariances=a.covariances,
        displacement=a.displacement,
        moved=a.moved,
        measured=a.trajectory,
    )
    words = text_of(svg)
    for word in (
        "learned path",
        "adapted path",
        "measured path",
        "tolerance, 2σ",
        "required clearance",
        "box",
        "tin",
    ):
        assert word in words
    assert "component, moved" in words and "component, not moved" in words
    for colour in (palette.OBSTACLE, palette.LIMIT, palette.MOVED, palette.UNMOVED, palette.NOMINAL, palette.ADAPTED):
        assert colour in svg
    assert len(svg) < 150_000


def test_nothing_is_said_of_obstacles_where_there_are_none() -> None:
    a = make_adaptation(0.0)
    words = text_of(maps.adaptation(a.nominal, a.trajectory, scene=Scene()))
    assert "required clearance" not in words and "moved" not in words


def test_a_path_in_space_shows_the_obstacles_shadow_where_the_path_is() -> None:
    u = np.linspace(0.0, 1.0, 50)
    path = Trajectory(u, np.stack([0.3 + 0.5 * u, 0.0 * u, 0.2 + 0.5 * u], axis=1))
    ball = Scene(None, (Sphere((0.55, 0.02, 0.45), 0.06, name="ball"),))
    svg = maps.adaptation(path, path, scene=ball, clearance=0.03)
    assert "seen from the side" in text_of(svg) and "ball" in text_of(svg)
    far = Scene(None, (Sphere((0.55, 0.9, 0.45), 0.06, name="ball"),))
    assert "ball" not in text_of(maps.adaptation(path, path, scene=far, clearance=0.03))


def test_the_tools_spheres_turn_with_the_tool() -> None:
    half = np.sqrt(0.5)
    turned = np.array([[1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half]])  # a quarter turn about z
    path = Trajectory([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], turned)
    centres, radii = maps._tool_along(path, [[0.1, 0.0, 0.0, 0.03]])
    np.testing.assert_allclose(centres[:, 0], [[0.1, 0.0, 0.0], [1.0, 0.1, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(radii, [0.03])


def test_the_band_is_two_sigma_wide_across_the_path() -> None:
    path = np.stack([np.linspace(0.0, 1.0, 20), np.zeros(20), np.zeros(20)], axis=1)
    band = maps._band(path, np.repeat(np.diag([9e-4, 4e-4, 1.0])[None], 20, axis=0), View(0, 1))
    np.testing.assert_allclose(np.abs(band[:, 1]), 0.04)
    np.testing.assert_allclose(band[:20, 0], path[:, 0])


def test_an_obstacles_hostile_name_stays_text() -> None:
    scene = Scene(None, (Sphere((0.57, 0.0, 0.06), 0.05, name='<script>alert("$x$")</script>'),))
    svg = maps.adaptation(make_path(), make_path(), scene=scene)
    assert "<script" not in svg
    assert '<script>alert("$x$")</script>' in text_of(svg)
    assert not re.search(r"\bhttps?:", svg)
