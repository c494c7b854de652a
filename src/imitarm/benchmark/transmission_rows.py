"""What ``make bench`` times of transmission: from one process's skeleton to another one's robot, over loopback."""

from __future__ import annotations

import contextlib
import multiprocessing
import random
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.timing import Row, duration
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.stream import SkeletonSender, UdpSource
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter
from imitarm.robots import RobotServer, SimulatedRobot, UdpRobot
from imitarm.teleoperation.loop import Teleoperation
from imitarm.transmission.latency import LatencyLog
from imitarm.transmission.sockets import Address

Array = NDArray[np.float64]

RATE = 500.0  # [Hz] control steps of the retargeting process: a skeleton waits for the next one
_PERSON = 0
_ENOUGH = 400  # skeletons of which the whole way is known
_PATIENCE = 60.0  # [s]
_WAY = ("expose", "arrive", "wait", "retarget", "send", "robot")  # exposure to the robot has the command


def _capture(to: Address) -> None:
    """Be the capture process: about a hundred skeletons a second, at times that go with nothing else."""
    truth, jitter = reaching(Person.from_seed(_PERSON), _PERSON), random.Random(0)
    with SkeletonSender(to) as sender:
        begin = time.monotonic()
        while True:
            now = time.monotonic() - begin
            sender.send(truth(now))
            time.sleep(jitter.uniform(0.007, 0.013))


def _retargeting(pipe: Connection, to: Address) -> None:
    """Be the retargeting process: tell where it listens, and at the end the log of its latencies."""
    person, arm = Person.from_seed(_PERSON), ArmModel.load("sawyer", tool="gripper")
    lengths = LimbLengths(person.upper_arm, person.forearm)
    retargeter = ModernRetargeter(arm, Correspondence(lengths=lengths, orientation="upright"), dt=1.0 / RATE)
    with UdpSource(0) as source, UdpRobot(arm, to, timeout=_PATIENCE) as robot:
        pipe.send(source.address)
        robot.enable(_PATIENCE)
        loop = Teleoperation(source, retargeter, robot, stream=source, operator=lambda trouble, stopped: stopped)
        until = time.monotonic() + _PATIENCE
        while len(complete(loop.tally.latency)) < _ENOUGH and time.monotonic() < until:
            loop.tally.reason = ""
            loop.run(loop.tally.duration + 1.0)
        pipe.send((loop.tally.latency.values, loop.tally.doing["following"] / max(loop.tally.steps, 1)))


def complete(log: LatencyLog) -> Array:
    """Return how long each skeleton took from exposure until the robot had the command, shape (n,) [s]."""
    columns = [log.stages.index(stage) for stage in _WAY]
    way = log.values[:, columns].sum(axis=1)
    return np.asarray(way[np.isfinite(way)])


def three_processes() -> tuple[Array, float]:
    """Let three processes work together for some seconds.

    Returns:
        how long each skeleton took (n,) [s], and the share of the control steps in which the arm was led.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    with RobotServer(SimulatedRobot(ArmModel.load("sawyer", tool="gripper")), 0) as server:
        retargeting = context.Process(target=_retargeting, args=(there, server.address), daemon=True)
        retargeting.start()
        capture = None
        try:
            while not here.poll():
                server.run(0.01)
            capture = context.Process(target=_capture, args=(here.recv(),), daemon=True)
            capture.start()
            until = time.monotonic() + 2.0 * _PATIENCE

            def finished(server: RobotServer) -> None:
                if here.poll() or time.monotonic() > until:
                    raise StopIteration

            with contextlib.suppress(StopIteration):
                server.run(on_step=finished)
            values, share = here.recv()
        finally:
            for process in (retargeting, capture):
                if process is not None:
                    process.terminate()
                    process.join()
                    process.close()
            here.close()
            there.close()
    log = LatencyLog()
    log._values, log._n = values, len(values)
    return complete(log), share


def capture_to_command() -> Row:
    """From a skeleton in the capture process to the command in the robot process; 99th percentile."""
    ways: list[Array] = []
    shares: list[float] = []

    def once() -> float:
        way, share = three_processes()
        ways.append(way)
        shares.append(share)
        return float(np.percentile(way, 99))

    def check() -> tuple[bool, str]:
        way = np.concatenate(ways)
        note = f"median {duration(float(np.median(way)))} of {len(way)}; led in {100 * min(shares):.0f} % of the steps"
        return len(way) >= _ENOUGH * len(ways) and min(shares) > 0.1, note

    name = f"capture to command, three processes, loopback UDP, {RATE:.0f} Hz, 99th percentile"
    return Row(name, once, most_seconds=5e-3, check=check, repeats=3, self_timed=True)


ROWS: tuple[Callable[[], Row], ...] = (capture_to_command,)
"""All rows of transmission."""
