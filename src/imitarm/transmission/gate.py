"""Gate: lets the newest datagrams of one sender in and counts whatever else comes (METHODS A.9)."""

from __future__ import annotations

import math
from bisect import insort
from collections import Counter, deque
from dataclasses import dataclass
from typing import TypeVar

from imitarm.transmission.datagram import Header, decode
from imitarm.transmission.messages import DatagramError, JointCommand, JointState, SkeletonFrame

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
_FALSE = 4  # stamps that may be false at once, where no later one was sent before them
_KEPT = 16  # differences that are alone
_RETIRED = 64  # sessions remembered


@dataclass(slots=True)
class _Alone:
    """A difference that nothing has come near to, and what has spoken against it since."""

    difference: int
    stamp: int  # when it was sent, as it says
    agreed: bool  # whether enough had agreed on what was known before it came
    earlier: int = 0  # how many later ones were sent before it, as they say
    agreeing: int = 0  # how many were fresh by what was known before
    since: int = 0  # when the first of those came
    turned: bool = False  # it came in the window of time before this one


class Quickest:
    """Least difference of receiving and sending: two clocks' offset plus the shortest way.

    A difference is *alone* when it is lower by more than half of ``max_age`` than what is known, and no later one that
    was sent after it has come as near. It counts at once, so that nothing old is taken for fresh, but is not yet known:
    each such one is weighed by itself, and forgotten as a false stamp

    * when two later datagrams say that they were sent before it: a sender's clock never goes back; or
    * when for ``max_age`` three have come that are fresh by what at least three had agreed on before it came; unless
      more than four are alone: those are rather a queue that empties.

    So stamps that are early, each by itself, do not make what is fresh look old for long, nor a dozen of them what is
    old look fresh, unless three had agreed on a slower way: after that up to four that were quicker count for nothing
    when no two agree and the slow way goes on, true or false. Two stamps that are late can speak against a way that
    was quick once and never again.

    Args:
        max_age: [ns].
    """

    def __init__(self, max_age: float) -> None:
        self._max_age, self._near = max_age, 0.5 * max_age
        self._known = [math.inf, math.inf]  # least of all that are not alone, in this window of time and the last [ns]
        self._window = 0
        self._support = 0  # how many have come near to that
        self._alone: list[_Alone] = []  # all lower than that, the lowest first
        self._refused: tuple[int, int] | None = None  # the last one, when it was too early: difference and sending

    @property
    def least(self) -> float:
        """The least difference [ns]; infinite when nothing has come."""
        return min(*self._known, self._alone[0].difference if self._alone else math.inf)

    def too_early(self, difference: int, sent: int, now: int) -> bool:
        """Whether a stamp is early by more than ten times ``max_age``: believed only if the next one bears it out.

        Args:
            difference: of receiving and sending [ns].
            sent: by the sender's clock [ns].
            now: by the receiver's [ns].
        """
        refused, self._refused = self._refused, None
        # One that was sent before it shows that it was false, as a clock never goes back; its own copy shows nothing.
        if refused is not None and sent > refused[1]:
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
        known = min(self._known)
        usual = difference >= known - self._near
        self._doubt(sent, now, fresh=usual and difference <= known + self._max_age)
        if usual:
            self._support += difference <= known + self._near
            self._learn(difference)
        elif any(abs(difference - one.difference) <= self._near and sent > one.stamp for one in self._alone):
            self._support = 2
            self._learn(difference)
        else:
            insort(self._alone, _Alone(difference, sent, self._support >= _AGREED), key=lambda one: one.difference)
            del self._alone[_KEPT:]
        return difference - self.least

    def _learn(self, difference: int) -> None:
        """Let a difference be known, and with it each that it is near to."""
        self._known[0] = min(self._known[0], difference)
        while self._alone and self._alone[-1].difference >= min(self._known) - self._near:
            self._known[0] = min(self._known[0], self._alone.pop().difference)

    def _doubt(self, sent: int, now: int, *, fresh: bool) -> None:
        """Count what a datagram, fresh by what is known or not, says against those alone; forget the false ones."""
        few, left = len(self._alone) <= _FALSE, []
        for one in self._alone:
            one.earlier += sent < one.stamp
            if fresh and one.agreed:
                one.since = one.since if one.agreeing else now
                one.agreeing += 1
            outvoted = few and one.agreeing >= _AGREED and now - one.since >= self._max_age
            if one.earlier < _EARLIER and not outvoted:
                left.append(one)
        self._alone = left

    def _turn_window(self, now: int) -> None:
        """Forget what is older than two windows of time."""
        if self.least == math.inf:
            self._window = now
        elif now - self._window > _WINDOW:
            self._window = now
            self._known = [math.inf, self._known[0]]
            self._support = self._support if self._known[1] < math.inf else 0
            self._alone = [one for one in self._alone if not one.turned]
            for one in self._alone:
                one.turned = True


class Gate:
    """Admits datagrams of one session, each later than the one before and not older than ``max_age``.

    *Order.* A sequence number counts as later when it is ahead by less than half of all numbers, so it may wrap around.

    *Age.* The clocks of two machines have nothing to do with each other. But the difference between receiving and
    sending is their offset plus the time on the way, and the least of it, over the last one to two minutes, is the
    offset plus the shortest way. What a datagram's difference exceeds that by is how long it was queued: its age.
    A stamp that is early, by a fault or by malice, would make all others look late for as long; so a difference that
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
