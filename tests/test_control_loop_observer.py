"""The simulated sensor and the tracked scene: stamps, delays, gaps, and independence of the order of calls."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.control_loop.observer import HIDDEN, SensorModel, TrackedScene
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, Capsule, ConvexHull, MovingScene, Scene, Sphere

RNG = np.random.default_rng(3)
SCENE = Scene(
    None,
    [
        Sphere([0.5, 0.0, 0.2], 0.04, velocity=[0.0, 0.3, 0.0], name="ball"),
        Box(
            Pose(np.array([0.6, 0.2, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])),
            [0.1, 0.1, 0.1],
            angular_velocity=[0.0, 0.0, 1.0],
            name="tin",
        ),
        Capsule([0.4, -0.4, 0.1], [0.4, -0.2, 0.1], 0.03),
        ConvexHull(np.array([0.3, 0.3, 0.3]) + 0.03 * RNG.normal(size=(12, 3)), velocity=[0.1, 0.0, 0.1]),
    ],
)
TRUTH = MovingScene(SCENE, {2: lambda t: [0.4 + 0.1 * np.sin(t), -0.3, 0.1]})
sensors = st.builds(
    SensorModel,
    noise=st.floats(0.0, 0.02),
    rate=st.sampled_from([15.0, 30.0, 100.0]),
    latency=st.floats(0.0, 0.2),
    dropout=st.floats(0.0, 0.9),
    occlusions=st.just(0.0) | st.floats(0.01, 1.0),
    seed=st.integers(0, 10**6),
)


class Recorder:
    """A tracker that keeps what it is given."""

    def __init__(self):
        self.frames = []

    def update(self, stamp, detections):
        self.frames.append((stamp, tuple(detections)))

    def scene(self, time, *, goal=None, fixtures=()):
        newest = self.frames[-1][1] if self.frames else ()
        return Scene(goal, [d.obstacle for d in newest], time, fixtures)

    def reset(self):
        self.frames = []


def places(frames):
    return [(stamp, [d.obstacle.solid().position.tolist() for d in seen]) for stamp, seen in frames]


@settings(max_examples=40, deadline=None)
@given(sensors, st.floats(0.0, 3.0))
def test_no_frame_is_from_the_future_and_none_is_early_or_missing(sensor, now):
    recorder = Recorder()
    observe = TrackedScene(TRUTH, sensor, recorder, lead=0.5)
    assert observe(now).stamp == now
    stamps = np.array([stamp for stamp, _ in recorder.frames])
    assert (stamps + sensor.latency <= now + 1e-8).all()
    due = np.arange(-np.floor(0.5 * sensor.rate) + 1, 1e4) / sensor.rate
    due = due[due + sensor.latency <= now]
    assert set(np.round(due, 9)) <= set(np.round(stamps, 9))
    assert (np.diff(stamps) > 0.0).all() and np.allclose(np.diff(stamps), 1.0 / sensor.rate)


@settings(max_examples=20, deadline=None)
@given(sensors, st.lists(st.floats(0.0, 2.0), min_size=1, max_size=5))
def test_the_order_of_calls_changes_nothing(sensor, times):
    once, often = Recorder(), Recorder()
    first = TrackedScene(TRUTH, sensor, once)
    first(1.5)
    second = TrackedScene(TRUTH, sensor, often)
    for time in [*times, 1.5]:
        second(time)
    assert places(once.frames) == places(often.frames)


@settings(max_examples=20, deadline=None)
@given(sensors, st.integers(-50, 50))
def test_a_frame_is_always_the_same_and_another_seed_gives_another(sensor, k):
    assert places([sensor.frame(TRUTH, k)[::2]]) == places([sensor.frame(TRUTH, k)[::2]])
    other = SensorModel(0.005, 30.0, 0.0, seed=sensor.seed + 1).frame(TRUTH, k)
    same = SensorModel(0.005, 30.0, 0.0, seed=sensor.seed).frame(TRUTH, k)
    assert places([other[::2]]) != places([same[::2]])


def test_without_noise_the_pose_is_that_of_the_stamp():
    frame = SensorModel(0.0, 30.0, 0.1).frame(TRUTH, 17)
    truth = TRUTH.at(17 / 30.0).obstacles
    assert frame.arrival == pytest.approx(17 / 30.0 + 0.1) and len(frame.detections) == 4
    for detection in frame.detections:
        same = next(o for o in truth if o.kind == detection.obstacle.kind)
        np.testing.assert_allclose(detection.obstacle.bounds(), same.bounds(), atol=1e-12)
        assert not detection.obstacle.moves and not detection.obstacle.name and detection.obstacle.track_id is None


def test_noise_dropout_and_covariance_are_as_stated():
    sensor = SensorModel(0.005, 30.0, dropout=0.2, seed=5)
    frames = [sensor.frame(SCENE, k) for k in range(400)]
    errors = [
        d.obstacle.solid().position - SCENE.poses(f.stamp)[0][0]
        for f in frames
        for d in f.detections
        if d.obstacle.kind == "sphere"
    ]
    assert np.std(errors) == pytest.approx(0.005, rel=0.1)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.001
    assert np.mean([len(f.detections) for f in frames]) == pytest.approx(0.8 * 4, rel=0.05)
    np.testing.assert_allclose(frames[0].detections[0].covariance, 0.005**2 * np.eye(3))


def test_an_occlusion_lasts_half_a_second():
    sensor = SensorModel(0.0, 100.0, occlusions=0.5, seed=2)
    seen = np.array([len(sensor.frame(Scene(None, [SCENE.obstacles[2]]), k).detections) for k in range(-400, 2000)])
    assert 1.0 - seen.mean() == pytest.approx(0.5 * HIDDEN, abs=0.01)
    changes = np.flatnonzero(np.diff(seen))
    gaps = np.diff(changes)[(0 if seen[changes[0]] else 1) :: 2]
    assert gaps.min() >= 100 * HIDDEN - 1 and gaps.max() <= 2 * 100 * HIDDEN + 1  # two may follow each other


def test_what_is_out_of_reach_is_not_seen():
    far = Scene(None, [Sphere([30.0, 0.0, 0.0], 0.1)])
    assert SensorModel().frame(far, 0).detections == ()


@pytest.mark.parametrize(
    "wrong",
    [{"noise": -1.0}, {"rate": 0.0}, {"latency": -0.1}, {"dropout": 1.0}, {"occlusions": 2.0}, {"noise": np.nan}],
)
def test_wrong_sensors_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        SensorModel(**wrong)


def test_wrong_arguments_are_refused():
    with pytest.raises(InputError, match="truth"):
        TrackedScene("scene", SensorModel(), Recorder())
    with pytest.raises(InputError, match="lead"):
        TrackedScene(SCENE, SensorModel(), Recorder(), lead=-1.0)
