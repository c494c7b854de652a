"""Skeletons over UDP: SkeletonSender sends the skeletons of a source, and UdpSource receives them."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from imitarm.capture.skeleton import HandState, Skeleton, SkeletonSource, Tracking, number_after_colon
from imitarm.transmission.datagram import Encoder, now_ns
from imitarm.transmission.datagram_filter import DatagramFilter
from imitarm.transmission.messages import SkeletonFrame
from imitarm.transmission.sockets import LOOPBACK, Address, connected, listening, try_to_send, wait_for, waiting

_LONGEST_WAIT = 60_000_000_000  # [ns] the longest that a datagram can state


class SkeletonSender:
    """Sends skeletons to one address, each in one datagram, without waiting for an answer.

    A lost datagram is not sent again, because the next skeleton follows about 1/30 s later.

    Args:
        address: host and port of the receiver.
        clock_ns: function that returns the current time, for the time stamps [ns].

    Attributes:
        sent: number of skeletons sent.
        failed: number of skeletons not sent because nobody listens or the operating system rejected them.

    Raises:
        InputError: when there is no such host.
    """

    def __init__(self, address: Address, *, clock_ns: Callable[[], int] = now_ns) -> None:
        self.sent = self.failed = 0
        self._clock_ns = clock_ns
        self._encoder = Encoder()
        self._socket = connected(address)

    def send(self, skeleton: Skeleton, exposed_ns: int | None = None) -> bool:
        """Send a skeleton; return whether it was sent.

        Args:
            skeleton: skeleton to send.
            exposed_ns: time of exposure, on the sender's clock [ns]; None: now.
        """
        now = self._clock_ns()
        waited = 0 if exposed_ns is None else min(max(now - exposed_ns, 0), _LONGEST_WAIT)
        gone = try_to_send(self._socket, self._encoder.encode(frame_of(skeleton, waited), now))
        self.sent += gone
        self.failed += not gone
        return gone

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def frame_of(skeleton: Skeleton, waited_ns: int = 0) -> SkeletonFrame:
    """Return the message for a skeleton; positions of lost joints are 0, because a datagram must not contain nan.

    Args:
        skeleton: skeleton to send.
        waited_ns: time from exposure to sending [ns].
    """
    seen = skeleton.tracking != Tracking.LOST
    positions = np.where(seen[:, None], skeleton.positions, 0.0)
    left, right = skeleton.hand_states
    return SkeletonFrame(skeleton.time, positions, skeleton.tracking, (left, right), skeleton.person, waited_ns)


class Arrival(NamedTuple):
    """Delays of the last received skeleton, and the time at which it was received.

    Attributes:
        waited: time between exposure and sending [s].
        queued: time between sending and receiving [s]. If the sender runs on another machine, the clocks of the two
            machines differ. The shortest time of the last one to two minutes is then subtracted.
        received_ns: time of receiving, on this machine's clock [ns].
    """

    waited: float
    queued: float
    received_ns: int


class UdpSource(SkeletonSource):
    """Live skeletons from a :class:`SkeletonSender`.

    A :class:`~imitarm.transmission.datagram_filter.DatagramFilter` drops and counts datagrams that are late, damaged,
    invalid, or from another sender. A sender that is killed and started again is accepted after half a second of
    silence. The time stamps of a restarted sender are shifted so that they keep increasing after the restart. While the
    sender is silent, every retargeter stops its robot. When skeletons arrive again, the robot follows the person again.

    Args:
        port: port to listen on; 0: any free port.
        host: address of this machine to listen on; by default, only programs on this machine can send skeletons.
        clock_ns: function that returns the time of receiving [ns].

    Attributes:
        datagram_filter: filter that selects the datagrams to use, and counts the dropped datagrams.
        arrival: delays of the last skeleton; None before the first skeleton.

    Raises:
        InputError: when another program uses the port, or the address does not belong to this machine.
    """

    argument = "PORT"
    description = "skeletons from 'imitarm capture --send'; udp:ADDRESS:PORT also accepts skeletons from other machines"
    live = True

    def __init__(self, port: int, host: str = LOOPBACK, *, clock_ns: Callable[[], int] = now_ns) -> None:
        self._socket = listening((host, port))
        self.address: Address = self._socket.getsockname()
        self.name = f"udp:{port}" if host == LOOPBACK else f"udp:{host}:{port}"
        self.datagram_filter = DatagramFilter()
        self.arrival: Arrival | None = None
        self._clock_ns = clock_ns
        self._sessions, self._shift = 1, 0.0
        self._time = 0.0  # of the last skeleton
        self._closed = False

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> UdpSource:
        """Listen for skeletons; ``argument`` is ``PORT`` or ``ADDRESS:PORT``.

        Raises:
            InputError: when the port is not a number or is used by another program, or the address does not belong to
                this machine.
        """
        host, colon, port = argument.rpartition(":")
        number = number_after_colon("udp", cls.argument, port, 65535)
        return cls(number, host) if colon else cls(number)

    @property
    def over(self) -> bool:
        """Whether the source was closed; a stream does not end by itself."""
        return self._closed

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._closed = True
        self._socket.close()

    def flush(self) -> None:
        """Discard all skeletons that have already arrived, so that :meth:`read` returns a newer skeleton."""
        for _ in waiting(self._socket):
            pass

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None if none arrives within ``timeout`` seconds, or if the source was closed."""
        until = clock.monotonic() + timeout
        while not self._closed:
            for data, address in waiting(self._socket):
                now = self._clock_ns()
                came = self.datagram_filter.receive(data, now, SkeletonFrame)
                if came is not None:
                    here = address[0].startswith("127.")  # sender and receiver have one clock
                    queued = 1e-9 * (now - came[0].time_ns) if here else self.datagram_filter.age
                    return self._skeleton(came[1], now, queued)
            left = until - clock.monotonic()
            if left <= 0.0:
                break
            wait_for(self._socket, left)
        return None

    def _skeleton(self, frame: SkeletonFrame, now: int, queued: float) -> Skeleton:
        """Return the received skeleton, with a time that keeps increasing when the sender is restarted."""
        if self.datagram_filter.n_sessions != self._sessions:
            self._sessions = self.datagram_filter.n_sessions
            silent = 0.0 if self.arrival is None else 1e-9 * (now - self.arrival.received_ns)
            self._shift = self._time + silent - frame.time
        self.arrival = Arrival(1e-9 * frame.waited_ns, queued, now)
        self._time = frame.time + self._shift
        left, right = frame.hands
        return Skeleton(self._time, frame.positions, frame.tracking, (HandState(left), HandState(right)), frame.person)
