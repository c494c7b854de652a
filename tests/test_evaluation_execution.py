from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm import ArmModel, Scene, Sphere
from imitarm.capture.synthetic import SyntheticSource
from imitarm.evaluation.execution import execute_on_robot
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
    fractions = []
    done = execute_on_robot(RUN, progress=fractions.append)
    assert done.limited == 0 and not done.fault and done.touched == ()
    assert 0.0 < done.error_rms <= done.error_max < 0.01
    assert 0.1 < done.peak_torque_ratio <= 1.0
    assert done.clearance == np.inf
    assert fractions == sorted(fractions) and fractions[-1] > 0.98
    assert done.duration == pytest.approx(RUN.times[-1], abs=0.02)


def test_what_breaks_them_is_cut_and_the_arm_falls_behind():
    joints = np.tile(RUN.joints[0], (len(RUN.joints), 1))
    joints[100:, 5] += 0.3  # at once
    done = execute_on_robot(moved(joints))
    assert done.limited > 3 and done.error_max > 0.1


def test_what_is_touched_is_named_and_an_arm_that_is_held_stops_itself():
    tool = ARM.tool_pose(RUN.joints[0]).position
    joints = np.tile(RUN.joints[0], (len(RUN.joints), 1))
    joints[:, 0] += np.clip(0.01 * (np.arange(len(joints)) - 50), 0.0, 1.0)  # a turn of the base, at 1 rad/s
    wall = Sphere(tool + np.array([0.0, 0.35, 0.0]), 0.12, name="wall")
    done = execute_on_robot(moved(joints), Scene(None, [wall]))
    assert done.touched == ('sphere "wall"',)
    assert done.clearance < 1e-3
    assert done.fault and done.duration < RUN.times[-1]
