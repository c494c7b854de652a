"""The benchmark of perception: seeded scenes with a known truth, and measures that tell good from bad."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.perception import Frame, Seen, run_frame, run_frames, tables
from imitarm.benchmark.perception_scenes import FAMILIES, SHAPES, images, make_object, make_scene
from imitarm.cli import main
from imitarm.errors import InputError, UnknownNameError
from imitarm.perception import DepthNoise

EXACT = DepthNoise.none()


@pytest.mark.parametrize("family", FAMILIES)
def test_the_same_seed_gives_the_same_scene_and_image(family):
    first, second = (make_scene(family, 4) for _ in range(2))
    np.testing.assert_array_equal(first.camera_to_base.position, second.camera_to_base.position)
    assert len(first.obstacles) == {"one object": 1, "empty": 0}.get(family, 2)
    for a, b in zip(first.obstacles, second.obstacles, strict=True):
        np.testing.assert_array_equal(a.bounds(), b.bounds())
        assert a.bounds()[0, 2] >= 0.0  # not inside the table
    one, two = images(first, DepthNoise(), 24), images(second, DepthNoise(), 24)
    np.testing.assert_array_equal(one[1].depth, two[1].depth)
    assert np.nanmin(one[0].depth) >= 0.5


def test_families_are_what_they_say():
    for seed in range(12):
        held, touching = make_scene("held bottle", seed), make_scene("in contact", seed)
        bottle, arm = held.obstacles
        assert abs(bottle.signed_distance(arm.start)) < 0.02
        first, second = touching.obstacles
        gap = first.signed_distance(second.support(np.random.default_rng(0).normal(size=(3000, 3)))).min()
        assert -0.01 < gap < 0.06
    hidden = make_scene("half hidden", 8)
    exact = images(hidden, EXACT, 60)[0]
    assert (np.abs(hidden.obstacles[1].signed_distance(exact.points())) < 1e-4).sum() > 10
    assert {make_scene("one object", seed).shape for seed in range(7)} == set(SHAPES)
    assert {make_scene("one object", seed).distance for seed in range(0, 21, 7)} == {1.0, 2.0, 3.0}


def test_unknown_families_and_seeds_are_refused():
    with pytest.raises(UnknownNameError, match="family"):
        make_scene("two objects", 0)
    with pytest.raises(InputError, match="seed"):
        make_scene("empty", -1)
    with pytest.raises(UnknownNameError, match="shape"):
        make_object("torus", np.random.default_rng(0))


def test_a_sphere_in_an_exact_image_is_found_and_an_empty_table_has_none():
    frame = run_frame("one object", 0, noise=EXACT)
    (one,) = frame.seen
    assert one.shape == "sphere"
    assert one.right_shape
    assert one.error < 0.002
    assert one.uncovered == 0.0
    assert not one.missed
    assert frame.false == 0
    empty = run_frame("empty", 3, noise=DepthNoise())
    assert (empty.seen, empty.detections, empty.false) == ((), 0, 0)


def test_most_of_every_object_is_covered_and_nothing_is_invented():
    frames = run_frames(7, families=["one object", "held bottle", "empty"], noise=EXACT)
    seen = [one for frame in frames for one in frame.seen if one.first]
    assert len(seen) >= 12
    assert np.mean([one.uncovered for one in seen]) < 0.12
    assert sum(one.missed for one in seen) == 0
    assert sum(frame.false for frame in frames) == 0


def test_the_tables_count_missed_and_merged():
    def seen(**changes):
        good = {
            "family": "one object",
            "shape": "sphere",
            "distance": 1.0,
            "first": True,
            "pixels": 50,
            "uncovered": 0.1,
            "sticks_out": 0.01,
            "excess": 0.02,
            "error": 0.005,
            "size_error": 0.003,
            "normalised": 1.0,
            "right_shape": True,
        }
        return Seen(**{**good, **changes})

    nothing = dict.fromkeys(("excess", "error", "size_error", "normalised"), np.nan)
    frame = Frame("one object", (seen(), seen(uncovered=1.0, **nothing), seen(**nothing)), 2, 3, 0.01)
    found = tables([frame])
    assert found[0].rows[0][:5] == ("one object: the object", "3", "1", "1", "5")
    assert found[1].rows[0][0] == "sphere"
    assert found[3].rows[0] == ("one object", "1", "3", "2", "10.0", "10.0", "100")


def test_the_command_prints_and_fills(capsys, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- imitarm benchmark perception -->\n<!-- end -->\n")
    command = ["benchmark", "perception", "--count", "2", "--first", "0", "--height", "60", "--exact"]
    assert main([*command, "--families", "one object", "empty", "--fill", str(page)]) == 0
    assert "Obstacles found" in capsys.readouterr().out
    assert "| one object: the object |" in page.read_text()
    for wrong in (["--count", "0"], ["--first", "-1"], ["--height", "3"]):
        assert main([*command, *wrong]) != 0
