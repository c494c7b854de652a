"""ObstacleTracker: births, deaths, identities, prediction, and input that is imperfect or invalid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import Detection, ObstacleTracker
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, HalfSpace, Sphere

SIGMA = 0.005  # [m]
NOISE = SIGMA**2 * np.eye(3)
MOTIONS = ("constant-velocity", "constant-acceleration", "imm", "ekf")
seeds = st.integers(0, 2**32 - 1)
each_motion = pytest.mark.parametrize("motion", MOTIONS)


def sphere(position, label="", radius=0.05, covariance=NOISE):
    return Detection(Sphere(np.asarray(position, dtype=float), radius), covariance, label)


def run(tracker, positions, times):
    """Update with one detection each."""
    for time, position in zip(times, positions, strict=True):
        tracks = tracker.update(time, [sphere(position)])
    return tracks


@each_motion
def test_a_steady_obstacle_is_followed(motion):
    rng = np.random.default_rng(1)
    velocity = np.array([0.3, -0.2, 0.1])
    times = np.arange(90) / 30.0
    truth = times[:, None] * velocity
    tracker = ObstacleTracker(motion)
    (track,) = run(tracker, truth + rng.normal(0.0, SIGMA, truth.shape), times)
    assert track.track_id == 0
    assert np.linalg.norm(track.position - truth[-1]) < 2.0 * SIGMA
    assert np.linalg.norm(track.velocity - velocity) < 0.2
    assert track.last_seen == track.stamp == times[-1]
    assert track.covariance.shape == (6, 6)
    assert track.covariance[0, 0] < NOISE[0, 0]


@each_motion
def test_a_scene_is_predicted_to_its_time(motion):
    times = np.arange(60) / 30.0
    velocity = np.array([0.3, -0.2, 0.1])
    tracker = ObstacleTracker(motion)
    (track,) = run(tracker, times[:, None] * velocity, times)
    goal = Pose(np.array([0.5, 0.0, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]))
    scene = tracker.scene(times[-1] + 0.1, goal=goal, fixtures=(HalfSpace(np.zeros(3)),))
    (obstacle,) = scene.obstacles
    assert scene.stamp == times[-1] + 0.1
    assert scene.goal is goal
    assert len(scene.fixtures) == 1
    ahead = track.predict(0.1)
    np.testing.assert_allclose(obstacle.center, ahead.position, atol=1e-12)
    np.testing.assert_allclose(obstacle.velocity, ahead.velocity, atol=1e-12)
    np.testing.assert_allclose(obstacle.covariance, ahead.covariance[:3, :3], atol=1e-15)
    np.testing.assert_allclose(scene.packed.covariances[0], obstacle.covariance, atol=1e-15)
    assert (obstacle.track_id, obstacle.name) == (0, "track 0")
    assert scene.packed.stamps[0] == times[-1]
    assert np.trace(ahead.covariance) > np.trace(track.covariance)
    np.testing.assert_allclose(obstacle.center, (times[-1] + 0.1) * velocity, atol=2e-3)


def test_without_confirmed_tracks_the_scene_is_empty():
    tracker = ObstacleTracker()
    assert tracker.scene(1.0).obstacles == ()
    assert tracker.update(0.0, [sphere([0, 0, 0])]) == ()
    assert tracker.scene(1.0).obstacles == ()
    assert tracker.scene(1.0).stamp == 1.0


def test_two_of_three_updates_confirm_a_track():
    for seen, confirmed in (((1, 1, 1), 1), ((1, 0, 1), 1), ((1, 1, 0), 1), ((1, 0, 0), 0)):
        tracker = ObstacleTracker()
        for k, there in enumerate(seen):
            tracker.update(0.03 * k, [sphere([0, 0, 0])] * there)
        assert len(tracker.tracks) == confirmed
    once = ObstacleTracker(confirm=(1, 1))
    assert len(once.update(0.0, [sphere([0, 0, 0])])) == 1


def test_a_hidden_track_grows_uncertain_and_ends():
    tracker = ObstacleTracker(max_unseen=0.5)
    times = np.arange(30) / 30.0
    run(tracker, times[:, None] * [0.2, 0.0, 0.0], times)
    sizes = [np.trace(tracker.tracks[0].covariance[:3, :3])]
    for k in range(15):
        (track,) = tracker.update(times[-1] + (k + 1) / 30.0, [])
        sizes.append(np.trace(track.covariance[:3, :3]))
        assert track.last_seen == times[-1]
    assert (np.diff(sizes) > 0.0).all()
    np.testing.assert_allclose(track.position[0], 0.2 * track.stamp, atol=0.01)
    assert tracker.update(times[-1] + 0.55, []) == ()


def test_the_speed_is_capped():
    tracker = ObstacleTracker(max_speed=0.5, initial_speed=2.0)
    times = np.arange(10) / 30.0
    (track,) = run(tracker, times[:, None] * [0.55, 0.0, 0.0], times)
    assert 0.49 < np.linalg.norm(track.velocity) <= 0.5 + 1e-12


SUDDEN = {"stops": (0.6, 0.0), "starts": (0.0, 0.6), "turns back": (0.4, -0.4), "turns aside": (0.4, 0.4j)}
"""Speeds before and after the change, as complex numbers: real along x, imaginary along y [m/s]."""


@each_motion
@pytest.mark.parametrize("change", SUDDEN)
def test_a_track_continues_after_a_sudden_change(motion, change):
    before, after = SUDDEN[change]
    times = np.arange(90) / 30.0
    place = np.where(times < 1.5, before * times, before * 1.5 + after * (times - 1.5))
    truth = np.column_stack([place.real, place.imag, np.zeros(90)])
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0.0, SIGMA, truth.shape)
        tracker = ObstacleTracker(motion)
        for time, position in zip(times, truth + noise, strict=True):
            tracks = tracker.update(time, [sphere(position)])
            assert len(tracks) <= 1, f"at {time:.2f} s, a second track follows the same obstacle"
        assert tracks[0].track_id == 0
        velocity = np.array([complex(after).real, complex(after).imag, 0.0])
        assert np.linalg.norm(tracks[0].velocity - velocity) < (0.45 if motion == "constant-acceleration" else 0.25)
        assert np.linalg.norm(tracks[0].position - truth[-1]) < 4.0 * SIGMA


@each_motion
def test_a_merged_track_has_the_shape_that_was_detected_last(motion):
    tracker = ObstacleTracker(motion)
    for time in np.arange(30) / 30.0:
        tracker.update(time, [sphere([0.6 * time, 0.0, 0.0])])  # without a label
    can = Cylinder(Pose(np.array([0.53, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])), 0.03, 0.12)
    for time in 1.0 + np.arange(5) / 30.0:
        tracks = tracker.update(time, [Detection(can, NOISE, "can")])
    (track,) = tracks
    assert (track.track_id, track.label) == (0, "can") and isinstance(track.obstacle, Cylinder)
    (seen,) = tracker.scene(1.2).obstacles
    np.testing.assert_allclose([seen.radius, seen.length], [0.03, 0.12])


@each_motion
def test_a_new_obstacle_far_from_a_lost_one_gets_a_track_of_its_own(motion):
    tracker = ObstacleTracker(motion)
    times = np.arange(30) / 30.0
    run(tracker, times[:, None] * [0.3, 0.0, 0.0], times)
    elsewhere = np.array([0.3, 0.25, 0.0])
    for time in 1.0 + np.arange(3) / 30.0:
        tracks = tracker.update(time, [sphere(elsewhere)])
    assert [track.track_id for track in tracks] == [0, 1]


@each_motion
def test_a_label_is_never_continued_by_another(motion):
    tracker = ObstacleTracker(motion)
    for time in np.arange(30) / 30.0:
        tracker.update(time, [sphere([0.6 * time, 0.0, 0.0], "bottle")])
    for time in 1.0 + np.arange(3) / 30.0:
        tracks = tracker.update(time, [sphere([0.58, 0.03, 0.0], "cube")])
    assert [track.label for track in tracks] == ["bottle", "cube"]


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_a_standing_obstacle_is_exact(seed):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, 3)
    tracker = ObstacleTracker()
    times = np.cumsum(rng.uniform(0.005, 0.1, 20))
    (track,) = run(tracker, [position] * 20, times)
    np.testing.assert_array_equal(track.position, position)
    np.testing.assert_array_equal(track.velocity, np.zeros(3))
    scene = tracker.scene(times[-1] + rng.uniform(0.0, 0.5))
    np.testing.assert_array_equal(scene.obstacles[0].center, position)
    assert scene.packed.still


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_exact_detections_give_exact_estimates(seed):
    rng = np.random.default_rng(seed)
    velocity = rng.uniform(-0.3, 0.3, 3)
    times = np.cumsum(rng.uniform(0.02, 0.05, 20))
    tracker = ObstacleTracker(process_noise=1e-6)
    for time in times:
        tracks = tracker.update(time, [sphere(velocity * time, covariance=np.zeros((3, 3)))])
    np.testing.assert_allclose(tracks[0].position, velocity * times[-1], atol=1e-9)
    np.testing.assert_allclose(tracks[0].velocity, velocity, atol=1e-6)


def test_shapes_keep_their_kind_and_smooth_their_size():
    rng = np.random.default_rng(5)
    pose = Pose(np.array([0.4, 0.1, 0.2]), quaternion_exp(np.array([0.2, -0.4, 0.1])))
    points = rng.normal(size=(12, 3)) * 0.05
    sizes = 1.0 + rng.normal(0.0, 0.1, 40)
    shapes = {
        "sphere": lambda f: Sphere(pose.position, 0.05 * f),
        "box": lambda f: Box(pose, f * np.array([0.1, 0.2, 0.3])),
        "capsule": lambda f: Capsule(pose.position, pose.position + f * np.array([0.0, 0.0, 0.2]), 0.05 * f),
        "cylinder": lambda f: Cylinder(pose, 0.05 * f, 0.2 * f),
        "convex_hull": lambda f: ConvexHull(points),
    }
    for kind, shape in shapes.items():
        tracker = ObstacleTracker()
        for k, factor in enumerate(sizes):
            tracks = tracker.update(k / 30.0, [Detection(shape(factor), NOISE)])
        solid = tracks[0].obstacle.solid()
        assert solid.kind == kind
        expected = shape(1.0).solid()
        np.testing.assert_allclose(solid.quaternion, expected.quaternion, atol=1e-12)
        if kind != "convex_hull":
            last = np.linalg.norm(np.asarray(shape(sizes[-1]).solid().size) - expected.size)
            assert np.linalg.norm(np.asarray(solid.size) - expected.size) < max(0.08 * np.max(expected.size), last)
        constant = ObstacleTracker()
        for k in range(4):
            tracks = constant.update(k / 30.0, [Detection(shape(1.0), NOISE)])
        np.testing.assert_array_equal(tracks[0].obstacle.solid().size, expected.size)


def test_invalid_detections_are_refused():
    for wrong in (np.full((3, 3), np.nan), np.eye(2), -np.eye(3), np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1.0]])):
        with pytest.raises(InputError, match="covariance"):
            Detection(Sphere(np.zeros(3), 0.1), wrong)
    with pytest.raises(InputError, match="center"):
        sphere([np.nan, 0.0, 0.0])
    with pytest.raises(InputError, match="half-space"):
        Detection(HalfSpace(np.zeros(3)), NOISE)
    with pytest.raises(InputError, match="obstacle must be"):
        Detection("a box", NOISE)
    with pytest.raises(InputError, match="label"):
        Detection(Sphere(np.zeros(3), 0.1), NOISE, label="two\nlines")
    camera = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="in front of the camera"):
        Detection(Sphere(np.array([0.0, 0.0, -1.0]), 0.1), NOISE, camera_to_base=camera)


def test_an_invalid_update_changes_nothing():
    tracker = ObstacleTracker(max_obstacles=2)
    run(tracker, np.zeros((3, 3)), [0.0, 0.1, 0.2])
    before = tracker.tracks
    with pytest.raises(InputError, match="stamp"):
        tracker.update(np.nan, [])
    with pytest.raises(InputError, match="sequence of Detection"):
        tracker.update(0.3, [Sphere(np.zeros(3), 0.1)])
    with pytest.raises(InputError, match="max_obstacles = 2"):
        tracker.update(0.3, [sphere([k, 0, 0]) for k in range(3)])
    with pytest.raises(InputError, match="reset"):
        tracker.update(-100.0, [])
    assert tracker.tracks == before
    tracker.reset()
    assert tracker.tracks == ()
    assert tracker.stamp is None
    run(tracker, np.zeros((3, 3)), [-100.0, -99.9, -99.8])
    assert len(tracker.tracks) == 1


def test_invalid_arguments_are_refused():
    for wrong in (
        {"motion": "circular"},
        {"process_noise": -1.0},
        {"process_noise": (1.0, 2.0)},
        {"motion": "imm", "process_noise": 1.0},
        {"gate": 1.0},
        {"gate": 0.0},
        {"confirm": (3, 2)},
        {"confirm": 2},
        {"max_unseen": 0.0},
        {"max_speed": np.inf},
        {"max_obstacles": 0},
        {"initial_speed": 0.0},
        {"history": -1.0},
    ):
        with pytest.raises(InputError):
            ObstacleTracker(**wrong)
