from dataclasses import replace

import numpy as np
import pytest

from imitarm.kinematics.pose import Pose
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import LOST_AFTER, SEEN_FOR, Engagement

TOOL = Pose(np.array([0.5, 0.1, 0.3]), np.array([0.0, 1.0, 0.0, 0.0]))
STILL = ArmEstimate(
    0.0,
    np.zeros(3),
    np.array([0.3, 0.0, 0.0]),
    np.array([0.3, 0.2, 0.1]),
    np.zeros(3),
    np.array([1.0, 0.0, 0.0, 0.0]),
    np.zeros(3),
    (1.0, 1.0, 1.0),
    None,
)


def engaged_at(times) -> float | None:
    engagement = Engagement(Correspondence())
    for t in times:
        if engagement.update(replace(STILL, time=float(t)), TOOL) is not None:
            return float(t)
    return None


@pytest.mark.parametrize("rate", [15.0, 30.0, 100.0])
def test_it_engages_after_half_a_second_at_any_frame_rate(rate):
    found = engaged_at(7.0 + np.arange(0.0, 2.0, 1.0 / rate))
    assert SEEN_FOR - 1e-9 <= found - 7.0 <= SEEN_FOR + 1.0 / rate + 1e-9


def test_a_gap_begins_the_count_anew_and_a_lost_frame_does_not():
    before, after = np.arange(0.0, 0.4, 1.0 / 30.0), np.arange(0.0, 2.0, 1.0 / 30.0)
    gap = before[-1] + LOST_AFTER + 0.02
    assert engaged_at([*before, *(gap + after)]) >= gap + SEEN_FOR - 1e-9
    assert engaged_at(np.delete(np.arange(0.0, 2.0, 1.0 / 30.0), [5, 9])) < SEEN_FOR + 0.04


def test_frames_that_show_no_arm_are_no_sight():
    engagement = Engagement(Correspondence())
    assert all(engagement.update(None, TOOL) is None for _ in range(100))


def test_a_source_too_slow_to_be_followed_is_not_taken_hold_of():
    assert engaged_at(np.arange(0.0, 5.0, 0.2)) is None  # 5 Hz


def test_time_that_runs_backwards_begins_the_count_anew():
    assert engaged_at([*np.arange(9.0, 9.4, 0.03), *np.arange(0.0, 0.45, 0.03)]) is None


def test_the_tool_is_where_it_was_when_the_clutch_engages_and_stays_engaged_until_released():
    engagement = Engagement(Correspondence(scale=1.5))
    for t in np.arange(0.0, 0.6, 1.0 / 30.0):
        clutch = engagement.update(replace(STILL, time=float(t)), TOOL)
    np.testing.assert_allclose(clutch.target(STILL.wrist, STILL.hand).position, TOOL.position)
    moved = clutch.target(STILL.wrist + [0.1, 0.0, 0.0], STILL.hand)
    np.testing.assert_allclose(moved.position - TOOL.position, [0.15, 0.0, 0.0])
    assert engagement.update(replace(STILL, time=50.0), TOOL) is clutch
    engagement.release()
    assert engagement.update(replace(STILL, time=50.1), TOOL) is None


def test_while_the_robot_can_not_be_taken_hold_of_the_time_is_counted_all_the_same():
    engagement = Engagement(Correspondence())
    for t in np.arange(0.0, 1.0, 1 / 30):
        assert engagement.update(replace(STILL, time=float(t)), None) is None
    assert engagement.update(replace(STILL, time=1.0), TOOL) is not None
