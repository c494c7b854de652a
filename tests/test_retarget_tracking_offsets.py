"""What comes with a change of tracking is taken for an error; what is measured between two changes is a motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import InputError
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, Skeleton, Tracking
from imitarm.retarget import FACING, Correspondence, LimbLengths
from imitarm.retarget.arm_estimator import ArmEstimator
from imitarm.retarget.smoothing import LONGEST_OFFSET, TrackingOffsets

T = 1 / 30
SEEN, GUESSED = [1.0, 1.0, 1.0], [1.0, 1.0, 0.5]
STILL = np.zeros((3, 3))
JUMP = np.array([0.08, -0.03, 0.05])
some = settings(deadline=None, max_examples=60)
seeds = st.integers(0, 2**32 - 1)


def arm(rng):
    return rng.normal(size=(3, 3))


def hidden(points, jump=JUMP):
    """The same arm with the wrist guessed elsewhere."""
    return points + np.array([[0.0], [0.0], [1.0]]) * jump


@some
@given(seeds, st.lists(st.sampled_from([0.2, 0.5, 1.0]), min_size=3, max_size=3))
def test_without_a_change_of_confidence_points_are_as_they_were_measured(seed, confidence):
    offsets, rng = TrackingOffsets(), np.random.default_rng(seed)
    for _ in range(20):
        points = arm(rng)
        assert np.array_equal(offsets.compensate(points, confidence, rng.normal(size=(3, 3)), T), points)


def test_a_hand_that_is_hidden_and_seen_again_does_not_jump():
    """The way that it goes on at each change is its velocity times the period, wherever the camera guesses it."""
    offsets, rng = TrackingOffsets(), np.random.default_rng(0)
    points, velocity = arm(rng), 0.1 * arm(rng)
    before = offsets.compensate(points, SEEN, velocity, T)
    for k in range(1, 120):
        guessed = (k // 20) % 2 == 1  # longer than a flicker
        points = points + T * velocity
        measured = hidden(points, 0.05 * rng.normal(size=3)) if guessed else points
        now = offsets.compensate(measured, GUESSED if guessed else SEEN, velocity, T)
        if k % 20 == 0:
            np.testing.assert_allclose(now[2] - before[2], T * velocity[2], atol=1e-12)
        np.testing.assert_array_equal(now[:2], measured[:2])  # the others are not touched
        before = now


def test_while_it_is_guessed_its_motion_is_followed_and_its_place_is_not_believed():
    offsets, rng = TrackingOffsets(), np.random.default_rng(1)
    points = arm(rng)
    offsets.compensate(points, SEEN, STILL, T)
    offsets.compensate(hidden(points), GUESSED, STILL, T)
    for _ in range(300):  # ten seconds on
        points = points + 0.02 * rng.normal(size=3)
        np.testing.assert_allclose(offsets.compensate(hidden(points), GUESSED, STILL, T), points, atol=1e-12)


def seen_again(offsets, points):
    """See, guess, and see again an arm at rest that the camera now puts elsewhere; return what it is off."""
    offsets.compensate(points, SEEN, STILL, T)
    for _ in range(20):
        offsets.compensate(points, GUESSED, STILL, T)
    elsewhere = hidden(points)
    return elsewhere, elsewhere - offsets.compensate(elsewhere, SEEN, STILL, T)


def test_when_it_is_seen_the_offset_fades_slowly_with_time():
    points = arm(np.random.default_rng(2))
    offsets = TrackingOffsets(time=8.0)
    elsewhere, off = seen_again(offsets, points)
    np.testing.assert_allclose(off[2], JUMP, atol=1e-12)
    for k in range(1, 241):
        left = elsewhere - offsets.compensate(elsewhere, SEEN, STILL, T)
        np.testing.assert_allclose(left[2], np.exp(-k * T / 8.0) * JUMP, atol=1e-12)


def test_when_it_is_seen_the_offset_fades_with_the_way():
    points = arm(np.random.default_rng(3))
    offsets = TrackingOffsets(time=1e9, distance=0.2)
    elsewhere, off = seen_again(offsets, points)
    for k in range(1, 31):
        moved = elsewhere + [0.0, 0.0, 0.01 * k]
        left = moved - offsets.compensate(moved, SEEN, STILL, T)
        np.testing.assert_allclose(left[2], np.exp(-0.01 * k / 0.2) * off[2], atol=1e-9)
    np.testing.assert_allclose(left[:2], 0.0, atol=1e-12)


@some
@given(seeds)
def test_between_changes_a_joint_goes_as_it_is_measured(seed):
    """While it is guessed exactly so; while it is seen what fades of the offset comes on top, and no more."""
    offsets, rng = TrackingOffsets(time=5.0, distance=0.1), np.random.default_rng(seed)
    points = arm(rng)
    before, off = offsets.compensate(points, SEEN, STILL, T), np.zeros((3, 3))
    confidence = SEEN
    for _ in range(60):
        measured = points + 0.05 * rng.normal(size=(3, 3)) * rng.integers(0, 2, size=(3, 1))
        changed = rng.random(3) < 0.2
        new = np.where(changed, rng.choice([0.2, 0.5, 1.0], size=3), confidence).tolist()
        velocity = rng.normal(size=(3, 3))
        now = offsets.compensate(measured, new, velocity, T)
        for i in range(3):
            step, way = now[i] - before[i], np.linalg.norm(measured[i] - points[i])
            if new[i] != confidence[i]:  # goes on, or has again the offset that it had a moment ago
                assert (
                    np.allclose(step, T * velocity[i]) or np.linalg.norm(now[i] - measured[i]) <= LONGEST_OFFSET + 1e-12
                )
            elif new[i] < 1.0:
                np.testing.assert_allclose(step, measured[i] - points[i], atol=1e-12)
            else:
                fades = np.linalg.norm(off[i]) * (T / 5.0 + way / 0.1)
                assert np.linalg.norm(step) <= way + fades + 1e-12
                assert np.linalg.norm(now[i] - measured[i]) <= np.linalg.norm(off[i]) + 1e-12
        points, confidence, before, off = measured, new, now, now - measured


@pytest.mark.parametrize("every", [1, 2, 5, 14])
@pytest.mark.parametrize("flickering", [[2], [0, 1, 2]])
def test_a_hand_at_rest_that_flickers_between_seen_and_guessed_stays_where_it_is(every, flickering):
    """Moved, then at rest; through the whole estimator, whose velocity comes from what offsets gave before."""
    person = Person.from_seed(1)
    estimator = ArmEstimator(Correspondence(lengths=LimbLengths(person.upper_arm, person.forearm)))
    shown = [JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist")]
    for k in range(240):
        way = 0.5 * np.clip(k / 30 - 1.0, 0.0, 0.6)
        truth = person.skeleton(k / 30, person.shoulder() + np.array([way - 0.1, -0.15, -0.35]))
        tracking = truth.tracking.copy()
        if 1.3 < k / 30 < 6.0 and (k // every) % 2 == 1:
            tracking[[shown[i] for i in flickering]] = Tracking.INFERRED
        estimate = estimator.update(Skeleton(truth.time, truth.positions, tracking, truth.hand_states))
        away = np.linalg.norm(estimate.wrist - FACING.apply(truth.arm().wrist))
        assert away < (0.15 if k < 75 else 0.02), k


def test_no_guess_is_taken_to_be_farther_off_than_a_camera_can_be():
    points = arm(np.random.default_rng(5))
    offsets = TrackingOffsets()
    offsets.compensate(points, SEEN, STILL, T)
    now = offsets.compensate(hidden(points, np.array([3.0, 0.0, 0.0])), GUESSED, STILL, T)
    np.testing.assert_allclose(now[2], points[2] + [3.0 - LONGEST_OFFSET, 0.0, 0.0])


def test_the_past_can_be_forgotten():
    offsets, points = TrackingOffsets(), arm(np.random.default_rng(4))
    elsewhere, off = seen_again(offsets, points)
    assert np.linalg.norm(off) > 0.05
    offsets.reset()
    for confidence in (GUESSED, GUESSED):  # a first sight is believed, whatever was before
        assert np.array_equal(offsets.compensate(elsewhere, confidence, STILL, T), elsewhere)


@pytest.mark.parametrize("options", [{"time": 0.0}, {"distance": 0.0}, {"time": -1.0}, {"distance": np.nan}])
def test_settings_that_never_let_go_are_refused(options):
    with pytest.raises(InputError, match="TrackingOffsets"):
        TrackingOffsets(**options)
