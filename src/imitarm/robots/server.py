"""RobotServer: serves a robot to clients over UDP; its Supervisor stops the robot if valid commands fail to arrive."""

from __future__ import annotations

import secrets
import zlib
from collections import Counter
from collections.abc import Callable
from socket import socket
from typing import Self

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.robots.robot import Robot
from imitarm.transmission.datagram import Encoder, Header, decode, now_ns
from imitarm.transmission.datagram_filter import DatagramFilter
from imitarm.transmission.messages import (
    MAX_JOINTS,
    CommandMode,
    DatagramError,
    JointCommand,
    JointState,
    RobotStatus,
)
from imitarm.transmission.rate import RateLimiter
from imitarm.transmission.sockets import LOOPBACK, Address, listening, try_to_send, wait_for, waiting
from imitarm.validation import finite_number

Array = NDArray[np.float64]

SLOW_AFTER, LATCH_AFTER = 0.1, 0.5  # [s] without a valid command: brake; latch the stop
REACH_TIME = 0.15  # [s] a command may be as far from the set-point as a joint moves in this time at full speed
_EXTRAPOLATE = 0.03  # [s] a command is extrapolated at its velocity; after this the velocity fades until SLOW_AFTER
_GAIN = 20.0  # [1/s] of the position error
_TOLERANCE = 1e-6  # [rad], and relative
_AT_ONCE = 64  # datagrams read in one period, so that a flood does not delay the robot
_MAX_ANSWERS = 8  # addresses answered in one period
_MAX_STEP = 0.02  # [s] longest step after missed periods


def fingerprint(arm: ArmModel) -> int:
    """Return a number that identifies an arm: a checksum of its joint names and all their limits."""
    limits = np.concatenate([arm.lower, arm.upper, arm.max_velocity, arm.max_acceleration])
    return zlib.crc32("\0".join(arm.joint_names).encode() + limits.astype("<f8").tobytes())


