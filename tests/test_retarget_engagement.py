import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import (
    LONGEST_GAP,
    SEEN_FOR,
    Engagement,
    EngagementRule,
    EngagementState,
    engaged_samples,
)

DT = 0.01
TOOL = Pose(np.array([0.5, 0.1, 0.3]), np.array([0.0, 1.0, 0.0, 0.0]))
STILL = ArmEstimate(
    0.0,
    np.zeros(3),
    np.array([0.3, 0.0, 0.0]),
    np.array([0.3, 0.2, 0.1]),
    np.zeros((3, 3)),
    np.array([1.0, 0.0, 0.0, 0.0]),
    np.zeros(3),
    (1.0, 1.0, 1.0),
    None,
)


def update(engagement: Engagement, time: float | None, period: float = DT, *, at_rest: bool = True) -> EngagementState:
    """One control period, with a frame of that time or without one; engages as soon as that is possible."""
    engagement.update(None if time is None else STILL._replace(time=float(time)), period, at_rest=at_rest)
    if engagement.ready:
        engagement.engage(STILL.wrist, STILL.hand, TOOL)
    return engagement.state


def engaged_at(times) -> float | None:
    engagement = Engagement(Correspondence())
    return next((float(t) for t in times if update(engagement, t).engaged), None)


def engaged(**options) -> Engagement:
    engagement = Engagement(Correspondence(**options))
    for t in np.arange(0.0, 0.6, 1.0 / 30.0):
        update(engagement, t)
    assert engagement.state is EngagementState.FOLLOWING
    return engagement


@pytest.mark.parametrize("rate", [15.0, 30.0, 100.0])
def test_it_engages_after_half_a_second_at_any_frame_rate(rate):
    found = engaged_at(7.0 + np.arange(0.0, 2.0, 1.0 / rate))
    assert SEEN_FOR - 1e-9 <= found - 7.0 <= SEEN_FOR + 1.0 / rate + 1e-9


def test_a_gap_restarts_the_count_and_a_dropped_frame_does_not():
    before, after = np.arange(0.0, 0.4, 1.0 / 30.0), np.arange(0.0, 2.0, 1.0 / 30.0)
    gap = before[-1] + LONGEST_GAP + 0.02
    assert engaged_at([*before, *(gap + after)]) >= gap + SEEN_FOR - 1e-9
    assert engaged_at(np.delete(np.arange(0.0, 2.0, 1.0 / 30.0), [5, 9])) < SEEN_FOR + 0.04


def test_without_a_view_of_the_arm_it_waits():
    engagement = Engagement(Correspondence())
    assert {update(engagement, None) for _ in range(100)} == {EngagementState.WAITING}


def test_a_source_too_slow_to_be_followed_is_not_followed():
    assert engaged_at(np.arange(0.0, 5.0, 0.2)) is None  # 5 Hz


def test_time_that_runs_backwards_restarts_the_count():
    assert engaged_at([*np.arange(9.0, 9.4, 0.03), *np.arange(0.0, 0.45, 0.03)]) is None


def test_the_tool_does_not_jump_when_the_person_begins_to_lead():
    clutch = engaged(scale=1.5).clutch
    np.testing.assert_allclose(clutch.target(STILL.wrist, STILL.hand).position, TOOL.position)
    moved = clutch.target(STILL.wrist + [0.1, 0.0, 0.0], STILL.hand)
    np.testing.assert_allclose(moved.position - TOOL.position, [0.15, 0.0, 0.0])


def test_a_shift_moves_the_target_and_nothing_else():
    engagement = engaged()
    before = engagement.clutch.target(STILL.wrist, STILL.hand)
    engagement.shift(np.array([0.0, 0.0, -0.02]))
    after = engagement.clutch.target(STILL.wrist, STILL.hand)
    np.testing.assert_allclose(after.position - before.position, [0.0, 0.0, -0.02])
    np.testing.assert_array_equal(after.quaternion, before.quaternion)


def test_a_lost_person_is_bridged_then_the_robot_stops_until_it_rests_and_the_person_is_seen_again():
    rule = EngagementRule(follow_until=0.075, coast_until=0.105, hold_until=0.305)
    engagement = Engagement(Correspondence(), rule)
    for t in np.arange(0.0, 0.6, 1.0 / 30.0):
        update(engagement, t)
    lost = [update(engagement, None) for _ in range(100)]
    order = [EngagementState.FOLLOWING, EngagementState.COASTING, EngagementState.HOLDING, EngagementState.STOPPED]
    assert [lost.index(state) for state in order] == [0, 7, 10, 30]
    assert sorted(lost, key=order.index) == lost
    assert engagement.clutch is None
    assert update(engagement, 5.0, at_rest=False) is EngagementState.STOPPED
    assert update(engagement, 5.03) is EngagementState.WAITING
    assert update(engagement, 5.06).engaged is False


def test_a_person_who_comes_back_soon_leads_on_with_the_same_clutch():
    engagement = engaged()
    clutch = engagement.clutch
    for _ in range(25):
        update(engagement, None)
    assert engagement.state is EngagementState.HOLDING
    assert update(engagement, 1.0) is EngagementState.FOLLOWING
    assert engagement.clutch is clutch


def test_while_the_robot_brakes_the_time_is_counted_all_the_same():
    engagement = Engagement(Correspondence())
    for t in np.arange(0.0, 1.0, 1 / 30):
        assert not update(engagement, t, at_rest=False).engaged
    assert update(engagement, 1.0).engaged


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=200))
def test_the_clutch_is_engaged_in_exactly_the_engaged_states_and_only_after_half_a_second(events):
    engagement, seen, time = Engagement(Correspondence()), 0.0, 0.0
    for sees, at_rest in events:
        time += 0.05
        seen = seen + 0.05 if sees else -0.05 if engagement.time_since_seen + 0.05 > LONGEST_GAP else seen + 0.05
        before = engagement.clutch
        state = update(engagement, time if sees else None, 0.05, at_rest=at_rest)
        assert (engagement.clutch is not None) == state.engaged
        if before is None and state.engaged:
            assert sees and at_rest and seen >= SEEN_FOR - 1e-6


def test_engaged_samples_are_those_whose_state_is_engaged():
    states = [state.value for state in EngagementState]
    np.testing.assert_array_equal(engaged_samples(states), [state.engaged for state in EngagementState])
    assert [str(state) for state in EngagementState] == states
