from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError, UnknownNameError, UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose

ARMS = {name: ArmModel.load(name, tool="brush") for name in ("sawyer", "panda")}


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(list(ARMS)), st.sampled_from(["tool", "flange"]), st.integers(0, 2**32 - 1))
def test_a_pose_that_was_reached_once_is_found_again(name, frame, seed):
    arm = ARMS[name]
    q = np.random.default_rng(seed).uniform(arm.lower, arm.upper)
    reach = arm.tool_pose if frame == "tool" else arm.forward_kinematics
    found = find_posture(arm, reach(q), frame=frame)
    arm.check_limits(found)
    error = reach(found).error_to(reach(q))
    assert np.linalg.norm(error[:3]) < 1e-6 and np.linalg.norm(error[3:]) < 1e-6


@pytest.mark.parametrize("name", list(ARMS))
def test_the_answer_stays_near_to_the_start(name):
    arm = ARMS[name]
    rng = np.random.default_rng(0)
    for _ in range(10):
        q = arm.home + 0.1 * rng.normal(size=7)
        found = find_posture(arm, arm.tool_pose(q), q0=arm.home)
        assert np.linalg.norm(found - arm.home) < np.linalg.norm(q - arm.home) + 0.1
    assert np.allclose(find_posture(arm, arm.tool_pose(arm.home)), arm.home, atol=1e-5)


def test_the_same_question_has_the_same_answer():
    arm = ARMS["sawyer"]
    pose = arm.tool_pose(np.random.default_rng(3).uniform(arm.lower, arm.upper))
    assert np.array_equal(find_posture(arm, pose), find_posture(arm, pose))


def test_the_whole_table_in_front_of_the_arm_can_be_reached_from_above():
    for arm in ARMS.values():
        down = arm.tool_pose(arm.home).quaternion
        for x in (0.4, 0.55, 0.65):
            for y in (-0.3, 0.0, 0.3):
                find_posture(arm, Pose([x, y, 0.05], down))


def test_what_is_out_of_reach_is_said_with_how_far():
    with pytest.raises(UnreachableError, match=r"panda can't bring its tool to position \[2.0, 0.0, 0.0\] m") as caught:
        find_posture(ARMS["panda"], Pose([2.0, 0, 0], [1, 0, 0, 0]), restarts=3)
    millimetres = float(str(caught.value).split(" mm")[0].split()[-1])
    assert 900 < millimetres < 1200  # the brush reaches a little over 1 m


def test_wrong_input_is_refused():
    arm = ARMS["panda"]
    with pytest.raises(UnknownNameError, match="known: flange, tool"):
        find_posture(arm, arm.tool_pose(arm.home), frame="hand")
    with pytest.raises(InputError, match="must be 7 numbers"):
        find_posture(arm, arm.tool_pose(arm.home), q0=np.zeros(3))


@pytest.mark.parametrize(
    "wrong",
    [
        {"pose": None},
        {"pose": np.eye(4)},
        {"q0": np.full(7, np.nan)},
        {"q0": "home"},
        {"frame": None},
        {"restarts": -1},
        {"restarts": 10**12},
        {"restarts": 2.5},
        {"seed": -1},
        {"seed": None},
    ],
    ids=str,
)
def test_every_argument_is_checked(wrong):
    arm = ArmModel.load("panda")
    arguments = {"pose": arm.forward_kinematics(arm.home)} | wrong
    with pytest.raises(InputError):
        find_posture(arm, **arguments)
    with pytest.raises(InputError):
        find_posture(None, arm.forward_kinematics(arm.home))
