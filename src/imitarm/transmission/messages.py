"""Messages: what can be sent between a capture process, a retargeting one and a robot, and what each may hold."""

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
_GRIPPER = 1  # the only flag
_FARTHEST = 20.0  # [m]
_LONGEST = 1e10  # [s]
_ANGLE, _SPEED, _TORQUE = 1e3, 1e3, 1e6  # [rad], [rad/s], [N m]: beyond them there is no joint
_WAITED = 60_000_000_000  # [ns]


class DatagramError(InputError):
    """Bytes that are no datagram; ``reason`` is the word under which they are counted."""

    def __init__(self, reason: str, what: str) -> None:
        super().__init__(f"datagram: {what}")
        self.reason = reason


class Mode(IntEnum):
    """What a joint command asks for."""

    OBSERVE = 0  # nothing but an answer
    MOVE = 1
    ENABLE = 2  # let the stopped robot move again; carries the challenge of that stop
    STOP = 3


class Status(IntEnum):
    """What a robot does."""

    STOPPED = 0  # latched: only ENABLE leads out
    FOLLOWING = 1
    SLOWING = 2  # commands are missing: it brakes and holds
    FAULT = 3  # it has stopped to protect itself; it must be started anew


@dataclass(frozen=True, eq=False)
class SkeletonFrame:
    """A person at one instant; see ``imitarm.capture.Skeleton``.

    Attributes:
        time: of the exposure, on the source's clock [s].
        positions: shape (25, 3) [m], at most 20 m; what is lost is 0.
        tracking: 0 lost, 1 inferred, 2 tracked, shape (25,).
        hands: states of the left and the right hand, 0 to 4.
        person: which one, u64.
        waited_ns: between exposure and sending [ns], at most a minute.
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
        _within(flags == 0, "unknown flags")
        _within(abs(time_) <= _LONGEST and waited <= _WAITED, "time")
        _within(left <= 4 and right <= 4, "state of a hand")
        _within(bool(tracking.min() >= 0 and tracking.max() <= 2), "tracking state")
        _within(_magnitude(numbers) <= _FARTHEST, "position")
        return cls(time_, numbers.reshape(N_BODY, 3), tracking, (left, right), person, waited)


@dataclass(frozen=True, eq=False)
class JointCommand:
    """What a robot should do.

    Attributes:
        mode: what is asked for.
        q: where the joints should be, shape (n_joints,) [rad]; at most 16 joints.
        velocity: and how fast they should move there, shape (n_joints,) [rad/s].
        arm: fingerprint of the arm that is meant.
        challenge: of the stop that ENABLE ends; else 0.
        opening: of the gripper [m], at most 1; None: as it is.
    """

    KIND: ClassVar[int] = 2
    BODY: ClassVar[struct.Struct] = struct.Struct("<BB2xIId")
    NUMBERS: ClassVar[int] = 2 * MAX_JOINTS

    mode: Mode
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
        _within(flags <= _GRIPPER, "unknown flags")
        _within(1 <= n <= MAX_JOINTS and mode <= max(Mode), "number of joints or mode")
        _within(0.0 <= opening <= 1.0, "opening of the gripper")
        q, velocity = numbers.reshape(2, MAX_JOINTS)[:, :n]
        _within(_magnitude(q) <= _ANGLE and _magnitude(velocity) <= _SPEED, "joint position or velocity")
        given = opening if flags & _GRIPPER else None
        return cls(Mode(mode), q, velocity, arm, challenge, given)


@dataclass(frozen=True, eq=False)
class JointState:
    """What a robot does.

    Attributes:
        status: what it does.
        time: the robot's own [s].
        q: measured, shape (n_joints,) [rad].
        velocity: measured, shape (n_joints,) [rad/s].
        torque: of the drives, shape (n_joints,) [N m].
        set_point: where the drives should be, shape (n_joints,) [rad].
        set_velocity: how fast the set-point moves, shape (n_joints,) [rad/s].
        arm: fingerprint of the arm.
        challenge: what ENABLE must carry; 0 when the robot is not stopped.
        owner: session of the sender whose commands are obeyed; 0: nobody's.
        opening: of the gripper and the widest it has [m]; None without one.
        echo: sequence number of the last command that was obeyed.
        echo_sent_ns: when that was sent, on the sender's clock [ns].
        received_ns: when it was received, on the robot's clock [ns].
        applied_ns: when the drives first got what follows from it, on the robot's clock [ns]; 0: none yet.
        reason: why it is stopped or faulty, in words; at most 91 bytes of UTF-8.
    """

    KIND: ClassVar[int] = 3
    BODY: ClassVar[struct.Struct] = struct.Struct("<BB2xIIIIQQQddd92s")
    NUMBERS: ClassVar[int] = 5 * MAX_JOINTS

    status: Status
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
        _within(flags <= _GRIPPER, "unknown flags")
        _within(1 <= n <= MAX_JOINTS and status <= max(Status), "number of joints or status")
        _within(abs(time_) <= _LONGEST, "time")
        _within(abs(opening) <= 1.0 and 0.0 <= widest <= 1.0, "opening of the gripper")
        vectors = numbers.reshape(5, MAX_JOINTS)[:, :n]
        q, velocity, torque, set_point, set_velocity = vectors
        _within(max(_magnitude(q), _magnitude(set_point)) <= _ANGLE, "joint position")
        _within(max(_magnitude(velocity), _magnitude(set_velocity)) <= _SPEED, "joint velocity")
        _within(_magnitude(torque) <= _TORQUE, "torque")
        reason = words.rstrip(b"\0").decode("utf-8", "replace")
        _within(not reason or reason.isprintable(), "reason")  # it will be shown in a terminal
        return cls(
            Status(status), time_, q, velocity, torque, set_point, set_velocity, arm, challenge, owner,
            (opening, widest) if flags & _GRIPPER else None, echo, sent, received, applied, reason,
        )  # fmt: skip


Message = SkeletonFrame | JointCommand | JointState
KINDS: dict[int, type[SkeletonFrame] | type[JointCommand] | type[JointState]] = {
    kind.KIND: kind for kind in (SkeletonFrame, JointCommand, JointState)
}
"""By the number in the header."""


def _magnitude(values: Array) -> float:
    """Return the largest magnitude; what is not a number is larger than all."""
    largest = float(np.abs(values).max())
    return np.inf if np.isnan(largest) else largest


def _within(good: bool, what: str) -> None:
    if not good:
        raise DatagramError("range", f"{what} is out of range")


def _padded(values: Array) -> Array:
    whole = np.zeros(MAX_JOINTS)
    whole[: len(values)] = values
    return whole
