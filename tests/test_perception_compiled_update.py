"""The compiled update computes what NumPy computes, and nothing needs it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imitarm.perception import Detection, ObstacleTracker
from imitarm.perception.motion_filter import MotionFilter, updated
from imitarm.scene import Sphere

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
    for kernel in (lambda *_: None, lambda *given: calls.append(updated(*given)) or calls[-1]):
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
def test_without_detections_the_kernel_predicts(motion):
    rng = np.random.default_rng(0)
    motion_filter = MotionFilter(motion, 0.3, 0.5)
    belief = motion_filter.born(rng.normal(size=(4, 3)), 1e-4 * np.eye(3)[None].repeat(4, 0))
    belief.mean[...] = rng.normal(size=belief.mean.shape)
    expected = motion_filter.predict(belief, 0.07)
    first = np.ones(4, dtype=bool)
    x, P, detections, _ = updated(belief.mean, belief.covariance, first, 0.07, 0.3, np.zeros((0, 15)), 11.0, 1e9)
    np.testing.assert_allclose(x, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(P, expected.covariance, rtol=1e-12, atol=1e-18)
    assert (detections == -1).all()


def test_a_doubtful_assignment_is_left_to_numpy():
    motion_filter = MotionFilter("constant-velocity", 0.05, 0.5)
    belief = motion_filter.born(np.zeros((1, 3)), 1e-4 * np.eye(3)[None])
    rows = np.array([Detection(Sphere([x, 0.0, 0.0], 0.01), 1e-6 * np.eye(3)).row for x in (0.01, -0.01)])
    arguments = (belief.mean, belief.covariance, np.ones(1, dtype=bool), 0.1, 0.05)
    assert updated(*arguments, rows, 11.0, 3.0) is None
    assert updated(*arguments, rows[:1], 11.0, 3.0) is not None
