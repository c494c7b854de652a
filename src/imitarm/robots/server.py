"""RobotServer: serves a robot to clients over UDP."""

from __future__ import annotations

from collections.abc import Callable
from socket import socket
from typing import Self

from imitarm.errors import InputError
from imitarm.robots.robot import Robot
from imitarm.robots.supervisor import Supervisor
from imitarm.transmission.datagram import now_ns
from imitarm.transmission.rate import RateLimiter
from imitarm.transmission.sockets import LOOPBACK, Address, listening, try_to_send, wait_for, waiting

_AT_ONCE = 64  # datagrams read in one period, so that a flood does not delay the robot
_MAX_ANSWERS = 8  # addresses answered in one period
_MAX_STEP = 0.02  # [s] longest step after missed periods


class RobotServer:
    """Receives commands, moves a robot at a fixed rate, and answers each client that has asked, once per period.

    It sends nothing unless asked, and a :class:`~imitarm.robots.supervisor.Supervisor` checks everything it receives.
    If the machine was too busy and periods were missed, the next step is longer by their time, up to 20 ms in total,
    so that the robot keeps up with the commands. The limits still hold, because they depend on the length of the
    step. Time missed beyond that is skipped.

    Args:
        robot: robot to serve.
        port: port to listen on; 0: any free port.
        host: address of this machine to listen on; the default hears this machine only. There is no password: listen
            on a network only if everyone on it may move the robot.
        rate: control periods per second, 100 to 1000 [Hz]; the period of a simulated robot must be a multiple of its
            timestep.
        on_event: called with a text when the robot is enabled, slows or stops.
        clock_ns: returns the time [ns].
        wait: waits until a datagram has arrived, at most some seconds, and returns whether one has; with a simulated
            clock it lets the time pass.

    Attributes:
        address: host and port on which it listens.
        supervisor: checks the commands and moves the robot.
        rate_limiter: starts the control periods and counts the missed ones.

    Raises:
        InputError: when the rate is out of range, or the port is in use.
    """

    def __init__(
        self,
        robot: Robot,
        port: int,
        host: str = LOOPBACK,
        *,
        rate: float = 250.0,
        on_event: Callable[[str], None] | None = None,
        clock_ns: Callable[[], int] = now_ns,
        wait: Callable[[socket, float], bool] = wait_for,
    ) -> None:
        if not 100.0 <= rate <= 1000.0:
            raise InputError(f"RobotServer: rate must be between 100 and 1000 Hz, got {rate!r}")
        self._clock_ns, self._wait = clock_ns, wait
        self.rate_limiter = RateLimiter(1.0 / rate, clock_ns=clock_ns)
        self.supervisor = Supervisor(robot, 1.0 / rate, on_event=on_event)
        self._max_periods = max(int(_MAX_STEP * rate), 1)
        self._clients: dict[Address, None] = {}
        self._socket = listening((host, port))
        self.address: Address = self._socket.getsockname()

    def receive(self) -> None:
        """Process the datagrams that have arrived, without waiting."""
        for data, address in waiting(self._socket, _AT_ONCE):
            if self.supervisor.receive(data, self._clock_ns()) and len(self._clients) < _MAX_ANSWERS:
                self._clients[address] = None

    def step(self, missed: int = 0) -> None:
        """Process datagrams, move the robot for one period, and answer.

        Args:
            missed: number of periods missed before this one.
        """
        self.receive()
        self.supervisor.step(self._clock_ns(), min(1 + missed, self._max_periods))
        if self._clients:
            answer = self.supervisor.answer(self._clock_ns)
            for address in self._clients:
                try_to_send(self._socket, answer, address)
            self._clients.clear()

    def run(self, seconds: float | None = None, *, on_step: Callable[[Self], None] | None = None) -> None:
        """Serve for some time or until an exception is raised, then brake the robot.

        Args:
            seconds: duration [s]; None: unlimited.
            on_step: called after every period.
        """
        until = None if seconds is None else self._clock_ns() + round(1e9 * seconds)
        try:
            while until is None or self._clock_ns() < until:
                while (left := self.rate_limiter.remaining) > 0.0:
                    if self._wait(self._socket, left):
                        self.receive()
                self.step(self.rate_limiter.tick())
                if on_step is not None:
                    on_step(self)
        finally:
            self.supervisor.robot.stop(self.supervisor.dt)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
