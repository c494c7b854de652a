"""ObstacleTracker with several obstacles and imperfect input: order, time stamps, duplicates, jumps, crossings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.perception import Detection, ObstacleTracker
from imitarm.scene import Sphere

SIGMA = 0.005  # [m]
NOISE = SIGMA**2 * np.eye(3)
MOTIONS = ("constant-velocity", "constant-acceleration", "imm", "ekf")
seeds = st.integers(0, 2**32 - 1)
motions = st.sampled_from(MOTIONS)


def sphere(position, label="", radius=0.03, covariance=NOISE):
    return Detection(Sphere(np.asarray(position, dtype=float), radius), covariance, label)


def recording(rng, n_obstacles=3, n_updates=25, dropout=0.1):
    """Stamps and detected positions of obstacles that move steadily."""
    start, velocity = rng.uniform(-0.5, 0.5, (n_obstacles, 3)), rng.uniform(-0.3, 0.3, (n_obstacles, 3))
    times = np.cumsum(rng.uniform(0.02, 0.05, n_updates))
    frames = []
    for time in times:
        positions = start + time * velocity + rng.normal(0.0, SIGMA, start.shape)
        frames.append(positions[rng.uniform(size=n_obstacles) >= dropout])
    return times, frames


def replayed(tracker, times, frames):
    for time, positions in zip(times, frames, strict=True):
        tracker.update(time, [sphere(p) for p in positions])
    return tracker.tracks


def state(tracks, order=None):
    """Positions, velocities and covariances of tracks, sorted by position."""
    rows = [np.concatenate([t.position, t.velocity, t.covariance.ravel()]) for t in tracks]
    return np.array(sorted(rows, key=lambda row: row[0]))


@settings(deadline=None, max_examples=15)
@given(seed=seeds, motion=motions)
def test_the_order_of_detections_changes_nothing_but_numbers(seed, motion):
    rng = np.random.default_rng(seed)
    times, frames = recording(rng)
    a = replayed(ObstacleTracker(motion), times, frames)
    b = replayed(ObstacleTracker(motion), times, [rng.permutation(positions) for positions in frames])
    np.testing.assert_allclose(state(b), state(a), rtol=1e-9, atol=1e-12)
    assert {t.track_id for t in a} == {t.track_id for t in b}


@settings(deadline=None, max_examples=15)
@given(seed=seeds, motion=motions, axis=st.integers(0, 2))
def test_mirrored_detections_give_mirrored_tracks(seed, motion, axis):
    times, frames = recording(np.random.default_rng(seed))
    mirror = np.ones(3)
    mirror[axis] = -1.0
    a = replayed(ObstacleTracker(motion), times, frames)
    b = replayed(ObstacleTracker(motion), times, [mirror * positions for positions in frames])
    assert [t.track_id for t in a] == [t.track_id for t in b]
    signs = np.concatenate([mirror, mirror])
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(other.position, mirror * one.position, atol=1e-9)
        np.testing.assert_allclose(other.velocity, mirror * one.velocity, atol=1e-9)
        np.testing.assert_allclose(other.covariance, np.outer(signs, signs) * one.covariance, atol=1e-9)


@settings(deadline=None, max_examples=15)
@given(seed=seeds, motion=motions)
def test_late_updates_give_the_same_tracks_as_punctual_ones(seed, motion):
    rng = np.random.default_rng(seed)
    times, frames = recording(rng)
    punctual, late = ObstacleTracker(motion), ObstacleTracker(motion)
    expected = replayed(punctual, times, frames)
    order = np.argsort(np.arange(len(times)) + rng.uniform(0.0, 4.0, len(times)))  # late by at most four updates
    found = replayed(late, times[order], [frames[i] for i in order])
    np.testing.assert_array_equal(state(found), state(expected))
    assert [t.track_id for t in found] == [t.track_id for t in expected]
    assert late.stamp == times[-1]
    assert not late.ignored["late"]
    assert late.consistency == punctual.consistency


def test_updates_that_are_too_late_are_counted_and_ignored():
    times, frames = recording(np.random.default_rng(0))
    tracker = ObstacleTracker(history=0.1)
    replayed(tracker, times, frames)
    before = state(tracker.tracks)
    tracker.update(times[-1] - 0.2, [sphere([0, 0, 0])])
    assert tracker.ignored == {"late": 1}
    np.testing.assert_array_equal(state(tracker.tracks), before)


def test_repeated_updates_are_counted_and_ignored():
    times, frames = recording(np.random.default_rng(0))
    tracker = ObstacleTracker()
    replayed(tracker, times, frames)
    before = state(tracker.tracks)
    for k in (-1, -1, -3):  # a frozen sensor repeats its last image; a network repeats a datagram
        tracker.update(times[k], [sphere(p) for p in frames[k]])
    assert tracker.ignored == {"repeated": 3}
    np.testing.assert_array_equal(state(tracker.tracks), before)


def test_two_sensors_with_the_same_stamp_are_both_used():
    one, two = ObstacleTracker(), ObstacleTracker()
    rng = np.random.default_rng(0)
    for k in range(30):
        first, second = (sphere(rng.normal(0.0, SIGMA, 3)) for _ in range(2))
        one.update(k / 30.0, [first])
        two.update(k / 30.0, [first])
        two.update(k / 30.0, [second])
    assert len(two.tracks) == 1
    assert np.trace(two.tracks[0].covariance) < np.trace(one.tracks[0].covariance)


@settings(deadline=None, max_examples=15)
@given(seed=seeds)
def test_an_obstacle_that_is_detected_twice_is_one(seed):
    rng = np.random.default_rng(seed)
    tracker = ObstacleTracker()
    for k in range(10):
        found = [sphere(rng.normal(0.0, SIGMA, 3)), sphere(rng.normal(0.0, SIGMA, 3), covariance=1.1 * NOISE)]
        tracker.update(k / 30.0, [found[i] for i in rng.permutation(2)])
    assert len(tracker.tracks) == 1
    assert tracker.ignored["duplicate"] >= 8


def test_two_obstacles_that_touch_are_two():
    rng = np.random.default_rng(0)
    tracker = ObstacleTracker()
    for k in range(30):
        tracker.update(k / 30.0, [sphere(rng.normal(0.0, SIGMA, 3) + [x, 0, 0]) for x in (0.0, 0.06)])
    assert len(tracker.tracks) == 2
    assert not tracker.ignored


def test_a_jump_starts_a_new_track():
    tracker = ObstacleTracker()
    times = np.arange(40) / 30.0
    for time in times:
        tracker.update(time, [sphere([0.0 if time < 0.6 else 0.4, 0.0, 0.0])])
    assert [t.track_id for t in tracker.tracks] == [1]
    np.testing.assert_allclose(tracker.tracks[0].position, [0.4, 0.0, 0.0], atol=1e-6)
    one_jump = ObstacleTracker()
    for k, time in enumerate(times):
        one_jump.update(time, [sphere([0.4 if k == 20 else 0.0, 0.0, 0.0])])
    assert [t.track_id for t in one_jump.tracks] == [0]


def test_a_clock_that_runs_ahead_ends_all_tracks():
    times, frames = recording(np.random.default_rng(0))
    tracker = ObstacleTracker()
    assert replayed(tracker, times, frames)
    assert tracker.update(times[-1] + 3600.0, []) == ()


@pytest.mark.parametrize("motion", MOTIONS)
def test_crossing_obstacles_keep_their_numbers(motion):
    """Paths that cross at a right angle, with centres as near as 7 cm, at 5 mm of noise."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        tracker = ObstacleTracker(motion)
        first = {}
        for time in np.arange(90) / 30.0:
            truth = np.array([[0.3 * time - 0.45, 0.0, 0.0], [0.05, 0.3 * time - 0.45, 0.05]])
            found = truth + rng.normal(0.0, SIGMA, (2, 3))
            tracks = tracker.update(time, [sphere(p) for p in rng.permutation(found)])
            if len(tracks) == 2:
                nearest = {t.track_id: int(np.linalg.norm(truth - t.position, axis=1).argmin()) for t in tracks}
                first = first or nearest
                assert nearest == first
        assert len(first) == 2


