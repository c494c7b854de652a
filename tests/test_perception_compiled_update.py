"""The compiled update computes what NumPy computes, and nothing needs it."""

from __future__ import annotations

import copy
import ctypes
import pickle

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compiled_code import by_numpy
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import Detection, ObstacleTracker
from imitarm.perception.motion_filter import MotionFilter
from imitarm.perception.track_memory import TrackMemory, updated
from imitarm.perception.tracks import UNCONFIRMED
from imitarm.scene import Box, ConvexHull, Scene, Sphere
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.scene.distances import resized
from imitarm.scene.packed_record import RECORD_WORDS, record_of
from scene_shapes import KINDS, random_obstacle

ARM = ArmModel.load("sawyer", tool="gripper")

pytestmark = pytest.mark.usefixtures("compiled")


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), motion=st.sampled_from(["constant-velocity", "constant-acceleration"]))
def test_both_ways_track_alike(monkeypatch, seed, motion):
    """Births, dropouts, outliers, labels, capped speeds and obstacles that are near each other."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-0.2, 0.2, (6, 3)), rng.uniform(-0.6, 0.6, (6, 3))
    noise = np.diag(rng.uniform(1e-5, 1e-4, 3))
    frames = []
    for k in range(30):
        positions = start + k / 30.0 * velocity + rng.multivariate_normal(np.zeros(3), noise, 6)
        seen = rng.permutation(6)[: rng.integers(3, 7)]
        labels = ["ball" if i % 2 else "" for i in seen]
        frames.append(
            [Detection(Sphere(positions[i], 0.02), noise, label) for i, label in zip(seen, labels, strict=True)]
        )
    calls, trackers = [], []
    for kernel in (lambda *_, **__: None, lambda *given, **more: calls.append(updated(*given, **more)) or calls[-1]):
        monkeypatch.setattr("imitarm.perception.tracker.updated", kernel)
        trackers.append(ObstacleTracker(motion, max_speed=0.5))
        for k, frame in enumerate(frames):
            trackers[-1].update(k / 30.0, frame)
    one, other = (tracker.tracks for tracker in trackers)
    assert [t.track_id for t in one] == [t.track_id for t in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(b.position, a.position, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(b.velocity, a.velocity, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-8, atol=1e-11)
    assert trackers[0].ignored == trackers[1].ignored
    assert any(call is not None for call in calls)


def memory_of(belief) -> TrackMemory:
    """Return confirmed tracks with these beliefs."""
    n = len(belief.mean)
    whole = {name: np.ones(n, dtype=np.int64) for name in ("hits", "ages", "counts", "ids")}
    columns = {"sizes": np.ones((n, 3)), "last_seen": np.zeros(n), **whole}
    return TrackMemory.of(belief.mean, belief.covariance, np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), columns)


@pytest.mark.parametrize("motion", ["constant-velocity", "constant-acceleration"])
def test_without_detections_the_kernel_predicts(motion):
    rng = np.random.default_rng(0)
    motion_filter = MotionFilter(motion, 0.3, 0.5)
    belief = motion_filter.born(rng.normal(size=(4, 3)), 1e-4 * np.eye(3)[None].repeat(4, 0))
    belief.mean[...] = rng.normal(size=belief.mean.shape)
    expected = motion_filter.predict(belief, 0.07)
    memory, flags = updated(memory_of(belief), 0.07, 0.07, b"", 0.3, 11.0, 1e9, window=3)
    np.testing.assert_allclose(memory.array("mean"), expected.mean, rtol=1e-12)
    np.testing.assert_allclose(memory.array("covariance"), expected.covariance, rtol=1e-12, atol=1e-18)
    assert (memory.array("detected") == -1).all() and flags == 0


def test_a_doubtful_assignment_is_left_to_numpy():
    motion_filter = MotionFilter("constant-velocity", 0.05, 0.5)
    memory = memory_of(motion_filter.born(np.zeros((1, 3)), 1e-4 * np.eye(3)[None]))
    rows = [Detection(Sphere([x, 0.0, 0.0], 0.01), 1e-6 * np.eye(3)).row_bytes for x in (0.01, -0.01)]
    numbers = 0.05, 11.0, 3.0
    assert updated(memory, 0.1, 0.1, b"".join(rows), *numbers, window=3) is None
    assert updated(memory, 0.1, 0.1, rows[0], *numbers, window=3) is not None


def frames_of(rng: np.random.Generator, n_frames: int = 12) -> list[list[Detection]]:
    """Return detections of a box, a sphere and a hull; their sizes, rotations and order vary."""
    corners, frames = rng.uniform(-0.05, 0.05, (8, 3)), []
    for k in range(n_frames):
        turn = np.array([np.cos(0.02 * k), 0.0, 0.0, np.sin(0.02 * k)])
        shapes = [
            Box(Pose([0.5, 0.01 * k, 0.2], turn), rng.uniform(0.09, 0.11, 3), name="tin"),
            Sphere([0.0, -0.5, 0.01 * k], rng.uniform(0.04, 0.05)),
            ConvexHull(corners + [-0.5, 0.01 * k, 0.0]),
        ]
        shapes = shapes[: 2 if k < n_frames // 2 else 3]
        frames.append(
            [
                Detection(shapes[i], 1e-5 * np.eye(3), "ball" if i == 1 else "")
                for i in rng.permutation(len(shapes)).tolist()
            ]
        )
    return frames


@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), rotations=st.booleans(), delay=st.sampled_from([-0.02, 0.0, 0.05]))
def test_both_ways_report_the_same_obstacles(seed, rotations, delay):
    """Scenes and tracks agree: poses, sizes, names, velocities, covariances and times."""
    frames = frames_of(np.random.default_rng(seed))

    def last() -> tuple:
        tracker = ObstacleTracker(rotations=rotations)
        for k, frame in enumerate(frames):
            tracker.update(0.1 * k, frame)
            scene = tracker.scene(0.1 * k + delay)
        return tracker, scene

    (one, here), (other, there) = last(), by_numpy(last)
    for name in ("positions", "quaternions", "sizes", "velocities", "angular_velocities", "covariances", "stamps"):
        np.testing.assert_allclose(getattr(here.packed, name), getattr(there.packed, name), rtol=0.0, atol=1e-9)
    assert (here.packed.still, here.packed.rotating) == (there.packed.still, there.packed.rotating)
    assert here.packed.fastest == pytest.approx(there.packed.fastest)
    assert repr(here) == repr(there)
    for a, b in zip(here.obstacles, there.obstacles, strict=True):
        assert (a.name, a.track_id) == (b.name, b.track_id)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.0, atol=1e-9)
    for a, b in zip(one.tracks, other.tracks, strict=True):
        assert (a.track_id, a.label, a.last_seen) == (b.track_id, b.label, b.last_seen)
    for name in ("hits", "ages", "counts", "sizes"):
        values = [getattr(tracker._steps[-1].tracks, name) for tracker in (one, other)]
        np.testing.assert_allclose(*values, rtol=0.0, atol=1e-12)


def test_a_track_that_is_not_confirmed_is_not_in_the_scene():
    tracker = ObstacleTracker()
    balls = [Detection(Sphere([x, 0.0, 0.0], 0.05), 1e-5 * np.eye(3)) for x in (0.0, 1.0)]
    for k in range(4):
        tracker.update(0.1 * k, balls[: 1 + (k == 3)])
    assert (tracker._steps[-1].tracks.ids == UNCONFIRMED).tolist() == [False, True]
    assert len(tracker.scene(0.4).packed) == 1


def test_copies_of_tracker_and_scene_go_on_alike():
    """Copies contain no address of the original's memory."""
    frames = frames_of(np.random.default_rng(0))
    tracker = ObstacleTracker()
    for k, frame in enumerate(frames[:5]):
        tracker.update(0.1 * k, frame)
    scene = tracker.scene(0.45)
    copies = [pickle.loads(pickle.dumps((tracker, scene))), copy.deepcopy((tracker, scene))]
    expected = ClearanceLimit(ARM, 2.0).rows(ARM.home, scene)
    tracker.update(0.5, frames[5])
    for other, seen in copies:
        rows = ClearanceLimit(ARM, 2.0).rows(ARM.home, seen)
        np.testing.assert_array_equal(rows.matrix, expected.matrix)
        np.testing.assert_array_equal(rows.lower, expected.lower)
        other.update(0.5, frames[5])
        np.testing.assert_array_equal(other.scene(0.5).packed.positions, tracker.scene(0.5).packed.positions)


