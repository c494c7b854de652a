import numpy as np
import pytest

from imitarm import InputError
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, HandState, Skeleton, Tracking

PERSON = Person.from_seed(0)
WRIST = PERSON.shoulder("right") + np.array([0.15, -0.15, -0.3])
ARM = [JOINT[name] for name in ("elbow_right", "wrist_right")]


def still(time, wrist=WRIST):
    steady = Person(**{**PERSON.__dict__, "tremor": 0.0 * PERSON.tremor, "sway": 0.0 * PERSON.sway})
    return steady.skeleton(time, wrist)


def watch(camera, seconds, wrist=WRIST):
    t, frames, times = 0.0, [], []
    while t < seconds:
        frames.append(camera.see(still(t, wrist)))
        times.append(t)
        t = camera.next_time(t)
    return np.array(times), frames


def test_the_error_has_the_size_that_was_asked_for():
    errors = []
    for seed in range(24):
        _, frames = watch(SkeletonCamera(seed, sigma=0.015, dropout=0.0, elbow_bias=0.0), 4.0)
        errors += [f.joint("spine_mid") - still(f.time).joint("spine_mid") for f in frames if f is not None]
    spread = np.std(errors, axis=0)
    np.testing.assert_allclose(spread, [0.015, 0.015, 0.021], rtol=0.15)


def test_only_a_small_part_of_the_error_is_new_in_every_frame():
    _, frames = watch(SkeletonCamera(1, sigma=0.012, dropout=0.0), 60.0)
    x = np.array([f.joint("head")[:2] for f in frames if f is not None])
    third = np.diff(x, 3, axis=0)
    white = 1.4826 * np.median(np.abs(third)) / np.sqrt(20.0)
    assert 0.001 < white < 0.004


def test_frames_come_at_their_rate_with_jitter_and_some_are_left_out():
    times, frames = watch(SkeletonCamera(2), 60.0)
    gaps = np.diff(times)
    assert np.median(gaps) == pytest.approx(1 / 30, abs=5e-4)
    assert 0.0005 < gaps[gaps < 0.045].std() < 0.003
    assert 0.01 < np.mean(gaps > 0.05) < 0.06
    assert 0.0 < np.mean([f is None for f in frames]) < 0.03


def test_dropouts_last_2_to_20_frames():
    camera = SkeletonCamera(3, dropout=1.0)
    _, frames = watch(camera, 120.0)
    bad = [f is not None and f.tracking[ARM[1]] != Tracking.TRACKED for f in frames if f is not None]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad, [0]])))
    lengths = edges[1::2] - edges[::2]
    assert len(lengths) > 20
    assert np.median(lengths) >= 2
    assert lengths.min() >= 1  # a lost frame may cut one
    assert {Tracking.LOST, Tracking.INFERRED} <= {f.tracking[ARM[1]] for f in frames if f is not None}


def test_a_forearm_behind_the_torso_is_inferred():
    truth = still(0.0)
    positions = np.array(truth.positions)
    positions[ARM[1]] = positions[JOINT["spine_mid"]] + [0.0, 0.0, 0.2]
    seen = SkeletonCamera(4, dropout=0.0).see(Skeleton(0.0, positions))
    assert seen.tracking[ARM[1]] == Tracking.INFERRED
    assert seen.tracking[JOINT["wrist_left"]] == Tracking.TRACKED


def test_an_elbow_behind_its_own_hand_is_inferred():
    shoulder = PERSON.shoulder("right")
    pointing = shoulder * (1.0 - 0.5 / np.linalg.norm(shoulder))  # straight at the sensor
    truth = still(0.0, pointing)
    positions = np.array(truth.positions)
    positions[ARM[0]] = 0.5 * (positions[JOINT["shoulder_right"]] + positions[ARM[1]])
    seen = SkeletonCamera(5, dropout=0.0).see(Skeleton(0.0, positions))
    assert seen.tracking[ARM[0]] == Tracking.INFERRED


def test_hands_are_misread_now_and_then_and_never_for_long():
    _, frames = watch(SkeletonCamera(6), 120.0)
    wrong = [f.hand_states[1] is not HandState.OPEN for f in frames if f is not None]
    assert 0.002 < np.mean(wrong) < 0.05
    runs = "".join("x" if w else " " for w in wrong).split()
    assert max(map(len, runs)) <= 4


def test_one_seed_is_one_recording_and_an_ideal_camera_sees_the_truth():
    first, second = (watch(SkeletonCamera(7), 3.0)[1] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a.positions, b.positions)
    times, frames = watch(SkeletonCamera.ideal(), 1.0)
    np.testing.assert_allclose(np.diff(times), 1 / 30)
    for f in frames:
        np.testing.assert_array_equal(f.positions, still(f.time).positions)


@pytest.mark.parametrize(
    "options", [{"sigma": -0.1}, {"sigma": 3.0}, {"rate": 0.0}, {"dropout": -1.0}, {"elbow_bias": 1.0}]
)
def test_settings_of_no_camera_are_refused(options):
    with pytest.raises(InputError, match="SkeletonCamera"):
        SkeletonCamera(0, **options)
