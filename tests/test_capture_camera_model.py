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


def watch(camera, seconds):
    t, frames, times, truth = 0.0, [], [], still(0.0)
    while t < seconds:
        frames.append(camera.see(Skeleton(t, truth.positions, hand_states=truth.hand_states)))
        times.append(t)
        t = camera.next_time(t)
    return np.array(times), frames


def moved(time, speed):
    """Everything moves at one speed, so that every error becomes another one in the same time."""
    truth = still(0.0)
    return Skeleton(time, truth.positions + [0.3 * np.sin(speed * time / 0.3), 0.0, 0.0])


def errors(seed, speed, seconds, **options):
    camera = SkeletonCamera(seed, dropout=0.0, occlusion=False, elbow_bias=0.0, jitter=0.0, **options)
    pairs = [(camera.see(truth), truth) for truth in (moved(i / 30, speed) for i in range(round(30 * seconds)))]
    return np.array([seen.positions - truth.positions for seen, truth in pairs if seen is not None])


def test_the_error_has_the_size_that_was_asked_for():
    spread = np.sqrt(
        np.mean(np.square(np.concatenate([errors(seed, 0.5, 5.0, sigma=0.015) for seed in range(4)])), axis=0)
    )
    body = [i for name, i in JOINT.items() if "tip" not in name and "thumb" not in name]
    np.testing.assert_allclose(spread[body].mean(axis=0), [0.015, 0.015, 0.021], rtol=0.15)
    assert 1.2 < spread[JOINT["thumb_left"]].mean() / spread[body].mean() < 1.8


def test_the_error_stays_at_rest_and_changes_with_the_way():
    lag = 10  # a third of a second
    change = [[np.std(e[lag:] - e[:-lag]) for e in (errors(1, v, 6.0)[:, ARM[0]],)] for v in (0.0, 0.05, 0.5)]
    rest, slow, quick = np.ravel(change)
    assert rest < 0.0025
    assert rest < slow < quick
    assert 0.010 < quick < 0.024  # by then it is another one: sigma times the root of 2


def test_what_is_new_in_every_frame_grows_with_the_speed():
    joints = [JOINT["elbow_left"], JOINT["wrist_left"]]
    rest, quick = (
        np.std(np.diff(errors(2, speed, 8.0)[:, joints, :2], 5, axis=0)) / np.sqrt(252.0) for speed in (0.0, 0.8)
    )
    assert rest == pytest.approx(0.02 * 0.012, rel=0.2)
    assert 0.002 < quick < 0.006


def test_neighbours_share_their_errors():
    e = np.concatenate([errors(seed, 0.5, 6.0) for seed in range(3)])[:, :, 0]
    elbow, wrist, other = (e[:, JOINT[name]] for name in ("elbow_right", "wrist_right", "wrist_left"))
    assert np.corrcoef(elbow, wrist)[0, 1] > 0.8
    assert abs(np.corrcoef(wrist, other)[0, 1]) < 0.6


def test_frames_come_at_their_rate_with_jitter_and_some_are_left_out():
    times, frames = watch(SkeletonCamera(2), 60.0)
    gaps = np.diff(times)
    assert np.median(gaps) == pytest.approx(1 / 30, abs=5e-4)
    assert 0.0005 < gaps[gaps < 0.045].std() < 0.003
    assert 0.01 < np.mean(gaps > 0.05) < 0.06
    assert 0.0 < np.mean([f is None for f in frames]) < 0.05


def test_dropouts_last_2_to_20_frames():
    _, frames = watch(SkeletonCamera(3, dropout=0.7), 120.0)
    runs = "".join(" " if f is None or f.tracking[ARM[1]] == Tracking.TRACKED else "x" for f in frames).split()
    whole = [len(run) for run in runs]
    assert len(whole) > 20
    assert max(whole) > 15
    assert 2 <= np.median(whole) <= 20
    assert {Tracking.LOST, Tracking.INFERRED} <= {f.tracking[ARM[1]] for f in frames if f is not None}
    nobody = "".join("x" if f is None else " " for f in frames).split()
    assert 2 <= max(map(len, nobody)) <= 25  # a single frame may be lost beside it
    assert max(whole) <= 40  # one right after the other


def test_a_forearm_behind_the_torso_is_inferred():
    truth = still(0.0)
    positions = np.array(truth.positions)
    positions[ARM[1]] = positions[JOINT["spine_mid"]] + [0.0, 0.0, 0.2]
    seen = SkeletonCamera(4, dropout=0.0).see(Skeleton(0.0, positions))
    assert SkeletonCamera(4, dropout=0.0, occlusion=False).see(truth).tracking[ARM[1]] == Tracking.TRACKED
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
    _, frames = watch(SkeletonCamera(6), 60.0)
    wrong = [f.hand_states[1] is not HandState.OPEN for f in frames if f is not None]
    assert 0.002 < np.mean(wrong) < 0.05
    runs = "".join("x" if w else " " for w in wrong).split()
    assert max(map(len, runs)) <= 4


def test_sigma_of_a_numbered_camera_is_1_to_2_cm():
    sigma = [SkeletonCamera.from_seed(seed).sigma for seed in range(30)]
    assert 0.01 <= min(sigma) < 0.013 < 0.017 < max(sigma) <= 0.02
    assert SkeletonCamera.from_seed(4).sigma == SkeletonCamera.from_seed(4).sigma


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
    "options", [{"sigma": -0.1}, {"sigma": 3.0}, {"rate": 0.0}, {"dropout": -1.0}, {"elbow_bias": 1.0}, {"jitter": 0.1}]
)
def test_settings_of_no_camera_are_refused(options):
    with pytest.raises(InputError, match="SkeletonCamera"):
        SkeletonCamera(0, **options)
