from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from demonstration_samples import motion, phase_of
from imitarm.demonstrations.align import barycentre_warps, dtw, features, identity_warps, medoid
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.trajectory import Trajectory


def dtw_by_the_book(a, b, band, price):
    """The recursion as it is written, cell by cell."""
    n = len(a)
    total = np.full((n, n), np.inf)
    for i in range(n):
        for j in range(max(0, i - band), min(n, i + band + 1)):
            cost = np.sum((a[i] - b[j]) ** 2)
            if i == j == 0:
                total[i, j] = cost
                continue
            options = [total[i - 1, j - 1] + cost if i and j else np.inf]
            options += [total[i - 1, j] + price if i else np.inf, total[i, j - 1] + price if j else np.inf]
            total[i, j] = cost + min(options)
    return total[-1, -1]


@given(n=st.integers(2, 14), band=st.integers(1, 14), price=st.sampled_from([0.0, 0.1, 2.0]), seed=st.integers(0, 1000))
def test_all_diagonals_at_once_equal_the_recursion(n, band, price, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3, n, 2))
    cost, paths = dtw(a, b, band=band, price=price)
    assert np.allclose(cost, [dtw_by_the_book(x, y, band, price) for x, y in zip(a, b, strict=True)])
    for x, y, total, steps in zip(a, b, cost, paths, strict=True):
        assert steps[0].tolist() == [n - 1, n - 1]
        assert steps[-1].tolist() == [0, 0]
        assert np.abs(steps[:, 0] - steps[:, 1]).max() <= band
        length = int(np.argmax(steps.sum(axis=1) == 0)) + 1
        moves = -np.diff(steps[:length], axis=0)
        assert set(map(tuple, moves.tolist())) <= {(1, 1), (1, 0), (0, 1)}
        # the path that is returned has the cost that is returned
        here = np.sum((x[steps[:length, 0]] - y[steps[:length, 1]]) ** 2, axis=1)
        diagonal = np.append(moves.sum(axis=1) == 2, False)
        assert total == pytest.approx(np.sum(here * (1 + diagonal)) + price * np.sum(~diagonal[:-1]))


def test_equal_motions_are_matched_straight():
    a = np.random.default_rng(0).normal(size=(1, 30, 3))
    cost, path_ = dtw(a, a, band=5)
    assert cost[0] == pytest.approx(0.0, abs=1e-10)
    assert np.array_equal(path_[0, :30, 0], np.arange(30)[::-1])
    assert np.array_equal(path_[0, :, 0], path_[0, :, 1])


def test_the_medoid_is_the_one_in_the_middle():
    values = np.array([0.0, 1.0, 1.2, 5.0])[:, None, None] * np.ones((4, 10, 3))
    assert medoid(values) in (1, 2)
    assert medoid(values[[3, 1, 0]]) == 1


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_known_warp_is_undone(noise):
    """After warping, every demonstration is at the same phase at the same time."""
    bends = [-0.12, -0.07, 0.0, 0.03, 0.08, 0.12]
    samples = [motion(bend=bend, noise=noise, seed=i, n=400) for i, bend in enumerate(bends)]
    warps = barycentre_warps(features([one.trajectory.resample(200) for one in samples]))
    phases = np.stack([phase_of(warp, bend) for warp, bend in zip(warps, bends, strict=True)])
    before = np.stack([phase_of(np.linspace(0, 1, 200), bend) for bend in bends])
    assert np.ptp(before, axis=0).max() > 0.1
    assert np.sqrt(np.mean(np.var(phases, axis=0))) < (0.004 if noise == 0.0 else 0.008)


@settings(max_examples=15)
@given(seed=st.integers(0, 30), n_demonstrations=st.integers(2, 6), n=st.sampled_from([20, 57, 100]))
def test_warps_are_increasing_pinned_and_centred(seed, n_demonstrations, n):
    rng = np.random.default_rng(seed)
    values = np.cumsum(rng.normal(size=(n_demonstrations, n, 3)), axis=1)  # motions that have nothing in common
    warps = barycentre_warps(values)
    assert warps.shape == (n_demonstrations, n)
    assert np.all(warps[:, 0] == 0.0)
    assert np.allclose(warps[:, -1], 1.0)
    assert np.all(np.diff(warps, axis=1) > 0.0)
    assert np.allclose(warps.mean(axis=0), np.linspace(0.0, 1.0, n), atol=0.02)


def test_noise_alone_bends_no_time():
    samples = [motion(noise=2e-3, seed=i) for i in range(6)]
    warps = barycentre_warps(features([one.trajectory.resample(200) for one in samples]))
    assert np.abs(warps - np.linspace(0.0, 1.0, 200)).max() < 0.03


def test_another_start_is_not_taken_for_another_time():
    samples = [motion(offset=(0.05 * i, 0.0, 0.0)) for i in range(4)]
    warps = barycentre_warps(features([one.trajectory.resample(200) for one in samples]))
    assert np.allclose(warps, identity_warps(4, 200), atol=1e-9)


def test_rotation_alone_can_align():
    share = np.linspace(0.0, 1.0, 150)

    def turning(bend):
        angle = 2.0 * np.sin(2.0 * np.pi * phase_of(share, bend))
        return Trajectory(5.0 * share, np.zeros((150, 3)), quaternion_exp(np.outer(angle, [1.0, 0, 0])))

    bends = [-0.1, 0.0, 0.1]
    warps = barycentre_warps(features([turning(bend) for bend in bends]))
    phases = np.stack([phase_of(warp, bend) for warp, bend in zip(warps, bends, strict=True)])
    assert np.ptp(phases, axis=0).max() < 0.02


def test_features_do_not_depend_on_the_base_rotation_of_quaternions():
    trajectory = motion(rotations=True, n=50).trajectory
    world = quaternion_exp([0.3, -0.2, 0.5])
    turned = Trajectory(trajectory.times, trajectory.positions, quaternion_multiply(world, trajectory.quaternions))
    a, b = features([trajectory, trajectory]), features([turned, turned])
    assert np.allclose(np.linalg.norm(np.diff(a, axis=1), axis=2), np.linalg.norm(np.diff(b, axis=1), axis=2))
