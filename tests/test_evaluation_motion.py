from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.evaluation.execution import execute_within_limits
from imitarm.evaluation.motion import (
    ArmMotion,
    jerk_rms,
    log_dimensionless_jerk,
    path_length,
    spectral_arc_length,
    violations,
)
from imitarm.kinematics.arm import ArmModel

ARM = ArmModel.load("sawyer", tool="gripper")
DT = 0.01
TIMES = DT * np.arange(301)


def minimum_jerk(u):
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def moved(course, joint=0, way=0.5):
    joints = np.tile(ARM.home, (len(course), 1))
    joints[:, joint] += way * course
    return joints


def test_a_still_arm_holds_its_weight_and_nothing_else():
    motion = ArmMotion.of(ARM, TIMES, moved(np.zeros(301)))
    np.testing.assert_allclose(motion.torques, np.tile(ARM.gravity_torque(ARM.home), (301, 1)), atol=1e-9)
    np.testing.assert_allclose(motion.torques, motion.gravity, atol=1e-9)
    jacobian = ARM.tool_jacobian(ARM.home) * np.array([1, 1, 1, 0.3, 0.3, 0.3])[:, None]
    np.testing.assert_allclose(motion.least_singular, np.linalg.svd(jacobian)[1][-1])


def test_a_turn_about_the_base_takes_inertia_times_acceleration():
    """One joint alone, at an acceleration that is constant: torque = M00 * a, gravity none."""
    acceleration = 0.4
    course = 0.5 * acceleration * TIMES**2
    motion = ArmMotion.of(ARM, TIMES, moved(course, way=1.0))
    inertia = ARM.mass_matrix(ARM.home)[0, 0]  # of the first joint: it does not depend on its own angle
    np.testing.assert_allclose(motion.torques[1:-1, 0], inertia * acceleration, rtol=1e-6)
    np.testing.assert_allclose(motion.gravity[:, 0], 0.0, atol=1e-9)


def test_the_tool_goes_along_a_circle_about_the_base():
    angle = 1.2
    motion = ArmMotion.of(ARM, TIMES, moved(minimum_jerk(TIMES / 2.5), way=angle))
    radius = np.hypot(*motion.tool[0, :2])
    assert path_length(motion.tool) == pytest.approx(angle * radius, rel=1e-4)
    assert motion.sew.shape == (301, 3, 3)


@pytest.mark.parametrize("bad", ["few", "uneven", "infinite"])
def test_what_is_no_motion_is_refused(bad):
    times, joints = TIMES.copy(), moved(np.zeros(301))
    if bad == "few":
        times, joints = times[:3], joints[:3]
    elif bad == "uneven":
        times[100] += 0.004
    else:
        joints[5, 2] = np.nan
    with pytest.raises(InputError):
        ArmMotion.of(ARM, times, joints)


def test_a_motion_within_limits_breaks_none():
    found = violations(ARM, moved(minimum_jerk(TIMES / 2.0)), DT)
    assert (found.position, found.velocity, found.acceleration, found.position_excess) == (0, 0, 0, 0.0)
    assert 0.0 < found.velocity_ratio < 1.0
    assert found.velocity_ratio == pytest.approx(1.875 * 0.5 / 2.0 / ARM.max_velocity[0], rel=1e-3)
    assert found.acceleration_ratio == pytest.approx(5.7735 * 0.5 / 4.0 / ARM.max_acceleration[0], rel=1e-2)


