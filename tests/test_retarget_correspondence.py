import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import InputError, Pose
from imitarm.errors import UnknownNameError
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.retarget import FACING, Correspondence

HOME = Pose(np.array([0.5, 0.1, 0.3]), quaternion_exp([0.3, 2.0, -0.4]))
ROTATIONS = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(lambda v: quaternion_exp(np.array(v)))


def test_a_person_who_faces_the_sensor_has_the_robots_directions():
    np.testing.assert_allclose(FACING.apply([0.0, 0.0, -1.0]), [1.0, 0.0, 0.0], atol=1e-12)  # forward
    np.testing.assert_allclose(FACING.apply([-1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-12)  # to the person's left
    np.testing.assert_allclose(FACING.apply([0.0, 1.0, 0.0]), [0.0, 0.0, 1.0], atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(ROTATIONS, ROTATIONS, st.sampled_from(["hand", "upright", "fixed"]))
def test_nothing_jumps_when_the_clutch_engages(hand, home, orientation):
    wrist, start = np.array([0.2, -0.3, 0.1]), Pose(HOME.position, home)
    clutch = Correspondence(orientation=orientation).engage(wrist, hand, start)
    error = start.error_to(clutch.target(wrist, hand))
    np.testing.assert_allclose(error, 0.0, atol=1e-7)


def test_motion_is_scaled():
    clutch = Correspondence(scale=1.43).engage(np.zeros(3), HOME.quaternion, HOME)
    moved = clutch.target(np.array([0.1, 0.0, -0.2]), HOME.quaternion)
    np.testing.assert_allclose(moved.position - HOME.position, [0.143, 0.0, -0.286])


@settings(max_examples=50, deadline=None)
@given(ROTATIONS, ROTATIONS)
def test_the_tool_turns_as_the_hand_does(hand, turn):
    clutch = Correspondence(orientation="hand").engage(np.zeros(3), hand, HOME)
    target = clutch.target(np.zeros(3), quaternion_multiply(turn, hand))
    expected = Pose(HOME.position, quaternion_multiply(turn, HOME.quaternion))
    np.testing.assert_allclose(target.error_to(expected), 0.0, atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(ROTATIONS, ROTATIONS)
def test_upright_a_tool_that_looks_down_goes_on_looking_down(hand, turn):
    down = Pose(HOME.position, np.array([0.0, 1.0, 0.0, 0.0]))
    clutch = Correspondence(orientation="upright").engage(np.zeros(3), hand, down)
    target = clutch.target(np.zeros(3), quaternion_multiply(turn, hand))
    np.testing.assert_allclose(target.rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-9)


def test_upright_follows_a_turn_about_the_vertical_and_fixed_none():
    yaw = quaternion_exp([0.0, 0.0, 0.7])
    for orientation, angle in (("upright", 0.7), ("fixed", 0.0)):
        clutch = Correspondence(orientation=orientation).engage(np.zeros(3), HOME.quaternion, HOME)
        turned = HOME.error_to(clutch.target(np.zeros(3), quaternion_multiply(yaw, HOME.quaternion)))
        np.testing.assert_allclose(turned[3:], [0.0, 0.0, angle], atol=1e-7)


@pytest.mark.parametrize(
    ("options", "error"),
    [({"side": "both"}, UnknownNameError), ({"orientation": "some"}, UnknownNameError), ({"scale": 0.0}, InputError)],
)
def test_what_can_not_correspond_is_named(options, error):
    with pytest.raises(error):
        Correspondence(**options)
