"""UdpRobot: a robot in another process or on another machine, led over UDP as if it were here."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.robots.robot import Robot
from imitarm.robots.supervisor import fingerprint
from imitarm.transmission.datagram import Encoder, Header, now_ns
from imitarm.transmission.gate import Gate
from imitarm.transmission.messages import JointCommand, JointState, Mode, Status
from imitarm.transmission.sockets import Address, connected, resolved, try_to_send, waiting

Array = NDArray[np.float64]

FRESH = 0.1  # [s] a state that is older says nothing about now
TAKEN = "somebody else leads the robot"
_ASK_AGAIN = 0.02  # [s]
_LED = (Status.FOLLOWING, Status.SLOWING)


class Echo(NamedTuple):
    """What became of a command.

    Attributes:
        sequence: of the command.
        sent: from sending to receiving [s]; from another machine, beyond the quickest.
        applied: from receiving until the drives had what follows from it [s].
        applied_ns: when that was, on the clock of this process; from another machine, as if the quickest took no time.
    """

    sequence: int
    sent: float
    applied: float
    applied_ns: int


class UdpRobot(Robot):
    """The client of a :class:`~imitarm.robots.server.RobotServer`.

    :meth:`move` limits a velocity as every robot does and sends the set-point that comes of it; the server judges it
    again. It only leads while the server says that it does, in a state that is at most 0.1 s old: else it sends no
    command, and its set-point is the server's. So a client that was started again, one whose link was cut and one whose
    server was started again all begin from where the arm is.

    A robot that is stopped moves again only after :meth:`enable`, which is for a person to decide.

    Args:
        arm: the model of the arm at the other end.
        address: host and port of the server.
        timeout: how long to wait for the first answer [s].
        clock_ns: the time to stamp with [ns].
        sleep: waits some seconds.

    Attributes:
        reported: the newest state.
        interruptions: how often it has lost the lead, or had to catch up with the server.
        sequence: number of the command that was sent last; None: none.
        gate: which judges what comes back.

    Raises:
        InputError: when there is no such host, or the robot there is another arm.
        TaskFailedError: when nobody answers.
    """

    following_error: ClassVar[float] = float("inf")  # the server looks after it, without the way over the wire

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
        self._here = resolved(address)[0].startswith("127.")  # one clock for both sides
        self._socket = connected(address)
        self._encoder = Encoder()
        self.gate = Gate(patience=FRESH)
        self.reported: JointState
        self.interruptions, self.sequence = 0, None
        self._heard: int | None = None
        self._opening: float | None = None
        self._led = self._slowed = self._other_arm = False
        self._echoes: list[Echo] = []
        self._echoed, self._quickest = 0, float("inf")
        super().__init__(arm, arm.home)
        try:
            self._connect(address, timeout)
        except BaseException:
            self.close()
            raise

    sequence: int | None

    def _connect(self, address: Address, timeout: float) -> None:
        """Ask until a state comes, and begin from there."""
        for _ in range(max(round(timeout / _ASK_AGAIN), 1)):
            self._say(Mode.OBSERVE)
            self._sleep(_ASK_AGAIN)
            if self.listen() or self._other_arm:
                break
        else:
            raise TaskFailedError(
                f"{address[0]}:{address[1]}: no robot answers; start one with 'imitarm serve', or check the address"
            )
        if self._other_arm:
            raise InputError(f"{address[0]}:{address[1]}: the robot there is not {self.arm.name}; name the right arm")
        self._begin(self.reported.set_point)

    # --- what it is

    @property
    def fresh(self) -> bool:
        """Whether a state has come within the last 0.1 s."""
        return self._heard is not None and self._clock_ns() - self._heard <= 1e9 * FRESH

    @property
    def ready(self) -> bool:
        """Whether commands are heeded: the state is fresh, and it is this client that leads."""
        return self.fresh and self.reported.owner == self._encoder.session and self.reported.status in _LED

    @property
    def trouble(self) -> str:
        """Why it is not ready, in words; empty when it is."""
        if not self.fresh:
            return f"the robot that answers is not {self.arm.name}" if self._other_arm else "the robot does not answer"
        if self.reported.status in _LED and not self.ready:
            return TAKEN
        return self.reported.reason

    def state(self) -> ArmState:
        """Return the newest state that has come."""
        reported = self.reported
        return ArmState(reported.q, reported.velocity, reported.torque, reported.time)

    @property
    def opening(self) -> float:
        """Measured opening between the gripper's fingers [m]; nan without a gripper."""
        return float("nan") if self.reported.opening is None else self.reported.opening[0]

    @property
    def widest_opening(self) -> float:
        """Opening of the gripper when it is wide open [m]; nan without a gripper."""
        return float("nan") if self.reported.opening is None else self.reported.opening[1]

    def echoes(self) -> list[Echo]:
        """Return what has become of commands since the last call."""
        echoes, self._echoes = self._echoes, []
        return echoes

    # --- what it does

    def move(self, velocity: ArrayLike, dt: float) -> ArmState:
        """Lead the robot, when it is ready; else ask how it is, and stay where it is.

        Args:
            velocity: of the joints at the end of ``dt``, shape (n_joints,) [rad/s].
            dt: [s].

        Returns:
            The newest state that has come.

        Raises:
            InputError: as :meth:`Robot.move <imitarm.robots.robot.Robot.move>`.
        """
        self.listen()
        if not self.ready:
            self.interruptions += self._led
            self._led = False
            self._begin(self.reported.set_point)
            self._say(Mode.OBSERVE)
            return self.state()
        slowing = self.reported.status is Status.SLOWING
        if not self._led or (slowing and not self._slowed):
            self.interruptions += self._led
            self._led = True
            self._begin(self.reported.set_point)
            self.velocity = self.reported.set_velocity.copy()
        self._slowed = slowing
        return super().move(velocity, dt)

    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        q = np.clip(self.set_point + 0.5 * dt * (previous + velocity), self.arm.lower, self.arm.upper)
        self.sequence = self._say(Mode.MOVE, q, velocity)

    def grasp(self, opening: float) -> None:
        """Ask for an opening of the gripper with every command from now on.

        Args:
            opening: between the fingers [m].

        Raises:
            InputError: when the robot has no gripper, or its fingers do not open so far.
        """
        if not 0.0 <= opening <= self.widest_opening:
            widest = "it has no gripper" if np.isnan(self.widest_opening) else f"0 to {self.widest_opening:g} m is"
            raise InputError(f"grasp: opening {opening!r} is not possible: {widest}")
        self._opening = float(opening)

    def stop(self, dt: float = 0.01) -> ArmState:
        """Brake as hard as the accelerations allow, at the pace of time.

        Args:
            dt: time between two commands [s].

        Returns:
            The newest state at the end.
        """
        while self.velocity.any():
            self.move(np.zeros(self.arm.n_joints), dt)
            self._sleep(dt)
        return self.state()

    def request_enable(self) -> None:
        """Send the operator's word that the robot may move again; whether it does is told by ``ready``."""
        self._say(Mode.ENABLE, challenge=self.reported.challenge)

    def enable(self, timeout: float = 1.0) -> None:
        """Let the robot move again, and wait until it may: for a person to decide, never for a program by itself.

        Raises:
            TaskFailedError: when it does not become ready; the message says why.
        """
        for _ in range(max(round(timeout / _ASK_AGAIN), 1)):
            self.listen()
            if self.ready:
                return
            if self.fresh and self.reported.status is Status.STOPPED:
                self.request_enable()
            else:
                self._say(Mode.OBSERVE)
            self._sleep(_ASK_AGAIN)
        self.listen()
        if not self.ready:
            raise TaskFailedError(f"the robot was not enabled: {self.trouble or 'it did not answer in time'}")

    def close(self) -> None:
        """Stop the robot if this client leads it, and let go of the socket; a second call does nothing."""
        if self._socket.fileno() >= 0:
            if self._heard is not None and self.reported.owner == self._encoder.session:
                self._say(Mode.STOP)
            self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- the wire

    def _say(self, mode: Mode, q: Array | None = None, velocity: Array | None = None, challenge: int = 0) -> int:
        """Send a command, and return its sequence number."""
        rest = np.zeros(self.arm.n_joints)
        opening = self._opening if mode is Mode.MOVE else None
        command = JointCommand(
            mode, rest if q is None else q, rest if velocity is None else velocity, self._arm, challenge, opening
        )
        sequence = self._encoder.sequence
        try_to_send(self._socket, self._encoder.encode(command, self._clock_ns()))
        return sequence

    def listen(self) -> bool:
        """Take in the states that have come; return whether there was one."""
        came = False
        for data, _ in waiting(self._socket):
            now = self._clock_ns()
            opened = self.gate.open(data, now, JointState)
            if opened is None:
                continue
            header, state = opened
            self._other_arm = state.arm != self._arm or len(state.q) != self.arm.n_joints
            if self._other_arm:
                continue
            self.reported, self._heard, came = state, now, True
            self._note_echo(header, state)
        return came

    def _note_echo(self, header: Header, state: JointState) -> None:
        """Note what has become of a command, once."""
        if state.owner != self._encoder.session or state.applied_ns == 0 or state.echo_sent_ns == self._echoed:
            return
        self._echoed = state.echo_sent_ns
        way = 1e-9 * (state.received_ns - state.echo_sent_ns)
        if not self._here:
            self._quickest = min(self._quickest, way)
            way -= self._quickest
        applied = 1e-9 * (state.applied_ns - state.received_ns)
        self._echoes.append(Echo(state.echo, way, applied, state.echo_sent_ns + round(1e9 * (way + applied))))
