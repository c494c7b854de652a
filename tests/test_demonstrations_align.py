from __future__ import annotations

import numpy as np
import pytest

from demonstration_samples import PEAK, motion, motions, turn, with_idle
from imitarm.demonstrations import align, compute_alignment, read
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.skills import GMR
from imitarm.trajectory import Demonstration, Trajectory


def height_of_the_mean(demonstrations):
    mean = np.mean([one.trajectory.positions[:, 2] for one in demonstrations], axis=0)
    return mean.max() - mean[0]


def test_a_peak_that_unaligned_demonstrations_flatten_is_recovered():
    """Without alignment, the mean of these motions is 0.085 m high at most, although each is 0.10 m high."""
    samples = motions(8)
    assert height_of_the_mean(align(samples, method="resample")) < 0.085
    assert height_of_the_mean(align(samples)) > 0.098
    assert height_of_the_mean(align(motions(8, noise=1e-3))) > 0.098


def test_what_is_learned_has_the_peak():
    prediction = GMR(20).fit(align(motions(8))).predict(np.linspace(0.0, 6.0, 400))[0]
    assert prediction[:, 2].max() - prediction[0, 2] > 0.096
    flat = GMR(20).fit(align(motions(8), method="resample")).predict(np.linspace(0.0, 6.0, 400))[0]
    assert flat[:, 2].max() - flat[0, 2] < 0.085


@pytest.mark.parametrize("method", ["dtw", "resample"])
def test_only_time_is_changed(method):
    """Every aligned pose lies on the path that was shown."""
    for one, shown in zip(align(motions(5, rotations=True), method=method), motions(5, rotations=True), strict=True):
        fine = shown.trajectory.resample(20000)
        gap = np.linalg.norm(one.trajectory.positions[:, None] - fine.positions[None, ::10], axis=2)
        assert gap.min(axis=1).max() < 1e-3
        nearest = np.array([np.argmin(g) for g in gap])
        turned = quaternion_multiply(quaternion_conjugate(fine.quaternions[::10][nearest]), one.trajectory.quaternions)
        assert np.linalg.norm(quaternion_log(turned), axis=1).max() < 0.02


def test_positions_rotations_and_joints_share_one_warp():
    """All three follow the phase of the sample, so they must agree about it after warping."""
    samples = [motion(bend=bend, rotations=True, joints=True, n=1000) for bend in (-0.12, 0.05, 0.12)]
    for one in align(samples):
        phase = np.arcsin(one.joints[:, 0])
        assert np.allclose(one.joints[:, 1], np.cos(phase), atol=1e-5)
        assert np.allclose(np.abs(np.sum(one.trajectory.quaternions * turn(phase), axis=1)), 1.0, atol=1e-6)


def test_times_are_common_and_the_duration_is_the_median():
    samples = [motion(duration=d, source=str(d)) for d in (4.0, 5.0, 9.0)]
    alignment = compute_alignment(samples, n=120)
    assert alignment.duration == pytest.approx(np.median(alignment.durations))
    for one in alignment.demonstrations:
        assert len(one) == 120
        assert np.allclose(one.trajectory.times, np.linspace(0.0, alignment.duration, 120))
        assert one.task == "reach"


def test_idle_ends_are_cut_and_named():
    idle, (first, last) = with_idle(motion(source="file.csv"), 2.0, 1.0)
    alignment = compute_alignment([idle, motion(source="other.csv")])
    rows = alignment.kept_rows[0]
    assert abs(rows[0] - first) < 20
    assert abs(rows[1] - last) < 20
    assert alignment.demonstrations[0].source == f"file.csv rows {rows[0]} to {rows[1]}"
    assert alignment.notes()[0].startswith(f"file.csv rows {rows[0]} to {rows[1]}: ")
    assert alignment.largest_shift.max() < 0.3


def test_stamps_that_start_late_change_nothing():
    samples = motions(4)
    later = [
        one.with_trajectory(Trajectory(one.trajectory.times + 1.7e9, one.trajectory.positions), None) for one in samples
    ]
    for a, b in zip(align(samples), align(later), strict=True):
        assert np.allclose(a.trajectory.positions, b.trajectory.positions, atol=1e-5)
        assert np.allclose(a.trajectory.times, b.trajectory.times, atol=1e-5)


def test_one_demonstration_is_only_trimmed_and_resampled():
    alignment = compute_alignment([motion()], n=50)
    assert np.allclose(alignment.warps, np.linspace(0.0, 1.0, 50))
    assert height_of_the_mean(alignment.demonstrations) == pytest.approx(PEAK, abs=2e-3)


def test_the_order_of_demonstrations_does_not_matter():
    samples = motions(5)
    forward, backward = align(samples), align(samples[::-1])[::-1]
    for a, b in zip(forward, backward, strict=True):
        assert np.allclose(a.trajectory.positions, b.trajectory.positions, atol=1e-9)


def test_what_can_not_be_aligned():
    still = Demonstration(Trajectory(np.arange(10.0), np.zeros((10, 3))), source="still.csv")
    with pytest.raises(InputError, match=r"still\.csv does not move"):
        align([motion(), still])
    with pytest.raises(InputError, match="no demonstrations"):
        align([])
    with pytest.raises(InputError, match=r"at least 10 .*got 3"):
        align([motion()], n=3)
    with pytest.raises(UnknownNameError, match=r"unknown method of alignment 'magic'.*; known: dtw, resample"):
        align([motion()], method="magic")
    with pytest.raises(InputError, match="bare has none"):
        align([motion(rotations=True), motion(source="bare")])


@pytest.mark.parametrize("name", ["bottle2shelf", "pouring", "letter_e", "letter_h", "letter_l", "letter_o"])
def test_real_demonstrations_come_closer(real_data, name):
    shown = read(real_data / "panda_kinesthetic" / f"{name}.npy", units="cm", duration=10.0)

    def spread(demonstrations):
        positions = np.stack([one.trajectory.positions for one in demonstrations])
        return np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=2)))

    alignment = compute_alignment(shown)
    assert spread(alignment.demonstrations) < 0.8 * spread(align(shown, method="resample"))
    assert np.all(np.diff(alignment.warps, axis=1) > 0.0)
    lengths = np.array(
        [
            [a.trajectory.path_length, b.trajectory.path_length]
            for a, b in zip(alignment.demonstrations, shown, strict=True)
        ]
    )
    assert np.all(lengths[:, 0] > 0.97 * lengths[:, 1])
