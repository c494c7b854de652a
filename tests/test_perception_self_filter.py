"""The self filter removes the arm where it was when the image was taken, and little else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.perception import SelfFilter


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("panda", tool="gripper")


def surface(arm, q, rng, n=400):
    """Random points on the spheres that cover the arm."""
    centers, radii = arm.collision_spheres(q)
    chosen = rng.integers(0, len(radii), n)
    away = rng.normal(size=(n, 3))
    return centers[chosen] + radii[chosen, None] * away / np.linalg.norm(away, axis=1)[:, None]


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), late=st.floats(-0.033, 0.033))
def test_the_arm_is_removed_with_wrong_stamps_and_a_wrong_calibration(arm, seed, late):
    rng = np.random.default_rng(seed)
    start, velocity = arm.home + rng.uniform(-0.2, 0.2, 7), rng.uniform(-1.0, 1.0, 7)
    own = SelfFilter(arm, padding=0.015, stamp_uncertainty=0.035)
    for k in range(60):
        own.record(0.01 * k + late, start + 0.01 * k * velocity)
    off = rng.normal(size=3)
    points = surface(arm, start + 0.4 * velocity, rng) + 0.01 * off / np.linalg.norm(off)
    assert own.on_arm(points, 0.4).all()


def test_points_farther_than_the_padding_are_kept(arm):
    own = SelfFilter(arm, padding=0.02)
    own.record(0.0, arm.home)
    own.record(1.0, arm.home)
    centers, radii = arm.collision_spheres(arm.home)
    points = np.random.default_rng(0).uniform([-1, -1, -0.5], [1, 1, 1.5], (4000, 3))
    every = np.concatenate([centers, arm.cover.base_centers])
    gaps = (np.linalg.norm(points[:, None] - every, axis=2) - np.concatenate([radii, arm.cover.base_radii])).min(axis=1)
    np.testing.assert_array_equal(own.on_arm(points, 0.5), gaps <= 0.02)
    np.testing.assert_array_equal(own.on_arm(points, 0.5, np.full(4000, 0.01)), gaps <= 0.03)
    assert own.on_arm(np.zeros((0, 3)), 0.5).shape == (0,)


def test_the_posture_is_interpolated_and_old_ones_are_forgotten(arm):
    own = SelfFilter(arm, stamp_uncertainty=0.05, history=1.0)
    np.testing.assert_array_equal(own.posture(3.0), arm.home)
    assert not own.ready
    step = np.full(7, 0.1)
    for stamp in (0.2, 0.0, 0.1):  # in any order
        own.record(stamp, arm.home + stamp * step)
    np.testing.assert_allclose(own.posture(0.15), arm.home + 0.15 * step)
    np.testing.assert_allclose(own.posture(-1.0), arm.home)
    np.testing.assert_allclose(own.posture(0.23), arm.home + 0.23 * step)
    np.testing.assert_allclose(own.posture(5.0), arm.home + 0.25 * step)  # not extrapolated without end
    own.record(1.15, arm.home)
    np.testing.assert_allclose(own.posture(-1.0), arm.home + 0.2 * step)
    own.reset()
    assert not own.ready


def test_bad_arguments_are_refused(arm):
    with pytest.raises(InputError, match="arm"):
        SelfFilter("panda")
    with pytest.raises(InputError, match="padding"):
        SelfFilter(arm, padding=-0.1)
    with pytest.raises(InputError, match="stamp_uncertainty"):
        SelfFilter(arm, stamp_uncertainty=np.nan)
    own = SelfFilter(arm)
    with pytest.raises(InputError, match="q must be 7"):
        own.record(0.0, [0.0] * 6)
    with pytest.raises(InputError, match="stamp"):
        own.record(np.nan, arm.home)
