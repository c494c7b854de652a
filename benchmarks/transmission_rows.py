"""What ``make bench`` times of transmission: from one process's skeleton to another one's robot, over loopback UDP.

The yardstick is the same chain of three processes at the same rates with bare sockets: what remains is our work.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import random
import socket
import struct
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.stream import SkeletonSender, UdpSource
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter
from imitarm.robots import RobotServer, SimulatedRobot, UdpRobot
from imitarm.teleoperation import Teleoperation
from imitarm.transmission.latency import LatencyLog
from imitarm.transmission.sockets import Address
from timing import Row, duration

Array = NDArray[np.float64]

RATE = 500.0  # [Hz] control ticks of the retargeting process: a skeleton waits for the next one
_PERSON = 0
_ENOUGH = 200  # skeletons whose latency is completely known
_PATIENCE = 60.0  # [s]
_STAGES = ("expose", "arrive", "wait", "retarget", "send", "robot")  # from exposure until the robot has the command


def _pause(jitter: random.Random) -> float:
    """Return the time between two skeletons [s]: about a hundred per second, in step with nothing else."""
    return jitter.uniform(0.007, 0.013)


def _capture(to: Address) -> None:
    """Be the capture process."""
    truth, jitter = reaching(Person.from_seed(_PERSON), _PERSON), random.Random(0)
    with SkeletonSender(to) as sender:
        begin = time.monotonic()
        while True:
            now = time.monotonic() - begin
            sender.send(truth(now))
            time.sleep(_pause(jitter))


def _retargeting(pipe: Connection, to: Address) -> None:
    """Be the retargeting process: report where it listens, and at the end the log of its latencies."""
    person, arm = Person.from_seed(_PERSON), ArmModel.load("sawyer", tool="gripper")
    lengths = LimbLengths(person.upper_arm, person.forearm)
    retargeter = ModernRetargeter(arm, Correspondence(lengths=lengths, orientation="upright"), dt=1.0 / RATE)
    with UdpSource(0) as source, UdpRobot(arm, to, timeout=_PATIENCE) as robot:
        pipe.send(source.address)
        robot.enable(_PATIENCE)
        loop = Teleoperation(source, retargeter, robot, stream=source, confirm_enable=lambda problem, stopped: stopped)
        until = time.monotonic() + _PATIENCE
        while len(complete(loop.summary.latency)) < _ENOUGH and time.monotonic() < until:
            loop.summary.reason = ""
            loop.run(loop.summary.duration + 1.0)
        pipe.send((loop.summary.latency.values, loop.summary.engagement["following"] / max(loop.summary.steps, 1)))


def complete(log: LatencyLog) -> Array:
    """Return the latencies of skeletons, from exposure until the robot had the command, shape (n,) [s]."""
    columns = [log.stages.index(stage) for stage in _STAGES]
    latencies = log.values[:, columns].sum(axis=1)
    return np.asarray(latencies[np.isfinite(latencies)])


def three_processes() -> tuple[Array, float]:
    """Let capture, retargeting and robot work together for some seconds, each in a process of its own.

    Returns:
        the latency of each skeleton (n,) [s], and the fraction of the control ticks in which the arm followed.
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
            values, fraction = here.recv()
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
    return complete(log), fraction


_STAMP = struct.Struct("d")


def _bare_capture(to: Address) -> None:
    """Send the time, as often as the capture process sends skeletons."""
    jitter = random.Random(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        while True:
            out.sendto(_STAMP.pack(time.monotonic()), to)
            time.sleep(_pause(jitter))


def _bare_middle(pipe: Connection, to: Address) -> None:
    """Forward the newest time at each control tick."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as into,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        into.bind(("127.0.0.1", 0))
        into.setblocking(False)
        pipe.send(into.getsockname())
        tick = time.monotonic()
        while True:
            newest = b""
            with contextlib.suppress(BlockingIOError):
                while True:
                    newest = into.recv(64)
            if newest:
                out.sendto(newest, to)
            tick = max(tick + 1.0 / RATE, time.monotonic())
            time.sleep(max(tick - time.monotonic(), 0.0))


def bare_sockets() -> Array:
    """Return the latencies of the same chain with nothing but sockets, shape (n,) [s]."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as into:
        into.bind(("127.0.0.1", 0))
        into.settimeout(_PATIENCE)
        middle = context.Process(target=_bare_middle, args=(there, into.getsockname()), daemon=True)
        middle.start()
        capture = context.Process(target=_bare_capture, args=(here.recv(),), daemon=True)
        capture.start()
        try:
            sent_and_here = [(_STAMP.unpack(into.recv(64))[0], time.monotonic()) for _ in range(_ENOUGH)]
        finally:
            for process in (capture, middle):
                process.terminate()
                process.join()
                process.close()
    return np.array([here - sent for sent, here in sent_and_here])


def capture_to_command() -> Row:
    """From a skeleton in the capture process to the command in the robot process: 90th percentile."""
    found: list[Array] = []
    followed: list[float] = []

    def once() -> float:
        latencies, fraction = three_processes()
        found.append(latencies)
        followed.append(fraction)
        return float(np.percentile(latencies, 90))

    def check() -> tuple[bool, str]:
        latencies = np.concatenate(found)
        late, least = duration(float(np.percentile(latencies, 99))), min(followed)
        note = f"99th percentile {late} of {len(latencies)}; followed in at least {100 * least:.0f} % of the ticks"
        return min(map(len, found)) >= _ENOUGH and least > 0.1, note

    return Row(
        f"capture to command, three processes, {RATE:.0f} Hz, 90th percentile",
        once,
        lambda: float(np.percentile(bare_sockets(), 90)),
        "bare sockets",
        cost=2.0,
        check=check,
        repeats=8,
        self_timed=True,
    )


ROWS: tuple[Callable[[], Row], ...] = (capture_to_command,)
