from __future__ import annotations

import numpy as np
import pytest

from imitarm.command import Command
from imitarm.control_loop import reproduce
from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel
from imitarm.policies import Policy
from imitarm.robots import ROBOTS, SimulatedRobot, UdpRobot
from imitarm.scene import Scene
from imitarm.transmission.messages import CommandMode, RobotStatus
from wire_samples import ARM, DT, MS, N, Paper, Served, assert_within_limits, command

PERIOD = 0.012  # of the client


@pytest.fixture
def served():
    served = Served()
    yield served
    served.kill()


@pytest.fixture
def led(served):
    with served.client() as robot:
        robot.enable()
        yield served, robot


def wave(served, robot, seconds, size=1.0, seed=0, each=None):
    """Lead with smooth velocities; return the set-points of the client."""
    phase = np.random.default_rng(seed).uniform(2.0, 4.0, N)
    set_points = []
    for k in range(round(seconds / PERIOD)):
        robot.move(size * np.sin(phase * k * PERIOD) * 0.5 * ARM.max_velocity, PERIOD)
        set_points.append(robot.set_point)
        served.sleep(PERIOD)
        if each is not None:
            each(k)
    return np.array(set_points)


def rest(served, robot, seconds):
    """Go on asking without wanting to move."""
    for _ in range(round(seconds / PERIOD)):
        robot.move(np.zeros(N), PERIOD)
        served.sleep(PERIOD)


def test_it_is_registered():
    assert ROBOTS["udp"] is UdpRobot


def test_nothing_moves_before_it_is_enabled(served):
    with served.client() as robot:
        assert not robot.ready and robot.problem == "the server has just started"
        wave(served, robot, 0.5)
        assert np.array_equal(served.robot.q, ARM.home) and np.array_equal(robot.set_point, ARM.home)
        assert not robot.velocity.any() and robot.interruptions == 0


def test_it_leads_within_the_limits_and_is_followed(led):
    served, robot = led
    wave(served, robot, 2.0)
    assert robot.ready and robot.problem == "" and robot.interruptions == 0
    assert np.abs(served.robot.set_point - ARM.home).max() > 0.2
    assert_within_limits(served.robot.steps)
    rest(served, robot, 1.0)
    np.testing.assert_allclose(served.robot.set_point, robot.set_point, atol=1e-4)
    np.testing.assert_array_equal(robot.state().q, robot.reported.q)


def test_its_own_limits_come_first_and_the_server_s_again(led):
    """What is asked for is cut by move, as with every robot; what is sent past it, by the server."""
    served, robot = led
    robot.move(np.full(N, 100.0), PERIOD)
    assert set(robot.clamped) >= {"velocity", "acceleration"}
    assert np.all(np.abs(robot.velocity) <= ARM.max_acceleration * PERIOD + 1e-9)
    with pytest.raises(InputError, match="move: velocity must be"):
        robot.move(np.full(N, np.nan), PERIOD)
    for k in range(100):
        robot._command(CommandMode.MOVE, robot.reported.set_point + 0.1, ARM.max_velocity * (-1) ** k)
        served.sleep(PERIOD)
        robot.listen()
    assert_within_limits(served.robot.steps)


def test_a_pause_of_the_client_is_a_stop_of_the_arm_and_no_jump(led):
    served, robot = led
    wave(served, robot, 0.6)
    served.sleep(0.3)  # the process was busy with something else
    assert served.status is RobotStatus.SLOWING and not robot.ready
    wave(served, robot, 0.6, seed=1)
    assert served.status is RobotStatus.FOLLOWING and robot.ready and robot.interruptions >= 1
    served.sleep(0.7)
    assert served.status is RobotStatus.STOPPED
    before = served.robot.q.copy()
    wave(served, robot, 0.5)
    assert np.array_equal(served.robot.q, before) and "no valid command" in robot.problem
    robot.enable()
    wave(served, robot, 0.3)
    assert not np.array_equal(served.robot.q, before)
    assert_within_limits(served.robot.steps)


def test_a_client_that_dies_and_is_started_again_begins_from_where_the_arm_is(led):
    served, robot = led
    wave(served, robot, 0.6)
    served.sleep(0.7)  # killed: it says nothing any more
    with served.client() as again:
        np.testing.assert_array_equal(again.set_point, served.robot.set_point)
        assert np.abs(again.set_point - ARM.home).max() > 0.05
        rest(served, again, 0.1)
        assert not again.ready
        again.enable()
        wave(served, again, 0.5)
        assert again.ready
        robot.move(np.ones(N), PERIOD)  # the dead one comes back
        served.sleep(PERIOD)
        robot.move(np.ones(N), PERIOD)
        assert robot.problem == "another client controls the robot" and not robot.ready
    assert_within_limits(served.robot.steps)


def test_a_client_that_is_started_while_another_one_leads_waits(led):
    served, robot = led
    wave(served, robot, 0.2)
    with served.client() as second:
        assert second.problem == "another client controls the robot"
        second.request_enable()
        second.move(np.ones(N), PERIOD)
        assert not second.ready
        wave(served, robot, 0.2)
    assert served.status is RobotStatus.FOLLOWING  # closing the second one has stopped nothing
    assert served.supervisor.datagram_filter.session == robot._encoder.session


