from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.capture.filters import PATIENCE, PersonFilter
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINTS, Skeleton, Tracking
from imitarm.errors import InputError
from recording_samples import Listed, changed, skeletons


def together(*streams):
    """Several persons before one sensor, in the order of their times."""
    return sorted((s for stream in streams for s in stream), key=lambda s: s.time)


def test_a_newcomer_never_takes_over():
    first, newcomer = skeletons(120, person=4), skeletons(90, person=2, start=1.0, away=0.8)
    followed = PersonFilter(Listed(together(first, newcomer)))
    assert [s.person for s in followed] == [4] * 120
    assert followed.followed == 4 and followed.passed_over == 90


def test_a_person_who_comes_back_in_time_is_still_the_one():
    first = skeletons(30, person=4) + skeletons(30, person=4, start=1.0 + 0.9 * PATIENCE)
    other = skeletons(150, person=2, away=0.8, start=0.01)
    assert [s.person for s in PersonFilter(Listed(together(first, other)))] == [4] * 60


def test_one_who_is_gone_for_longer_is_followed_no_more_and_a_robot_has_stopped_by_then():
    first = skeletons(30, person=4) + skeletons(30, person=4, start=6.0)
    other = skeletons(240, person=2, away=0.8, start=0.01)
    given_on = list(PersonFilter(Listed(together(first, other))))
    assert [s.person for s in given_on[:30]] == [4] * 30 and {s.person for s in given_on[30:]} == {2}
    assert given_on[30].time - given_on[29].time > PATIENCE


def test_a_person_leaving_ends_cleanly():
    followed = PersonFilter(Listed([*skeletons(5), None, None, *skeletons(9, person=1, start=0.5, away=0.8)]))
    assert sum(s is not None for s in followed) == 5
    assert followed.over and followed.read() is None


def test_a_source_of_one_number_for_all_can_not_pass_the_next_person_off():
    first, other = skeletons(30), skeletons(45, start=1.0, away=1.2)
    followed = PersonFilter(Listed(first + other + skeletons(30, start=2.5)))
    given_on = list(followed)
    places = [s.joint("spine_shoulder")[0] for s in given_on]
    assert len(given_on) == 60 and np.ptp(places) < 0.1 and followed.passed_over == 45


def test_one_may_be_named():
    both = together(skeletons(10, person=1), skeletons(10, person=2, away=0.8))
    assert {s.person for s in PersonFilter(Listed(both), person=2)} == {2}
    assert list(PersonFilter(Listed(both), person=7)) == []


def test_a_clock_that_starts_anew_is_a_gap():
    """A sender that was restarted: its clock is far behind, its numbers are others."""
    followed = PersonFilter(Listed(skeletons(10, start=1000.0, person=1) + skeletons(10, start=0.0, person=2)))
    assert [s.person for s in followed] == [1] * 10 + [2] * 10


def test_nobody_begins_to_be_followed_by_a_hand_alone():
    tracking = np.full(len(JOINTS), Tracking.LOST)
    tracking[JOINTS.index("hand_right")] = Tracking.TRACKED
    one = skeletons(1)[0]
    followed = PersonFilter(Listed([Skeleton(0.0, one.positions, tracking, person=9), changed(one, time=0.1)]))
    assert [s.person for s in followed] == [0]


def test_waiting_ends_when_the_time_is_up_and_closing_reaches_the_source():
    source = SkeletonRecording(skeletons(1000, rate=1000.0, person=3), realtime=True)
    followed = PersonFilter(source, person=1)
    assert followed.read(timeout=0.05) is None and not followed.over
    listed = Listed([])
    with PersonFilter(listed):
        pass
    assert listed.closed
    with pytest.raises(InputError, match="patience"):
        PersonFilter(listed, patience=-1.0)


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 2)), max_size=40))
def test_whoever_is_given_on_never_changes_without_the_gap(steps):
    one, time, frames = skeletons(1)[0], 0.0, []
    for step, person in steps:
        time += step
        frames.append(changed(one, time=time, person=person))
    given_on = list(PersonFilter(Listed(frames)))
    for before, after in pairwise(given_on):
        assert after.person == before.person or after.time - before.time > PATIENCE
