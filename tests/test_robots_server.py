from __future__ import annotations

import contextlib
import math
import socket
import threading

import numpy as np
import pytest

from imitarm.errors import InputError, TaskFailedError
from imitarm.robots import RobotServer, UdpRobot
from imitarm.transmission.messages import CommandMode, RobotStatus
from wire_samples import ARM, Clock, N, Paper, Sender, Served, assert_within_limits, command


def test_it_listens_to_this_machine_only_unless_told_otherwise():
    with RobotServer(Paper(), 0) as server:
        assert server.address[0] == "127.0.0.1"
    with RobotServer(Paper(), 0, "0.0.0.0") as server:
        assert server.address[0] == "0.0.0.0"


def test_what_can_not_be_is_refused():
    with pytest.raises(InputError, match="rate must be a finite number of at least 100"):
        RobotServer(Paper(), 0, rate=50.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="cannot listen at this address"):
            RobotServer(Paper(), taken.getsockname()[1])


def test_missed_periods_make_the_next_step_longer_but_not_long():
    served = Served()
    for missed in (0, 2, 1000):
        served.server.step(missed)
    assert [round(1e3 * step[2]) for step in served.robot.steps[1:]] == [4, 12, 20]
    served.kill()


def test_it_keeps_its_rate_follows_commands_and_is_braked_at_the_end():
    """On a clock that only goes on while the server waits, so that the machine's load changes nothing."""
    robot, clock = Paper(), Clock()

    def wait(_, seconds):
        clock.ns += math.ceil(1e9 * seconds)
        return False

    with (
        RobotServer(robot, 0, clock_ns=clock, wait=wait) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        sender, statuses = Sender(server.supervisor), []

        def lead(server):
            statuses.append(server.supervisor.status)
            if len(statuses) == 1:
                enable = command(CommandMode.ENABLE, challenge=server.supervisor.challenge)
                client.sendto(sender.bytes(enable, clock()), server.address)
            elif len(statuses) < 100:
                q, velocity = robot.set_point + 0.002, np.full(N, 0.3)
                client.sendto(sender.bytes(command(CommandMode.MOVE, q, velocity), clock()), server.address)

        server.run(0.6, on_step=lead)
    assert (
        len(statuses) == server.rate_limiter.ticks == 151 and server.rate_limiter.overruns == 0
    )  # every 4 ms, from 0 to 0.6 s
    assert statuses[50] == RobotStatus.FOLLOWING and statuses[-1] == RobotStatus.SLOWING  # silence since 0.4 s
    assert np.abs(np.array([velocity for _, velocity, _ in robot.steps])).max() > 0.2
    assert not robot.velocity.any()
    assert_within_limits(robot.steps)


def test_in_real_time_a_client_leads_it():
    """It goes on until the client has seen the arm move, however long a busy machine takes."""
    robot, moved = Paper(), threading.Event()

    def until_moved(_):
        if moved.is_set():
            raise StopIteration

    def run():
        with contextlib.suppress(StopIteration):
            server.run(on_step=until_moved)

    with RobotServer(robot, 0) as server:
        running = threading.Thread(target=run)
        running.start()
        try:
            with UdpRobot(ARM, server.address, timeout=60.0) as client:
                while not robot.velocity.any():
                    client.enable(60.0)  # again, when a command was so late that the arm has stopped
                    with contextlib.suppress(TaskFailedError):
                        for _ in range(5):
                            client.move(np.full(N, 0.3), 0.01)
        finally:
            moved.set()
            running.join()
    assert_within_limits(robot.steps)


def test_what_a_step_raises_ends_it_with_the_robot_at_rest():
    robot = Paper()
    robot.velocity = np.full(N, 0.1)

    def fail(server):
        raise RuntimeError("broken")

    with RobotServer(robot, 0) as server, pytest.raises(RuntimeError, match="broken"):
        server.run(on_step=fail)
    assert not robot.velocity.any()
