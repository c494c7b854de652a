"""Style of a path: compared as a curve, in the unit of the demonstrations, with the tilt of the tool."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import InputError
from imitarm.evaluation.path_style import path_style, tilts
from imitarm.kinematics.pose import quaternion_exp
from imitarm.trajectory import Trajectory

N = 200
TIMES = np.linspace(0.0, 4.0, N)


def arc(times=TIMES, lift=0.0):
    """A quarter circle of radius 0.5 m, at an even speed or at that of ``times``."""
    angle = 0.5 * np.pi * (times - times[0]) / (times[-1] - times[0])
    positions = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full(len(times), lift)], axis=1)
    return Trajectory(times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1)))


COVARIANCES = np.tile(np.diag([0.01, 0.01, 0.02]) ** 2, (N, 1, 1))


def test_the_mean_itself_does_not_depart():
    style = path_style(arc(), arc(), COVARIANCES)
    assert style.rmse < 1e-9
    assert style.deviation < 1e-6
    assert style.tilt == 0.0


@given(st.floats(0.3, 3.0), st.floats(-0.1, 0.1))
@settings(max_examples=20, deadline=None)
def test_timing_does_not_matter_and_a_lift_counts_in_metres_and_sigmas(power, lift):
    other = arc(lift=lift)
    late = Trajectory(4.0 * (TIMES / 4.0) ** power + 1e-3 * TIMES, other.positions, other.quaternions)
    style = path_style(late, arc(), COVARIANCES)
    assert style.rmse == pytest.approx(abs(lift), abs=1e-6)
    assert style.deviation == pytest.approx(abs(lift) / 0.02, abs=1e-3)


def test_a_loop_counts_although_it_returns_to_the_path():
    """Matching in order can't skip a detour, and the largest deviation is that of its farthest point."""
    mean = arc()
    positions = mean.positions.copy()
    positions[80:120, 2] += 0.1 * np.sin(np.linspace(0.0, np.pi, 40))
    style = path_style(mean.with_positions(positions), mean, COVARIANCES)
    assert 0.1 / 0.02 - 0.01 <= style.deviation < 1.2 * 0.1 / 0.02  # a matched point may also lag along the path
    assert 0.01 < style.rmse < 0.1


@pytest.mark.parametrize("angle", [0.0, 0.2, 1.5])
def test_the_tilt_is_the_angle_to_the_learned_rotation_at_the_nearest_sample(angle):
    mean = arc()
    turned = np.tile(quaternion_exp(np.array([angle, 0.0, 0.0])), (N, 1))
    found, nearest = tilts(mean, mean.positions + [0.0, 0.0, 0.05], turned)
    np.testing.assert_allclose(found, angle, atol=1e-7)
    np.testing.assert_array_equal(nearest, np.arange(N))


def test_paths_without_rotations_are_rejected():
    bare = Trajectory(TIMES, arc().positions)
    with pytest.raises(InputError, match="rotations"):
        path_style(bare, arc(), COVARIANCES)
    with pytest.raises(InputError, match="rotations"):
        path_style(arc(), bare, COVARIANCES)
