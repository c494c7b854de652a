"""Contact detection: the residual is the external torque, free motion raises no alarm, and the arm stops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.command import Command
from imitarm.control_loop import Contact, ContactDetector, reproduce
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.policy import Policy
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, Scene

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
either = pytest.mark.parametrize("name", list(ARMS))
DT = 0.01


def dry_friction(robot):
    return robot.model.dof_frictionloss[[robot.model.joint(j).dofadr[0] for j in robot.arm.joint_names]]


@settings(deadline=None, max_examples=10)
@given(st.sampled_from(list(ARMS)), st.sampled_from(["position", "torque"]), st.integers(0, 2**32 - 1))
def test_within_a_quarter_second_the_residual_is_the_external_torque(name, control, seed):
    """Up to the dry friction, 0.1 N m and 2 %, for any force up to 40 N on any link of a standing arm."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    robot, detector = SimulatedRobot(arm, control=control), ContactDetector(arm)
    body = arm.cover.bodies[rng.integers(len(arm.cover.bodies))]
    direction = rng.normal(size=3)
    force = rng.uniform(5.0, 40.0) * direction / np.linalg.norm(direction)
    for k in range(45):
        if k == 20:
            assert np.all(np.abs(detector.residual) <= 0.02)
            robot.data.xfrc_applied[robot.model.body(body).id, :3] = force
        state = robot.move(np.zeros(7), DT)
        detector.update(state)
    point = robot.data.xipos[robot.model.body(body).id]
    external = arm.point_jacobian(state.q, body, point).T @ force
    assert np.all(np.abs(detector.residual - external) <= dry_friction(robot) + 0.1 + 0.02 * np.abs(external))


def wander(robot, seconds, rng, every=0.8):
    """Move between random postures near home, fast and with the largest accelerations."""
    arm, tick, target = robot.arm, -1, robot.arm.home
    while robot.time < seconds:
        if int(robot.time / every) != tick:
            tick = int(robot.time / every)
            target = np.clip(arm.home + 0.25 * rng.normal(size=7), arm.lower + 0.2, arm.upper - 0.2)
        yield robot.move(4.0 * (target - robot.set_point), DT)
        assert not robot.fault and not robot.contacts


@either
@pytest.mark.parametrize("control", ["position", "torque"])
def test_sixty_seconds_of_free_motion_raise_no_alarm_with_errors_of_the_model(name, control):
    """All masses are 5 % larger than known, the friction 20 %, and the torques have 1 % noise of the rated ones."""
    arm, rng = ARMS[name], np.random.default_rng(1)
    robot, detector = SimulatedRobot(arm, control=control), ContactDetector(arm)
    robot.model.body_mass[:] *= 1.05
    robot.model.body_inertia[:] *= 1.05
    robot.model.dof_frictionloss[:] *= 1.2
    robot.model.dof_damping[:] *= 1.2
    for state in wander(robot, 60.0, rng):
        torque = state.torque + 0.01 * arm.max_torque * rng.normal(size=7)
        assert detector.update(ArmState(state.q, state.velocity, torque, state.time)) is None


@either
def test_a_payload_of_half_a_kilogram_is_no_contact(name):
    arm = ARMS[name]
    robot, detector = SimulatedRobot(arm), ContactDetector(arm)
    robot.data.xfrc_applied[robot.model.body("tool/gripper").id, 2] = -0.5 * 9.81
    assert all(detector.update(state) is None for state in wander(robot, 10.0, np.random.default_rng(2)))


class Push(Policy):
    def __init__(self):
        pass

    def reset(self, observation):
        pass

    def step(self, observation, dt):
        return Command([0.15, 0.0, 0.0, 0.0, 0.0, 0.0])

    def finished(self, observation):
        return False


@either
def test_an_arm_that_pushes_something_stops_and_names_the_joint(name):
    arm = ARMS[name]
    tool = arm.tool_pose(arm.home).position
    box = Box(Pose(tool + [0.2, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), size=[0.2, 0.4, 0.4], name="box")
    robot, blind = SimulatedRobot(arm, scene=Scene(None, [box])), SafetyFilter(arm, clearance=None)
    rollout = reproduce(Push(), robot, lambda t: Scene(), safety=blind, timeout=5.0)
    contact = rollout.details["contact"]
    assert isinstance(contact, Contact) and contact.joint in arm.joint_names
    assert abs(contact.torque) > contact.threshold > 0.0
    assert rollout.reason.startswith(f"contact: an external torque of {contact.torque:.1f} N m acts on {contact.joint}")
    assert not rollout.success and not robot.fault and not robot.velocity.any()
    first = rollout.trajectory.times[np.argmax(rollout.clearance <= 0.0)]
    assert rollout.trajectory.duration - first < 0.5
    assert rollout.min_clearance > -0.005


@either
def test_an_obstacle_that_pushes_a_standing_arm_is_felt(name):
    """The filter does not see it, so only the torques tell."""
    arm = ARMS[name]
    tool = arm.tool_pose(arm.home).position
    pose = Pose(tool + [0.22, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    box = Box(pose, size=[0.2, 0.2, 0.2], velocity=[-0.2, 0.0, 0.0])
    robot, detector = SimulatedRobot(arm, scene=Scene(None, [box])), ContactDetector(arm)
    felt = touched = None
    while robot.time < 2.0 and felt is None:
        state = robot.move(np.zeros(7), DT)
        felt = detector.update(state)
        touched = touched if touched is not None or not robot.contacts else robot.time
    assert felt is not None and touched is not None
    assert 0.0 <= felt.time - touched < 0.15


def test_gaps_and_missing_torques_raise_no_alarm():
    arm = ARMS["panda"]
    detector, q, still, some = ContactDetector(arm), arm.home, np.zeros(7), np.full(7, 0.01)
    for k in range(20):
        assert detector.update(ArmState(q, still, still, 0.01 * k)) is None  # not measured
    assert detector.update(ArmState(q, still, some, 0.5)) is None  # after a gap
    assert not detector.residual.any()
    felt = [detector.update(ArmState(q, still, some, 0.5 + 0.01 * k)) for k in range(1, 20)]
    assert felt[-1] is not None  # nothing holds the arm against its weight, so something else must
    detector.reset()
    assert not detector.residual.any()


@pytest.mark.parametrize(("options", "said"), [({"gain": 0.0}, "gain"), ({"threshold": [1.0, 2.0]}, "threshold")])
def test_options_that_can_not_be_used_are_refused(options, said):
    with pytest.raises((InputError, ValueError), match=said if said == "gain" else "threshold|broadcast"):
        ContactDetector(ARMS["panda"], **options)
