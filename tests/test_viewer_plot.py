"""``imitarm.plot``: the lines of the figure are the numbers of the object."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

import imitarm
from imitarm import Box, HalfSpace, InputError, Pose, Scene, Skill, Sphere, adapt
from imitarm.viewer.plot import plot
from skill_samples import shown
from viewer_samples import make_path, make_rollout


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def skill() -> Skill:
    return Skill(n_components=6).fit(shown())


def lines(figure: Figure, axes: int, label: str | None = None) -> list[np.ndarray]:
    found = figure.axes[axes].lines
    return [np.array(line.get_data()).T for line in found if label is None or line.get_label() == label]


def has(figure: Figure, axes: int, points: np.ndarray, label: str | None = None) -> bool:
    return any(np.array_equal(line, points) for line in lines(figure, axes, label))


def test_it_is_public() -> None:
    assert imitarm.plot is plot and "plot" in imitarm.__all__


def test_a_trajectory_is_drawn_as_its_path_and_its_coordinates_over_time() -> None:
    path = make_path()
    figure = plot(path)
    assert isinstance(figure, Figure) and len(figure.axes) == 4
    assert has(figure, 0, path.positions[:, [1, 0]])  # the longest axis across
    for axis in range(3):
        assert has(figure, axis + 1, np.column_stack([path.times, path.positions[:, axis]]))
    assert figure.axes[0].get_xlabel() == "y [m]" and figure.axes[3].get_xlabel() == "time [s]"
    assert has(figure, 0, path.positions[:1, [1, 0]], "start") and has(figure, 0, path.positions[-1:, [1, 0]], "end")


def test_demonstrations_are_drawn_from_the_start_of_each() -> None:
    demonstrations = shown()
    figure = plot(demonstrations)
    for demonstration in demonstrations:
        path = demonstration.trajectory
        assert has(figure, 0, path.positions[:, :2])
        assert has(figure, 3, np.column_stack([path.times - path.times[0], path.positions[:, 2]]))
    one = plot(demonstrations[1])
    assert len(lines(one, 1)) == 1 and has(one, 0, demonstrations[1].trajectory.positions[:, :2])


def test_a_skill_is_drawn_with_its_components_and_its_tolerance(skill: Skill) -> None:
    figure = plot(skill)
    times = np.linspace(0.0, skill.duration_, 200)
    path = skill.nominal(times)
    assert has(figure, 0, path.positions[:, :2], "learned path")
    assert has(figure, 0, skill.gmr_.position_means_[:, :2])
    assert len(figure.axes[0].patches) == 6  # an ellipse for each component
    band = figure.axes[1].collections[0].get_paths()[0].vertices
    sigma = np.sqrt(np.einsum("nii->ni", skill.tolerance(times)))[:, 0]
    for edge in (path.positions[:, 0] - 2.0 * sigma, path.positions[:, 0] + 2.0 * sigma):
        distances = np.abs(band[None] - np.column_stack([times, edge])[:, None]).max(axis=2)
        assert distances.min(axis=1).max() < 1e-12


def test_an_adaptation_is_drawn_with_both_paths_and_the_moved_components(skill: Skill) -> None:
    middle = skill.nominal(np.linspace(0.0, skill.duration_, 3)).positions[1]
    adaptation = adapt(skill, Scene(None, [Sphere(middle, 0.03)]), tool_radius=0.01)
    assert adaptation.moved.any()
    figure = plot(adaptation)
    assert has(figure, 0, adaptation.nominal.positions[:, :2], "learned path")
    assert has(figure, 0, adaptation.trajectory.positions[:, :2], "adapted path")
    for axis in range(3):
        path = adaptation.trajectory
        assert has(figure, axis + 1, np.column_stack([path.times, path.positions[:, axis]]))
    arrows = np.array([text.xy for text in figure.axes[0].texts])
    moved = (adaptation.means + adaptation.displacement)[adaptation.moved, :2]
    np.testing.assert_allclose(arrows, moved)


def test_a_rollout_is_drawn_with_clearance_velocities_and_torques() -> None:
    rollout = make_rollout(make_path())
    figure = plot(rollout)
    times = rollout.trajectory.times
    assert has(figure, 0, rollout.trajectory.positions[:, [1, 0]])
    assert has(figure, 1, np.column_stack([times, 1000.0 * rollout.clearance]))
    for joint in range(7):
        assert has(figure, 2, np.column_stack([times, rollout.velocities[:, joint]]), f"joint {joint + 1}")
        assert has(figure, 3, np.column_stack([times, rollout.torques[:, joint]]))
    free = plot(replace(rollout, clearance=np.full(len(times), np.inf)))
    assert not lines(free, 1) and free.axes[1].texts[0].get_text() == "no obstacle"


def test_a_scene_is_drawn_from_above_and_from_the_side() -> None:
    upright = (1.0, 0.0, 0.0, 0.0)
    box = Box(Pose((0.5, -0.2, 0.1), upright), (0.2, 0.1, 0.3), name="box $1$")
    floor = HalfSpace((0.0, 0.0, -0.1), (0.0, 0.0, 1.0))
    figure = plot(Scene(Pose((0.6, 0.1, 0.3), upright), [box], fixtures=[floor]))
    for axes, other in ((0, 1), (1, 2)):
        assert has(figure, axes, np.array([[0.6, (0.6, 0.1, 0.3)[other]]]), "goal")
        (name,) = [text for text in figure.axes[axes].texts if "box" in text.get_text()]
        np.testing.assert_allclose(name.get_position(), [0.5, (0.5, -0.2, 0.1)[other]], atol=0.01)
        filled = [np.concatenate([p.vertices for p in c.get_paths()]) for c in figure.axes[axes].collections]
        size = np.ptp(filled[-1], axis=0)
        np.testing.assert_allclose(size, [0.2, (0.2, 0.1, 0.3)[other]], atol=0.02)
    assert len(figure.axes[0].texts) == 1  # a floor seen from above would cover the whole figure
    assert isinstance(plot(Scene()), Figure)


@pytest.mark.parametrize("thing", [None, 3, "path.csv", [], [1], np.zeros((3, 3)), [make_path()]])
def test_another_type_is_refused_by_name(thing: object) -> None:
    with pytest.raises(InputError, match=f"needs a Trajectory, .* got {type(thing).__name__}"):
        plot(thing)
    assert not pyplot.get_fignums()


def test_a_skill_that_has_not_learned_is_refused_and_leaves_no_figure() -> None:
    with pytest.raises(imitarm.ImitarmError):
        plot(Skill())
    assert not pyplot.get_fignums()


def test_without_matplotlib_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"matplotlib, which is not installed; .*pip install 'imitarm\[report\]'"):
        plot(make_path())


def test_a_notebook_shows_the_figure_once(monkeypatch: pytest.MonkeyPatch) -> None:
    plot(make_path())
    assert len(pyplot.get_fignums()) == 1
    monkeypatch.setattr("matplotlib.get_backend", lambda: "module://matplotlib_inline.backend_inline")
    plot(make_path())
    assert len(pyplot.get_fignums()) == 1
