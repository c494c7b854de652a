from __future__ import annotations

import socket
import threading
import time

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.robots import RobotServer, UdpRobot
from imitarm.transmission.messages import Status
from wire_samples import ARM, N, Paper, Served, assert_within_limits


def test_it_listens_to_this_machine_only_unless_told_otherwise():
    with RobotServer(Paper(), 0) as server:
        assert server.address[0] == "127.0.0.1"
    with RobotServer(Paper(), 0, "0.0.0.0") as server:
        assert server.address[0] == "0.0.0.0"


def test_what_can_not_be_is_refused():
    with pytest.raises(InputError, match="between 100 and 1000 Hz"):
        RobotServer(Paper(), 0, rate=50.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="can't listen there"):
            RobotServer(Paper(), taken.getsockname()[1])


def test_missed_periods_make_the_next_step_longer_but_not_long():
    served = Served()
    for missed in (0, 2, 1000):
        served.server.step(missed)
    assert [round(1e3 * step[2]) for step in served.robot.steps[1:]] == [4, 12, 20]
    served.kill()


def test_in_real_time_it_goes_at_its_rate_and_is_braked_at_the_end():
    robot = Paper()
    with RobotServer(robot, 0) as server:
        running = threading.Thread(target=server.run, args=(0.6,))
        running.start()
        with UdpRobot(ARM, server.address) as client:
            client.enable(5.0)
            until = time.monotonic() + 0.2
            while time.monotonic() < until:
                client.move(np.full(N, 0.3), 0.01)
                time.sleep(0.01)
            running.join()
    assert server.supervisor.status in (Status.FOLLOWING, Status.SLOWING, Status.STOPPED)
    assert not robot.velocity.any()
    assert server.pace.ticks >= 140
    assert_within_limits(robot.steps)


def test_what_a_step_raises_ends_it_with_the_robot_at_rest():
    robot = Paper()
    robot.velocity = np.full(N, 0.1)

    def fail(server):
        raise RuntimeError("broken")

    with RobotServer(robot, 0) as server, pytest.raises(RuntimeError, match="broken"):
        server.run(on_step=fail)
    assert not robot.velocity.any()
