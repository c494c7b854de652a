from __future__ import annotations

import numpy as np
import pytest

from imitarm.command import Command
from imitarm.control_loop.reproduce import reproduce
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.policies.policy import Policy
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, Scene

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ARM = ArmModel.load("sawyer", tool="brush")
START = ARM.tool_pose(ARM.home)


class Glide(Policy):
    """Along a line with a smooth speed, then stand."""

    def __init__(self, way, duration=2.0):
        self.way, self.duration, self.resets = np.asarray(way, dtype=float), duration, 0

    def reset(self, observation):
        self.resets += 1
        self.start = observation.tool_to_base

    def wanted(self, time):
        u = np.clip(time / self.duration, 0.0, 1.0)
        return Pose(self.start.position + self.way * (10 * u**3 - 15 * u**4 + 6 * u**5), self.start.quaternion)

    def step(self, observation, dt):
        rate = (self.wanted(observation.time + dt).position - self.wanted(observation.time).position) / dt
        forward = np.concatenate([rate, np.zeros(3)])
        twist = forward + 5.0 * observation.tool_to_base.error_to(self.wanted(observation.time))
        return Command(twist, progress=min(observation.time / self.duration, 1.0))

    def finished(self, observation):
        return observation.time >= self.duration + 0.3


def robot_with(*obstacles, **options):
    return SimulatedRobot(ARM, scene=Scene(None, obstacles), **options)


def wall(gap):
    return Box(Pose(START.position + np.array([gap + 0.15, 0.0, 0.0]), UPRIGHT), size=[0.2, 0.3, 0.4], name="wall")


@pytest.mark.parametrize("dt", [0.004, 0.01])
@pytest.mark.parametrize("method", ["qp", "dls"])
def test_the_tool_goes_where_the_policy_wants(dt, method):
    policy, robot = Glide([0.05, 0.15, -0.05]), robot_with(wall(0.4))
    options = {} if method == "qp" else {"clearance": None, "self_clearance": None, "method": method}
    safety = SafetyFilter(ARM, dt=dt, **options)
    rollout = reproduce(policy, robot, lambda t: robot.scene, dt=dt, safety=safety)
    assert rollout.success
    assert rollout.reason == "finished"
    wanted = np.array([policy.wanted(t).position for t in rollout.trajectory.times])
    assert np.linalg.norm(rollout.trajectory.positions - wanted, axis=1).max() < 1e-3
    assert rollout.trajectory.times[0] == 0.0
    assert rollout.trajectory.duration == pytest.approx(2.3, abs=0.05)
    np.testing.assert_allclose(np.diff(rollout.trajectory.times), dt, atol=1e-9)
    assert np.abs(rollout.velocities[-1]).max() < 2e-3  # at rest
    assert rollout.clearance.shape == rollout.trajectory.times.shape
    assert rollout.min_clearance == pytest.approx(rollout.clearance.min())
    assert rollout.details["twists"].shape == (len(rollout.trajectory), 6)
    assert rollout.details["clamped"] == {}
    np.testing.assert_allclose(rollout.torques[0], ARM.gravity_torque(ARM.home), atol=1e-2)


def test_each_step_is_told_and_the_scene_is_the_observed_one():
    seen, scenes = [], []
    robot = robot_with()

    def observe(time):
        scenes.append(Scene(Pose([time, 0.0, 0.0], UPRIGHT)))
        return scenes[-1]

    rollout = reproduce(Glide([0.0, 0.02, 0.0], 0.3), robot, observe, on_step=seen.append)
    assert [step.time for step in seen] == pytest.approx(list(rollout.trajectory.times[1 : len(seen) + 1]))
    assert all(step.scene in scenes for step in seen)
    assert seen[10].scene.goal.position[0] == pytest.approx(0.10)
    np.testing.assert_array_equal(seen[5].state.q, rollout.joints[6])
    np.testing.assert_array_equal(seen[5].command.twist, rollout.details["twists"][6])


def test_a_second_reproduction_begins_at_time_zero_again():
    robot, policy = robot_with(), Glide([0.0, 0.03, 0.0], 0.3)
    first = reproduce(policy, robot, lambda t: Scene())
    second = reproduce(policy, robot, lambda t: Scene())
    assert first.trajectory.times[0] == second.trajectory.times[0] == 0.0
    assert policy.resets == 2
    away = second.trajectory.positions[-1] - first.trajectory.positions[0]
    np.testing.assert_allclose(away, [0.0, 0.06, 0.0], atol=2e-3)


