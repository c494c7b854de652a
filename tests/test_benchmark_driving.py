from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm import ArmModel, Scene, Sphere
from imitarm.capture.synthetic import SyntheticSource
from imitarm.evaluation.driving import drive
from imitarm.retarget import Correspondence, ModernRetargeter

ARM = ArmModel.load("sawyer", tool="gripper")
RUN = ModernRetargeter(ARM, Correspondence(orientation="fixed", scale=0.6)).run(
    SyntheticSource.from_seed(1, duration=4.0)
)


def moved(joints):
    """A run with other joints, whose velocities belong to them."""
    velocities = np.zeros_like(joints)
    velocities[1:] = np.diff(joints, axis=0) / 0.01
    return replace(RUN, joints=joints, velocities=velocities)


def test_what_keeps_the_limits_is_followed_and_nothing_is_cut():
    shares = []
    driven = drive(RUN, progress=shares.append)
    assert driven.cut == 0 and not driven.fault and driven.touched == ()
    assert 0.0 < driven.behind_rms <= driven.behind_max < 0.01
    assert 0.1 < driven.peak_torque_ratio <= 1.0
    assert driven.clearance == np.inf
    assert shares == sorted(shares) and shares[-1] > 0.98
    assert driven.duration == pytest.approx(RUN.times[-1], abs=0.02)


def test_what_breaks_them_is_cut_and_the_arm_falls_behind():
    joints = np.tile(RUN.joints[0], (len(RUN.joints), 1))
    joints[100:, 5] += 0.3  # at once
    driven = drive(moved(joints))
    assert driven.cut > 3 and driven.behind_max > 0.1


def test_what_is_touched_is_named_and_an_arm_that_is_held_stops_itself():
    tool = ARM.tool_pose(RUN.joints[0]).position
    joints = np.tile(RUN.joints[0], (len(RUN.joints), 1))
    joints[:, 0] += np.clip(0.01 * (np.arange(len(joints)) - 50), 0.0, 1.0)  # a turn of the base, at 1 rad/s
    wall = Sphere(tool + np.array([0.0, 0.35, 0.0]), 0.12, name="wall")
    driven = drive(moved(joints), Scene(None, [wall]))
    assert driven.touched == ('sphere "wall"',)
    assert driven.clearance < 1e-3
    assert driven.fault and driven.duration < RUN.times[-1]
