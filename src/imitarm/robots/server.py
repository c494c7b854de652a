"""RobotServer: a process of its own for a robot, led over UDP."""

from __future__ import annotations

from collections.abc import Callable
from socket import socket
from typing import Self

from imitarm.errors import InputError
from imitarm.robots.robot import Robot
from imitarm.robots.supervisor import Supervisor
from imitarm.transmission.datagram import now_ns
from imitarm.transmission.pace import Pace
from imitarm.transmission.sockets import LOOPBACK, Address, listening, try_to_send, wait_for, waiting

_AT_ONCE = 64  # datagrams taken in one period: a flood must not keep the robot waiting
_ANSWERED = 8  # addresses answered in one period
_MADE_UP = 0.02  # [s] longest step


class RobotServer:
    """Listens for commands, moves a robot at a fixed rate, and answers whoever has asked, at most once a period.

    Nothing is sent unasked, and what is received is judged by a :class:`~imitarm.robots.supervisor.Supervisor`.
    Where the machine was too busy for some periods, the next step is as much longer, up to 20 ms: the robot keeps up
    with the commands, and the limits hold, since they count by the length of a step. What is missed beyond that is
    left out.

    Args:
        robot: a simulated or a real one.
        port: to listen at; 0: any that is free.
        host: address of this machine to listen at; the usual one hears this machine only. There is no password:
            open it to a network only where everybody may move the robot.
        rate: periods a second [Hz], at least 100; a simulated robot needs a multiple of its timestep.
        on_event: is told in words when the robot is enabled, slows, stops.
        clock_ns: returns the time [ns].
        wait: waits until a datagram has arrived, at most some seconds, and returns whether one has; with a simulated
            clock it lets the time pass.

    Attributes:
        address: where it listens.
        supervisor: which watches over the robot.
        pace: which counts overruns.

    Raises:
        InputError: when the rate is too low, or the port is taken.
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
        self.pace = Pace(1.0 / rate, clock_ns=clock_ns)
        self.supervisor = Supervisor(robot, 1.0 / rate, on_event=on_event)
        self._most = max(int(_MADE_UP * rate), 1)
        self._asked: dict[Address, None] = {}
        self._socket = listening((host, port))
        self.address: Address = self._socket.getsockname()

    def receive(self) -> None:
        """Take in what has come, without waiting."""
        for data, address in waiting(self._socket, _AT_ONCE):
            if self.supervisor.receive(data, self._clock_ns()) and len(self._asked) < _ANSWERED:
                self._asked[address] = None

    def step(self, missed: int = 0) -> None:
        """Take in what has come, move the robot, and answer.

        Args:
            missed: periods before this one.
        """
        self.receive()
        self.supervisor.step(self._clock_ns(), min(1 + missed, self._most))
        if self._asked:
            answer = self.supervisor.answer(self._clock_ns)
            for address in self._asked:
                try_to_send(self._socket, answer, address)
            self._asked.clear()

    def run(self, seconds: float | None = None, *, on_step: Callable[[Self], None] | None = None) -> None:
        """Go on for some seconds, or until something raises; the robot is braked at the end.

        Args:
            seconds: None: without end.
            on_step: is called after every period.
        """
        until = None if seconds is None else self._clock_ns() + round(1e9 * seconds)
        try:
            while until is None or self._clock_ns() < until:
                while (left := self.pace.left) > 0.0:
                    if self._wait(self._socket, left):
                        self.receive()
                self.step(self.pace.tick())
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
