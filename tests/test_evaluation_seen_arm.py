from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.errors import TaskFailedError
from imitarm.evaluation.tracking import TrueArm, seen_arm, target_lag
from imitarm.retarget import Correspondence

TRUTH = reaching(Person.from_seed(3), 3, duration=5.0)
FRAMES = [TRUTH(t) for t in np.arange(0.0, 5.0, 1 / 30)]
TIMES = np.arange(0.0, 4.9, 0.01)
FOLLOW = Correspondence()


def test_of_a_faultless_recording_it_is_the_true_arm():
    seen, true = seen_arm(FRAMES, TIMES, FOLLOW), TrueArm.of(TRUTH, TIMES, FOLLOW)
    for part in ("shoulder", "elbow", "wrist"):
        np.testing.assert_allclose(getattr(seen, part), getattr(true, part), atol=2e-3)
    assert np.abs(np.sum(seen.hand * true.hand, axis=1)).min() > 0.99


def test_times_count_from_the_first_skeleton_and_gaps_are_bridged():
    late = [Skeleton(s.time + 100.0, s.positions, s.tracking) for s in FRAMES if not 2.0 < s.time < 2.3]
    seen, true = seen_arm(late, TIMES, FOLLOW), TrueArm.of(TRUTH, TIMES, FOLLOW)
    kept = (TIMES < 2.0) | (TIMES > 2.4)
    np.testing.assert_allclose(seen.wrist[kept], true.wrist[kept], atol=2e-3)
    assert np.isfinite(seen.wrist).all()


def test_an_arm_that_is_never_seen_is_told():
    tracking = np.array(FRAMES[0].tracking)
    tracking[JOINT["elbow_left"]] = 0
    lost = [Skeleton(s.time, s.positions, tracking) for s in FRAMES]
    with pytest.raises(TaskFailedError, match="left arm is never seen"):
        seen_arm(lost, TIMES, Correspondence("left"))


@pytest.mark.parametrize("lag", [0.0, 0.05, 0.3])
def test_the_lag_behind_a_target_is_found(lag):
    target = np.stack([np.sin(2.0 * TIMES), np.cos(3.0 * TIMES), 0.1 * TIMES], axis=1)
    at = TIMES - lag
    tool = np.stack([np.sin(2.0 * at), np.cos(3.0 * at), 0.1 * at], axis=1)
    target[:50] = np.nan
    assert target_lag(TIMES, tool, target) == pytest.approx(lag, abs=1e-9)


def test_without_a_target_its_motion_or_a_tool_that_follows_there_is_no_lag():
    still, moving = np.zeros((len(TIMES), 3)), np.stack([np.sin(TIMES)] * 3, axis=1)
    assert np.isnan(target_lag(TIMES, still, np.full_like(still, np.nan)))
    assert np.isnan(target_lag(TIMES, still, still))
    assert np.isnan(target_lag(TIMES, still + 5.0, moving))
