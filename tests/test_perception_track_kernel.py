"""The compiled update computes what NumPy computes, and nothing needs it."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imitarm.perception import Detection, ObstacleTracker, track_kernel
from imitarm.perception.motion_filter import MotionFilter
from imitarm.scene import Sphere


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A kernel that was compiled for these tests."""
    if not any(shutil.which(name) for name in ("cc", "gcc", "clang")):
        if os.environ.get("CI") == "true":
            pytest.fail("no C compiler; in CI the kernel must be tested")
        pytest.skip("no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(track_kernel, "LIBRARY", tmp_path_factory.mktemp("kernel") / "track_kernel.compiled")
        track_kernel.library.cache_clear()
        assert track_kernel.build() == "built track_kernel.compiled"
        assert track_kernel.library() is not None
        yield track_kernel.updated
    track_kernel.library.cache_clear()


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), motion=st.sampled_from(["constant-velocity", "constant-acceleration"]))
def test_both_ways_track_alike(built, monkeypatch, seed, motion):
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
    for kernel in (lambda *_: None, lambda *given: calls.append(built(*given)) or calls[-1]):
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


@pytest.mark.parametrize("motion", ["constant-velocity", "constant-acceleration"])
def test_without_detections_the_kernel_predicts(built, motion):
    rng = np.random.default_rng(0)
    motion_filter = MotionFilter(motion, 0.3, 0.5)
    belief = motion_filter.born(rng.normal(size=(4, 3)), 1e-4 * np.eye(3)[None].repeat(4, 0))
    belief.mean[...] = rng.normal(size=belief.mean.shape)
    expected = motion_filter.predict(belief, 0.07)
    first = np.ones(4, dtype=bool)
    x, P, detections, _ = built(belief.mean, belief.covariance, first, 0.07, 0.3, np.zeros((0, 15)), 11.0, 1e9)
    np.testing.assert_allclose(x, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(P, expected.covariance, rtol=1e-12, atol=1e-18)
    assert (detections == -1).all()


def test_a_doubtful_assignment_is_left_to_numpy(built):
    motion_filter = MotionFilter("constant-velocity", 0.05, 0.5)
    belief = motion_filter.born(np.zeros((1, 3)), 1e-4 * np.eye(3)[None])
    rows = np.array([Detection(Sphere([x, 0.0, 0.0], 0.01), 1e-6 * np.eye(3)).row for x in (0.01, -0.01)])
    arguments = (belief.mean, belief.covariance, np.ones(1, dtype=bool), 0.1, 0.05)
    assert built(*arguments, rows, 11.0, 3.0) is None
    assert built(*arguments, rows[:1], 11.0, 3.0) is not None


def test_without_a_compiler_or_a_kernel_numpy_is_used(tmp_path, monkeypatch):
    monkeypatch.setattr(track_kernel, "LIBRARY", tmp_path / "track_kernel.compiled")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    track_kernel.library.cache_clear()
    assert "uses NumPy" in track_kernel.build()
    assert track_kernel.library() is None
    monkeypatch.undo()
    (tmp_path / "track_kernel.compiled").write_text("no library")
    monkeypatch.setattr(track_kernel, "LIBRARY", tmp_path / "track_kernel.compiled")
    track_kernel.library.cache_clear()
    assert track_kernel.library() is None
    tracker = ObstacleTracker()
    for k in range(3):
        tracker.update(k / 30.0, [Detection(Sphere(np.zeros(3), 0.1), 1e-4 * np.eye(3))])
    assert len(tracker.tracks) == 1
    track_kernel.library.cache_clear()


def test_a_failing_compiler_is_reported(tmp_path, monkeypatch):
    source = tmp_path / "track_kernel.c"
    source.write_text("this is not C")
    monkeypatch.setattr(track_kernel, "SOURCE", source)
    monkeypatch.setattr(track_kernel, "LIBRARY", tmp_path / "track_kernel.compiled")
    if any(shutil.which(name) for name in ("cc", "gcc", "clang")):
        assert "failed; the tracker uses NumPy" in track_kernel.build()
        assert not (tmp_path / "track_kernel.compiled").exists()
