from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.limits import JointLimits
from imitarm.robots import Robot, limit_velocity

ARM = ArmModel.load("sawyer")
LIMITS = JointLimits(ARM)
DT = 0.01


class Paper(Robot):
    """A robot that follows perfectly, until its joints are held."""

    def __init__(self, q=ARM.home):
        super().__init__(ARM, q)
        self.time, self.held = 0.0, None
        self.q = np.array(q)
        self.sent = []

    def state(self):
        return ArmState(self.q if self.held is None else self.held, self.velocity, np.zeros(7), self.time)

    def _send(self, previous, velocity, dt):
        self.sent.append((previous, velocity))
        self.q = self.q + 0.5 * dt * (previous + velocity)
        self.time += dt


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), dt=st.sampled_from([0.002, 0.01, 0.05]))
def test_no_sequence_of_commands_breaks_a_limit(seed, dt):
    rng = np.random.default_rng(seed)
    robot = Paper(rng.uniform(ARM.lower, ARM.upper))
    drift = rng.normal(0.0, 3.0, 7)  # towards some limits, with bursts
    for _ in range(150):
        before = robot.velocity
        robot.move(drift + rng.normal(0.0, 4.0, 7) * (rng.random() < 0.3), dt)
        assert np.all(np.abs(robot.velocity) <= ARM.max_velocity + 1e-12)
        assert np.all(np.abs(robot.velocity - before) <= ARM.max_acceleration * dt + 1e-9)
        assert np.all((robot.set_point >= ARM.lower - 1e-9) & (robot.set_point <= ARM.upper + 1e-9))


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_an_admissible_velocity_is_sent_as_it_is(seed):
    rng = np.random.default_rng(seed)
    previous = rng.uniform(-0.5, 0.5, 7) * ARM.max_velocity
    asked = previous + rng.uniform(-0.9, 0.9, 7) * ARM.max_acceleration * DT
    sent, clamped = limit_velocity(LIMITS, ARM.home, previous, asked, DT)
    np.testing.assert_allclose(sent, asked, atol=1e-12)
    assert clamped == ()


def test_too_fast_slows_all_joints_by_one_factor():
    asked = np.array([5.0, 0.4, -1.0, 0.2, 0.1, 0.3, -0.2])
    sent, clamped = limit_velocity(LIMITS, ARM.home, asked / 5.0 * ARM.max_velocity[0], asked, DT)
    np.testing.assert_allclose(sent, asked * ARM.max_velocity[0] / 5.0, atol=1e-12)
    assert clamped == ("velocity",)


def test_beyond_a_limit_the_way_back_is_free_and_the_way_out_is_not():
    q = ARM.home.copy()
    q[0] = ARM.upper[0] + 0.05
    out, clamped = limit_velocity(LIMITS, q, np.zeros(7), np.full(7, 0.05), DT)
    assert out[0] == 0.0
    assert clamped == ("position",)
    back, _ = limit_velocity(LIMITS, q, np.zeros(7), np.full(7, -0.05), DT)
    assert back[0] == pytest.approx(-0.05)


def test_the_limits_are_the_velocity_box_of_the_inverse_kinematics_half_a_step_ahead():
    rng = np.random.default_rng(1)
    for _ in range(200):
        q, previous = rng.uniform(ARM.lower, ARM.upper), rng.uniform(-1.0, 1.0, 7) * ARM.max_velocity
        asked = rng.uniform(-1.0, 1.0, 7) * ARM.max_velocity
        box = LIMITS.box(q + 0.5 * DT * previous, DT, previous)
        np.testing.assert_array_equal(
            limit_velocity(LIMITS, q, previous, asked, DT)[0], np.clip(asked, box.lower, box.upper)
        )


def test_a_period_that_is_measured_anew_in_every_step_takes_no_memory():
    limits, rng = JointLimits(ARM), np.random.default_rng(2)
    for dt in rng.uniform(0.009, 0.011, 100):
        limit_velocity(limits, ARM.home, np.zeros(7), np.full(7, 0.01), float(dt))
    assert len(limits._boxes) <= 8


@pytest.mark.parametrize("bad", [np.full(7, np.nan), np.zeros(6), [np.inf] * 7, "fast", None, [[0.1], [0.1, 0.2]]])
def test_no_velocity_stops_the_robot_and_says_so(bad):
    robot = Paper()
    for _ in range(10):
        robot.move(np.full(7, 0.3), DT)
    with pytest.raises(InputError, match="move: velocity must be"):
        robot.move(bad, DT)
    assert not robot.velocity.any()


@pytest.mark.parametrize("dt", [0.0, -0.01, np.inf, np.nan, "soon", None])
def test_a_time_that_is_none_is_refused_and_stops_the_robot(dt):
    robot = Paper()
    robot.move(np.full(7, 0.02), DT)
    with pytest.raises(InputError, match="move: dt must be"):
        robot.move(np.full(7, 0.02), dt)
    assert not robot.velocity.any()
    with pytest.raises(InputError, match="stop: dt must be"):
        robot.stop(dt)


def test_stop_brakes_as_fast_as_the_accelerations_allow():
    robot = Paper()
    for _ in range(30):
        robot.move(np.full(7, 1.0), DT)
    speed, moves = robot.velocity.copy(), len(robot.sent)
    robot.stop(DT)
    needed = int(np.ceil(np.max(speed / (ARM.max_acceleration * DT)) - 1e-9))
    assert len(robot.sent) - moves == needed
    assert not robot.velocity.any()


def test_a_held_joint_is_a_fault_and_nothing_is_sent_any_more():
    robot = Paper()
    robot.held = ARM.home.copy()
    while not robot.fault:
        robot.move(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]), DT)
        assert len(robot.sent) < 100
    assert "right_j3" in robot.fault
    np.testing.assert_array_equal(robot.set_point, robot.held)
    sent = len(robot.sent)
    robot.move(np.full(7, 0.1), DT)
    assert len(robot.sent) == sent


def test_a_body_without_senses_measures_no_clearance():
    assert np.isnan(Paper().clearance())
    assert Paper().report() == {}


def test_a_robot_without_a_gripper_says_so():
    robot = Paper()
    assert np.isnan(robot.opening)
    with pytest.raises(InputError, match="no gripper"):
        robot.grasp(0.03)
