from __future__ import annotations

import pytest

from imitarm.benchmark.recording_plan import CAPTURED, KINDS, Plan
from imitarm.errors import InputError, UnknownNameError


@pytest.mark.parametrize("bad", [{"kind": "dance"}, {"person": -1}, {"repeat": 100}, {"seconds": 1.0}, {"sigma": 0.5}])
def test_what_is_no_plan_is_refused(bad):
    with pytest.raises((InputError, UnknownNameError)):
        Plan(**{"kind": "inside", "person": 0, **bad})


def test_no_two_recordings_have_the_same_seeds_whoever_the_persons_are():
    plans = [
        Plan(kind, person, repeat)
        for kind in (*KINDS, CAPTURED)
        for person in (0, 1, 30, 99, 100, 101, 200, 209, 1000)
        for repeat in (0, 1, 99)
    ]
    cameras = [2 * plan.number + k for plan in plans for k in (0, 1)]
    assert len(set(cameras)) == len(cameras) == 2 * len(plans)