def test_out_of_time_the_robot_stops_and_the_reason_is_told():
    robot = robot_with()
    rollout = reproduce(Glide([0.0, 0.2, 0.0], 2.0), robot, lambda t: Scene(), timeout=1.0)
    assert not rollout.success
    assert rollout.reason == "not finished within 1 s"
    assert not robot.velocity.any()
    assert np.abs(rollout.velocities[50]).max() > 0.05  # it was under way


def test_what_is_touched_is_named_and_a_held_robot_gives_up():
    robot, blind = robot_with(wall(0.04)), SafetyFilter(ARM, clearance=None)
    rollout = reproduce(Glide([0.3, 0.0, 0.0]), robot, lambda t: robot.scene, safety=blind, contact=False)
    assert not rollout.success
    assert "protective stop" in rollout.reason
    assert 'with box "wall"' in rollout.reason
    assert rollout.min_clearance <= 0.0
    assert rollout.trajectory.duration < 2.0


@pytest.mark.parametrize("stage", ["step", "observe", "on_step"])
def test_whatever_is_raised_the_robot_is_stopped_first(stage):
    robot, policy = robot_with(), Glide([0.0, 0.2, 0.0])

    def fail(time):
        if time > 0.7:
            raise RuntimeError("camera unplugged")

    step = policy.step
    if stage == "step":
        policy.step = lambda observation, dt: (fail(observation.time), step(observation, dt))[1]

    def observe(time):
        if stage == "observe":
            fail(time)
        return Scene()

    with pytest.raises(RuntimeError, match="camera unplugged"):
        reproduce(policy, robot, observe, on_step=(lambda s: fail(s.time)) if stage == "on_step" else None)
    assert robot.time > 0.7
    assert not robot.velocity.any()


def test_an_answer_that_is_no_command_is_an_error():
    policy = Glide([0.0, 0.1, 0.0])
    policy.step = lambda observation, dt: np.zeros(6)
    with pytest.raises(InputError, match=r"Glide\.step must return a Command"):
        reproduce(policy, robot_with(), lambda t: Scene())
    with pytest.raises(InputError, match="Command: twist"):
        Command(np.full(6, np.nan))


def test_by_default_nothing_is_touched_whatever_the_policy_wants():
    robot = robot_with(wall(0.04))
    rollout = reproduce(Glide([0.3, 0.0, 0.0]), robot, lambda t: robot.scene, timeout=3.0)
    assert not rollout.details["contacts"] and rollout.min_clearance > 0.0
    assert rollout.details["filtered"] > 50
    found = rollout.details["interventions"]
    assert sum(one.count for one in found) > 50 and {one.other for one in found} == {'box "wall"'}
    assert all(0.0 < one.first <= one.last <= 3.1 for one in found)
    assert f'mostly between {found[0].link} and box "wall"' in rollout.reason


def test_a_motion_nearer_than_the_filter_requires_is_no_success():
    robot = robot_with(wall(0.05))
    rollout = reproduce(Glide([0.0, 0.05, 0.0]), robot, lambda t: robot.scene, safety=SafetyFilter(ARM, clearance=0.08))
    assert not rollout.success
    assert rollout.reason.startswith("clearance fell to")


def test_an_arm_that_starts_in_contact_is_refused_before_it_moves():
    robot = robot_with(wall(-0.1))
    with pytest.raises(InfeasibleError, match=r'starts in contact .*box "wall"'):
        reproduce(Glide([0, 0, 0]), robot, lambda t: robot.scene)
    assert robot.time == 0.0


def test_a_filter_for_another_period_is_refused():
    with pytest.raises(InputError, match=r"made for dt 0\.02 s"):
        reproduce(Glide([0, 0, 0]), robot_with(), lambda t: Scene(), safety=SafetyFilter(ARM, dt=0.02))


def test_a_refusal_comes_before_any_motion():
    class Refuse(Glide):
        def reset(self, observation):
            raise InfeasibleError('box "wall" is in the way')

    robot = robot_with()
    with pytest.raises(InfeasibleError, match="in the way"):
        reproduce(Refuse([0, 0, 0]), robot, lambda t: Scene())
    assert robot.time == 0.0


@pytest.mark.parametrize("times", [{"dt": 0.0}, {"dt": -1.0}, {"timeout": 0.001}, {"timeout": np.inf}])
def test_times_that_make_no_loop_are_refused(times):
    with pytest.raises(InputError, match=r"0 < dt <= timeout|timeout must be a finite"):
        reproduce(Glide([0, 0, 0]), robot_with(), lambda t: Scene(), **times)
