from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from imitarm.scene import Scene, Sphere
from imitarm.trajectory import Trajectory
from imitarm.viewer import palette, plots
from imitarm.viewer.views import View
from viewer_samples import make_adaptation, make_learning, make_path, make_scene


def text_of(svg: str) -> str:
    return " ".join(" ".join(ElementTree.fromstring(svg).itertext()).split())


def test_demonstrations_shows_every_demonstration_and_component() -> None:
    learning = make_learning()
    svg = plots.demonstrations(learning.demonstrations, learning.means, learning.covariances, learning.predicted)
    assert svg.count(f"stroke: {palette.DEMONSTRATION}") >= 5
    assert svg.count(f"fill: {palette.UNMOVED}") >= 7
    assert "seen from above" in text_of(svg) and "[m]" in text_of(svg)


def test_adaptation_shows_obstacles_paths_and_what_moved() -> None:
    a = make_adaptation()
    svg = plots.adaptation(
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
        "learnt path",
        "adapted path",
        "measured on the robot",
        "tolerance, 2σ",
        "asked distance",
        "box",
        "tin",
    ):
        assert word in words
    assert "component, moved" in words and "component, unmoved" in words
    for colour in (palette.OBSTACLE, palette.LIMIT, palette.MOVED, palette.UNMOVED, palette.NOMINAL, palette.ADAPTED):
        assert colour in svg
    assert len(svg) < 150_000


def test_nothing_is_said_of_obstacles_where_there_are_none() -> None:
    a = make_adaptation(0.0)
    words = text_of(plots.adaptation(a.nominal, a.trajectory, scene=Scene()))
    assert "asked distance" not in words and "moved" not in words


def test_a_path_in_space_shows_the_obstacles_shadow_where_the_path_is() -> None:
    u = np.linspace(0.0, 1.0, 50)
    path = Trajectory(u, np.stack([0.3 + 0.5 * u, 0.0 * u, 0.2 + 0.5 * u], axis=1))
    ball = Scene(None, (Sphere((0.55, 0.02, 0.45), 0.06, name="ball"),))
    svg = plots.adaptation(path, path, scene=ball, clearance=0.03)
    assert "seen from the side" in text_of(svg) and "ball" in text_of(svg)
    far = Scene(None, (Sphere((0.55, 0.9, 0.45), 0.06, name="ball"),))
    assert "ball" not in text_of(plots.adaptation(path, path, scene=far, clearance=0.03))


def test_the_tools_spheres_turn_with_the_tool() -> None:
    half = np.sqrt(0.5)
    turned = np.array([[1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half]])  # a quarter turn about z
    path = Trajectory([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], turned)
    centres, radii = plots._tool_along(path, [[0.1, 0.0, 0.0, 0.03]])
    np.testing.assert_allclose(centres[:, 0], [[0.1, 0.0, 0.0], [1.0, 0.1, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(radii, [0.03])


def test_the_band_is_two_sigma_wide_across_the_path() -> None:
    path = np.stack([np.linspace(0.0, 1.0, 20), np.zeros(20), np.zeros(20)], axis=1)
    band = plots._band(path, np.repeat(np.diag([9e-4, 4e-4, 1.0])[None], 20, axis=0), View(0, 1))
    np.testing.assert_allclose(np.abs(band[:, 1]), 0.04)
    np.testing.assert_allclose(band[:20, 0], path[:, 0])


def test_an_obstacles_hostile_name_stays_text() -> None:
    scene = Scene(None, (Sphere((0.57, 0.0, 0.06), 0.05, name='<script>alert("$x$")</script>'),))
    svg = plots.adaptation(make_path(), make_path(), scene=scene)
    assert "<script" not in svg
    assert '<script>alert("$x$")</script>' in text_of(svg)
    assert not re.search(r"\bhttps?:", svg)
