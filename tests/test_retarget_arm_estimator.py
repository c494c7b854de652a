from dataclasses import replace

import numpy as np
import pytest

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, HandState, Skeleton, Tracking
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import UnknownNameError
from imitarm.retarget import FACING, Correspondence, LimbLengths
from imitarm.retarget.arm_estimator import ArmEstimator
from imitarm.retarget.smoothing import TrackingOffsets

PERSON = Person.from_seed(2)
LENGTHS = LimbLengths(PERSON.upper_arm, PERSON.forearm)
HOLD = PERSON.shoulder("right") + np.array([0.2, -0.25, -0.25])


def frames(seconds=1.0, **options):
    return [PERSON.skeleton(k / 30, HOLD, **options) for k in range(int(30 * seconds))]


def test_without_noise_it_is_the_arm_in_the_base_frame():
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS), smoothing=False)
    for frame in frames(0.3):
        estimate, arm = estimator.update(frame), frame.arm()
        np.testing.assert_allclose(estimate.shoulder, FACING.apply(arm.shoulder), atol=1e-9)
        np.testing.assert_allclose(estimate.elbow, FACING.apply(arm.elbow), atol=1e-9)
        np.testing.assert_allclose(estimate.wrist, FACING.apply(arm.wrist), atol=1e-9)
        assert estimate.confidence == (1.0, 1.0, 1.0)


def test_smoothing_takes_off_noise_and_bones_keep_their_lengths():
    truth = reaching(PERSON, 0, duration=8.0)
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS), smoothing=False)
    seen = 0
    for frame in SyntheticSource(truth, SkeletonCamera(0), 8.0):
        estimate = estimator.update(frame)
        if estimate is not None:
            seen += 1
            assert np.linalg.norm(estimate.elbow - estimate.shoulder) == pytest.approx(PERSON.upper_arm)
            assert np.linalg.norm(estimate.wrist - estimate.elbow) == pytest.approx(PERSON.forearm)
    assert seen > 150


def test_lengths_that_are_not_known_are_learnt_first():
    estimator = ArmEstimator(Correspondence())
    estimates = [estimator.update(frame) for frame in frames(2.0)]
    assert estimates[0] is None
    assert estimates[-1] is not None
    assert estimator.lengths.upper_arm == pytest.approx(PERSON.upper_arm, abs=2e-3)


def test_a_lost_arm_an_old_frame_and_a_jump_give_no_estimate():
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS))
    shown = frames(1.0)
    for frame in shown:
        assert estimator.update(frame) is not None
    assert estimator.update(shown[3]) is None  # time runs backwards
    lost = np.array(shown[-1].positions)
    lost[10] = np.inf
    assert estimator.update(Skeleton(1.0, lost)) is None
    away = np.array(shown[-1].positions)
    away[8:12] += [0.0, 0.0, 0.0]
    away[10] += [0.0, 0.6, 0.0]
    assert estimator.update(Skeleton(1.04, away)) is None
    assert estimator.update(PERSON.skeleton(1.07, HOLD)) is not None


def test_a_hand_counts_as_closed_when_three_frames_say_so():
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS))
    for frame in frames(0.5):
        estimate = estimator.update(frame)
    assert estimate.closed is False
    states = [True, True, False, True, True, True]
    for k, closed in enumerate(states):
        estimate = estimator.update(PERSON.skeleton(0.5 + k / 30, HOLD, closed=closed))
        assert estimate.closed is (k == 5)
    unknown = Skeleton(0.9, PERSON.skeleton(0.9, HOLD).positions, hand_states=(HandState.UNKNOWN, HandState.UNKNOWN))
    assert estimator.update(unknown).closed is True


def test_the_hand_is_carried_by_the_forearm_when_it_is_not_seen():
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS), smoothing=False)
    for frame in frames(0.3):
        before = estimator.update(frame)
    positions = np.array(PERSON.skeleton(0.3, HOLD).positions)
    positions[24] = np.nan  # the thumb
    after = estimator.update(Skeleton(0.3, positions))
    assert after.confidence[2] == 0.0
    assert abs(float(after.hand @ before.hand)) > 0.999


def test_an_unknown_way_with_limbs_is_named():
    with pytest.raises(UnknownNameError, match="fit"):
        ArmEstimator(Correspondence(), limbs="guess")


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_at_rest_that_is_hidden_now_and_then_wanders_less_than_half_as_far(seed, monkeypatch):
    """The way that its estimate goes, with and without compensation of offsets; the camera often loses the arm."""
    still = Person(**{**PERSON.__dict__, "tremor": 0.0 * PERSON.tremor, "sway": 0.0 * PERSON.sway})

    def wandered():
        camera = SkeletonCamera(seed, sigma=0.015, dropout=2.0)
        estimator = ArmEstimator(Correspondence(lengths=LENGTHS))
        source = SyntheticSource(lambda t: still.skeleton(t, HOLD), camera, 20.0)
        wrist = [estimate.wrist for estimate in map(estimator.update, source) if estimate is not None]
        assert len(wrist) > 300
        return np.linalg.norm(np.diff(wrist, axis=0), axis=1).sum()

    compensated = wandered()
    monkeypatch.setattr(TrackingOffsets, "compensate", lambda self, points, *_: points)
    assert compensated < 0.5 * wandered()


def test_an_elbow_that_is_guessed_wrong_does_not_pull_the_wrist_away():
    """Guessed 15 cm off, then seen again: what it was compensated to is doubtful, the wrist is seen all the time."""
    still = Person(**{**PERSON.__dict__, "tremor": 0.0 * PERSON.tremor, "sway": 0.0 * PERSON.sway})
    estimator, off = ArmEstimator(Correspondence(lengths=LENGTHS)), []
    arm = still.skeleton(0.0, HOLD).arm()
    along = (arm.wrist - arm.elbow) / np.linalg.norm(arm.wrist - arm.elbow)
    for k in range(120):
        true = still.skeleton(k / 30, HOLD)
        positions, tracking = true.positions.copy(), true.tracking.copy()
        elbow = JOINT["elbow_right"]
        if 30 <= k < 90:  # the guess creeps away while the elbow is hidden
            tracking[elbow] = Tracking.INFERRED
            positions[elbow] += 0.15 * (k - 30) / 60 * along
        estimate = estimator.update(replace(true, positions=positions, tracking=tracking))
        off.append(np.linalg.norm(estimate.wrist - FACING.apply(true.arm().wrist)))
    assert max(off[95:]) < 0.005  # the wrist was off for seconds
    assert np.abs(np.diff(off)).max() < 0.02  # and leapt when the elbow was back


def test_without_smoothing_nothing_is_anchored():
    """What is given as it is corrected stays so, hidden or not."""
    estimator = ArmEstimator(Correspondence(lengths=LENGTHS), smoothing=False)
    for k, frame in enumerate(frames(1.0)):
        tracking = np.array(frame.tracking)
        tracking[9:11] = Tracking.INFERRED if k % 6 < 3 else Tracking.TRACKED
        estimate = estimator.update(Skeleton(frame.time, frame.positions, tracking))
        np.testing.assert_allclose(estimate.wrist, FACING.apply(frame.arm().wrist), atol=1e-9)