@pytest.mark.parametrize("way", ["compiled", "NumPy"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_sizes_of_a_scene_follow_the_detections(kind, way):
    """Arrays, obstacles and distances agree, although the scene's obstacles are not built again."""
    rng = np.random.default_rng(0)
    first = random_obstacle(kind, rng)
    size = np.asarray(first.solid().size, dtype=float)

    def last() -> Scene:
        tracker = ObstacleTracker()
        for k in range(5):
            tracker.update(0.1 * k, [Detection(resized(first, (1.0 + 0.02 * k) * size), 1e-6 * np.eye(3))])
            scene = tracker.scene(0.1 * k + 0.01)
        return scene

    scene = last() if way == "compiled" else by_numpy(last)
    built = Scene(None, scene.obstacles)
    if kind != "convex_hull":
        assert (scene.packed.sizes[0][size > 0.0] > size[size > 0.0]).all()
    np.testing.assert_allclose(scene.packed.sizes, built.packed.sizes, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(scene.packed.radii, built.packed.radii, rtol=0.0, atol=1e-9)
    record = record_of(scene.packed)[0]
    radius = ctypes.c_double.from_address(record_words(record)[8]).value
    np.testing.assert_allclose(radius, built.packed.radii, rtol=0.0, atol=1e-9)
    points = rng.uniform(-1.0, 1.0, (20, 3))
    np.testing.assert_allclose(scene.distances(points), built.distances(points), rtol=0.0, atol=1e-9)


def record_words(record) -> list[int]:
    """Return the words of a C structure ``Obstacles``."""
    return list((ctypes.c_int64 * RECORD_WORDS).from_address(record.address))
