r"""Supervisor: stands between the wire and a robot; believes nothing, keeps every limit, stops when commands stop."""

from __future__ import annotations

import secrets
import zlib
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.robots.robot import Robot
from imitarm.transmission.datagram import Encoder, Header, decode, now_ns
from imitarm.transmission.gate import Gate
from imitarm.transmission.messages import MAX_JOINTS, DatagramError, JointCommand, JointState, Mode, Status

Array = NDArray[np.float64]

SLOW_AFTER, LATCH_AFTER = 0.1, 0.5  # [s] without a valid command, METHODS A.9
NEAR = 0.15  # [s] a set-point must be nearer than a joint gets in this time at full speed
_AHEAD = 0.03  # [s] a command is carried on at its velocity for so long; then that fades until SLOW_AFTER
_GAIN = 20.0  # [1/s]
_TOLERANCE = 1e-6  # [rad], and relative


def fingerprint(arm: ArmModel) -> int:
    """Return a number that tells one arm from another: its joints and all their limits."""
    limits = np.concatenate([arm.lower, arm.upper, arm.max_velocity, arm.max_acceleration])
    return zlib.crc32("\0".join(arm.joint_names).encode() + limits.astype("<f8").tobytes())


class Supervisor:
    r"""Lets one remote client lead a robot, as long as that client is there and asks for what is possible.

    ========== ============================================================= ======================================
    status     what the robot does                                           what leads out
    ========== ============================================================= ======================================
    stopped    has braked and holds; commands are not heeded                 ENABLE with this stop's challenge
    following  goes towards the set-point of the newest command              0.1 s without a valid command; a stop
    slowing    has no command for 0.1 s: brakes and holds                    a valid command; 0.5 s without one
    fault      has stopped to protect itself                                 only a new start of this process
    ========== ============================================================= ======================================

    It begins stopped, and every stop draws a new challenge: a recorded ENABLE opens nothing, and a client that was
    started again must have its operator enable the robot again. Whoever enables it owns it until the next stop.
    Anybody may stop it.

    A command is valid when the gate admits it (:class:`~imitarm.transmission.gate.Gate`), it is for this arm, within
    the joints' limits of position and velocity, and not farther from the set-point than the joints get in 0.15 s at
    full speed.

    The robot goes from its own set-point towards the one received, at

    .. math:: \dot q = f\,\dot q_c + \mathrm{sign}(e) \min(k |e|, \sqrt{a |e|}), \qquad e = q_c + \dot q_c\, s - q

    where s is the age of the command and f its share that is left: whole for 30 ms, then fading until 100 ms. That
    goes through :meth:`Robot.move <imitarm.robots.robot.Robot.move>`, which limits it once more. So whatever is
    received, the set-point moves within the limits of position, velocity and acceleration.

    Time comes in as an argument, nothing waits: see :class:`~imitarm.robots.server.RobotServer` for the rest.

    Args:
        robot: that it moves.
        dt: between two calls of :meth:`step` [s].
        on_event: is told in words when the status changes.

    Attributes:
        robot: as given.
        status: see the table.
        reason: why it is stopped or faulty.
        challenge: what ENABLE must carry now; 0 when it is not stopped.
        gate: for the owner's commands.
        dropped: datagrams that were not heeded, besides those the gate dropped, by reason.
    """

    def __init__(self, robot: Robot, dt: float, *, on_event: Callable[[str], None] | None = None) -> None:
        if robot.arm.n_joints > MAX_JOINTS:
            raise DatagramError("range", f"{robot.arm.n_joints} joints are more than {MAX_JOINTS}")
        self.robot, self.dt = robot, dt
        self._arm = fingerprint(robot.arm)
        self._on_event = on_event
        self._encoder = Encoder()
        self._near = NEAR * robot.arm.max_velocity
        self.gate = Gate(patience=np.inf)
        self.dropped: Counter[str] = Counter()
        self.status, self.reason, self.challenge = Status.STOPPED, "", 0
        self._command: JointCommand | None = None
        self._header: Header | None = None
        self._heard = self._applied = 0
        self._stop("just started")

    # --- what comes in

    def receive(self, data: bytes, now: int) -> bool:
        """Take in a datagram; return whether its sender is to be answered.

        Args:
            data: as received; anything at all.
            now: when [ns].
        """
        try:
            header, message = decode(data)
        except DatagramError as error:
            self.dropped[error.reason] += 1
            return False
        if not isinstance(message, JointCommand):
            self.dropped["kind"] += 1
            return False
        if message.mode is Mode.STOP:
            if self.status in (Status.FOLLOWING, Status.SLOWING):
                self._stop("stopped by an operator")
        elif message.mode is not Mode.OBSERVE:
            fault = self._enable(header, message, now) if message.mode is Mode.ENABLE else self._take(
                header, message, now
            )  # fmt: skip
            if fault:
                self.dropped[fault] += 1
        return True

    def _enable(self, header: Header, message: JointCommand, now: int) -> str:
        """Let a client lead from here on, or return why not."""
        if self.status is not Status.STOPPED:
            return "not stopped"
        if message.arm != self._arm or len(message.q) != self.robot.arm.n_joints:
            return "another arm"
        if message.challenge != self.challenge:
            return "wrong challenge"
        if self.robot.velocity.any():
            return "still braking"
        if header.session != self.gate.session:
            self.gate.begin(header.session)
        if not self.gate.admit(header, now):
            return ""
        self._heard, self._command, self._header = now, None, None
        self._become(Status.FOLLOWING, "", "enabled")
        return ""

    def _take(self, header: Header, message: JointCommand, now: int) -> str:
        """Take a command for the newest one, or return why not."""
        if self.status not in (Status.FOLLOWING, Status.SLOWING):
            return "stopped"
        if not self.gate.admit(header, now):  # which counts it
            return ""
        fault = self._impossible(message)
        if fault:
            return fault
        if message.opening is not None and (self._command is None or message.opening != self._command.opening):
            self.robot.grasp(message.opening)
        if self.status is Status.SLOWING:
            self._become(Status.FOLLOWING, "", "commands come again")
        self._command, self._header, self._heard, self._applied = message, header, now, 0
        return ""

    def _impossible(self, message: JointCommand) -> str:
        """Return what is wrong with a command for this arm in its present posture; empty: nothing."""
        arm = self.robot.arm
        if message.arm != self._arm or len(message.q) != arm.n_joints:
            return "another arm"
        if (message.q < arm.lower - _TOLERANCE).any() or (message.q > arm.upper + _TOLERANCE).any():
            return "beyond a position limit"
        if (np.abs(message.velocity) > (1.0 + _TOLERANCE) * arm.max_velocity).any():
            return "beyond a velocity limit"
        if (np.abs(message.q - self.robot.set_point) > self._near).any():
            return "too far away"
        if message.opening is not None and not message.opening <= self.robot.widest_opening:
            return "gripper"
        return ""

    # --- what is done

    def step(self, now: int, periods: int = 1) -> None:
        """Watch the time, and move the robot.

        Args:
            now: [ns].
            periods: to move for, in one step; more than one after some were missed.
        """
        silent = 1e-9 * (now - self._heard)
        if self.status in (Status.FOLLOWING, Status.SLOWING):
            if silent > LATCH_AFTER:
                self._stop(f"no valid command for {1e3 * LATCH_AFTER:.0f} ms")
            elif silent > SLOW_AFTER and self.status is Status.FOLLOWING:
                self._become(Status.SLOWING, "", f"no valid command for {1e3 * SLOW_AFTER:.0f} ms: slowing")
        self.robot.move(self._wanted(silent), periods * self.dt)
        if self.robot.fault and self.status is not Status.FAULT:
            self._become(Status.FAULT, self.robot.fault, self.robot.fault)

    def _wanted(self, silent: float) -> Array:
        """Return the velocity (n_joints,) [rad/s] to ask the robot for."""
        command = self._command
        if command is None or self.status is not Status.FOLLOWING:
            return np.zeros(self.robot.arm.n_joints)
        fading = min(max(silent - _AHEAD, 0.0) / (SLOW_AFTER - _AHEAD), 1.0)
        carried = min(silent, _AHEAD) + (SLOW_AFTER - _AHEAD) * fading * (1.0 - 0.5 * fading)
        error = command.q + carried * command.velocity - self.robot.set_point
        size = np.abs(error)
        catching_up = np.minimum(_GAIN * size, np.sqrt(self.robot.arm.max_acceleration * size))
        return (1.0 - fading) * command.velocity + np.sign(error) * catching_up

    def answer(self, now: Callable[[], int] = now_ns) -> bytes:
        """Return the robot's state as a datagram.

        Args:
            now: tells the time [ns].
        """
        robot, state, header = self.robot, self.robot.state(), self._header
        if header is not None and self._applied == 0:
            self._applied = now()
        gripper = None if np.isnan(robot.opening) else (robot.opening, robot.widest_opening)
        led = self.status in (Status.FOLLOWING, Status.SLOWING) and self.gate.session is not None
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
            (self.gate.session or 0) if led else 0,
            gripper,
            *((0, 0, 0, 0) if header is None else (header.sequence, header.time_ns, self._heard, self._applied)),
            self.reason,
        )
        return self._encoder.encode(message, now())

    def _stop(self, reason: str) -> None:
        """Latch: from now on brake and hold until somebody enables the robot again."""
        self._command = self._header = None
        self._become(Status.STOPPED, reason, f"stopped: {reason}")
        self.challenge = 1 + secrets.randbelow(2**32 - 1)

    def _become(self, status: Status, reason: str, event: str) -> None:
        self.status, self.reason, self.challenge = status, reason, 0
        if self._on_event is not None:
            self._on_event(event)
