from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.evaluation.tracking import (
    EngagementPeriods,
    TrueArm,
    best_lag,
    elbow_angle_errors,
    elbow_direction_errors,
    motion_end,
    reference_positions,
    reference_rotations,
    rms,
    rotation_errors,
    settling_time,
)
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply, rotate
from imitarm.retarget import FACING, Correspondence

DT = 0.01
TIMES = DT * np.arange(801)
HOME = np.array([0.5, 0.1, 0.3])


def swinging(times):
    return np.column_stack([0.1 * np.sin(2.0 * times), 0.08 * np.cos(1.3 * times), 0.05 * np.sin(3.1 * times + 1.0)])


def true_arm(wrist=None):
    n = len(TIMES)
    wrist = swinging(TIMES) if wrist is None else wrist
    shoulder = np.zeros((n, 3))
    elbow = np.tile([0.15, -0.05, -0.2], (n, 1))
    hand = quaternion_exp(0.4 * swinging(TIMES) / 0.1)
    return TrueArm(TIMES, shoulder, elbow, wrist + [0.4, 0.0, -0.1], hand)


def states(*runs):
    return np.array([state for state, n in runs for _ in range(n)])


WHOLE = states(("waiting", 51), ("following", 750))


def obeying(true, hold, scale, lag=0.0):
    """A tool that does what the clutch's law says, a constant time late."""
    tool = np.tile(HOME, (len(TIMES), 1))
    for i in range(1, len(TIMES)):
        if hold.engaged[i]:
            e = hold.start[i]
            tool[i] = tool[e] + scale * (true.wrist_at(TIMES[i : i + 1] - lag)[0] - true.wrist[e])
        else:
            tool[i] = tool[i - 1]
    return tool


def test_the_true_arm_is_the_persons_in_the_axes_of_the_base():
    person, correspondence = Person.from_seed(2), Correspondence()
    truth = reaching(person, 2, duration=5.0)
    true = TrueArm.of(truth, TIMES[:300], correspondence, start=0.7)
    arm = truth(0.7 + 1.2).arm()
    np.testing.assert_allclose(true.wrist[120], FACING.apply(arm.wrist))
    np.testing.assert_allclose(true.elbow[120], FACING.apply(arm.elbow))
    hand = rotate(true.hand[120], np.array([1.0, 0.0, 0.0]))
    tip = FACING.apply(arm.points[4]) - true.wrist[120]
    np.testing.assert_allclose(hand, tip / np.linalg.norm(tip), atol=1e-9)


def test_an_engagement_lasts_until_the_person_is_let_go():
    hold = EngagementPeriods.of(
        states(("waiting", 3), ("following", 4), ("coasting", 1), ("stopped", 2), ("following", 2), ("holding", 1))
    )
    assert hold.count == 2
    np.testing.assert_array_equal(hold.engaged.nonzero()[0], [3, 4, 5, 6, 7, 10, 11, 12])
    np.testing.assert_array_equal(hold.start[hold.engaged], [2] * 5 + [9] * 3)
    first = EngagementPeriods.of(
        states(("waiting", 3), ("following", 4), ("stopped", 2), ("following", 2)), first_only=True
    )
    assert first.engaged.sum() == 8
    assert set(first.start) == {2}
    assert EngagementPeriods.of(states(("waiting", 9))).count == 0


@given(st.floats(0.0, 0.5), st.floats(0.3, 2.0))
def test_a_constant_lag_is_found_and_taken_out(lag, scale):
    true, hold = true_arm(), EngagementPeriods.of(WHOLE)
    tool = obeying(true, hold, scale, lag)
    found, left = best_lag(true, tool, hold, scale)
    assert found == pytest.approx(lag, abs=2e-3)
    assert left < 5e-4
    if lag > 0.05:
        assert rms((tool - reference_positions(true, tool, hold, scale))[hold.engaged]) > 10.0 * left


def test_noise_is_left_when_the_lag_is_taken_out():
    true, hold = true_arm(), EngagementPeriods.of(WHOLE)
    noise = np.random.default_rng(0).normal(0.0, 0.01, (len(TIMES), 3))
    noise[hold.start[-1]] = 0.0
    found, left = best_lag(true, obeying(true, hold, 1.0, 0.2) + noise, hold, 1.0)
    assert found == pytest.approx(0.2, abs=0.02)
    assert left == pytest.approx(0.01 * np.sqrt(3.0), rel=0.05)


def test_each_engagement_begins_anew_and_the_first_one_forgives_nothing():
    true = true_arm()
    seen = states(("waiting", 51), ("following", 200), ("stopped", 200), ("following", 350))
    hold, first = EngagementPeriods.of(seen), EngagementPeriods.of(seen, first_only=True)
    tool = obeying(true, hold, 1.0)
    assert rms((tool - reference_positions(true, tool, hold, 1.0))[hold.engaged]) == pytest.approx(0.0, abs=1e-12)
    assert rms((tool - reference_positions(true, tool, first, 1.0))[first.engaged]) > 0.01


