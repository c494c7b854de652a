from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills import (
    GMR,
    DegenerateAxisWarning,
    SingleDemonstrationWarning,
    UnalignedWarning,
    ellipsoid_scale,
)
from imitarm.skills.gmr import samples_of
from imitarm.skills.rotations import RotationReference
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import shown as sweeps

Array = NDArray[np.float64]


def shown(
    seed: int = 0,
    n: int = 6,
    *,
    samples: int = 100,
    turn: float | None = None,
    offset: float = 0.0,
    spread: float = 0.02,
) -> list[Demonstration]:
    """Return variations of one motion; with ``turn`` [rad] about a tilted axis, as quaternions."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0, samples)
    answer = []
    for i in range(n):
        a = spread * rng.standard_normal(3)
        x = np.column_stack([0.3 * np.sin(1.5 * t) + a[0], 0.2 * np.cos(2.5 * t) + a[1], 0.1 * t + a[2] * t])
        q = None
        if turn is not None:
            axis = np.array([0.6, 0.0, 0.8])
            wobble = 0.05 * rng.standard_normal(3)
            q = quaternion_multiply(
                quaternion_exp(wobble * np.sin(t)[:, None]), quaternion_exp((turn * t / 2.0)[:, None] * axis)
            )
            q *= rng.choice([-1.0, 1.0])
        answer.append(Demonstration(Trajectory(t + offset, x, q), task="wave", source=f"shown {i}"))
    return answer


def angle(p: Array, q: Array) -> Array:
    return np.linalg.norm(quaternion_log(quaternion_multiply(p, quaternion_conjugate(q))), axis=-1)


def test_one_gaussian_equals_the_closed_form() -> None:
    demonstrations = shown()
    gmr = GMR(1).fit(demonstrations)
    Z = np.concatenate([np.column_stack([d.trajectory.times, d.trajectory.positions]) for d in demonstrations])
    mu, sigma = Z.mean(axis=0), np.cov(Z.T, bias=True)
    t = np.linspace(0.0, 2.0, 7)
    mean, covariance = gmr.predict(t)
    np.testing.assert_allclose(mean, mu[1:] + (t - mu[0])[:, None] * sigma[1:, 0] / sigma[0, 0], atol=1e-5)
    conditional = sigma[1:, 1:] - np.outer(sigma[1:, 0], sigma[0, 1:]) / sigma[0, 0]
    np.testing.assert_allclose(covariance, np.broadcast_to(conditional, (7, 3, 3)), atol=1e-6)


def test_prediction_is_the_conditional_moments_of_the_mixture() -> None:
    gmr = GMR(5).fit(shown())
    for t in (0.0, 0.3, 1.1, 2.0):
        h, means, covariances = [], [], []
        for w, m, s in zip(gmr.weights_, gmr.means_, gmr.covariances_, strict=True):
            h.append(w * np.exp(-0.5 * (t - m[0]) ** 2 / s[0, 0]) / np.sqrt(s[0, 0]))
            means.append(m[1:] + s[1:, 0] / s[0, 0] * (t - m[0]))
            covariances.append(s[1:, 1:] - np.outer(s[1:, 0], s[0, 1:]) / s[0, 0])
        p = np.array(h) / np.sum(h)
        mean = sum(a * m for a, m in zip(p, means, strict=True))
        second = sum(a * (c + np.outer(m, m)) for a, m, c in zip(p, means, covariances, strict=True))
        got_mean, got_covariance = gmr.predict([t])
        np.testing.assert_allclose(got_mean[0], mean, atol=1e-12)
        np.testing.assert_allclose(got_covariance[0], second - np.outer(mean, mean), atol=1e-12)
        np.testing.assert_allclose(gmr.responsibilities([t])[0], p, atol=1e-12)


def test_covariance_comes_with_the_prediction_for_all_queries_at_once() -> None:
    gmr = GMR(6).fit(shown(turn=1.0))
    t = np.linspace(0.0, 2.0, 333)
    mean, covariance = gmr.predict(t)
    quaternions, turning = gmr.predict_orientation(t)
    assert mean.shape == (333, 3)
    assert quaternions.shape == (333, 4)
    assert covariance.shape == turning.shape == (333, 3, 3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert np.linalg.eigvalsh(turning).min() > 0.0
    np.testing.assert_allclose(gmr.responsibilities(t).sum(axis=1), 1.0)


def test_covariance_tells_how_much_demonstrations_differ() -> None:
    demonstrations = shown(n=40, spread=0.03)
    _, covariance = GMR(6).fit(demonstrations).predict([1.0])
    at_one = np.stack([d.trajectory.at([1.0])[0][0] for d in demonstrations])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), at_one.std(axis=0), rtol=0.15)


def test_a_95_percent_tolerance_holds_95_percent_of_new_demonstrations() -> None:
    gmr = GMR(6).fit(shown(n=300, spread=0.03, samples=50))
    t = np.linspace(0.2, 1.8, 9)
    mean, covariance = gmr.predict(t)
    new = np.stack([d.trajectory.at(t)[0] for d in shown(seed=1, n=600, spread=0.03)])
    apart = new - mean
    squared = np.einsum("nti,tij,ntj->nt", apart, np.linalg.inv(covariance), apart)
    assert np.mean(squared <= ellipsoid_scale(0.95, 3) ** 2) == pytest.approx(0.95, abs=0.03)


def test_the_mean_follows_the_motion() -> None:
    demonstrations = shown(spread=0.005)
    gmr = GMR().fit(demonstrations)
    plain = np.mean([d.trajectory.positions for d in demonstrations], axis=0)
    apart = np.linalg.norm(gmr.predict(demonstrations[0].trajectory.times)[0] - plain, axis=1)
    assert np.sqrt(np.mean(apart**2)) < 2e-3


@pytest.mark.parametrize("offset", [1.0, -3.5, 1.7e9])
def test_times_may_start_anywhere(offset: float) -> None:
    t = np.linspace(0.0, 2.0, 50)
    a = GMR(5).fit(shown(turn=2.0, samples=101)).predict_pose(t)
    b = GMR(5).fit(shown(turn=2.0, samples=101, offset=offset)).predict_pose(t)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)  # 50 Hz: the stamps are whole milliseconds


def test_epoch_stamps_off_the_millisecond_change_next_to_nothing() -> None:
    """1.7e9 s has digits down to 0.2 us only, so times differ a little; the mean may, by one iteration more or less."""
    t = np.linspace(0.0, 2.0, 50)
    a, b = (GMR(5).fit(shown(offset=offset)).predict(t) for offset in (0.0, 1.7e9))
    np.testing.assert_allclose(a[0], b[0], atol=2e-4)
    np.testing.assert_allclose(a[1], b[1], atol=1e-5)


def test_queries_outside_are_held_at_the_ends() -> None:
    gmr = GMR(4).fit(shown())
    mean, covariance = gmr.predict([-5.0, 0.0, 2.0, 99.0])
    np.testing.assert_array_equal(mean[[0, 3]], mean[[1, 2]])
    np.testing.assert_array_equal(covariance[[0, 3]], covariance[[1, 2]])


def test_components_are_in_the_order_of_time() -> None:
    gmr = GMR(7).fit(shown())
    assert np.all(np.diff(gmr.time_means_) > 0.0)
    assert gmr.position_means_.shape == (7, 3)
    assert gmr.position_covariances_.shape == (7, 3, 3)


def test_a_planar_task_keeps_its_accuracy_in_the_plane() -> None:
    plane = []
    for d in shown():
        x = d.trajectory.positions.copy()
        x[:, 2] = 0.23
        plane.append(Trajectory(d.trajectory.times, x))
    t = np.linspace(0.0, 2.0, 80)
    with pytest.warns(DegenerateAxisWarning, match="in z"):
        flat = GMR(6).fit(plane)
    assert flat.degenerate_axes_ == (2,)
    tilted = [Trajectory(k.times, k.positions + [0.0, 0.0, 1.0] * k.positions[:, :1]) for k in plane]
    mean, covariance = flat.predict(t)
    np.testing.assert_allclose(mean[:, 2], 0.23, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(covariance[:, 2, 2]), 1e-4, rtol=1e-6)  # 0.1 mm, the repeatability of arms
    in_plane = np.mean([k.positions[:, :2] for k in plane], axis=0)
    error = np.linalg.norm(
        np.column_stack([np.interp(plane[0].times, t, mean[:, i]) for i in range(2)]) - in_plane, axis=1
    )
    other = GMR(6).fit(tilted).predict(plane[0].times)[0][:, :2]
    assert np.sqrt(np.mean(error**2)) <= 1.1 * np.sqrt(np.mean(np.sum((other - in_plane) ** 2, axis=1)))


def test_noise_below_the_repeatability_of_arms_is_no_motion() -> None:
    rng = np.random.default_rng(0)
    plane = [
        Trajectory(
            d.trajectory.times,
            np.column_stack([d.trajectory.positions[:, :2], 0.23 + 2e-5 * rng.standard_normal(len(d))]),
        )
        for d in shown()
    ]
    with pytest.warns(DegenerateAxisWarning):
        assert GMR(4).fit(plane).degenerate_axes_ == (2,)


@pytest.mark.parametrize("degrees", [30.0, 170.0, 270.0, 720.0])
def test_turns_of_any_size_are_learnt(degrees: float) -> None:
    demonstrations = shown(turn=np.deg2rad(degrees))
    gmr = GMR(8).fit(demonstrations)
    d = demonstrations[0].trajectory
    exact = quaternion_exp((np.deg2rad(degrees) * d.times / 2.0)[:, None] * np.array([0.6, 0.0, 0.8]))
    assert angle(gmr.predict_orientation(d.times)[0], exact).max() < np.deg2rad(3.0)


def test_signs_of_quaternions_do_not_matter() -> None:
    demonstrations = shown(turn=2.0)
    flipped = []
    for i, d in enumerate(demonstrations):
        q = d.trajectory.quaternions
        assert q is not None
        flipped.append(Trajectory(d.trajectory.times, d.trajectory.positions, -q if i % 2 else q))
    t = np.linspace(0.0, 2.0, 40)
    a, b = GMR(5).fit(demonstrations).predict_orientation(t), GMR(5).fit(flipped).predict_orientation(t)
    assert angle(a[0], b[0]).max() < 1e-6
    np.testing.assert_allclose(a[1], b[1], atol=1e-8)


def test_orientation_covariance_is_of_small_turns_in_the_base_frame() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 1.0, 40)
    spread = np.array([0.02, 0.05, 0.10])
    far = np.array([1.2, 0.4, -0.5])  # away from the mean rotation, where the tangent space is distorted
    demonstrations = []
    for _ in range(400):
        turn = quaternion_exp((2.0 * t - 1.0)[:, None] * far)
        small = quaternion_exp(np.broadcast_to(spread * rng.standard_normal(3), (40, 3)))
        x = np.column_stack([t, t**2, np.sin(t)])
        demonstrations.append(Trajectory(t, x, quaternion_multiply(small, turn)))
    _, covariance = GMR(5).fit(demonstrations).predict_orientation([0.05, 0.5, 0.95])
    for c in covariance:
        np.testing.assert_allclose(np.sqrt(np.diag(c)), spread, rtol=0.25)


def test_demonstrations_that_turn_opposite_ways_are_refused() -> None:
    there, back = shown(turn=3.0, n=2), shown(turn=-3.0, n=2)
    with pytest.raises(InputError, match="do not rotate in the same way"):
        GMR(3).fit([*there, *back])


def test_auto_keeps_the_table_it_chose_from() -> None:
    gmr = GMR(candidates=range(1, 13)).fit(shown())
    numbers = [c.n_components for c in gmr.selection_]
    assert numbers == sorted(numbers)
    assert gmr.n_components_ in numbers
    assert all(np.isfinite([c.bic, c.aic, c.held_out_rmse_mm, c.bias_rmse_mm]).all() for c in gmr.selection_)
    assert GMR(4).fit(shown()).selection_ == ()


def test_one_demonstration_is_learnt_with_a_warning() -> None:
    with pytest.warns(SingleDemonstrationWarning, match="only one demonstration"):
        gmr = GMR().fit(shown(n=1))
    assert np.isnan(gmr.selection_[0].held_out_rmse_mm)
    assert gmr.n_demonstrations_ == 1


def test_different_durations_are_scaled_with_a_warning() -> None:
    a, b, c = shown(n=3)
    slow = Trajectory(b.trajectory.times * 1.2, b.trajectory.positions)
    with pytest.warns(UnalignedWarning, match="Align them first"):
        gmr = GMR(4).fit([a, slow, c])
    assert gmr.duration_ == pytest.approx(2.0)
    np.testing.assert_allclose(gmr.predict([1.0])[0], GMR(4).fit([a, b, c]).predict([1.0])[0], atol=1e-9)


def test_trajectory_is_the_nominal_path() -> None:
    gmr = GMR(5).fit(shown(turn=1.0, offset=7.0))
    k = gmr.trajectory(50)
    assert len(k) == 50
    assert (k.times[0], k.times[-1]) == (0.0, pytest.approx(2.0))
    assert k.quaternions is not None
    np.testing.assert_allclose(k.positions, gmr.nominal(k.times)[0], atol=1e-12)


def test_bad_demonstrations_are_named() -> None:
    with pytest.raises(InputError, match="no demonstrations"):
        GMR().fit([])
    with pytest.raises(InputError, match="give a list"):
        GMR().fit(shown(n=1)[0])  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"demonstrations \[2, 3\] have no quaternions"):
        GMR(2).fit([*shown(n=2, turn=1.0), *shown(n=2)])
    with pytest.raises(InputError, match="too few"):
        GMR(50).fit(shown(n=2, samples=10))


def test_a_pause_can_be_learnt() -> None:
    still = Trajectory(np.arange(5.0), np.ones((5, 3)))
    with pytest.warns(DegenerateAxisWarning, match="x, y, z"):
        gmr = GMR(1).fit([still, still])
    np.testing.assert_allclose(gmr.predict([2.0])[0], 1.0)


@pytest.mark.parametrize("n_components", [0, -1, 2.5, "many", "AUTO"])
def test_bad_numbers_of_components_are_refused_when_given(n_components: object) -> None:
    with pytest.raises(InputError):
        GMR(n_components)  # type: ignore[arg-type]


def test_use_before_fit_and_bad_times() -> None:
    with pytest.raises(InputError, match="not fitted"):
        GMR(3).predict([0.0])
    gmr = GMR(3).fit(shown())
    with pytest.raises(InputError, match="times must be finite"):
        gmr.predict([0.0, np.nan])
    with pytest.raises(InputError, match="no quaternions"):
        gmr.predict_orientation([0.0])
    assert not gmr.has_orientation_


def test_from_mixture_gives_the_same_regression_and_refuses_nonsense() -> None:
    gmr = GMR(4).fit(shown(turn=4.0))
    again = GMR.from_mixture(
        gmr.weights_, gmr.means_, gmr.covariances_, duration=gmr.duration_, reference=gmr.reference_
    )
    t = np.linspace(0.0, 2.0, 20)
    for a, b in zip(gmr.predict_pose(t), again.predict_pose(t), strict=True):
        np.testing.assert_array_equal(a, b)
    broken = gmr.covariances_.copy()
    broken[1, 2, 2] = -1.0
    reference = RotationReference(np.zeros(1), np.array([[1.0, 0.0, 0.0, 0.0]]))
    for arguments in (
        (gmr.weights_ * 2.0, gmr.means_, gmr.covariances_),
        (gmr.weights_, gmr.means_[:, :4], gmr.covariances_),
        (gmr.weights_, gmr.means_ * np.nan, gmr.covariances_),
        (gmr.weights_, gmr.means_, broken),
    ):
        with pytest.raises(InputError, match="from_mixture"):
            GMR.from_mixture(*arguments, duration=2.0, reference=reference)
    with pytest.raises(InputError, match="duration"):
        GMR.from_mixture(gmr.weights_, gmr.means_, gmr.covariances_, duration=0.0, reference=reference)


@settings(max_examples=20, deadline=None)
@given(shift=st.tuples(*[st.floats(-2.0, 2.0)] * 3), yaw=st.floats(-3.0, 3.0))
def test_learning_moves_with_the_frame(shift: tuple[float, float, float], yaw: float) -> None:
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = [Trajectory(d.trajectory.times, d.trajectory.positions @ R.T + shift) for d in shown(n=3, samples=60)]
    t = np.linspace(0.0, 2.0, 15)
    mean, covariance = GMR(1).fit(shown(n=3, samples=60)).predict(t)
    moved_mean, moved_covariance = GMR(1).fit(moved).predict(t)
    np.testing.assert_allclose(moved_mean, mean @ R.T + shift, atol=1e-5)
    np.testing.assert_allclose(moved_covariance, R @ covariance @ R.T, atol=1e-6)


def test_times_are_counted_from_each_first_sample() -> None:
    tables, reference, duration = samples_of(sweeps(n=3, turn=None))  # they start at 0, 100 and 200 s
    assert reference is None
    assert duration == pytest.approx(2.0)
    for table in tables:
        assert table.shape == (120, 4)
        assert table[0, 0] == 0.0
        assert table[-1, 0] == pytest.approx(2.0)


def test_rotations_become_vectors_near_one_reference() -> None:
    demonstrations = sweeps(n=2, turn=1.0)
    tables, reference, _ = samples_of(demonstrations)
    assert reference is not None
    assert [table.shape for table in tables] == [(120, 7)] * 2
    q = demonstrations[1].trajectory.quaternions
    assert q is not None
    back = reference.to_quaternions(tables[1][:, 0], tables[1][:, 4:])
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-12)


def test_times_are_scaled_to_the_median_with_a_warning() -> None:
    a, b, c = (d.trajectory for d in sweeps(n=3, turn=None))
    slow = Trajectory(2.0 * b.times, b.positions)
    with pytest.warns(UnalignedWarning, match=r"from 2 to 4 s.*Align them first"):
        tables, _, duration = samples_of([a, slow, c])
    assert duration == pytest.approx(2.0)
    np.testing.assert_allclose(tables[1][:, 0], tables[0][:, 0], atol=1e-6)


def test_what_cannot_be_learnt_from_is_named() -> None:
    with pytest.raises(InputError, match="no demonstrations"):
        samples_of([])
    with pytest.raises(InputError, match="give a list"):
        samples_of(sweeps(n=1)[0])  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"demonstrations \[1\] have no quaternions"):
        samples_of([sweeps(n=1)[0], sweeps(n=1, turn=None)[0]])
    with pytest.raises(InputError, match="demonstration 1 is a str"):
        samples_of([sweeps(n=1)[0], "sweep.csv"])  # type: ignore[list-item]
