"""The person of the scene ``person_reaches``: the true arm, and what the camera and the tracker make of it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from imitarm.cli import main
from imitarm.perception import PersonCapsules
from imitarm.tasks.reaching_person import LINKS, SIDE, ReachingPerson
from imitarm.tasks.sweep import SweepTask

TIMES = np.arange(0.0, 14.0, 0.37)


def test_the_capsules_in_the_world_are_those_of_the_true_skeleton():
    moving, capsules = ReachingPerson.scene(), PersonCapsules(ReachingPerson.camera, sides=[SIDE])
    for time in TIMES:
        exact = {one.label: one.obstacle for one in capsules.detections(ReachingPerson.truth(time))}
        scene = moving.at(time)
        assert {one.name for one in scene.obstacles} == set(exact)
        for one in scene.obstacles:
            np.testing.assert_allclose(one.start, exact[one.name].start, atol=2e-3)
            np.testing.assert_allclose(one.end, exact[one.name].end, atol=2e-3)
            assert one.radius == pytest.approx(exact[one.name].radius, abs=1e-4)


def test_the_hand_reaches_over_the_path_and_stays_above_the_table():
    moving = ReachingPerson.scene()
    path = SweepTask.motion().curve(np.linspace(0.0, 1.0, 200))
    near = np.array([moving.at(time).clearance(path).min() for time in TIMES])
    assert near[TIMES < 0.8].min() > 0.15
    assert near[(TIMES > 3.0) & (TIMES < 4.4)].max() < SweepTask.tool_radius
    assert near[(TIMES > 8.6) & (TIMES < 10.2)].max() < SweepTask.tool_radius + SweepTask.clearance
    table = np.array([[x, y, 0.0] for x in np.linspace(0.31, 1.0, 12) for y in np.linspace(-0.6, 0.6, 20)])
    assert min(moving.at(time).clearance(table).min() for time in TIMES) > -0.005  # the capsule is thicker than a hand


def test_the_tracker_follows_the_arm_within_a_few_centimetres():
    observe, moving = ReachingPerson.observer(3), ReachingPerson.scene()
    errors, numbers = [], set()
    for time in np.arange(0.0, 12.0, 0.05):
        scene, truth = observe(time), {one.name: one for one in moving.at(time).obstacles}
        numbers |= {one.track_id for one in scene.obstacles}
        assert all(one.covariance is not None for one in scene.obstacles)
        for one in scene.obstacles:
            exact = truth[one.name]
            errors.append(0.5 * np.linalg.norm(one.start + one.end - exact.start - exact.end))
    assert len(errors) > 400 and len(numbers) <= 4
    assert np.quantile(errors, 0.95) < 0.05


@pytest.mark.slow
def test_the_arm_sweeps_and_stays_clear_of_the_person(tmp_path):
    assert main(["demo", "--out", str(tmp_path), "--scenes", "person_reaches"]) == 0
    (scene,) = json.loads((tmp_path / "results.json").read_text())["scenes"]
    assert scene["success"] and scene["min_clearance_m"] > 0.02
    assert scene["details"]["dirt in the pan"] == "100 %"
    assert LINKS > 0.02
