"""Gate: lets the newest datagrams of one sender in and counts whatever else comes (METHODS A.9)."""

from __future__ import annotations

from collections import Counter, deque
from typing import TypeVar

from imitarm.datagram import Header, decode
from imitarm.messages import DatagramError, JointCommand, JointState, SkeletonFrame

Kind = TypeVar("Kind", SkeletonFrame, JointCommand, JointState)

REASONS = {
    "length": "not as long as it must be",
    "magic": "not ours",
    "version": "of another version",
    "kind": "of another kind",
    "checksum": "damaged",
    "range": "a number that can't be",
    "duplicate": "had come already",
    "order": "older than one that had come already",
    "stale": "too long on its way",
    "clock": "sent later than it was received",
    "foreign": "another sender while one is at work",
    "retired": "of a sender that was replaced",
}
"""Why a datagram is dropped, by the word under which it is counted."""

_HALF = 2**31
_MASK = 2**32 - 1
_WINDOW = 60_000_000_000  # [ns] quicker than two clocks drift apart by what matters, longer than a queue lasts
_BELIEVED_AFTER = 500_000_000  # [ns] of silence
_RETIRED = 64  # sessions remembered


class Gate:
    """Admits datagrams of one session, each later than the one before and not older than ``max_age``.

    *Order.* A sequence number counts as later when it is ahead by less than half of all numbers, so it may wrap around.

    *Age.* The clocks of two machines have nothing to do with each other. But the difference between receiving and
    sending is their offset plus the time on the way, and the least of it, over the last one to two minutes, is the
    offset plus the shortest way. What a datagram's difference exceeds that by is how long it was queued: its age.

    *Sessions.* A sender that is restarted begins a new session, which is admitted once the one before has been silent
    for ``patience``; until then it is foreign. So two senders never mix, and a session that was replaced never comes
    back, be it late or replayed.

    Args:
        max_age: [s].
        patience: silence after which another session may begin [s]; infinite: only :meth:`begin` changes it.

    Attributes:
        session: that is admitted; None: whichever comes first.
        sessions: how many there have been.
        age: of the datagram that was admitted last [s].
        admitted: how many were.
        dropped: how many were not, by the words of :data:`REASONS`.
    """

    def __init__(self, *, max_age: float = 0.1, patience: float = 0.5) -> None:
        self._max_age, self._patience = 1e9 * max_age, 1e9 * patience
        self.session: int | None = None
        self.sessions = self.admitted = 0
        self.age = 0.0
        self.dropped: Counter[str] = Counter()
        self._retired: deque[int] = deque(maxlen=_RETIRED)
        self._last: int | None = None
        self._heard = self._window = 0
        self._least = [0, 0]  # of receiving less sending, in this window of time and the one before [ns]

    def open(self, data: bytes, now_ns: int, kind: type[Kind]) -> tuple[Header, Kind] | None:
        """Return what a datagram says, or None when it is dropped.

        Args:
            data: as received.
            now_ns: when, on the receiver's clock [ns].
            kind: that is wanted.
        """
        try:
            header, message = decode(data)
        except DatagramError as error:
            self.dropped[error.reason] += 1
            return None
        if not isinstance(message, kind):
            self.dropped["kind"] += 1
            return None
        return (header, message) if self.admit(header, now_ns) else None

    def admit(self, header: Header, now_ns: int) -> bool:
        """Return whether a datagram may come in, and remember it."""
        fault = self._fault(header, now_ns)
        if fault:
            self.dropped[fault] += 1
        else:
            self.admitted += 1
        return not fault

    def begin(self, session: int) -> None:
        """From now on admit this session and no other."""
        if self.session is not None and self.session != session:
            self._retired.append(self.session)
        self.session, self._last = session, None
        self.sessions += 1

    def _fault(self, header: Header, now: int) -> str:
        """Return why a datagram is to be dropped; empty when it is not."""
        difference = now - header.time_ns
        fault = self._unwanted(header, now) or self._untimely(header, difference, now)
        if fault:
            return fault
        if self._last is None:
            self._least, self._window = [difference, difference], now
        elif now - self._window > _WINDOW:
            self._least, self._window = [difference, self._least[0]], now
        self._last, self._heard = header.sequence, now
        self._least[0] = min(self._least[0], difference)
        age = difference - min(self._least)
        if age > self._max_age:
            return "stale"
        self.age = 1e-9 * age
        return ""

    def _unwanted(self, header: Header, now: int) -> str:
        """Return why this is not the sender to listen to; begins a session whose turn has come."""
        if header.session == self.session:
            return ""
        if header.session in self._retired:
            return "retired"
        if self.session is not None and now - self._heard <= self._patience:
            return "foreign"
        self.begin(header.session)
        return ""

    def _untimely(self, header: Header, difference: int, now: int) -> str:
        """Return why this does not come after the one before."""
        if self._last is None:
            return ""
        step = (header.sequence - self._last) & _MASK
        if step == 0 or step >= _HALF:
            return "order" if step else "duplicate"
        # or it would make all that come after it look late; but when nothing else comes, it is the clock that was wrong
        early = difference < min(self._least) - 10.0 * self._max_age
        return "clock" if early and now - self._heard <= _BELIEVED_AFTER else ""
