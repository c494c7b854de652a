"""The processes beside the control loop of the real-time benchmark: simulation, camera and tracker.

Each function runs in a process of its own until :attr:`Shared.stopping`. Its result consists of plain values.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from imitarm.benchmark.real_time import Shared
from imitarm.benchmark.real_time_world import CAMERA_RATE, RealTimeSetup
from imitarm.perception import ObstacleTracker
from imitarm.robots.server import RobotServer
from imitarm.transmission.rate import RateLimiter

_CHECK = 0.1  # [s] at most until a waiting process sees that it must stop
_MEASURE_EVERY = 0.005  # [s] between two measurements of the clearance
_NICE = 5  # added to the priority of camera and tracker; a higher number means a lower priority


@contextmanager
def _until_stopped(shared: Shared) -> Iterator[None]:
    """Ignore that another process has closed a connection, if all processes must end."""
    try:
        yield
    except (EOFError, ConnectionError):
        if not shared.stopping:
            raise


class _Stopped(Exception):  # noqa: N818 (not an error)
    """Ends the server's loop."""


def simulate(setup: RealTimeSetup, shared: Shared, control: Connection) -> dict[str, Any]:
    """Simulate the arm and the obstacles, and serve the arm over UDP on this machine.

    Args:
        setup: what is measured.
        shared: shared memory, to which the state is written after each period.
        control: connection to the control process. It sends the start posture, and receives the server's address.
    """
    arm = setup.arm()
    robot = setup.simulated(arm, control.recv())
    gaps: list[float] = []
    before: list[int] = []  # number of periods and of missed periods when the measurement began
    every = max(round(_MEASURE_EVERY * setup.rate), 1)

    def on_step(server: RobotServer) -> None:
        shared.publish(robot.time, robot.state().q)
        if server.rate_limiter.ticks % every == 0:
            gaps.append(robot.clearance())
        if not before and shared.measuring:
            before.extend((server.rate_limiter.ticks, server.rate_limiter.overruns))
        if shared.stopping:
            raise _Stopped

    shared.publish(robot.time, robot.state().q)
    with RobotServer(robot, 0, rate=setup.rate) as server:
        control.send(server.address)
        with suppress(_Stopped):
            server.run(on_step=on_step)
        accepted = server.supervisor.datagram_filter.accepted
        dropped = server.supervisor.datagram_filter.dropped + server.supervisor.dropped
    ticks, overruns = before or (server.rate_limiter.ticks, server.rate_limiter.overruns)
    return {
        "periods": server.rate_limiter.ticks - ticks,
        "missed": server.rate_limiter.overruns - overruns,
        "accepted": accepted,
        "dropped": {str(reason): n for reason, n in dropped.items() if n},
        "clearance": min(gaps, default=float("inf")),
        "contacts": sorted(" with ".join(pair) for pair in robot.contacts),
        "simulated": robot.time,
    }


def watch(setup: RealTimeSetup, shared: Shared, tracker: Connection) -> dict[str, Any]:
    """Take depth images of the simulated world at a fixed rate, detect the obstacles, and send them to the tracker.

    The camera has a copy of the world, because :mod:`multiprocessing` can't share a world of MuJoCo. Before each image,
    the copy is set to the newest state of the simulation.
    """
    _give_way()
    robot = setup.simulated(setup.arm(), setup.arm().home)
    camera, detector = setup.camera(robot), setup.detector(robot)
    seconds: list[float] = []
    missed = 0
    while not shared.started:
        time.sleep(0.01)
    limiter = RateLimiter(1.0 / CAMERA_RATE)
    with _until_stopped(shared):
        while not shared.stopping:
            late = limiter.wait()
            began = time.perf_counter()
            simulated, q = shared.state(robot.arm.n_joints)
            robot.show(q, simulated)
            frame = camera.frame()
            found = detector.detect(frame, q)
            tracker.send((frame.stamp, found))
            if shared.measuring:
                missed += late
                seconds.append(time.perf_counter() - began)
    return {"images": len(seconds), "missed": missed, "seconds": seconds}


def track(setup: RealTimeSetup, shared: Shared, camera: Connection, control: Connection) -> dict[str, Any]:
    """Track the detected obstacles, and send the tracked obstacles of each image to the control process.

    The message for an image consists of its stamp, on the clock of the simulation, and the obstacles at this time.
    """
    del setup
    _give_way()
    tracker = ObstacleTracker("imm")
    seconds: list[float] = []
    with _until_stopped(shared):
        while not shared.stopping:
            if not camera.poll(_CHECK):
                continue
            stamp, found = camera.recv()
            began = time.perf_counter()
            tracker.update(stamp, found)
            control.send((stamp, tracker.scene(stamp).obstacles))
            shared.scenes += 1
            if shared.measuring:
                seconds.append(time.perf_counter() - began)
    return {"updates": len(seconds), "seconds": seconds}


def _give_way() -> None:
    """Lower the priority of this process, so that the control loop and the simulation need not wait for it."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