def test_a_server_that_dies_and_is_started_again_is_not_led_by_old_set_points(led):
    """The new one stands elsewhere; the client goes there, not the robot to the client."""
    served, robot = led
    wave(served, robot, 0.6)
    port = served.server.address[1]
    served.kill()
    for k in range(20):
        robot.move(np.full(N, 0.2), PERIOD)
        served.sleep(PERIOD)
        assert k < 9 or (not robot.ready and robot.problem == "the robot does not answer")
    again = Served(Paper(ARM.home + 0.3), port=port, clock=served.clock)
    try:
        for _ in range(30):
            robot.move(np.full(N, 0.2), PERIOD)
            again.sleep(PERIOD)
        assert not robot.ready and robot.problem == "the server has just started"
        np.testing.assert_array_equal(robot.set_point, ARM.home + 0.3)
        assert np.array_equal(again.robot.q, ARM.home + 0.3)
        robot._sleep = again.sleep
        robot.enable()
        wave(again, robot, 0.3)
        assert robot.ready and not np.array_equal(again.robot.q, ARM.home + 0.3)
        assert_within_limits(again.robot.steps)
    finally:
        again.kill()


def test_closing_stops_the_robot_at_once(served):
    with served.client() as robot:
        robot.enable()
        wave(served, robot, 0.5)
    served.sleep(DT)
    assert served.status is RobotStatus.STOPPED and served.supervisor.reason == "a client has stopped it"
    robot.close()


def test_stop_brakes_at_the_pace_of_time(led):
    served, robot = led
    wave(served, robot, 0.6)
    moving = np.abs(robot.velocity).max()
    begun = served.clock()
    robot.stop(PERIOD)
    assert moving > 0.3 and not robot.velocity.any()
    assert served.clock() - begun > 20 * MS
    assert served.status is RobotStatus.FOLLOWING
    assert_within_limits(served.robot.steps)


def test_the_gripper_is_told_with_the_commands(led):
    served, robot = led
    assert robot.widest_opening == 0.08 and robot.opening == 0.08
    robot.grasp(0.02)
    rest(served, robot, 0.1)
    assert served.robot.grasped == [0.02] and robot.opening == 0.02
    with pytest.raises(InputError, match=r"0 to 0\.08 m is"):
        robot.grasp(0.2)


def test_a_robot_without_gripper_says_so():
    served = Served(SimulatedRobot(ARM))
    try:
        with served.client() as robot:
            assert np.isnan(robot.opening)
            with pytest.raises(InputError, match="it has no gripper"):
                robot.grasp(0.0)
    finally:
        served.kill()


def test_what_became_of_each_command_is_told(led):
    served, robot = led
    sent = []
    wave(served, robot, 0.3, each=lambda k: sent.append(robot.sequence))
    echoes = robot.echoes()
    assert len(echoes) >= len(sent) - 2 and {echo.sequence for echo in echoes} <= set(sent)
    assert all(0.0 <= echo.sent <= 2 * DT and 0.0 <= echo.applied <= 2 * DT for echo in echoes)
    assert robot.echoes() == []


def test_nobody_there_is_said(served):
    served.kill()
    with pytest.raises(TaskFailedError, match="no robot server answers; start one with 'imitarm serve'"):
        served.client(timeout=0.1)


def test_another_arm_is_not_led(served):
    with pytest.raises(InputError, match="the robot there is not panda"):
        UdpRobot(ArmModel.load("panda"), served.server.address, clock_ns=served.clock, sleep=served.sleep)


def test_another_arm_that_takes_the_place_of_the_robot_is_not_led(led):
    served, robot = led
    wave(served, robot, 0.3)
    port = served.server.address[1]
    served.kill()
    for _ in range(15):
        robot.move(np.zeros(N), PERIOD)
        served.sleep(PERIOD)
    other = Served(SimulatedRobot(ArmModel.load("panda")), port=port, clock=served.clock)
    try:
        for _ in range(20):
            robot.move(np.ones(N), PERIOD)
            other.sleep(PERIOD)
        assert not robot.ready and robot.problem == "the robot that answers is not sawyer"
        assert not other.robot.velocity.any()
    finally:
        other.kill()


def test_a_robot_that_can_not_be_enabled_says_why(led):
    served, robot = led
    with served.client() as second, pytest.raises(TaskFailedError, match="not enabled: another client controls"):
        rest(served, robot, 0.05)

        def both(seconds):
            robot.move(np.zeros(N), seconds)
            served.sleep(seconds)

        second._sleep = both
        second.enable(0.3)


def test_answers_from_elsewhere_are_not_heard(led):
    """The socket is connected: what another process sends to its port does not come in."""
    _, robot = led
    before = robot.reported
    with Served(Paper(ARM.home + 0.5)).server as other:
        address = robot._socket.getsockname()
        other._clients[address] = None
        other.step()
        robot.listen()
    assert robot.reported is before


def test_the_server_answers_only_who_has_clients_and_bears_a_flood(served):
    with served.client() as robot:
        for _ in range(500):
            robot._socket.send(b"x" * 50)
        robot._socket.send(robot._encoder.encode(command(CommandMode.OBSERVE), served.clock()))
        assert len(served.server._clients) == 0
        for _ in range(3):
            served.server.receive()
            assert len(served.server._clients) == 0
        served.sleep(0.1)
        assert robot.listen()
        assert served.supervisor.dropped["magic"] > 100
        served.sleep(0.1)
        assert not robot.listen()


class Nudge(Policy):
    """Moves the tool up for five steps."""

    def __init__(self):
        self.steps = 0

    def reset(self, observation):
        self.steps = 0

    def step(self, observation, dt):
        self.steps += 1
        return Command(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]))

    def finished(self, observation):
        return self.steps >= 5


def test_a_remote_robot_reproduces_a_skill_although_its_clearance_is_unknown(led):
    served, robot = led

    def observe(_):
        served.sleep(PERIOD)
        return Scene()

    rollout = reproduce(Nudge(), robot, observe, dt=PERIOD, contact=False)
    assert rollout.success and np.isnan(rollout.clearance).all()
    assert rollout.trajectory.positions[-1, 2] > rollout.trajectory.positions[0, 2]
