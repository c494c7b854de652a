from dataclasses import replace

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.capture.person import Person
from imitarm.errors import InputError
from imitarm.retarget import Correspondence, LimbLengths
from imitarm.retarget.baselines.incremental_ik import IncrementalIK
from shown_arm import EASY, LENGTHS, shown, swing

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}


def away(arm, run):
    """Distance (m) and angle [rad] of the tool from its target."""
    errors = np.array(
        [
            arm.tool_pose(q).error_to(type(arm.tool_pose(q))(p, r))
            for q, p, r in zip(run.joints, *run.targets, strict=True)
            if np.isfinite(p).all()
        ]
    )
    return np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("orientation", ["hand", "fixed"])
def test_the_tool_comes_to_its_target_and_stays_near_on_the_way(arm, orientation):
    frames = shown(swing(0, 0.5, over=3.0), 6.0)
    run = IncrementalIK(arm, Correspondence(lengths=LENGTHS, orientation=orientation)).run(frames)
    distance, angle = away(arm, run)
    assert distance[-1] < 1e-6
    assert angle[-1] < 1e-6
    assert distance.max() < 0.015  # late by a frame, at most 0.2 m/s
    assert run.notes["caps"] == run.notes["position_clips"] == 0.0


def test_a_deviation_dies_out_by_half_a_frame():
    """K = 0.5: what one frame leaves of it is half, while the target stands."""
    arm = ARMS["sawyer"]
    method = IncrementalIK(arm, Correspondence(lengths=LENGTHS, orientation="fixed"), dt=1 / 30)
    for frame in shown(lambda _: EASY, 1.0):
        method.step(frame, arm.home)
    moved = method.latest.q + 0.02 * np.array([1, -1, 1, 1, -1, 1, 1])
    method.latest = replace(method.latest, q=moved)  # as if the arm had been moved aside
    errors = []
    for frame in shown(lambda _: EASY, 1.4)[31:]:
        method.step(frame, method.latest.q)
        errors.append(np.linalg.norm(arm.tool_pose(method.latest.q).error_to(method.latest.target)))
    np.testing.assert_allclose(np.array(errors[1:5]) / errors[:4], 0.5, atol=0.05)


def edge_run(**options):
    """A hand that goes 0.3 m ahead, and the target 0.43 m, out of reach, and comes back."""
    person, frames = Person.from_seed(1), []
    for t in np.arange(0.0, 6.0, 1 / 30):
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.clip((t - 1.0) / 4.0, 0.0, 1.0))
        frames.append(person.skeleton(float(t), person.shoulder() + np.array([0.05, -0.2, -0.2 - 0.3 * share])))
    lengths = LimbLengths(person.upper_arm, person.forearm)
    correspondence = Correspondence(lengths=lengths, scale=1.43, orientation="fixed")
    return IncrementalIK(ARMS["sawyer"], correspondence, **options).run(frames)


def test_at_the_edge_of_reach_it_explodes_and_only_the_caps_hold_it():
    """Nothing damps the inverse, so joints are at their caps again and again."""
    arm, run = ARMS["sawyer"], edge_run()
    inside = IncrementalIK(arm, Correspondence(lengths=LENGTHS, orientation="fixed")).run(shown(swing(0, 0.5), 6.0))
    assert run.notes["capped_steps"] > 100
    assert run.notes["caps"] > run.notes["capped_steps"]  # often several joints at once
    assert inside.notes["caps"] == 0.0
    assert (np.abs(run.velocities) <= arm.max_velocity * (1.0 + 1e-9)).all()
    distance, _ = away(arm, run)
    assert distance.max() > 0.2  # cut joint by joint the tool is thrown aside
    jumps = np.abs(np.diff(run.velocities, axis=0)).max(axis=0) / 0.01
    assert (jumps > 10.0 * arm.max_acceleration).any()  # no limit of acceleration


def test_without_the_caps_the_steps_would_be_many_times_too_long():
    arm = ARMS["sawyer"]
    method = IncrementalIK(arm, Correspondence(orientation="fixed"))
    straight = np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.5, 0.0])
    method.start(straight)
    pose = arm.tool_pose(straight)
    out = type(pose)(pose.position + [0.01, 0.0, 0.0], pose.quaternion)
    assert (np.abs(method._increment(straight, pose, out)) / (arm.max_velocity / 30)).max() > 50.0


def test_scaled_as_a_whole_the_tool_keeps_its_direction_and_is_cut_no_joint_by_itself():
    run = edge_run(velocity_scaling=True)
    assert run.notes["velocity_excess"] > 0.0
    assert (np.abs(run.velocities) <= ARMS["sawyer"].max_velocity * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("gain", [0.0, -1.0, 1.5, float("nan")])
def test_a_gain_that_can_not_be_is_refused(gain):
    with pytest.raises(InputError, match="gain"):
        IncrementalIK(ARMS["sawyer"], gain=gain)