def test_who_was_never_followed_has_no_lag():
    true, hold = true_arm(), EngagementPeriods.of(states(("waiting", 801)))
    assert np.isnan(best_lag(true, np.tile(HOME, (801, 1)), hold, 1.0)).all()
    still = true_arm(np.zeros((801, 3)))
    lag, left = best_lag(still, np.tile(HOME, (801, 1)), EngagementPeriods.of(WHOLE), 1.0)
    assert np.isnan(lag)
    assert left == pytest.approx(0.0)


@pytest.mark.parametrize("orientation", ["hand", "upright", "fixed"])
def test_rotations_are_those_of_the_clutch(orientation):
    true, hold = true_arm(), EngagementPeriods.of(WHOLE)
    home = quaternion_exp(np.array([0.3, 2.0, -0.4]))
    quaternions = np.tile(home, (len(TIMES), 1))
    wanted = reference_rotations(true, quaternions, hold, orientation)
    clutch = Correspondence(orientation=orientation).engage(true.wrist[50], true.hand[50], Pose(HOME, home))
    for i in (51, 200, 700):
        expected = clutch.target(true.wrist[i], true.hand[i]).quaternion
        assert rotation_errors(wanted[i : i + 1], expected[None])[0] < 1e-7
    angles = rotation_errors(wanted, quaternions)
    assert (angles[51:].max() < 1e-12) == (orientation == "fixed")


def test_angles_between_rotations():
    turn = quaternion_exp(np.array([0.0, 0.7, 0.0]))
    some = quaternion_exp(np.random.default_rng(0).normal(size=(20, 3)))
    np.testing.assert_allclose(rotation_errors(some, quaternion_multiply(some, turn)), 0.7)
    np.testing.assert_allclose(rotation_errors(some, -quaternion_multiply(some, turn)), 0.7)


def arms(turns):
    """Shoulder, elbow and wrist of an arm bent at the elbow, turned as a whole, shape (n, 3, 3)."""
    points = np.array([[0.0, 0.0, 0.0], [0.3, -0.1, -0.2], [0.6, 0.0, 0.05]])
    return rotate(turns[:, None], points[None])


def test_a_robot_that_turns_its_upper_arm_as_the_person_has_no_error():
    turns = quaternion_exp(0.5 * swinging(TIMES) / 0.1)
    points, hold = arms(turns), EngagementPeriods.of(WHOLE)
    true = TrueArm(TIMES, points[:, 0], points[:, 1], points[:, 2], turns)
    robot = 1.4 * points + [0.0, 0.0, 0.3]  # longer, elsewhere, the same directions
    assert rms(elbow_direction_errors(true, robot, hold)) < 1e-9
    assert np.nanmax(elbow_angle_errors(true, robot, hold)) < 1e-9
    still = np.tile(robot[50], (len(TIMES), 1, 1))
    person = true.elbow / np.linalg.norm(true.elbow, axis=1, keepdims=True)
    expected = np.arccos(np.clip(person @ person[50], -1.0, 1.0))
    np.testing.assert_allclose(elbow_direction_errors(true, still, hold)[51:], expected[51:], atol=1e-6)


def test_the_elbows_swing_about_the_line_to_the_wrist_is_its_error():
    points = np.tile(arms(np.array([[1.0, 0.0, 0.0, 0.0]])), (len(TIMES), 1, 1))
    true = TrueArm(TIMES, points[:, 0], points[:, 1], points[:, 2], np.tile([1.0, 0, 0, 0], (len(TIMES), 1)))
    axis = points[0, 2] / np.linalg.norm(points[0, 2])
    swung = points.copy()
    swung[51:, 1] = rotate(quaternion_exp(0.3 * axis), points[51:, 1])
    np.testing.assert_allclose(elbow_angle_errors(true, swung, EngagementPeriods.of(WHOLE))[51:], 0.3, atol=1e-9)
    straight = points.copy()
    straight[:, 1] = 0.5 * points[:, 2]
    assert np.isnan(elbow_angle_errors(true, straight, EngagementPeriods.of(WHOLE))).all()


def test_settling_is_counted_from_the_end_of_the_motion():
    goal = np.array([0.3, 0.0, 0.0])
    wrist = np.outer(np.clip(TIMES / 2.0, 0.0, 1.0), goal)  # there at 2 s, within 1 cm at 1.94 s
    end = motion_end(TIMES, wrist)
    assert end == pytest.approx(2.0 * 0.29 / 0.30, abs=0.011)
    late = np.outer(np.clip((TIMES - 0.4) / 2.0, 0.0, 1.0), goal)
    assert settling_time(TIMES, late, goal, end) == pytest.approx(0.4, abs=0.011)
    assert settling_time(TIMES, wrist, goal, end + 1.0) == 0.0
    away = late.copy()
    away[TIMES > 2.6] += [0.0, 0.02, 0.0]  # leaves before it has stayed for half a second
    assert np.isnan(settling_time(TIMES, away, goal, end))
    assert np.isnan(settling_time(TIMES, wrist + [0.0, 0.011, 0.0], goal, end))
