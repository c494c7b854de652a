import numpy as np
import pytest

from imitarm import InputError
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.recording import read_recording
from imitarm.capture.sensor_quality import measure_noise
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton
from imitarm.capture.synthetic import SyntheticSource

GESTURES = ("Ges01_wavehand", "Ges02_balancinghands", "Ges03_drawlines", "Ges04_comehere")
WHITE = {  # largest share of real over made-up noise, both ways
    "spine_mid": 2.0,
    "elbow_left": 2.0,
    "wrist_left": 2.0,
    "hand_right": 1.6,
    "hand_tip_right": 1.6,
    "thumb_right": 1.6,
}


def middle(noises, what, joint):
    return np.nanmedian([getattr(noise, what)[JOINT[joint]] for noise in noises])


@pytest.fixture(scope="module")
def real(real_data):
    return [measure_noise(read_recording(real_data / "kinect_gestures" / f"{g}.csv").skeletons) for g in GESTURES]


@pytest.fixture(scope="module")
def made_up():
    people = [Person.from_seed(seed) for seed in range(6)]
    return [
        measure_noise(SyntheticSource(reaching(p, p.seed, duration=7.0), SkeletonCamera(p.seed, dropout=0.0), 7.0))
        for p in people
    ]


def test_white_noise_is_found_beneath_a_motion():
    rng = np.random.default_rng(0)
    body = np.zeros((25, 3)) + [0.0, 0.0, 2.0]
    times = np.arange(400) / 30
    wave = 0.2 * np.sin(2 * np.pi * times)  # at most 1.3 m/s
    moves = np.arange(25) == JOINT["wrist_right"]
    frames = [
        Skeleton(t, body + moves[:, None] * [w, 0.0, 0.0] + rng.normal(0.0, 0.002, (25, 3)))
        for t, w in zip(times, wave, strict=True)
    ]
    noise = measure_noise(frames)
    np.testing.assert_allclose(noise.at_rest[~moves], 0.002, rtol=0.2)
    assert noise.in_motion[moves] == pytest.approx(0.002, rel=0.25)
    assert np.isnan(noise.in_motion[~moves]).all()
    assert noise.bones["left hand"][1] < 0.004
    assert noise.median_interval == pytest.approx(1 / 30)
    assert noise.late == 0.0
    assert noise.jitter == pytest.approx(0.0, abs=1e-12)
    text = str(noise)
    assert all(name in text for name in (*JOINTS, "left forearm"))


def test_what_can_not_be_measured_is_refused():
    frames = [Skeleton(i / 30, np.zeros((25, 3))) for i in range(30)]
    with pytest.raises(InputError, match="too few"):
        measure_noise(frames[:10])
    with pytest.raises(InputError, match="frame 30"):
        measure_noise([*frames, frames[3]])


def test_figures_of_the_real_recordings(real):
    assert [noise.n_frames for noise in real] == [154, 161, 213, 172]
    for noise in real:
        assert noise.median_interval == pytest.approx(0.033, abs=1e-4)
        assert 0.0005 < noise.jitter < 0.0006
        assert 0.012 < noise.late < 0.030
        assert 0.066 < noise.longest_interval < 0.068
        assert noise.inferred.max() < 0.07
        stds = [noise.bones[f"{side} upper arm"][1] for side in ("left", "right")]
        assert 0.008 < min(stds) <= max(stds) < 0.022
        assert max(noise.bones[f"{side} forearm"][1] for side in ("left", "right")) < 0.019
    at_rest = {joint: middle(real, "at_rest", joint) for joint in JOINTS}
    assert at_rest["spine_mid"] < 0.00015
    assert 0.0001 < at_rest["wrist_right"] < at_rest["wrist_left"] < 0.0004
    assert 0.0009 < at_rest["hand_right"] < 0.0011
    assert 0.002 < at_rest["hand_tip_right"] < at_rest["thumb_right"] < 0.004
    assert 0.003 < middle(real, "in_motion", "wrist_right") < 0.005


@pytest.mark.parametrize("joint", WHITE)
def test_made_up_noise_at_rest_is_like_that_of_real_recordings(real, made_up, joint):
    share = middle(made_up, "at_rest", joint) / middle(real, "at_rest", joint)
    assert 1.0 / WHITE[joint] < share < WHITE[joint]


@pytest.mark.parametrize("joint", ["elbow_right", "wrist_right", "hand_right", "hand_tip_right", "thumb_right"])
def test_made_up_noise_in_motion_is_like_that_of_real_recordings(real, made_up, joint):
    share = middle(made_up, "in_motion", joint) / middle(real, "in_motion", joint)
    assert 0.4 < share < 2.0


def test_made_up_bones_and_intervals_are_like_those_of_real_recordings(real, made_up):
    for bone, least, most in (("upper arm", 0.6, 2.0), ("forearm", 0.5, 2.5)):  # the right arm moves in both
        real_std, std = (np.median([n.bones[f"right {bone}"][1] for n in group]) for group in (real, made_up))
        assert least < std / real_std < most
    assert np.median([n.late for n in made_up]) == pytest.approx(np.median([n.late for n in real]), abs=0.02)
    assert all(0.0010 < n.jitter < 0.0020 for n in made_up)  # three times that of a real Kinect
