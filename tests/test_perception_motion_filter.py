"""The filters equal their textbook forms, and their uncertainty is as large as their errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import chi2

from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import Consistency, Detection, ObstacleTracker
from imitarm.perception.association import assign
from imitarm.perception.consistency import chi_square_moments, chi_square_quantile
from imitarm.perception.motion_filter import Measurements, MotionFilter, inverse_3x3
from imitarm.scene import Sphere

seeds = st.integers(0, 2**32 - 1)
intervals = st.floats(1e-3, 0.5)


def random_covariance(rng, n=3, scale=0.01):
    root = rng.normal(0.0, scale, (n, n))
    return root @ root.T + 0.01 * scale**2 * np.eye(n)


@settings(deadline=None, max_examples=30)
@given(seed=seeds, order=st.sampled_from([1, 2]), noise=st.floats(1e-4, 10.0))
def test_the_filter_equals_the_textbook_filter(seed, order, noise):
    """Predict and update as in any textbook, one obstacle at a time, with F and Q from the matrix exponential."""
    rng = np.random.default_rng(seed)
    motion = "constant-velocity" if order == 1 else "constant-acceleration"
    tracker = ObstacleTracker(motion, process_noise=noise, gate=1.0 - 1e-12, max_speed=100.0, confirm=(1, 1))
    m = 3 * (order + 1)
    H = np.eye(3, m)
    x, P, before = None, None, None
    for time in np.cumsum(rng.uniform(0.01, 0.2, 12)):
        R = random_covariance(rng)
        z = rng.multivariate_normal(np.zeros(3), R)
        (track,) = tracker.update(time, [Detection(Sphere(z, 0.1), R)])
        if x is None:
            x = np.concatenate([z, np.zeros(m - 3)])
            P = np.diag([0.0] * 3 + [0.25] * 3 + [4.0] * (m - 6))
            P[:3, :3] = R
        else:
            F, Q = van_loan(order, noise, time - before)
            x, P = F @ x, F @ P @ F.T + Q
            S = H @ P @ H.T + R
            K = P @ H.T @ np.linalg.inv(S)
            x = x + K @ (z - H @ x)
            P = (np.eye(m) - K @ H) @ P
        before = time
        np.testing.assert_allclose(np.concatenate([track.position, track.velocity]), x[:6], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(track.covariance, P[:6, :6], rtol=1e-7, atol=1e-10)
        assert np.linalg.eigvalsh(track.covariance)[0] > 0.0


def van_loan(order, noise, dt):
    """Transition and noise by the matrix exponential (Van Loan 1978)."""
    m = 3 * (order + 1)
    A, G = np.kron(np.eye(order + 1, k=1), np.eye(3)), np.zeros((m, m))
    G[-3:, -3:] = noise * np.eye(3)
    E = expm(np.block([[-A, G], [np.zeros((m, m)), A.T]]) * dt)
    F = E[m:, m:].T
    return F, F @ E[:m, m:]


@settings(deadline=None, max_examples=30)
@given(a=intervals, b=intervals, motion=st.sampled_from(["constant-velocity", "constant-acceleration"]))
def test_two_predictions_equal_one(a, b, motion):
    motion_filter = MotionFilter(motion, None, 0.5)
    belief = motion_filter.born(np.array([[0.1, 0.2, 0.3]]), 1e-4 * np.eye(3)[None])
    belief.mean[..., 3:] = 0.3
    twice = motion_filter.predict(motion_filter.predict(belief, a), b)
    once = motion_filter.predict(belief, a + b)
    np.testing.assert_allclose(twice.mean, once.mean, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-10, atol=1e-13)
    back = motion_filter.predict(belief, -a)
    np.testing.assert_allclose(back.mean[0, 0, :3], belief.mean[0, 0, :3] + expected_displacement(belief, -a))
    assert np.linalg.eigvalsh(back.covariance[0, 0])[0] > 0.0


def expected_displacement(belief, dt):
    mean = belief.mean[0, 0]
    acceleration = mean[6:9] if len(mean) > 6 else np.zeros(3)
    return dt * mean[3:6] + 0.5 * dt * dt * acceleration


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_the_camera_measures_with_the_right_jacobian(seed):
    rng = np.random.default_rng(seed)
    camera = Pose(rng.uniform(-0.3, 0.3, 3), quaternion_exp(0.5 * rng.normal(size=3)))
    point = camera.apply(rng.uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 3.0]))
    measured = Measurements(point[None], random_covariance(rng)[None], camera.rotation.T[None], camera.position[None])
    innovation, jacobian, noise = measured.innovation(point[None])
    np.testing.assert_allclose(innovation, 0.0, atol=1e-12)
    step = 1e-6
    columns = [
        (measured.innovation((point - step * e)[None])[0] - measured.innovation((point + step * e)[None])[0]) / 2 / step
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(jacobian[0], np.concatenate(columns).T, atol=1e-6)
    np.testing.assert_allclose(noise[0], jacobian[0] @ measured.noise[0] @ jacobian[0].T, rtol=1e-9, atol=1e-15)
    behind = camera.apply(np.array([0.0, 0.0, -1.0]))
    assert np.isinf(measured.innovation(behind[None])[0]).all()


def test_the_extended_filter_uses_the_camera_and_agrees_with_the_linear_one():
    rng = np.random.default_rng(2)
    camera = Pose(np.array([0.0, 0.0, -1.5]), np.array([1.0, 0.0, 0.0, 0.0]))
    linear, extended, blind = ObstacleTracker(), ObstacleTracker("ekf"), ObstacleTracker("ekf")
    velocity = np.array([0.1, -0.2, 0.15])
    noise = np.diag([0.003, 0.003, 0.015]) ** 2
    for time in np.arange(60) / 30.0:
        z = velocity * time + rng.multivariate_normal(np.zeros(3), noise)
        (a,) = linear.update(time, [Detection(Sphere(z, 0.1), noise)]) or [None]
        (b,) = extended.update(time, [Detection(Sphere(z, 0.1), noise, camera_to_base=camera)]) or [None]
        (c,) = blind.update(time, [Detection(Sphere(z, 0.1), noise)]) or [None]
    np.testing.assert_array_equal(a.position, c.position)
    difference = np.linalg.norm(a.position - b.position)
    assert 0.0 < difference < 0.002
    assert np.linalg.norm(b.position - velocity * time) < 0.02
    mixed = [Detection(Sphere(z, 0.1), noise), Detection(Sphere(z + 0.5, 0.1), noise, camera_to_base=camera)]
    extended.update(time + 0.03, mixed)
    assert len(extended.update(time + 0.06, mixed)) == 2


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_small_matrices_are_inverted(seed):
    rng = np.random.default_rng(seed)
    matrices = np.array([random_covariance(rng, scale=1.0) for _ in range(5)])
    inverse, determinant = inverse_3x3(matrices)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-6)
    np.testing.assert_allclose(determinant, np.linalg.det(matrices), rtol=1e-6)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_the_assignment_is_the_best_one(seed):
    """Compared with all assignments of three tracks and three detections."""
    rng = np.random.default_rng(seed)
    positions, measured = rng.normal(0.0, 0.03, (3, 3)), rng.normal(0.0, 0.03, (3, 3))
    P = np.array([random_covariance(rng, scale=0.03) for _ in range(3)])
    R = np.array([random_covariance(rng, scale=0.03) for _ in range(3)])
    gate = chi_square_quantile(0.99, 3)
    pairs = assign(positions, P, Measurements(measured, R), gate)
    best = None
    for permutation in ([0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]):
        S = P + R[permutation]
        difference = measured[permutation] - positions
        distance = np.einsum("ki,kij,kj->k", difference, np.linalg.inv(S), difference)
        inside = distance <= gate
        key = (-inside.sum(), (distance + np.log(np.linalg.det(S)))[inside].sum())
        if best is None or key < best[0]:
            best = key, {(i, permutation[i]) for i in range(3) if inside[i]}
    assert set(zip(pairs.tracks.tolist(), pairs.detections.tolist(), strict=True)) == best[1]


@pytest.mark.parametrize("motion", ["constant-velocity", "constant-acceleration", "imm", "ekf"])
def test_the_uncertainty_is_as_large_as_the_errors(motion):
    """Motion of the filter's own model: NIS and NEES lie inside their bands (bands of 99.9 %, one seed)."""
    rng = np.random.default_rng(7)
    order = 2 if motion == "constant-acceleration" else 1
    noise = 5.0 if order == 2 else 0.05
    options = {"process_noise": (noise, 10.0) if motion == "imm" else noise}
    F, Q = van_loan(order, noise, 1.0 / 30.0)
    root = np.linalg.cholesky(Q)
    errors, distances = [], []
    for _ in range(100):
        tracker = ObstacleTracker(motion, gate=1.0 - 1e-9, max_speed=50.0, **options)
        start = [0.5] * 3 + ([2.0] * 3 if order == 2 else [])
        x = np.concatenate([np.zeros(3), rng.normal(0.0, start)])
        for k in range(40):
            x = F @ x + root @ rng.normal(size=len(Q))
            tracks = tracker.update(
                k / 30.0, [Detection(Sphere(x[:3] + rng.normal(0, 0.005, 3), 0.1), 25e-6 * np.eye(3))]
            )
        error = np.concatenate([tracks[0].position, tracks[0].velocity]) - x[:6]
        errors.append(error @ np.linalg.solve(tracks[0].covariance, error))
        distances.append(tracker.consistency.mean)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(errors)) / len(errors)
    assert np.mean(errors) < high
    if motion != "imm":  # cautious where one of its two models is wrong
        assert np.mean(errors) > low
        assert abs(np.mean(distances) - 3.0) < 3.3 * np.sqrt(6.0 / (100 * 39))


