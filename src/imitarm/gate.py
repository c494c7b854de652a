"""Gate: lets the newest datagrams of one sender in and counts whatever else comes (METHODS A.9)."""

from __future__ import annotations

import math
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
_AGREED = 3  # datagrams that agree on the quickest way
_EARLIER = 2  # datagrams that show that a stamp was false
_RETIRED = 64  # sessions remembered


class Quickest:
    """Least difference of receiving and sending: two clocks' offset plus the shortest way.

    A difference is *alone* when it is lower by more than half of ``max_age`` than all before it, and none has come as
    near since. It counts at once, so that nothing old is taken for fresh, and is forgotten as a false stamp

    * when two later datagrams say that they were sent before it: a sender's clock never goes back; or
    * when for ``max_age`` three have come that are fresh by what at least three had agreed on before.

    So it takes more than one false stamp to make old datagrams look fresh, or fresh ones look old for long.

    Args:
        max_age: [ns].
    """

    def __init__(self, max_age: float) -> None:
        self._max_age, self._near = max_age, 0.5 * max_age
        self._least = [math.inf, math.inf]  # in this window of time and the one before [ns]
        self._window = 0
        self._support = 0  # how many have come near to the least
        self._before, self._before_support = self._least, 0  # what was known before the one that is alone
        self._stamp = self._since = self._earlier = self._agreeing = 0  # of that one, and what spoke against it since
        self._others = math.inf  # least of those since
        self._refused: tuple[int, int] | None = None  # the last one, when it was too early: difference and sending

    @property
    def least(self) -> float:
        """The least difference [ns]; infinite when nothing has come."""
        return min(self._least)

    def too_early(self, difference: int, sent: int, now: int) -> bool:
        """Whether a stamp is early by more than ten times ``max_age``: believed only if the next one bears it out.

        Args:
            difference: of receiving and sending [ns].
            sent: by the sender's clock [ns].
            now: by the receiver's [ns].
        """
        refused, self._refused = self._refused, None
        if refused is not None and sent >= refused[1]:  # else that one was false: a clock never goes back
            self.age(*refused, now)
        early = difference < self.least - 10.0 * self._max_age
        if early:
            self._refused = difference, sent
        return early

    def age(self, difference: int, sent: int, now: int) -> float:
        """Note a datagram and return how long it was queued [ns].

        Args:
            difference: of receiving and sending [ns].
            sent: by the sender's clock [ns].
            now: by the receiver's [ns].
        """
        self._turn_window(now)
        if difference < self.least - self._near:
            self._before, self._before_support = list(self._least), self._support
            self._support, self._stamp = 1, sent
            self._since = self._earlier = self._agreeing = 0
            self._others = math.inf
        elif difference <= self.least + self._near:
            self._support += 1
        elif self._support == 1:
            self._doubt(difference, sent, now)
        self._least[0] = min(self._least[0], difference)
        return difference - self.least

    def _turn_window(self, now: int) -> None:
        """Forget what is older than two windows of time."""
        if self.least == math.inf:
            self._window = now
        elif now - self._window > _WINDOW:
            self._window = now
            self._least, self._before = [math.inf, self._least[0]], [math.inf, self._before[0]]

    def _doubt(self, difference: int, sent: int, now: int) -> None:
        """Count what speaks against the one that is alone, and forget that one when it is enough."""
        self._earlier += sent < self._stamp
        self._others = min(self._others, difference)
        if difference <= min(self._before) + self._max_age and self._before_support >= _AGREED:
            self._since = self._since or now
            self._agreeing += 1
        agreed = self._agreeing >= _AGREED and now - self._since >= self._max_age
        if self._earlier >= _EARLIER or agreed:
            self._least = [min(self._before[0], self._others), self._before[1]]
            self._support = max(self._before_support, _AGREED)


class Gate:
    """Admits datagrams of one session, each later than the one before and not older than ``max_age``.

    *Order.* A sequence number counts as later when it is ahead by less than half of all numbers, so it may wrap around.

    *Age.* The clocks of two machines have nothing to do with each other. But the difference between receiving and
    sending is their offset plus the time on the way, and the least of it, over the last one to two minutes, is the
    offset plus the shortest way. What a datagram's difference exceeds that by is how long it was queued: its age.
    One stamp that is early, by a fault or by malice, would make all others look late for as long; so a difference that
    nothing else comes near is forgotten after about ``max_age`` (:class:`Quickest`).

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
        self._heard = 0
        self._quickest = Quickest(self._max_age)

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
            self._quickest = Quickest(self._max_age)
        self._last, self._heard = header.sequence, now
        age = self._quickest.age(difference, header.time_ns, now)
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
        return "clock" if self._quickest.too_early(difference, header.time_ns, now) else ""
