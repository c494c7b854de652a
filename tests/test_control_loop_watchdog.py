"""The watchdog: without new scenes the arm slows down, stops, and moves again when scenes arrive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.command import Command, Status
from imitarm.control_loop import Watchdog, reproduce
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.policies.policy import Policy
from imitarm.robots import SimulatedRobot
from imitarm.scene import Scene

ARM = ArmModel.load("panda", tool="gripper")
FAST = Command([0.05, 0.0, 0.0, 0.0, 0.0, 0.0], posture=ARM.home)


class Creep(Policy):
    """Up at 5 cm/s."""

    def __init__(self):
        pass

    def reset(self, observation):
        pass

    def step(self, observation, dt):
        return Command([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])

    def finished(self, observation):
        return observation.time >= 3.0


def test_a_frozen_sensor_slows_the_arm_down_and_stops_it_until_new_scenes_arrive():
    robot, steps = SimulatedRobot(ARM), []

    def observe(time):
        return Scene(stamp=min(time, 1.0) if time < 2.0 else time)

    rollout = reproduce(Creep(), robot, observe, on_step=steps.append)
    speed = {round(step.time, 2): float(np.linalg.norm(step.command.twist)) for step in steps}
    assert speed[1.0] == speed[1.2] == pytest.approx(0.05) and 0.0 < speed[1.4] < 0.05
    assert speed[1.6] == speed[1.9] == 0.0 and speed[2.1] == pytest.approx(0.05)
    stopped = next(step for step in steps if step.time > 1.805)
    assert stopped.command.status is Status.BRAKING and stopped.command.reason == "no new scene for 0.80 s: stopped"
    assert float(np.abs(stopped.state.velocity).max()) < 1e-3
    assert rollout.success and rollout.details["statuses"]["braking"] == pytest.approx(80, abs=3)


def test_a_scene_that_never_changes_does_not_stop_the_arm_unless_scenes_are_expected():
    for expected in (False, True):
        watch = Watchdog(from_start=expected)
        commands = [watch.guard(FAST, 0.0, 0.01 * k) for k in range(100)]
        assert (commands[-1] is FAST) is not expected
    assert commands[10] is FAST and not commands[-1].twist.any() and commands[-1].posture is None


def test_a_sensor_that_stays_silent_to_the_end_is_the_reason():
    rollout = reproduce(Creep(), SimulatedRobot(ARM), lambda t: Scene(stamp=min(t, 0.5)), timeout=1.5)
    assert not rollout.success and "braking, no new scene for 1.0" in rollout.reason


@given(st.lists(st.floats(0.0, 0.3), min_size=2, max_size=30), st.floats(0.05, 0.3), st.floats(0.01, 0.5))
def test_the_speed_falls_with_the_age_of_the_newest_scene_and_never_rises_above_the_command(waits, slow, more):
    watch, time, stamp = Watchdog(slow, slow + more), 0.0, 0.0
    watch.guard(FAST, -1.0, -0.1)
    for i, wait in enumerate(waits):
        time += wait
        if i % 3 == 0:
            stamp = time + 1e-9
        age = time - stamp
        share = watch.guard(FAST, stamp, time).twist[0] / FAST.twist[0]
        assert share == pytest.approx(np.clip((slow + more - age) / more, 0.0, 1.0), abs=1e-6)


def test_joint_velocities_are_slowed_down_too():
    watch = Watchdog(0.1, 0.3, from_start=True)
    moving = Command(np.zeros(6), joint_velocity=np.ones(7))
    assert watch.guard(moving, 0.0, 0.0) is moving
    np.testing.assert_allclose(watch.guard(moving, 0.0, 0.2).joint_velocity, 0.5)


@pytest.mark.parametrize("times", [(0.0, 0.5), (0.5, 0.5), (0.5, 0.2), (np.nan, 1.0)])
def test_times_that_can_not_be_used_are_refused(times):
    with pytest.raises(InputError, match="Watchdog: "):
        Watchdog(*times)
