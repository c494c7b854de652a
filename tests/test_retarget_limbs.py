import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import InputError
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton, Tracking
from imitarm.capture.synthetic import SyntheticSource
from imitarm.retarget.limbs import LimbLengths, correct_limbs, fit_limbs, measure_limbs

LENGTHS = LimbLengths(0.30, 0.26)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_corrected_bones_have_their_lengths_and_keep_their_directions(seed):
    points = np.random.default_rng(seed).normal(size=(3, 7, 3))
    elbow, wrist = correct_limbs(*points, LENGTHS)
    np.testing.assert_allclose(np.linalg.norm(elbow - points[0], axis=1), 0.30)
    np.testing.assert_allclose(np.linalg.norm(wrist - elbow, axis=1), 0.26)
    along = np.sum((elbow - points[0]) * (points[1] - points[0]), axis=1)
    np.testing.assert_allclose(along, 0.30 * np.linalg.norm(points[1] - points[0], axis=1))


def test_as_printed_the_elbow_is_on_the_other_side_of_the_shoulder_and_the_chain_is_broken():
    s, e, w = np.zeros(3), np.array([0.0, -0.25, 0.0]), np.array([0.0, -0.25, -0.25])
    elbow, wrist = correct_limbs(s, e, w, LENGTHS, as_printed=True)
    np.testing.assert_allclose(elbow, [0.0, 0.30, 0.0])
    assert np.linalg.norm(wrist - elbow) != pytest.approx(0.26, abs=0.05)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_fit_moves_all_three_points_by_the_least_that_gives_the_lengths(seed):
    rng = np.random.default_rng(seed)
    u, f = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    truth = np.cumsum([np.zeros(3), 0.30 * u, 0.26 * f], axis=0)
    measured = truth + 0.01 * rng.normal(size=(3, 3))
    confidence = np.array([1.0, rng.choice([0.2, 1.0]), 1.0])
    fitted = np.array(fit_limbs(measured, confidence, LENGTHS, rounds=6))
    np.testing.assert_allclose(np.linalg.norm(np.diff(fitted, axis=0), axis=1), [0.30, 0.26])

    def cost(points):
        return float((confidence * np.sum(np.square(points - measured), axis=1)).sum())

    s, elbow, wrist = measured[0], *correct_limbs(*measured, LENGTHS)
    assert cost(fitted) <= cost(np.array([s, elbow, wrist])) + 1e-9
    for _ in range(20):  # no arm of these lengths nearby fits better
        moved = fitted + 0.002 * rng.normal(size=(3, 3))
        feasible = np.array([moved[0], *correct_limbs(*moved, LENGTHS)])
        assert cost(fitted) <= cost(feasible) * 1.02 + 1e-8


def test_the_fit_finds_the_wrist_better_than_directions_do():
    fitted, directed = [], []
    for seed in range(3):
        person = Person.from_seed(seed)
        truth = reaching(person, seed, duration=8.0)
        lengths = LimbLengths(person.upper_arm, person.forearm)
        for seen in SyntheticSource(truth, SkeletonCamera(seed, dropout=0.0), 8.0):
            arm, wrist = seen.arm(), truth(seen.time).arm().wrist
            fitted.append(fit_limbs(arm.points[:3], arm.confidence[:3], lengths)[2] - wrist)
            directed.append(correct_limbs(*arm.points[:3], lengths)[1] - wrist)
    rms = [np.sqrt(np.mean(np.sum(np.square(e), axis=1))) for e in (fitted, directed)]
    assert rms[0] < 0.8 * rms[1]


def test_lengths_are_measured_to_a_few_millimetres_and_say_how_well():
    for seed in range(5):
        person = Person.from_seed(seed)
        hold = person.shoulder("right") + np.array([0.25, -0.3, -0.15])
        camera, frames, t = SkeletonCamera(seed, sigma=0.008, elbow_bias=0.0), [], 0.0
        while t < 6.0:
            seen = camera.see(person.skeleton(t, hold))
            frames += [] if seen is None else [seen]
            t = camera.next_time(t)
        found = measure_limbs(frames)
        assert found.upper_arm == pytest.approx(person.upper_arm, abs=0.02)
        assert found.forearm == pytest.approx(person.forearm, abs=0.02)
        assert 0.0 < found.standard_error < 0.005
        assert found.accepted


def test_outliers_do_not_change_the_lengths():
    person = Person.from_seed(0)
    hold = person.shoulder("right") + np.array([0.25, -0.3, -0.15])
    frames = [person.skeleton(k / 30, hold) for k in range(60)]
    thrown = []
    for k, frame in enumerate(frames):
        positions = np.array(frame.positions)
        if k % 4 == 0:
            positions[9] += [0.5, 0.0, 0.0]
        thrown.append(Skeleton(frame.time, positions))
    assert measure_limbs(thrown).upper_arm == pytest.approx(person.upper_arm, abs=0.002)


def test_an_arm_that_is_not_seen_has_no_lengths():
    tracking = np.full(25, Tracking.TRACKED)
    tracking[9] = Tracking.INFERRED
    frames = [Skeleton(k / 30, np.ones((25, 3)), tracking) for k in range(60)]
    with pytest.raises(InputError, match="tracked in 0 of 60"):
        measure_limbs(frames)
    with pytest.raises(InputError, match="upper_arm"):
        LimbLengths(30.0, 26.0)  # centimetres
