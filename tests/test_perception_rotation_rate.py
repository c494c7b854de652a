"""Angular velocities of tracked obstacles, and shapes that decide an assignment."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.perception import Detection, ObstacleTracker
from imitarm.perception.rotation_rate import turned
from imitarm.scene import Box, Capsule, Sphere

NOISE = 0.005**2 * np.eye(3)
seeds = st.integers(0, 2**32 - 1)


def box(rotation_vector, position=(0.0, 0.0, 0.0)):
    return Box(Pose(np.asarray(position), quaternion_exp(np.asarray(rotation_vector))), np.array([0.2, 0.1, 0.05]))


def followed(shapes, rate=30.0, **options):
    tracker = ObstacleTracker(rotations=True, **options)
    for k, shape in enumerate(shapes):
        tracker.update(k / rate, [Detection(shape, NOISE)])
    return tracker


@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_a_steady_rotation_is_estimated_and_predicted(seed):
    omega = np.random.default_rng(seed).normal(size=3)
    tracker = followed([box(k / 30.0 * omega) for k in range(30)])
    (track,) = tracker.tracks
    np.testing.assert_allclose(track.angular_velocity, omega, rtol=1e-3, atol=1e-6)
    (obstacle,) = tracker.scene(29 / 30.0 + 0.1).obstacles
    expected = quaternion_exp((29 / 30.0 + 0.1) * omega)
    assert abs(obstacle.solid().quaternion @ expected) == pytest.approx(1.0, abs=1e-6)


def test_an_obstacle_that_does_not_rotate_has_no_rate():
    tracker = followed([box([0.3, 0.2, 0.1], [0.01 * k, 0.0, 0.0]) for k in range(20)])
    assert not tracker.tracks[0].angular_velocity.any()
    assert not tracker.scene(0.8).packed.rotating


def test_without_the_option_no_obstacle_rotates():
    tracker = ObstacleTracker()
    for k in range(20):
        tracker.update(k / 30.0, [Detection(box([0.0, 0.0, 0.1 * k]), NOISE)])
    assert not tracker.scene(0.8).packed.rotating


def test_noise_of_the_measured_rotation_is_not_taken_for_a_rotation():
    rng = np.random.default_rng(3)
    rates = []
    for _ in range(20):
        tracker = followed([box(rng.normal(0.0, 0.05, 3)) for _ in range(30)])
        rates.append(np.linalg.norm(tracker.tracks[0].angular_velocity))
    assert np.median(rates) == 0.0
    assert np.max(rates) < 1.5  # [rad/s], where single differences have 2.6


@settings(deadline=None, max_examples=50)
@given(seed=seeds)
def test_rotations_that_can_not_be_seen_are_left_out(seed):
    rng = np.random.default_rng(seed)
    before = quaternion_exp(rng.normal(size=3))[None]
    step = quaternion_exp(0.3 * rng.uniform(-1.0, 1.0, 3))
    now = quaternion_multiply(step, before)
    half_turn = np.eye(4)[rng.integers(1, 4)]
    np.testing.assert_allclose(
        turned(["box"], before, quaternion_multiply(now, half_turn)), turned(["box"], before, now), atol=1e-9
    )
    about_axis = quaternion_multiply(before, quaternion_exp([0.0, 0.0, rng.uniform(-3.0, 3.0)]))
    np.testing.assert_allclose(turned(["capsule"], before, about_axis), 0.0, atol=1e-7)
    upside_down = quaternion_multiply(before, quaternion_exp([np.pi, 0.0, 0.0]))
    np.testing.assert_allclose(turned(["cylinder"], before, upside_down), 0.0, atol=1e-7)
    assert not turned(["sphere"], before, now).any()


def test_another_axis_of_the_fitted_shape_is_not_a_rotation():
    shapes = [box([0.0, 0.0, 0.5 * np.pi * (k % 2)]) for k in range(30)]
    assert np.linalg.norm(followed(shapes).tracks[0].angular_velocity) == 0.0


def test_shapes_decide_which_of_two_near_obstacles_is_which():
    small, large = Sphere([0.0, 0.0, 0.0], 0.03), Sphere([0.0, 0.0, 0.0], 0.08)
    rod = Capsule([-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], 0.03)
    for other in (large, rod):
        tracker = ObstacleTracker()
        for k in range(10):
            pair = [Detection(small.placed([-0.2 + 0.01 * k, 0, 0], [1, 0, 0, 0], np.zeros(3), np.zeros(3)), NOISE)]
            place = np.array([0.2 - 0.01 * k, 0.0, 0.0])
            pair.append(Detection(other.placed(place, other.solid().quaternion, np.zeros(3), np.zeros(3)), NOISE))
            tracker.update(k / 30.0, pair)
        first, second = tracker.tracks
        stamp = 30 / 30.0  # both have been hidden, and either detection may belong to either track
        near = [np.array([0.012, 0.0, 0.0]), np.array([-0.012, 0.0, 0.0])]
        seen = [
            Detection(shape.placed(at, shape.solid().quaternion, np.zeros(3), np.zeros(3)), NOISE)
            for shape, at in zip((small, other), near, strict=True)
        ]
        tracker.update(stamp - 0.4, seen)
        kinds = {track.track_id: track.obstacle for track in tracker.tracks}
        assert kinds[first.track_id].kind == "sphere"
        assert kinds[second.track_id].kind == other.kind
