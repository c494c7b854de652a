"""Datagrams: messages encoded as bytes, and decoded with every value checked.

A datagram consists of a header of 28 bytes and a payload, both little-endian. The message type determines the size of
the payload; docs/transmission.md has a table of the fields. An invalid datagram is rejected with a reason. No part of a
datagram is executed or used as a length, so a hostile datagram has no effect except that a counter increases.
"""

from __future__ import annotations

import secrets
import struct
import time
import zlib
from dataclasses import dataclass

import numpy as np

from imitarm.transmission.messages import KINDS, DatagramError, Message

MAGIC, VERSION = b"IMTR", 1

_HEAD = struct.Struct("<4sBBHIIQI")  # magic, version, kind, flags, session, sequence, time, checksum
_SIGNED = _HEAD.size - 4  # all of the header but the checksum
_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", None)


def now_ns() -> int:
    """Return the current time [ns] of a clock that never goes back and that all processes of this machine share.

    If the operating system allows it, the clock keeps running while the machine is suspended. A clock that stops during
    a suspension would make every later datagram of this machine look delayed to its receiver.
    """
    return time.clock_gettime_ns(_CLOCK) if _CLOCK is not None else time.monotonic_ns()


@dataclass(frozen=True)
class Header:
    """The fields at the start of every datagram.

    Attributes:
        kind: number of the message type.
        flags: bits whose meaning depends on the message type.
        session: random number that the sender draws when it starts, u32.
        sequence: sequence number of the datagram within the session, u32; after the largest number follows 0.
        time_ns: time of sending, on the sender's clock, u64 [ns].
    """

    kind: int
    flags: int
    session: int
    sequence: int
    time_ns: int


class Encoder:
    """Encodes messages as the numbered and time-stamped datagrams of one session.

    Args:
        session: session number; None: a random number other than 0. From a new number, receivers recognise that the
            sender has restarted.
        first: first sequence number.
    """

    def __init__(self, session: int | None = None, first: int = 0) -> None:
        self.session = 1 + secrets.randbelow(2**32 - 1) if session is None else session
        self.sequence = first

    def encode(self, message: Message, time_ns: int) -> bytes:
        """Encode a message as the next datagram of this session.

        Args:
            message: message to send.
            time_ns: time of sending, on the sender's clock [ns].

        Raises:
            DatagramError: when a value cannot be encoded.
        """
        try:
            body, numbers = message._pack()
            flags, sequence = message._flags, self.sequence
            head = _HEAD.pack(MAGIC, VERSION, message.KIND, flags, self.session, sequence, time_ns, 0)[:_SIGNED]
        except (struct.error, ValueError) as error:
            raise DatagramError("range", f"{type(message).__name__} cannot be encoded: {error}") from error
        payload = b"".join([body, *(vector.astype("<f8").tobytes() for vector in numbers)])
        self.sequence = (self.sequence + 1) & 0xFFFFFFFF
        return b"".join([head, struct.pack("<I", zlib.crc32(payload, zlib.crc32(head))), payload])


def size_of(kind: type[Message]) -> int:
    """Return the size of a datagram of a message type [bytes]."""
    return _HEAD.size + kind.BODY.size + 8 * kind.NUMBERS


def decode(data: bytes) -> tuple[Header, Message]:
    """Decode a datagram and return its header and its message.

    Args:
        data: received bytes, which may be arbitrary.

    Raises:
        DatagramError: when the bytes are not a valid datagram. Its ``reason`` is ``"length"``, ``"magic"``,
            ``"version"``, ``"kind"``, ``"checksum"`` or ``"range"``.
    """
    if len(data) < _HEAD.size:
        raise DatagramError("length", f"the datagram has only {len(data)} bytes, fewer than its header needs")
    magic, version, number, flags, session, sequence, time_ns, checksum = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise DatagramError("magic", "the datagram was not sent by imitarm")
    if version != VERSION:
        raise DatagramError(
            "version", f"format version {version}, but this imitarm uses {VERSION}; use the same version on both sides"
        )
    kind = KINDS.get(number)
    if kind is None:
        raise DatagramError("kind", f"unknown message type {number}")
    if len(data) != size_of(kind):
        raise DatagramError("length", f"the datagram has {len(data)} bytes, but {size_of(kind)} are expected")
    if zlib.crc32(data[_HEAD.size :], zlib.crc32(data[:_SIGNED])) != checksum:
        raise DatagramError("checksum", "damaged (wrong checksum)")
    body = kind.BODY.unpack_from(data, _HEAD.size)
    numbers = np.frombuffer(data, dtype="<f8", offset=_HEAD.size + kind.BODY.size).astype(float)
    return Header(number, flags, session, sequence, time_ns), kind._unpack(flags, body, numbers)
