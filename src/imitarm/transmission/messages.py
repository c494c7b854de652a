"""Messages between the capture, retargeting and robot processes, with the valid range of each value."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]

N_BODY, MAX_JOINTS = 25, 16
_GRIPPER = 1  # flag: the gripper's fields are valid
_MAX_DISTANCE = 20.0  # [m]
_MAX_TIME = 1e10  # [s]
_MAX_ANGLE, _MAX_SPEED, _MAX_TORQUE = 1e3, 1e3, 1e6  # [rad], [rad/s], [N m]: no joint exceeds them
_MAX_WAIT = 60_000_000_000  # [ns]


class DatagramError(InputError):
    """The bytes are not a valid datagram; ``reason`` is the key under which the receiver counts them."""

    def __init__(self, reason: str, what: str) -> None:
        super().__init__(f"datagram: {what}")
        self.reason = reason


class CommandMode(IntEnum):
    """Kinds of joint commands."""

    OBSERVE = 0  # an answer only
    MOVE = 1  # move to the commanded joint positions
    ENABLE = 2  # allow the stopped robot to move again; carries the challenge of that stop
    STOP = 3  # brake and stay stopped


class RobotStatus(IntEnum):
    """States of a robot server."""

    STOPPED = 0  # latched: only ENABLE ends it
    FOLLOWING = 1  # moves to the commanded joint positions
    SLOWING = 2  # commands are missing: brakes and holds
    FAULT = 3  # protective stop: the server must be restarted


@dataclass(frozen=True, eq=False)
class SkeletonFrame:
    """The skeleton of a person at one time; see ``imitarm.capture.Skeleton``.

    Attributes:
        time: time of exposure, on the source's clock [s].
        positions: positions of the joints in the sensor's frame, shape (25, 3) [m]. Each coordinate is between -20 and
            20 m. The coordinates of a lost joint are 0.
        tracking: tracking state of each joint (0 lost, 1 inferred, 2 tracked), shape (25,).
        hands: states of the left and the right hand, numbers of :class:`~imitarm.capture.skeleton.HandState`, shape
            (2,).
        person: identifier of the person, u64.
        waited_ns: time from exposure to sending [ns]; at most one minute.
    """

    KIND: ClassVar[int] = 1
    BODY: ClassVar[struct.Struct] = struct.Struct("<dQQ2B25s5x")
    NUMBERS: ClassVar[int] = 3 * N_BODY

    time: float
    positions: Array
    tracking: NDArray[np.int8]
    hands: tuple[int, int]
    person: int = 0
    waited_ns: int = 0

    @property
    def _flags(self) -> int:
        return 0

    def _pack(self) -> tuple[bytes, list[Array]]:
        tracking = np.asarray(self.tracking, dtype=np.int8).tobytes()
        body = self.BODY.pack(self.time, self.person & (2**64 - 1), self.waited_ns, *self.hands, tracking)
        return body, [np.asarray(self.positions, dtype=float).ravel()]

    @classmethod
    def _unpack(cls, flags: int, body: tuple[Any, ...], numbers: Array) -> Self:
        time_, person, waited, left, right, states = body
        tracking = np.frombuffer(states, dtype=np.int8)
        _require(flags == 0, "unknown flags")
        _require(abs(time_) <= _MAX_TIME and waited <= _MAX_WAIT, "time")
        _require(left <= 4 and right <= 4, "state of a hand")
        _require(bool(tracking.min() >= 0 and tracking.max() <= 2), "tracking state")
        _require(_magnitude(numbers) <= _MAX_DISTANCE, "position")
        return cls(time_, numbers.reshape(N_BODY, 3), tracking, (left, right), person, waited)


@dataclass(frozen=True, eq=False)
class JointCommand:
    """A command from a client to a robot.

    Attributes:
        mode: kind of command.
        q: commanded joint positions, shape (n_joints,) [rad]; at most 16 joints.
        velocity: joint velocities that the arm should have at the positions ``q``, shape (n_joints,) [rad/s].
        arm: checksum of the arm model for which the command was computed (:func:`imitarm.robots.server.fingerprint`).
        challenge: for an ENABLE command, the number that the stopped robot has sent; for other commands, 0.
        opening: commanded opening of the gripper [m], at most 1 m; None: the opening does not change.
    """

    KIND: ClassVar[int] = 2
    BODY: ClassVar[struct.Struct] = struct.Struct("<BB2xIId")
    NUMBERS: ClassVar[int] = 2 * MAX_JOINTS

    mode: CommandMode
    q: Array
    velocity: Array
    arm: int = 0
    challenge: int = 0
    opening: float | None = None

    @property
    def _flags(self) -> int:
        return 0 if self.opening is None else _GRIPPER

    def _pack(self) -> tuple[bytes, list[Array]]:
        opening = 0.0 if self.opening is None else self.opening
        body = self.BODY.pack(len(self.q), self.mode, self.challenge, self.arm, opening)
        return body, [_padded(self.q), _padded(self.velocity)]

    @classmethod
    def _unpack(cls, flags: int, body: tuple[Any, ...], numbers: Array) -> Self:
        n, mode, challenge, arm, opening = body
        _require(flags <= _GRIPPER, "unknown flags")
        _require(1 <= n <= MAX_JOINTS and mode <= max(CommandMode), "the number of joints or the mode")
        _require(0.0 <= opening <= 1.0, "the opening of the gripper")
        q, velocity = numbers.reshape(2, MAX_JOINTS)[:, :n]
        _require(
            _magnitude(q) <= _MAX_ANGLE and _magnitude(velocity) <= _MAX_SPEED, "a joint position or a joint velocity"
        )
        given = opening if flags & _GRIPPER else None
        return cls(CommandMode(mode), q, velocity, arm, challenge, given)


@dataclass(frozen=True, eq=False)
class JointState:
    """The state of a robot.

    Attributes:
        status: state of the server.
        time: time on the robot's clock [s].
        q: measured joint positions, shape (n_joints,) [rad].
        velocity: measured joint velocities, shape (n_joints,) [rad/s].
        torque: torques of the joint drives, shape (n_joints,) [N m].
        set_point: joint positions that the drives track, shape (n_joints,) [rad].
        set_velocity: velocity of the set-point, shape (n_joints,) [rad/s].
        arm: checksum of the arm model that the robot uses.
        challenge: number that an ENABLE command must contain; 0 if the robot is not stopped.
        owner: session of the client whose commands the robot follows; 0 if it follows no client.
        opening: current and largest opening of the gripper [m]; None without a gripper.
        echo: sequence number of the last command that the robot followed.
        echo_sent_ns: time at which the client sent command ``echo``, on the client's clock [ns].
        received_ns: time at which the robot received command ``echo``, on the robot's clock [ns].
        applied_ns: time at which the drives first received a set-point computed from command ``echo``, on the robot's
            clock [ns]; 0: not yet.
        reason: why the robot is stopped or faulty; at most 91 bytes of UTF-8.
    """

    KIND: ClassVar[int] = 3
    BODY: ClassVar[struct.Struct] = struct.Struct("<BB2xIIIIQQQddd92s")
    NUMBERS: ClassVar[int] = 5 * MAX_JOINTS

    status: RobotStatus
    time: float
    q: Array
    velocity: Array
    torque: Array
    set_point: Array
    set_velocity: Array
    arm: int = 0
    challenge: int = 0
    owner: int = 0
    opening: tuple[float, float] | None = None
    echo: int = 0
    echo_sent_ns: int = 0
    received_ns: int = 0
    applied_ns: int = 0
    reason: str = field(default="")

    @property
    def _flags(self) -> int:
        return 0 if self.opening is None else _GRIPPER

    def _pack(self) -> tuple[bytes, list[Array]]:
        times = (self.echo_sent_ns, self.received_ns, self.applied_ns, self.time)
        reason = self.reason.encode()[:91].decode(errors="ignore").encode()
        opening = (0.0, 0.0) if self.opening is None else self.opening
        head = (len(self.q), self.status, self.challenge, self.arm, self.owner, self.echo)
        vectors = (self.q, self.velocity, self.torque, self.set_point, self.set_velocity)
        return self.BODY.pack(*head, *times, *opening, reason), [_padded(vector) for vector in vectors]

    @classmethod
    def _unpack(cls, flags: int, body: tuple[Any, ...], numbers: Array) -> Self:
        n, status, challenge, arm, owner, echo, sent, received, applied, time_, opening, widest, words = body
        _require(flags <= _GRIPPER, "unknown flags")
        _require(1 <= n <= MAX_JOINTS and status <= max(RobotStatus), "the number of joints or the status")
        _require(abs(time_) <= _MAX_TIME, "time")
        _require(abs(opening) <= 1.0 and 0.0 <= widest <= 1.0, "the opening of the gripper")
        vectors = numbers.reshape(5, MAX_JOINTS)[:, :n]
        q, velocity, torque, set_point, set_velocity = vectors
        _require(max(_magnitude(q), _magnitude(set_point)) <= _MAX_ANGLE, "a joint position")
        _require(max(_magnitude(velocity), _magnitude(set_velocity)) <= _MAX_SPEED, "a joint velocity")
        _require(_magnitude(torque) <= _MAX_TORQUE, "torque")
        reason = words.rstrip(b"\0").decode("utf-8", "replace")
        _require(not reason or reason.isprintable(), "reason")  # it will be shown in a terminal
        return cls(
            RobotStatus(status), time_, q, velocity, torque, set_point, set_velocity, arm, challenge, owner,
            (opening, widest) if flags & _GRIPPER else None, echo, sent, received, applied, reason,
        )  # fmt: skip


Message = SkeletonFrame | JointCommand | JointState
KINDS: dict[int, type[SkeletonFrame] | type[JointCommand] | type[JointState]] = {
    kind.KIND: kind for kind in (SkeletonFrame, JointCommand, JointState)
}
"""The message types, by their numbers in the header of a datagram."""


def _magnitude(values: Array) -> float:
    """Return the largest magnitude; infinite if a value is not a number."""
    largest = float(np.abs(values).max())
    return np.inf if np.isnan(largest) else largest


def _require(in_range: bool, what: str) -> None:
    if not in_range:
        raise DatagramError("range", f"{what} is out of range")


def _padded(values: Array) -> Array:
    whole = np.zeros(MAX_JOINTS)
    whole[: len(values)] = values
    return whole