def test_crossing_obstacles_that_hide_each_other_keep_their_numbers():
    """Their images merge for 0.2 s: the hidden one is predicted."""
    rng = np.random.default_rng(4)
    tracker = ObstacleTracker()
    for time in np.arange(90) / 30.0:
        truth = np.array([[0.4 * time - 0.6, 0.0, 0.0], [0.6 - 0.4 * time, 0.0, 0.1]])
        found = truth + rng.normal(0.0, SIGMA, (2, 3))
        seen = found[:1] if abs(time - 1.5) < 0.1 else found
        tracks = tracker.update(time, [sphere(p) for p in seen])
    assert [t.track_id for t in tracks] == [0, 1]
    sides = sorted(tracks, key=lambda t: t.position[2])
    assert sides[0].velocity[0] > 0.3
    assert sides[1].velocity[0] < -0.3


def test_labels_are_never_mixed():
    tracker = ObstacleTracker()
    for k in range(10):
        tracks = tracker.update(k / 30.0, [sphere([0, 0, 0], "target"), sphere([0.02, 0, 0], "bottle", radius=0.02)])
    assert sorted(t.label for t in tracks) == ["bottle", "target"]
    for k in range(10, 20):
        tracks = tracker.update(k / 30.0, [sphere([0, 0, 0], "bottle")])
    assert {t.label: t.last_seen for t in tracks}["target"] == pytest.approx(9 / 30.0)
    assert tracks[0].obstacle.name in {"bottle", "target"}


def test_the_longest_unseen_track_gives_way():
    tracker = ObstacleTracker(max_obstacles=3, confirm=(1, 1))
    tracker.update(0.0, [sphere([0.3 * i, 0, 0]) for i in range(3)])
    tracker.update(0.03, [sphere([0.3 * i, 0, 0]) for i in (0, 2)])
    tracks = tracker.update(0.06, [sphere([0, 0, 0]), sphere([0.0, 0.5, 0])])
    assert [t.track_id for t in tracks] == [0, 2, 3]
    assert tracker.ignored == {"removed": 1}
