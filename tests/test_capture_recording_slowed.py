from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.capture.recording import slowed
from imitarm.capture.skeleton import JOINT, Skeleton, Tracking
from imitarm.errors import InputError
from recording_samples import same, skeletons

FRAMES = skeletons(20, start=3.0)


@given(st.floats(0.05, 1.0))
def test_the_motion_takes_longer_and_its_places_are_the_same(pace):
    slow = slowed(FRAMES, pace)
    times = np.array([s.time for s in slow])
    assert times[0] == FRAMES[0].time
    assert times[-1] - times[0] == pytest.approx((FRAMES[-1].time - FRAMES[0].time) / pace)
    assert (np.diff(times) > 0.0).all()
    assert np.diff(times).max() < 1.01 / 30.0  # as many frames a second as before, or more
    parts = int(np.ceil(1.0 / pace))
    for before, after in zip(FRAMES, slow[::parts], strict=True):
        np.testing.assert_array_equal(before.positions, after.positions)


def test_at_its_own_pace_nothing_changes():
    assert all(map(same, slowed(FRAMES, 1.0), FRAMES))
    assert slowed([], 0.5) == [] and len(slowed(FRAMES[:1], 0.5)) == 1


def test_between_two_frames_joints_go_straight_and_a_lost_one_is_not_guessed():
    tracking = np.array(FRAMES[1].tracking)
    tracking[JOINT["wrist_right"]], tracking[JOINT["elbow_right"]] = Tracking.LOST, Tracking.INFERRED
    frames = [FRAMES[0], Skeleton(FRAMES[1].time, FRAMES[1].positions, tracking)]
    _, between, after = slowed(frames, 0.5)
    middle = 0.5 * (FRAMES[0].positions + FRAMES[1].positions)
    np.testing.assert_allclose(between.joint("shoulder_right"), middle[JOINT["shoulder_right"]])
    assert between.tracking[JOINT["elbow_right"]] == Tracking.INFERRED
    np.testing.assert_array_equal(between.joint("wrist_right"), FRAMES[0].joint("wrist_right"))
    assert np.isnan(after.joint("wrist_right")).all()


def test_gaps_stay_gaps():
    frames = FRAMES[:5] + FRAMES[15:]
    steps = np.diff([s.time for s in slowed(frames, 0.5)])
    assert steps.max() == pytest.approx(2.0 * (FRAMES[15].time - FRAMES[4].time))
    assert (steps > 0.1).sum() == 1


@pytest.mark.parametrize("pace", [0.0, 0.01, 1.5, float("nan")])
def test_a_pace_out_of_range_is_told(pace):
    with pytest.raises(InputError, match="must be a finite number"):
        slowed(FRAMES, pace)
