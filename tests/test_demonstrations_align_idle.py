from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from demonstration_samples import motion, with_idle
from imitarm.demonstrations.align import moving_rows, noise_level, smooth_slope, smooth_speed, turns
from imitarm.kinematics.pose import quaternion_exp, quaternion_log

TIMES = np.linspace(0.0, 4.0, 401)


@given(sigma=st.floats(1e-4, 5e-3), seed=st.integers(0, 20))
def test_noise_is_measured_in_spite_of_the_motion(sigma, seed):
    noisy = motion(noise=sigma, seed=seed, n=500).trajectory.positions
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.25)


def test_a_smooth_motion_has_no_noise():
    assert noise_level(motion(n=1000).trajectory.positions) < 2e-5
    assert noise_level(np.zeros((3, 3))) == 0.0


def test_slope_and_mean_of_a_straight_line_are_exact_even_when_samples_are_missing():
    times = np.delete(TIMES, [50, 51, 52, 200])
    values = np.outer(times, [1.0, -2.0, 0.0]) + 5.0
    slope, mean, n = smooth_slope(times, values)
    assert np.allclose(slope, [1.0, -2.0, 0.0])
    assert np.allclose(mean[n == 21], values[n == 21])
    assert np.allclose(smooth_speed(times, values)[0], np.sqrt(5.0))


def test_the_turn_adds_up_beyond_half_a_revolution():
    angle = np.linspace(0.0, 1.5 * np.pi, 100)
    q = quaternion_exp(np.outer(angle, [0, 1, 0])) * np.where(np.arange(100) % 7 == 0, -1.0, 1.0)[:, None]
    assert np.allclose(turns(q), np.outer(angle, [0, 1, 0]))
    assert np.linalg.norm(quaternion_log(q[-1])) < np.pi  # what the last rotation alone would say


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
@pytest.mark.parametrize(("head", "tail"), [(1.0, 2.0), (0.0, 1.0), (3.0, 0.0)])
def test_idle_ends_are_found(noise, head, tail):
    idle, (first, last) = with_idle(motion(), head, tail, noise=noise)
    found = moving_rows(idle.trajectory.times, idle.trajectory.positions)
    # late: a minimum-jerk start is slow itself; early: 0.1 s that is kept and half a window, longer with noisy samples
    late, early = (30, 26) if noise == 1e-3 else (20, 13)
    assert first - early <= found[0] <= first + late
    assert last - late <= found[1] <= last + early


def test_nothing_but_the_slow_ends_of_a_clean_motion_is_idle():
    trajectory = motion(n=500).trajectory
    first, last = moving_rows(trajectory.times, trajectory.positions)
    assert np.linalg.norm(trajectory.positions[first] - trajectory.positions[0]) < 3e-3
    assert np.linalg.norm(trajectory.positions[last] - trajectory.positions[-1]) < 3e-3


def test_a_pause_on_the_way_is_no_idle_end():
    phase = np.concatenate([np.linspace(0, 0.5, 200), np.full(100, 0.5), np.linspace(0.5, 1, 101)])
    positions = np.outer(phase, [0.3, 0.0, 0.0])
    assert moving_rows(TIMES, positions) == (0, 400)


def test_turning_on_the_spot_is_moving():
    still = np.zeros((401, 3))
    assert moving_rows(TIMES, still) is None
    assert moving_rows(TIMES, still, np.tile([1.0, 0, 0, 0], (401, 1))) is None
    angle = np.interp(TIMES, [1.0, 3.0], [0.0, 1.0])
    first, last = moving_rows(TIMES, still, quaternion_exp(np.outer(angle, [0, 0, 1])))
    assert 75 <= first <= 100
    assert 300 <= last <= 325


def test_a_motion_that_ends_turning_is_kept_to_its_end():
    positions = np.outer(np.interp(TIMES, [0.0, 2.0], [0.0, 0.4]), [1.0, 0, 0])
    q = quaternion_exp(np.outer(np.interp(TIMES, [2.0, 4.0], [0.0, 1.2]), [1, 0, 0]))
    assert moving_rows(TIMES, positions)[1] < 220
    assert moving_rows(TIMES, positions, q)[1] == 400


def test_epoch_stamps_change_nothing():
    idle, _ = with_idle(motion(), 1.0, 1.0)
    t = idle.trajectory
    assert moving_rows(t.times, t.positions) == moving_rows(np.round(t.times + 1.7e9, 4), t.positions)


def test_noise_that_goes_nowhere_is_no_motion_or_all_of_it():
    """Columns that are not positions, read as such: lint has to get that far to say so."""
    for seed in range(200):
        rows = moving_rows(np.linspace(0.0, 5.0, 50), np.random.default_rng(seed).random((50, 3)), None)
        assert rows is None or 0 <= rows[0] <= rows[1] < 50


@pytest.mark.parametrize("speed", [0.5e-3, 1e-3, 2e-3, 5e-3])
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_a_slow_insertion_after_a_fast_approach_is_kept(speed, noise):
    """0.5 m in 2 s, a stop, 20 mm slowly downwards, and standing."""
    times = np.arange(0.0, 8.0 + 0.02 / speed, 0.01)
    phase = np.clip((times - 1.0) / 2.0, 0.0, 1.0)
    depth = np.clip((times - 4.0) * speed, 0.0, 0.02)
    clean = np.stack([0.5 * phase**3 * (10 - 15 * phase + 6 * phase**2), 0.0 * times, -depth], axis=1)
    positions = clean + noise * np.random.default_rng(0).normal(size=clean.shape)
    first, last = moving_rows(times, positions)
    assert np.linalg.norm(clean[first] - clean[0]) < 1e-9
    assert 0.02 - depth[last] < 6e-5 + 2.0 * noise
    assert times[last] < 4.0 + 0.02 / speed + 0.2 and first > 80  # what stands is still cut off


@pytest.mark.parametrize("speed", [1e-3, 3e-3])
def test_a_slow_withdrawal_and_slow_rotation_are_kept(speed):
    times = np.arange(0.0, 3.0 + 0.02 / speed, 0.01)
    depth = np.clip((times - 1.0) * speed, 0.0, 0.02)
    fast = np.clip(times - 1.5 - 0.02 / speed, 0.0, 1.0)
    positions = np.stack([0.5 * fast, 0.0 * times, depth], axis=1)
    assert depth[moving_rows(times, positions)[0]] == 0.0
    angle = np.clip((times - 1.0) * speed, 0.0, 0.02)
    rotations = quaternion_exp(np.outer(angle, [0, 0, 1]))
    first, last = moving_rows(times, np.zeros_like(positions), rotations)
    assert angle[first] < 1e-3 and 0.02 - angle[last] < 1e-3  # 0.06 degrees
