"""Datagrams: messages as bytes, and back, every byte judged (METHODS A.9).

A datagram is a header of 28 bytes and a payload whose size its kind fixes; little-endian; docs/transmission.md has the
table. Whatever is not exactly such a datagram is refused with a reason. Nothing in it is executed or believed to be a
length, so the worst that a hostile one can do is to be counted.
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
    """Return the time that all datagrams go by [ns]: never set, never standing still, the same for all processes here.

    It goes on while the machine sleeps, where the system has such a clock: else all that is sent afterwards would
    look late.
    """
    return time.clock_gettime_ns(_CLOCK) if _CLOCK is not None else time.monotonic_ns()


@dataclass(frozen=True)
class Header:
    """What every datagram begins with.

    Attributes:
        kind: of the payload.
        flags: bits, as the kind defines them.
        session: drawn by the sender when it begins, u32.
        sequence: number within the session, u32, wraps around.
        time_ns: when it was sent, on the sender's clock, u64 [ns].
    """

    kind: int
    flags: int
    session: int
    sequence: int
    time_ns: int


class Encoder:
    """Turns messages into datagrams of one session, numbered and stamped.

    Args:
        session: None: drawn at random, never 0, so that a sender that was restarted is known to be another one.
        first: sequence number to begin with.
    """

    def __init__(self, session: int | None = None, first: int = 0) -> None:
        self.session = 1 + secrets.randbelow(2**32 - 1) if session is None else session
        self.sequence = first

    def encode(self, message: Message, time_ns: int) -> bytes:
        """Return a message as a datagram.

        Args:
            message: to send.
            time_ns: now, on the sender's clock [ns].

        Raises:
            DatagramError: when a number can't be sent.
        """
        try:
            body, numbers = message._pack()
            flags, sequence = message._flags, self.sequence
            head = _HEAD.pack(MAGIC, VERSION, message.KIND, flags, self.session, sequence, time_ns, 0)[:_SIGNED]
        except (struct.error, ValueError) as error:
            raise DatagramError("range", f"{type(message).__name__} can't be sent: {error}") from error
        payload = b"".join([body, *(vector.astype("<f8").tobytes() for vector in numbers)])
        self.sequence = (self.sequence + 1) & 0xFFFFFFFF
        return b"".join([head, struct.pack("<I", zlib.crc32(payload, zlib.crc32(head))), payload])


def size_of(kind: type[Message]) -> int:
    """Return how many bytes a datagram of a kind has."""
    return _HEAD.size + kind.BODY.size + 8 * kind.NUMBERS


def decode(data: bytes) -> tuple[Header, Message]:
    """Return what a datagram says.

    Raises:
        DatagramError: when it is none; its ``reason`` is ``"length"``, ``"magic"``, ``"version"``, ``"kind"``,
            ``"checksum"`` or ``"range"``.
    """
    if len(data) < _HEAD.size:
        raise DatagramError("length", f"{len(data)} bytes are less than a header")
    magic, version, number, flags, session, sequence, time_ns, checksum = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise DatagramError("magic", "not one of imitarm's")
    if version != VERSION:
        raise DatagramError(
            "version", f"of version {version}, this imitarm speaks {VERSION}; use the same on both sides"
        )
    kind = KINDS.get(number)
    if kind is None:
        raise DatagramError("kind", f"of unknown kind {number}")
    if len(data) != size_of(kind):
        raise DatagramError("length", f"{len(data)} bytes where {size_of(kind)} are expected")
    if zlib.crc32(data[_HEAD.size :], zlib.crc32(data[:_SIGNED])) != checksum:
        raise DatagramError("checksum", "damaged on its way")
    body = kind.BODY.unpack_from(data, _HEAD.size)
    numbers = np.frombuffer(data, dtype="<f8", offset=_HEAD.size + kind.BODY.size).astype(float)
    return Header(number, flags, session, sequence, time_ns), kind._unpack(flags, body, numbers)
