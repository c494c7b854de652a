"""Execution times of a joint path: within all limits, from rest to rest, and not much longer than necessary."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from imitarm import ArmModel, Sphere
from imitarm.kinematics.arm_path import ArmPath, track
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.retiming import retimed, safe_rates

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}


def swing(arm, seed, duration):
    rng = np.random.default_rng(seed)
    knots = arm.home + 0.3 * np.cumsum(rng.normal(size=(5, 7)), axis=0)
    knots = np.clip(knots, arm.lower + 0.05, arm.upper - 0.05)
    s = np.linspace(0.0, duration, 200)
    return CubicSpline(np.linspace(0.0, duration, 5), knots)(s), s


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("duration", [0.8, 2.0, 8.0])
def test_velocity_acceleration_and_torque_stay_within_their_limits(name, duration):
    arm = ARMS[name]
    for seed in range(4):
        joints, s = swing(arm, seed, duration)
        timing = retimed(arm, joints, s, np.ones(len(s)))
        assert timing.blocked == -1
        t = timing.times
        assert (np.diff(t) >= np.diff(s) - 1e-9).all()  # never faster than demonstrated
        velocity = np.diff(joints, axis=0) / np.diff(t)[:, None]
        assert (np.abs(velocity) <= 1.02 * arm.max_velocity).all()
        middle = 0.5 * (t[1:] + t[:-1])
        acceleration = np.diff(velocity, axis=0) / np.diff(middle)[:, None]
        # two differences of a coarse grid: the ends, where the path begins from rest, are rough
        assert (np.abs(acceleration[3:-3]) <= 1.15 * arm.max_acceleration).all()
        torque = [
            arm.inverse_dynamics(q, 0.5 * (v + w), a)
            for q, v, w, a in zip(joints[1:-1], velocity[:-1], velocity[1:], acceleration, strict=True)
        ]
        assert (np.abs(torque[3:-3]) <= 1.05 * arm.max_torque).all()


def test_one_joint_takes_the_time_of_full_acceleration_and_braking():
    arm = ARMS["sawyer"]
    s = np.linspace(0.0, 0.05, 400)  # far too fast
    joints = np.tile(arm.home, (400, 1))
    joints[:, 6] += np.linspace(0.0, 1.0, 400)
    timing = retimed(arm, joints, s, np.full(400, np.inf))
    v, a = 0.95 * arm.max_velocity[6], 0.9 * arm.max_acceleration[6]
    least = 2.0 * np.sqrt(1.0 / a) if v**2 / a > 1.0 else 1.0 / v + v / a
    assert least <= timing.times[-1] <= 1.05 * least


def test_a_slow_place_is_passed_slowly_and_a_path_within_the_limits_keeps_its_times():
    arm = ARMS["panda"]
    u = np.linspace(0.0, 1.0, 200)
    joints = arm.home + 0.2 * (u**3 * (10 - 15 * u + 6 * u * u))[:, None]  # from rest to rest
    s = 10.0 * u
    free = retimed(arm, joints, s, np.ones(200))
    assert free.times[-1] == pytest.approx(10.0, rel=0.02)
    slow = np.ones(200)
    slow[100] = 0.1
    held = retimed(arm, joints, s, slow)
    assert held.times[-1] > free.times[-1] + 0.05
    assert np.diff(held.times)[99:101].min() > 1.5 * np.diff(s)[99]


def test_an_arm_that_cannot_carry_its_weight_is_told_with_the_joint(tmp_path):
    path = tmp_path / "weak.xml"
    path.write_text(
        """<mujoco><compiler angle="radian"/><worldbody><body><joint name="shoulder" axis="0 1 0" range="-3 3"
        actuatorfrcrange="-1 1"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".05" mass="5" group="3"/>
        <site name="flange" pos="1 0 0"/></body></worldbody></mujoco>"""
    )
    arm = ArmModel.load(path)
    timing = retimed(arm, np.linspace([0.5 * np.pi], [0.0], 50), np.linspace(0.0, 5.0, 50), np.ones(50))
    assert timing.blocked > 0
    assert timing.joint == 0


def test_the_tool_is_as_slow_in_every_posture_and_the_whole_arm_is_no_faster():
    arm, times = ARMS["panda"], np.linspace(0.0, 2.0, 100)
    pose = arm.tool_pose(arm.home)
    positions = pose.position + 0.2 * np.sin(0.5 * np.pi * times)[:, None] * [0.0, 1.0, 0.0]
    quaternions = np.tile(pose.quaternion, (100, 1))
    ahead = Sphere(positions[50] + [0.0, 0.08, -0.02], 0.02)
    around = ArmAmongObstacles(arm, [ahead], 0.0)
    rates = []
    for drift in (None, arm.home + [0.3, 0.0, -0.5, 0.0, 0.3, 0.0, 0.0]):
        joints = track(arm, arm.home, positions, quaternions, drift)
        path, error = ArmPath.of(arm, joints).moved_to(positions, quaternions)
        assert error < 1e-5
        whole = safe_rates(around, path, times, times, 0.0)
        tool = safe_rates(around, path, times, times, 0.0, tool_only=True)
        assert (whole <= tool).all()
        rates.append((tool, path.joints))
    (first, a), (second, b) = rates
    assert np.abs(a - b).max() > 0.1
    assert first.min() < 0.8  # the sphere slows the tool
    np.testing.assert_allclose(first[2:-2], second[2:-2], rtol=0.05)  # speeds are differences of samples