@given(st.integers(3, 290), st.integers(0, 6), st.floats(1.05, 5.0))
def test_each_violation_is_counted_where_it_happens(frame, joint, factor):
    joints = np.tile(ARM.home, (301, 1))
    joints[frame:, joint] += 1e-3 * DT * factor * ARM.max_velocity[joint]  # a step, first a small one
    assert violations(ARM, joints, DT).velocity == 0
    joints = np.tile(ARM.home, (301, 1))
    joints[frame:, joint] += DT * factor * ARM.max_velocity[joint] * np.sign(-ARM.home[joint] - 1e-9)
    found = violations(ARM, joints, DT)
    assert found.velocity == 1
    assert found.velocity_ratio == pytest.approx(factor)
    assert found.acceleration == 2  # it starts, it stops
    assert found.acceleration_ratio == pytest.approx(
        factor * ARM.max_velocity[joint] / DT / ARM.max_acceleration[joint]
    )


def test_a_joint_beyond_its_range_and_a_jump_at_the_beginning_are_seen():
    joints = np.tile(ARM.home, (50, 1))
    joints[20:30, 3] = ARM.upper[3] + 0.02
    found = violations(ARM, joints, DT)
    assert found.position == 10
    assert found.position_excess == pytest.approx(0.02)
    joints = np.tile(ARM.home, (50, 1))
    joints[1:, 0] += 0.9 * DT * ARM.max_velocity[0]
    assert violations(ARM, joints, DT).acceleration == 2


def test_jerk_of_a_cubic_is_its_third_derivative():
    course = np.column_stack([0.7 * TIMES**3, -0.2 * TIMES**3 + TIMES**2])
    assert jerk_rms(course, DT) == pytest.approx(6.0 * np.hypot(0.7, 0.2), rel=1e-6)


def test_spectral_arc_length_knows_a_smooth_motion():
    """A minimum-jerk reach has about -1.4, whatever its size and duration; what is added to it makes it worse."""
    times = DT * np.arange(400)
    bell = np.gradient(minimum_jerk(times / 1.5), DT)
    smooth = spectral_arc_length(bell, DT)
    assert smooth == pytest.approx(-1.41, abs=0.03)
    assert spectral_arc_length(7.0 * bell, DT) == pytest.approx(smooth, rel=1e-9)
    slow = np.gradient(minimum_jerk(times / 3.0), DT)
    assert spectral_arc_length(slow, DT) == pytest.approx(smooth, abs=0.02)
    shaky = bell * (1.0 + 0.4 * np.sin(2.0 * np.pi * 5.0 * times))
    assert spectral_arc_length(shaky, DT) < smooth - 0.2
    assert np.isnan(spectral_arc_length(np.zeros(100), DT))


def test_commands_within_the_limits_are_executed_as_they_are():
    joints = moved(minimum_jerk(TIMES / 2.0))
    np.testing.assert_allclose(execute_within_limits(ARM, joints, DT), joints, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.6))
def test_what_is_executed_breaks_no_limit_and_arrives(seed, size):
    """Whatever is commanded; when the commands rest, the arm gets there."""
    rng = np.random.default_rng(seed)
    goal = np.clip(ARM.home + rng.normal(0.0, size, 7), ARM.lower, ARM.upper)
    joints = np.tile(ARM.home, (500, 1)) + rng.normal(0.0, 0.1 * size, (500, 7))
    joints[0], joints[100:] = ARM.home, goal
    done = execute_within_limits(ARM, joints, DT)
    found = violations(ARM, done, DT)
    assert (found.position, found.velocity, found.acceleration) == (0, 0, 0)
    np.testing.assert_allclose(done[-1], goal, atol=0.02)


def test_the_jerk_of_a_minimum_jerk_motion_is_its_closed_form_at_every_scale():
    u = np.linspace(0.0, 1.0, 4001)
    shape = 10 * u**3 - 15 * u**4 + 6 * u**5
    for length, duration in ((1.0, 1.0), (0.3, 7.0)):
        x = length * shape[:, None] * [0.6, 0.0, 0.8]
        found = log_dimensionless_jerk(x, duration / 4000)
        assert found == pytest.approx(-np.log(720.0 / 1.875**2), abs=2e-3)
    assert np.isnan(log_dimensionless_jerk(np.zeros((10, 3)), 0.1))