class Supervisor:
    r"""Checks every command, and lets one remote client move a robot as long as the client sends valid commands.

    The supervisor always has one of four statuses:

    * ``stopped``: the robot holds its position, and commands are ignored. Every stop generates a new random number,
      the challenge. An ENABLE message that contains this number changes the status to ``following``.
    * ``following``: the robot moves to the newest commanded positions. If no valid command arrives for 0.1 s, the
      status becomes ``slowing``. A STOP message changes the status to ``stopped``.
    * ``slowing``: the robot brakes to rest and holds its position. A valid command changes the status to
      ``following``. If no valid command arrives for 0.5 s, the status becomes ``stopped``.
    * ``fault``: the robot has made a protective stop. Only a restart of the process ends this status.

    The first status is ``stopped``. The client that enables the robot is its owner until the next stop. Every stop has
    a new challenge, so a copy of an old ENABLE message has no effect. After a restart of the client, its user must
    enable the robot again. Any client may stop the robot.

    A command is valid if it passes the :class:`~imitarm.transmission.datagram_filter.DatagramFilter`, is meant for this
    arm, and is within the joints' position and velocity limits. The command must also be near the set-point. No joint
    may differ from it by more than the joint moves in 0.15 s at full speed.

    Let :math:`q_c` be the commanded position and :math:`\dot q_c` its velocity. The set-point q moves towards
    :math:`q_c` at the following velocity:

    .. math:: \dot q = f\,\dot q_c + \mathrm{sign}(e) \min(k |e|, \sqrt{a |e|}), \qquad
              e = q_c + \dot q_c\, s - q

    Here, k is the gain, a the maximum acceleration, and s the time for which the command is extrapolated. The factor f
    is 1 until the command is 30 ms old, and then decreases to 0 at 100 ms. :meth:`Robot.move
    <imitarm.robots.robot.Robot.move>` limits this velocity again. No sequence of datagrams can therefore move the
    set-point beyond the limits of position, velocity and acceleration.

    The methods of this class take the time as an argument and never wait. :class:`~imitarm.robots.server.RobotServer`
    receives the datagrams and calls these methods in real time.

    Args:
        robot: robot to move.
        dt: time between two calls of :meth:`step` [s].
        on_event: function called with a text when the status changes.

    Attributes:
        robot: the robot.
        status: current status, one of the statuses above.
        reason: why the robot is stopped or faulty.
        challenge: number that ENABLE must currently contain; 0 if the robot is not stopped.
        datagram_filter: checks the owner's commands.
        dropped: number of commands that the supervisor ignored, by reason. Commands dropped by ``datagram_filter`` are
            not counted here.
    """

    def __init__(self, robot: Robot, dt: float, *, on_event: Callable[[str], None] | None = None) -> None:
        if robot.arm.n_joints > MAX_JOINTS:
            raise DatagramError(
                "range", f"the arm has {robot.arm.n_joints} joints, but a datagram can hold at most {MAX_JOINTS}"
            )
        self.robot, self.dt = robot, dt
        self._arm = fingerprint(robot.arm)
        self._on_event = on_event
        self._encoder = Encoder()
        self._reach = REACH_TIME * robot.arm.max_velocity
        self.datagram_filter = DatagramFilter(session_timeout=np.inf)
        self.dropped: Counter[str] = Counter()
        self.status, self.reason, self.challenge = RobotStatus.STOPPED, "", 0
        self._command: JointCommand | None = None
        self._header: Header | None = None
        self._received = self._applied = 0
        self._stop("the server has just started")

    # --- received datagrams

    def receive(self, data: bytes, now: int) -> bool:
        """Process a datagram and return whether to answer its sender.

        Args:
            data: received bytes, which may be arbitrary.
            now: time of receiving [ns].
        """
        try:
            header, message = decode(data)
        except DatagramError as error:
            self.dropped[error.reason] += 1
            return False
        if not isinstance(message, JointCommand):
            self.dropped["kind"] += 1
            return False
        if message.mode is CommandMode.STOP:
            if self.status in (RobotStatus.FOLLOWING, RobotStatus.SLOWING):
                self._stop("a client has stopped it")
        elif message.mode is not CommandMode.OBSERVE:
            fault = self._enable(header, message, now) if message.mode is CommandMode.ENABLE else self._take(
                header, message, now
            )  # fmt: skip
            if fault:
                self.dropped[fault] += 1
        return True

    def _enable(self, header: Header, message: JointCommand, now: int) -> str:
        """Make a client the owner, or return the reason why it can't become the owner."""
        if self.status is not RobotStatus.STOPPED:
            return "not stopped"
        if message.arm != self._arm or len(message.q) != self.robot.arm.n_joints:
            return "wrong arm"
        if message.challenge != self.challenge:
            return "wrong challenge"
        if self.robot.velocity.any():
            return "still braking"
        if header.session != self.datagram_filter.session:
            self.datagram_filter.start_session(header.session)
        if not self.datagram_filter.accept(header, now):
            return ""
        self._received, self._command, self._header = now, None, None
        self._become(RobotStatus.FOLLOWING, "", "enabled")
        return ""

    def _take(self, header: Header, message: JointCommand, now: int) -> str:
        """Accept a command as the newest command, or return the reason why it is rejected."""
        if self.status not in (RobotStatus.FOLLOWING, RobotStatus.SLOWING):
            return "stopped"
        if not self.datagram_filter.accept(header, now):  # the filter counts it
            return ""
        fault = self._impossible(message)
        if fault:
            return fault
        if message.opening is not None and (self._command is None or message.opening != self._command.opening):
            self.robot.grasp(message.opening)
        if self.status is RobotStatus.SLOWING:
            self._become(RobotStatus.FOLLOWING, "", "commands arrive again")
        self._command, self._header, self._received, self._applied = message, header, now, 0
        return ""

    def _impossible(self, message: JointCommand) -> str:
        """Return why a command is invalid for this arm at its set-point; empty if it is valid."""
        arm = self.robot.arm
        if message.arm != self._arm or len(message.q) != arm.n_joints:
            return "wrong arm"
        if (message.q < arm.lower - _TOLERANCE).any() or (message.q > arm.upper + _TOLERANCE).any():
            return "beyond a position limit"
        if (np.abs(message.velocity) > (1.0 + _TOLERANCE) * arm.max_velocity).any():
            return "beyond a velocity limit"
        if (np.abs(message.q - self.robot.set_point) > self._reach).any():
            return "too far from the set-point"
        if message.opening is not None and not message.opening <= self.robot.widest_opening:
            return "gripper opening"
        return ""

    # --- control

    def step(self, now: int, periods: int = 1) -> None:
        """Move the robot for one control period, and brake or stop it if commands are missing.

        Args:
            now: time [ns].
            periods: number of control periods that this step covers; more than one if the server has missed periods.
        """
        silence = 1e-9 * (now - self._received)
        if self.status in (RobotStatus.FOLLOWING, RobotStatus.SLOWING):
            if silence > LATCH_AFTER:
                self._stop(f"no valid command for {1e3 * LATCH_AFTER:.0f} ms")
            elif silence > SLOW_AFTER and self.status is RobotStatus.FOLLOWING:
                self._become(RobotStatus.SLOWING, "", f"no valid command for {1e3 * SLOW_AFTER:.0f} ms: slowing")
        self.robot.move(self._requested(silence), periods * self.dt)
        if self.robot.fault and self.status is not RobotStatus.FAULT:
            self._become(RobotStatus.FAULT, self.robot.fault, self.robot.fault)

    def _requested(self, silence: float) -> Array:
        """Return the joint velocity to request from the robot, shape (n_joints,) [rad/s]."""
        command = self._command
        if command is None or self.status is not RobotStatus.FOLLOWING:
            return np.zeros(self.robot.arm.n_joints)
        fading = min(max(silence - _EXTRAPOLATE, 0.0) / (SLOW_AFTER - _EXTRAPOLATE), 1.0)
        extrapolated = min(silence, _EXTRAPOLATE) + (SLOW_AFTER - _EXTRAPOLATE) * fading * (1.0 - 0.5 * fading)
        error = command.q + extrapolated * command.velocity - self.robot.set_point
        size = np.abs(error)
        catching_up = np.minimum(_GAIN * size, np.sqrt(self.robot.arm.max_acceleration * size))
        return (1.0 - fading) * command.velocity + np.sign(error) * catching_up

    def answer(self, now: Callable[[], int] = now_ns) -> bytes:
        """Return the state of the robot as a datagram.

        Args:
            now: function that returns the time [ns].
        """
        robot, state, header = self.robot, self.robot.state(), self._header
        if header is not None and self._applied == 0:
            self._applied = now()
        gripper = None if np.isnan(robot.opening) else (robot.opening, robot.widest_opening)
        owned = self.status in (RobotStatus.FOLLOWING, RobotStatus.SLOWING) and self.datagram_filter.session is not None
        message = JointState(
            self.status,
            state.time,
            state.q,
            state.velocity,
            state.torque,
            robot.set_point,
            robot.velocity,
            self._arm,
            self.challenge,
            (self.datagram_filter.session or 0) if owned else 0,
            gripper,
            *((0, 0, 0, 0) if header is None else (header.sequence, header.time_ns, self._received, self._applied)),
            self.reason,
        )
        return self._encoder.encode(message, now())

    def _stop(self, reason: str) -> None:
        """Brake and hold until a client enables the robot again."""
        self._command = self._header = None
        self._become(RobotStatus.STOPPED, reason, f"stopped: {reason}")
        self.challenge = 1 + secrets.randbelow(2**32 - 1)

    def _become(self, status: RobotStatus, reason: str, event: str) -> None:
        self.status, self.reason, self.challenge = status, reason, 0
        if self._on_event is not None:
            self._on_event(event)


