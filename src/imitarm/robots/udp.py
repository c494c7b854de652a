"""UdpRobot: controls a robot in another process or on another machine over UDP."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.robots.robot import Robot
from imitarm.robots.server import fingerprint
from imitarm.transmission.datagram import Encoder, Header, now_ns
from imitarm.transmission.datagram_filter import DatagramFilter
from imitarm.transmission.messages import CommandMode, JointCommand, JointState, RobotStatus
from imitarm.transmission.sockets import Address, connected, resolved, try_to_send, waiting

Array = NDArray[np.float64]

FRESH = 0.1  # [s] an older state is not used
OTHER_CLIENT = "another client controls the robot"
_RETRY_PERIOD = 0.02  # [s] between two requests without an answer
_ACTIVE = (RobotStatus.FOLLOWING, RobotStatus.SLOWING)


class Echo(NamedTuple):
    """Times at which one command was sent, received and applied, as reported by the server.

    Attributes:
        sequence: sequence number of the command.
        sent: travel time of the command from this client to the server [s]. If the server is on another machine, the
            travel time of the fastest command is subtracted.
        applied: time from the command's arrival at the server until the drives received a set-point computed from it
            [s].
        applied_ns: time at which this set-point was given to the drives, on the clock of this process [ns]. If the
            server is on another machine, the travel time of the fastest command is assumed to be 0.
    """

    sequence: int
    sent: float
    applied: float
    applied_ns: int


class UdpRobot(Robot):
    """The client of a :class:`~imitarm.robots.server.RobotServer`.

    :meth:`move` limits the velocity in the same way as for every other robot. It then sends the resulting set-point,
    and the server checks the set-point again. The client sends commands only if the robot follows this client. The
    newest state from the server must say so and be at most 0.1 s old. Otherwise, the client sends no command and adopts
    the server's set-point. Therefore the arm never jumps after a restart of client or server, or after an interrupted
    connection.

    A stopped robot moves again only after :meth:`enable`. A person must decide to call :meth:`enable`.

    Args:
        arm: model of the arm that is served.
        address: host and port of the server.
        timeout: longest time to wait for the first answer [s].
        clock_ns: clock for the time stamps [ns].
        sleep: function that waits for a time [s].

    Attributes:
        reported: the newest state that the server has sent.
        interruptions: number of times that the client has lost control of the robot, or had to adopt the server's
            set-point.
        sequence: sequence number of the last command; None before the first.
        datagram_filter: drops states that are invalid, old or out of order.

    Raises:
        InputError: when the host does not exist, or its server controls another arm.
        TaskFailedError: when no server answers.
    """

    following_error: ClassVar[float] = float("inf")  # the server checks it, where the network adds no delay

    def __init__(
        self,
        arm: ArmModel,
        address: Address,
        *,
        timeout: float = 2.0,
        clock_ns: Callable[[], int] = now_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._clock_ns, self._sleep = clock_ns, sleep
        self._arm = fingerprint(arm)
        self._same_clock = resolved(address)[0].startswith("127.")  # both processes are on this machine
        self._socket = connected(address)
        self._encoder = Encoder()
        self.datagram_filter = DatagramFilter(session_timeout=FRESH)
        self.reported: JointState
        self.interruptions, self.sequence = 0, None
        self._received: int | None = None
        self._opening: float | None = None
        self._in_control = self._slowed = self._other_arm = False
        self._echoes: list[Echo] = []
        self._echoed, self._fastest = 0, float("inf")
        super().__init__(arm, arm.home)
        try:
            self._connect(address, timeout)
        except BaseException:
            self.close()
            raise

    sequence: int | None

    def _connect(self, address: Address, timeout: float) -> None:
        """Send requests until a state arrives, and adopt its set-point."""
        for _ in range(max(round(timeout / _RETRY_PERIOD), 1)):
            self._command(CommandMode.OBSERVE)
            self._sleep(_RETRY_PERIOD)
            if self.listen() or self._other_arm:
                break
        else:
            raise TaskFailedError(
                f"{address[0]}:{address[1]}: no robot server answers; start one with 'imitarm serve', "
                "or check the address"
            )
        if self._other_arm:
            raise InputError(
                f"{address[0]}:{address[1]}: the robot there is not {self.arm.name}; choose the model of the arm that "
                "the server controls"
            )
        self._begin(self.reported.set_point)

    # --- state

    @property
    def fresh(self) -> bool:
        """Whether a state has arrived within the last 0.1 s."""
        return self._received is not None and self._clock_ns() - self._received <= 1e9 * FRESH

    @property
    def ready(self) -> bool:
        """Whether the robot follows this client: the state is fresh, and this client is the owner."""
        return self.fresh and self.reported.owner == self._encoder.session and self.reported.status in _ACTIVE

    @property
    def problem(self) -> str:
        """Why the robot does not follow this client; empty if it does."""
        if not self.fresh:
            return f"the robot that answers is not {self.arm.name}" if self._other_arm else "the robot does not answer"
        if self.reported.status in _ACTIVE and not self.ready:
            return OTHER_CLIENT
        return self.reported.reason

    def state(self) -> ArmState:
        """Return the newest state that has arrived."""
        reported = self.reported
        return ArmState(reported.q, reported.velocity, reported.torque, reported.time)

    @property
    def opening(self) -> float:
        """Measured opening between the gripper's fingers [m]; nan without a gripper."""
        return float("nan") if self.reported.opening is None else self.reported.opening[0]

    @property
    def widest_opening(self) -> float:
        """Largest opening of the gripper [m]; nan without a gripper."""
        return float("nan") if self.reported.opening is None else self.reported.opening[1]

    def echoes(self) -> list[Echo]:
        """Return the times of the commands, as reported by the server since the last call of this method."""
        echoes, self._echoes = self._echoes, []
        return echoes

    # --- commands

    def move(self, velocity: ArrayLike, dt: float) -> ArmState:
        """Send a command if the robot follows this client; otherwise only ask for the robot's state.

        Args:
            velocity: joint velocities at the end of ``dt``, shape (n_joints,) [rad/s].
            dt: duration of the motion [s].

        Returns:
            The newest state that has arrived.

        Raises:
            InputError: for the same reasons as :meth:`Robot.move <imitarm.robots.robot.Robot.move>`.
        """
        self.listen()
        if not self.ready:
            self.interruptions += self._in_control
            self._in_control = False
            self._begin(self.reported.set_point)
            self._command(CommandMode.OBSERVE)
            return self.state()
        slowing = self.reported.status is RobotStatus.SLOWING
        if not self._in_control or (slowing and not self._slowed):
            self.interruptions += self._in_control
            self._in_control = True
            self._begin(self.reported.set_point)
            self.velocity = self.reported.set_velocity.copy()
        self._slowed = slowing
        return super().move(velocity, dt)

    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        q = np.clip(self.set_point + 0.5 * dt * (previous + velocity), self.arm.lower, self.arm.upper)
        self.sequence = self._command(CommandMode.MOVE, q, velocity)

    def grasp(self, opening: float) -> None:
        """Set the opening of the gripper that every command from now on requests.

        Args:
            opening: distance between the fingers [m].

        Raises:
            InputError: when the robot has no gripper, or its fingers do not open so far.
        """
        if not 0.0 <= opening <= self.widest_opening:
            widest = "it has no gripper" if np.isnan(self.widest_opening) else f"0 to {self.widest_opening:g} m is"
            raise InputError(f"grasp: opening {opening!r} is not possible: {widest}")
        self._opening = float(opening)

    def stop(self, dt: float = 0.01) -> ArmState:
        """Brake at the maximum acceleration until the commanded velocity is zero; this takes real time.

        Args:
            dt: time between two commands [s].

        Returns:
            The newest state that has arrived.
        """
        while self.velocity.any():
            self.move(np.zeros(self.arm.n_joints), dt)
            self._sleep(dt)
        return self.state()

    def request_enable(self) -> None:
        """Ask the server to let the robot move again; ``ready`` becomes true when the robot may move."""
        self._command(CommandMode.ENABLE, challenge=self.reported.challenge)

    def enable(self, timeout: float = 1.0) -> None:
        """Let the robot move again, and wait until it is ready.

        A person must make this decision; a program must never make it alone.

        Args:
            timeout: longest time to wait [s].

        Raises:
            TaskFailedError: when the robot does not become ready; the message says why.
        """
        for _ in range(max(round(timeout / _RETRY_PERIOD), 1)):
            self.listen()
            if self.ready:
                return
            if self.fresh and self.reported.status is RobotStatus.STOPPED:
                self.request_enable()
            else:
                self._command(CommandMode.OBSERVE)
            self._sleep(_RETRY_PERIOD)
        self.listen()
        if not self.ready:
            raise TaskFailedError(f"the robot was not enabled: {self.problem or 'it did not answer in time'}")

    def close(self) -> None:
        """Stop the robot if it follows this client, and close the socket; a second call does nothing."""
        if self._socket.fileno() >= 0:
            if self._received is not None and self.reported.owner == self._encoder.session:
                self._command(CommandMode.STOP)
            self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- network

    def _command(
        self, mode: CommandMode, q: Array | None = None, velocity: Array | None = None, challenge: int = 0
    ) -> int:
        """Send a command, and return its sequence number."""
        rest = np.zeros(self.arm.n_joints)
        opening = self._opening if mode is CommandMode.MOVE else None
        command = JointCommand(
            mode, rest if q is None else q, rest if velocity is None else velocity, self._arm, challenge, opening
        )
        sequence = self._encoder.sequence
        try_to_send(self._socket, self._encoder.encode(command, self._clock_ns()))
        return sequence

    def listen(self) -> bool:
        """Process the states that have arrived, and return whether any state has arrived."""
        came = False
        for data, _ in waiting(self._socket):
            now = self._clock_ns()
            opened = self.datagram_filter.receive(data, now, JointState)
            if opened is None:
                continue
            header, state = opened
            self._other_arm = state.arm != self._arm or len(state.q) != self.arm.n_joints
            if self._other_arm:
                continue
            self.reported, self._received, came = state, now, True
            self._record_echo(header, state)
        return came

    def _record_echo(self, header: Header, state: JointState) -> None:
        """Record the times of a command unless they are already recorded."""
        if state.owner != self._encoder.session or state.applied_ns == 0 or state.echo_sent_ns == self._echoed:
            return
        self._echoed = state.echo_sent_ns
        travel = 1e-9 * (state.received_ns - state.echo_sent_ns)
        if not self._same_clock:
            self._fastest = min(self._fastest, travel)
            travel -= self._fastest
        applied = 1e-9 * (state.applied_ns - state.received_ns)
        self._echoes.append(Echo(state.echo, travel, applied, state.echo_sent_ns + round(1e9 * (travel + applied))))