def test_a_wrong_noise_is_noticed():
    rng = np.random.default_rng(3)
    means = []
    for factor in (0.5, 1.0, 2.0):
        tracker = ObstacleTracker(process_noise=1e-6)
        for k in range(300):
            position = rng.normal(0.0, 0.005 * factor, 3)
            tracker.update(k / 30.0, [Detection(Sphere(position, 0.1), 25e-6 * np.eye(3))])
        means.append(tracker.consistency)
    assert [c.inside for c in means] == [False, True, False]
    assert means[0].mean < means[0].low
    assert means[2].mean > means[2].high
    assert "above" in str(means[2])
    nothing = ObstacleTracker().consistency
    assert nothing.inside
    assert np.isnan(nothing.mean)


def test_moments_below_the_gate():
    values = np.random.default_rng(0).chisquare(3, 200_000)
    gate = chi_square_quantile(0.9, 3)
    assert gate == pytest.approx(chi2.ppf(0.9, 3))
    mean, variance = chi_square_moments(3, gate)
    below = values[values <= gate]
    assert below.mean() == pytest.approx(mean, rel=0.01)
    assert below.var() == pytest.approx(variance, rel=0.02)
    assert chi_square_moments(6) == (6.0, 12.0)
    assert Consistency.of(below[:1000], gate=gate).inside