class RobotServer:
    """Receives commands, moves a robot at a fixed rate, and answers each request once per period.

    The server sends nothing without a request, and a :class:`~imitarm.robots.server.Supervisor` checks every datagram
    that it receives. If the machine is too busy and the server misses periods, the next step also covers the missed
    time. The robot then keeps up with the commands. A step lasts at most 20 ms; the server skips the rest of the missed
    time. The joints keep their limits in a longer step, because the permitted velocity is computed from the length of
    the step.

    Args:
        robot: robot to serve.
        port: port to listen on; 0: any free port.
        host: address of this machine to listen on; by default, only this machine can connect. There is no password:
            listen on a network only if everyone on it may move the robot.
        rate: control periods per second, 100 to 1000 [Hz]; the period of a simulated robot must be a multiple of its
            timestep.
        on_event: function called with a text when the robot is enabled, slows or stops.
        clock_ns: function that returns the time [ns].
        wait: function that takes a time [s], waits at most this long for a datagram, and returns whether one has
            arrived. If the clock is simulated, the function must advance the clock.

    Attributes:
        address: host and port on which the server listens.
        supervisor: checks the commands and moves the robot.
        rate_limiter: timer that starts the control periods and counts the missed periods.

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
        rate = finite_number(rate, "RobotServer: rate", "Hz", at_least=100.0, at_most=1000.0)
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
            on_step: function called after every period.

        Raises:
            InputError: when the duration is not positive.
        """
        until = None
        if seconds is not None:
            seconds = finite_number(seconds, "RobotServer: seconds", "s", above=0.0)
            until = self._clock_ns() + round(1e9 * seconds)
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
