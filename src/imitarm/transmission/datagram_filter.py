"""DatagramFilter: accepts new, recent datagrams of one sender and counts the rejected ones by reason.

docs/transmission.md, "Which datagrams are accepted", states the rules and their limits.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import Counter, deque
from dataclasses import dataclass
from typing import TypeVar

from imitarm.transmission.datagram import Header, decode
from imitarm.transmission.messages import DatagramError, JointCommand, JointState, SkeletonFrame
from imitarm.validation import finite_number

Kind = TypeVar("Kind", SkeletonFrame, JointCommand, JointState)

DROP_REASONS = {
    "length": "wrong length",
    "magic": "not a datagram of imitarm",
    "version": "of another version of the datagram format",
    "kind": "not the expected type of message",
    "checksum": "damaged",
    "range": "with a value that is out of range",
    "duplicate": "already received",
    "order": "older than a datagram that was already received",
    "stale": "delayed too long",
    "clock": "time stamp in the future",
    "foreign": "from a second sender, while the first is still active",
    "retired": "from a sender that has been replaced by another",
}
"""Reasons for dropping a datagram: the keys of the counters of dropped datagrams, and their meanings."""

_HALF = 2**31
_MASK = 2**32 - 1
_WINDOW = 60_000_000_000  # [ns] short enough for clock drift to stay small, longer than a queue lasts
_CONSENSUS = 3  # samples near the minimum that make it trusted
_CONTRADICTIONS = 2  # later datagrams with earlier time stamps that prove a time stamp false
_MAX_REJECTED = 4  # unconfirmed samples that may be rejected at once; more are a queue that empties
_MAX_UNCONFIRMED = 16
_MAX_RETIRED = 64  # replaced sessions that are remembered


@dataclass(slots=True)
class _Unconfirmed:
    """An unconfirmed sample (see :class:`ClockOffsetEstimator`), with the evidence against it."""

    offset: int
    sent: int  # time stamp of its datagram [ns]
    against_consensus: bool  # whether the confirmed minimum was trusted when this one arrived
    contradictions: int = 0  # later datagrams with an earlier time stamp
    fresh: int = 0  # later datagrams that are fresh by the confirmed minimum
    fresh_since: int = 0  # time at which the first of those arrived [ns]
    old_window: bool = False  # it arrived in the previous time window


class ClockOffsetEstimator:
    r"""Estimates the offset between two clocks from the time stamps of datagrams.

    A datagram that is sent at :math:`t_s` on the sender's clock and received at :math:`t_r` on the receiver's clock
    gives the sample :math:`t_r - t_s`. The sample is the clock offset plus the travel time. The minimum of the samples
    over the last one to two minutes is therefore the clock offset plus the shortest travel time. The difference between
    a datagram's sample and this minimum is the delay of the datagram.

    One false time stamp in the future would lower the minimum and make all other datagrams look delayed. Therefore, a
    sample more than ``max_age / 2`` below the confirmed minimum is at first *unconfirmed*. The sample becomes confirmed
    when a later datagram gives a similar sample. Even an unconfirmed sample lowers the minimum at once, so that no
    delayed datagram is accepted as recent.

    An unconfirmed sample is rejected as a false time stamp in two cases:

    * Two datagrams that arrive later have earlier time stamps than the sample. Then the sample must be false, because a
      sender's clock never goes back.
    * The datagrams before and after the sample agree with the confirmed minimum. Three earlier datagrams gave samples
      near this minimum. Three later datagrams, which arrive over a period of at least ``max_age``, have a delay of at
      most ``max_age`` relative to this minimum. This case applies only while at most four samples are unconfirmed. With
      more unconfirmed samples, it is likely that the other datagrams were delayed in a queue.

    Args:
        max_age: longest accepted delay [ns].
    """

    def __init__(self, max_age: float) -> None:
        self._max_age, self._tolerance = max_age, 0.5 * max_age
        self._confirmed = [math.inf, math.inf]  # minimum of this time window and of the previous one [ns]
        self._window_start = 0
        self._support = 0  # samples near the confirmed minimum
        self._unconfirmed: list[_Unconfirmed] = []  # lowest first
        self._refused: tuple[int, int] | None = None  # offset and time stamp of the last one, if too_early refused it

    @property
    def minimum(self) -> float:
        """The smallest sample [ns], confirmed or not; infinite before the first sample."""
        return min(*self._confirmed, self._unconfirmed[0].offset if self._unconfirmed else math.inf)

    def too_early(self, offset: int, sent: int, now: int) -> bool:
        """Return whether a time stamp lies more than ``10 * max_age`` in the future.

        The sample of such a datagram is used only if the time stamp of the next datagram is later still.

        Args:
            offset: time of receiving minus time stamp [ns].
            sent: time stamp, on the sender's clock [ns].
            now: time of receiving, on the receiver's clock [ns].
        """
        refused, self._refused = self._refused, None
        # an earlier time stamp proves the refused one false, because a clock never goes back; its copy proves nothing
        if refused is not None and sent > refused[1]:
            self.delay(*refused, now)
        early = offset < self.minimum - 10.0 * self._max_age
        if early:
            self._refused = offset, sent
        return early

    def delay(self, offset: int, sent: int, now: int) -> float:
        """Add a sample, and return the delay of its datagram [ns].

        Args:
            offset: time of receiving minus time stamp [ns].
            sent: time stamp, on the sender's clock [ns].
            now: time of receiving, on the receiver's clock [ns].
        """
        self._forget_old_windows(now)
        confirmed = min(self._confirmed)
        usual = offset >= confirmed - self._tolerance
        self._reject_false(sent, now, fresh=usual and offset <= confirmed + self._max_age)
        if usual:
            self._support += offset <= confirmed + self._tolerance
            self._confirm(offset)
        elif any(abs(offset - one.offset) <= self._tolerance and sent > one.sent for one in self._unconfirmed):
            self._support = 2
            self._confirm(offset)
        else:
            sample = _Unconfirmed(offset, sent, self._support >= _CONSENSUS)
            insort(self._unconfirmed, sample, key=lambda one: one.offset)
            del self._unconfirmed[_MAX_UNCONFIRMED:]
        return offset - self.minimum

    def _confirm(self, offset: int) -> None:
        """Confirm a sample and all unconfirmed samples near it."""
        self._confirmed[0] = min(self._confirmed[0], offset)
        while self._unconfirmed and self._unconfirmed[-1].offset >= min(self._confirmed) - self._tolerance:
            self._confirmed[0] = min(self._confirmed[0], self._unconfirmed.pop().offset)

    def _reject_false(self, sent: int, now: int, *, fresh: bool) -> None:
        """Count a datagram as evidence against the unconfirmed samples, and drop the samples that are proved false."""
        few, kept = len(self._unconfirmed) <= _MAX_REJECTED, []
        for one in self._unconfirmed:
            one.contradictions += sent < one.sent
            if fresh and one.against_consensus:
                one.fresh_since = one.fresh_since if one.fresh else now
                one.fresh += 1
            outvoted = few and one.fresh >= _CONSENSUS and now - one.fresh_since >= self._max_age
            if one.contradictions < _CONTRADICTIONS and not outvoted:
                kept.append(one)
        self._unconfirmed = kept

    def _forget_old_windows(self, now: int) -> None:
        """Drop samples older than two time windows."""
        if self.minimum == math.inf:
            self._window_start = now
        elif now - self._window_start > _WINDOW:
            self._window_start = now
            self._confirmed = [math.inf, self._confirmed[0]]
            self._support = self._support if self._confirmed[1] < math.inf else 0
            self._unconfirmed = [one for one in self._unconfirmed if not one.old_window]
            for one in self._unconfirmed:
                one.old_window = True


class DatagramFilter:
    """Accepts the datagrams of one session, each newer than the previous one and delayed by at most ``max_age``.

    *Order.* A sequence number counts as newer if it is ahead of the previous one by less than half of the number range.
    Therefore, sequence numbers may start again at 0 after the largest number.

    *Delay.* The clocks of two machines are not synchronized. The delay of a datagram is therefore measured relative to
    the fastest datagram of the last one to two minutes (:class:`ClockOffsetEstimator`).

    *Sessions.* A sender that restarts begins a new session. The new session is accepted when the previous session has
    been silent for ``session_timeout``. Therefore, the datagrams of two senders are never mixed. A session that was
    replaced is never accepted again.

    Args:
        max_age: longest accepted delay [s].
        session_timeout: duration of silence after which another session is accepted [s]; infinite: only
            :meth:`start_session` changes the session.

    Attributes:
        session: number of the accepted session; None: no datagram has arrived yet, and the first session will be
            accepted.
        n_sessions: number of sessions accepted so far.
        age: delay of the last accepted datagram [s].
        accepted: number of accepted datagrams.
        dropped: number of dropped datagrams for each reason; the reasons are the keys of :data:`DROP_REASONS`.

    Raises:
        InputError: when ``max_age`` or ``session_timeout`` is not positive.
    """

    def __init__(self, *, max_age: float = 0.1, session_timeout: float = 0.5) -> None:
        self._max_age = 1e9 * finite_number(max_age, "DatagramFilter: max_age", "s", above=0.0)
        if session_timeout != math.inf:
            session_timeout = finite_number(session_timeout, "DatagramFilter: session_timeout", "s", above=0.0)
        self._session_timeout = 1e9 * session_timeout
        self.session: int | None = None
        self.n_sessions = self.accepted = 0
        self.age = 0.0
        self.dropped: Counter[str] = Counter()
        self._retired: deque[int] = deque(maxlen=_MAX_RETIRED)
        self._last_sequence: int | None = None
        self._last_received = 0
        self._clock_offset = ClockOffsetEstimator(self._max_age)

    def receive(self, data: bytes, now_ns: int, kind: type[Kind]) -> tuple[Header, Kind] | None:
        """Decode and check a datagram; return its header and its message, or None if it is dropped.

        Args:
            data: bytes of the datagram as received.
            now_ns: time of receiving, on the receiver's clock [ns].
            kind: expected message type.
        """
        try:
            header, message = decode(data)
        except DatagramError as error:
            self.dropped[error.reason] += 1
            return None
        if not isinstance(message, kind):
            self.dropped["kind"] += 1
            return None
        return (header, message) if self.accept(header, now_ns) else None

    def accept(self, header: Header, now_ns: int) -> bool:
        """Return whether a decoded datagram is accepted, and count it as accepted or dropped.

        Args:
            header: header of the datagram.
            now_ns: time of receiving, on the receiver's clock [ns].
        """
        reason = self._reason_to_drop(header, now_ns)
        if reason:
            self.dropped[reason] += 1
        else:
            self.accepted += 1
        return not reason

    def start_session(self, session: int) -> None:
        """Accept only this session from now on."""
        if self.session is not None and self.session != session:
            self._retired.append(self.session)
        self.session, self._last_sequence = session, None
        self.n_sessions += 1

    def _reason_to_drop(self, header: Header, now: int) -> str:
        """Return why a datagram is dropped; empty if it is accepted."""
        offset = now - header.time_ns
        reason = self._wrong_session(header, now) or self._wrong_order(header, offset, now)
        if reason:
            return reason
        if self._last_sequence is None:
            self._clock_offset = ClockOffsetEstimator(self._max_age)
        self._last_sequence, self._last_received = header.sequence, now
        delay = self._clock_offset.delay(offset, header.time_ns, now)
        if delay > self._max_age:
            return "stale"
        self.age = 1e-9 * delay
        return ""

    def _wrong_session(self, header: Header, now: int) -> str:
        """Return why the datagram's session is not accepted; start the session if the previous one has timed out."""
        if header.session == self.session:
            return ""
        if header.session in self._retired:
            return "retired"
        if self.session is not None and now - self._last_received <= self._session_timeout:
            return "foreign"
        self.start_session(header.session)
        return ""

    def _wrong_order(self, header: Header, offset: int, now: int) -> str:
        """Return the reason why the datagram cannot follow the last accepted datagram; an empty text if it can."""
        if self._last_sequence is None:
            return ""
        step = (header.sequence - self._last_sequence) & _MASK
        if step == 0 or step >= _HALF:
            return "order" if step else "duplicate"
        return "clock" if self._clock_offset.too_early(offset, header.time_ns, now) else ""
