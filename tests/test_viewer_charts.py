from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from imitarm.viewer import charts, palette
from viewer_samples import make_path, make_rollout


def text_of(svg: str) -> str:
    return " ".join(" ".join(ElementTree.fromstring(svg).itertext()).split())


def test_clearance_names_the_smallest_and_the_asked_distance() -> None:
    rollout = make_rollout(make_path(2000), clearance=0.0187)
    svg = charts.clearance(rollout.trajectory.times, rollout.clearance, 0.02)
    words = text_of(svg)
    assert f"smallest: {1000 * rollout.min_clearance:.1f} mm" in words
    assert "required: 20 mm" in words and "time [s]" in words and "[mm]" in words
    assert len(svg) < 40_000  # 2000 samples are thinned


def test_clearance_without_obstacles_is_no_chart() -> None:
    assert charts.clearance([0.0, 1.0], [np.inf, np.inf], 0.02) == ""


def test_a_negative_clearance_is_shown_below_zero() -> None:
    assert "smallest: -12.0 mm" in text_of(charts.clearance([0.0, 1.0, 2.0], [0.1, -0.012, 0.2], 0.02))


def test_torques_show_each_joint_with_its_share_of_the_rated_torque() -> None:
    times = np.linspace(0.0, 2.0, 500)
    values = np.outer(np.sin(times), [40.0, -8.0, 2.0])
    words = text_of(charts.torques(times, values, [80.0, 40.0, 9.0], joint_names=["j0", "$j_1$", "<j2>"]))
    assert "j0: 50 %" in words and "$j_1$: 20 %" in words and "<j2>: 22 %" in words
    assert "torque [N m]" in words and "80" in words


def test_long_names_of_joints_lose_the_part_that_all_share() -> None:
    assert charts.short_names([f"panda_joint{i}" for i in (1, 2)]) == ["joint1", "joint2"]
    assert charts.short_names(["right_j0", "right_j1"]) == ["right_j0", "right_j1"]
    assert charts.short_names(["shoulder_pan_joint", "elbow_joint"]) == ["shoulder_pan_joint", "elbow_joint"]
    assert charts.short_names([]) == []


def test_displacement_says_which_components_stayed() -> None:
    svg = charts.displacement([0.0, 0.031, 0.0002, 0.0], [False, True, True, False])
    assert "31" in text_of(svg) and "<1" in text_of(svg) and "2 of 4 components" in svg
    markers = [use for use in ElementTree.fromstring(svg).iter("use") if palette.UNMOVED in (use.get("style") or "")]
    assert len(markers) == 2 + 1  # and one in the legend
    assert svg.count(f"fill: {palette.MOVED}") == 2 + 1


def test_selection_marks_the_chosen_number_and_bears_missing_values() -> None:
    k = np.arange(2, 8)
    words = text_of(charts.selection(k, -100.0 * k, -90.0 * k, 0.004 / k, 5))
    assert "K = 5" in words and "BIC" in words and "AIC" in words and "[mm]" in words
    assert "K = 3" in text_of(charts.selection([3], [1.0], [2.0], [np.nan], 3))
