from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.transmission.datagram import Encoder, Header
from imitarm.transmission.datagram_filter import DROP_REASONS, DatagramFilter
from imitarm.transmission.messages import JointCommand, SkeletonFrame
from wire_samples import MS, command, skeleton_frame

PERIOD = 10 * MS


def header(sequence, time, session=1):
    return Header(1, 0, session, sequence & 0xFFFFFFFF, time)


def test_in_order_everything_comes_in():
    datagrams = DatagramFilter()
    assert all(datagrams.accept(header(k, k * PERIOD), k * PERIOD + 5) for k in range(1000))
    assert datagrams.accepted == 1000 and not datagrams.dropped and datagrams.age == 0.0


@given(first=st.integers(0, 2**32 - 1), shuffled=st.permutations(range(12)), repeats=st.lists(st.integers(0, 11)))
def test_only_what_is_newer_comes_in_whatever_the_order_also_around_the_end_of_all_numbers(first, shuffled, repeats):
    datagrams, newest = DatagramFilter(), -1
    for k in [*shuffled, *repeats]:
        admitted = datagrams.accept(header(first + k, 0), 50 * MS)
        assert admitted == (k > newest)
        newest = max(newest, k)
    assert datagrams.accepted + datagrams.dropped["order"] + datagrams.dropped["duplicate"] == 12 + len(repeats)


@given(offset=st.integers(-(10**15), 10**15), seed=st.integers(0, 2**32 - 1))
def test_clocks_may_differ_by_anything_and_age_is_the_time_in_a_queue(offset, seed):
    rng, datagrams = np.random.default_rng(seed), DatagramFilter()
    start = 2 * 10**15
    datagrams.accept(header(0, start + offset), start + 2 * MS)  # the quickest: 2 ms on its way
    for k in range(1, 50):
        sent, queued = start + k * PERIOD, int(rng.integers(0, 200)) * MS
        admitted = datagrams.accept(header(k, sent + offset), sent + 2 * MS + queued)
        assert admitted == (queued <= 100 * MS)
        if admitted:
            assert abs(datagrams.age - 1e-9 * queued) < 1e-9


def test_the_quickest_is_found_though_the_first_was_slow():
    datagrams = DatagramFilter()
    datagrams.accept(header(0, 0), 80 * MS)  # 78 ms queued, which can't be known yet
    datagrams.accept(header(1, 100 * MS), 102 * MS)
    assert not datagrams.accept(header(2, 200 * MS), 310 * MS)
    assert datagrams.dropped == {"stale": 1}


def test_clocks_may_drift_apart_for_hours():
    """50 millionths: 180 ms an hour, more than the age that is allowed."""
    datagrams = DatagramFilter()
    for k in range(2 * 3600):
        sent = k * 1000 * MS
        assert datagrams.accept(header(k, sent), sent + sent // 20_000), k
    assert datagrams.age < 0.01


def test_a_time_in_the_future_does_not_make_the_others_look_late():
    datagrams = DatagramFilter()
    datagrams.accept(header(0, 1000 * MS), 1000 * MS)
    assert not datagrams.accept(header(1, 2**63), 1010 * MS)
    assert datagrams.accept(header(2, 1020 * MS), 1020 * MS)
    assert datagrams.dropped == {"clock": 1}


EARLY = st.one_of(st.integers(1, 60), st.integers(1, 1500), st.integers(1, 10**9))  # [ms]


COPY = st.one_of(st.none(), st.integers(0, 40))  # [ms] after the datagram


@given(
    period=st.integers(4, 33),
    at=st.integers(0, 40),
    early=EARLY,
    copy=COPY,
    way=st.integers(0, 50),
    seed=st.integers(0, 2**32 - 1),
)
def test_one_stamp_that_is_early_locks_nobody_out_for_longer_than_about_the_age_that_is_allowed(
    period, at, early, copy, way, seed
):
    """Be it the first of all or any later one, early by little or by centuries, delivered once or twice."""
    rng, begin = np.random.default_rng(seed), 10**12
    arrivals = []  # when, number, stamp
    for k in range(120):
        sent = begin + k * period * MS
        arrival = sent + (way + int(rng.integers(0, 30))) * MS
        arrivals.append((arrival, k, sent + early * MS if k == at else sent))
        if k == at and copy is not None:
            arrivals.append((arrival + copy * MS, k, sent + early * MS))
    refused = refused_numbers(arrivals)
    assert all(at < k and (k - at) * period <= 100 + 3 * period + 30 for k in refused - {at})


def refused_numbers(arrivals):
    """Which of the datagrams are refused though they are newer than all that came."""
    datagrams, refused, newest = DatagramFilter(), set(), -1
    for arrival, k, stamp in sorted(arrivals, key=lambda one: one[0]):
        if not datagrams.accept(header(k, stamp), arrival) and k > newest:
            refused.add(k)
        newest = max(newest, k)
    return refused


@pytest.mark.parametrize("early", [1200, 5000, 20_000])
def test_a_copy_does_not_bear_out_a_stamp_that_is_much_too_early(early):
    times = [(k, 10**12 + 33 * k * MS) for k in range(3600)]
    arrivals = [(time, k, time + early * MS if k == 50 else time) for k, time in times]
    arrivals.insert(51, arrivals[50])
    assert refused_numbers(arrivals) == {50}


@pytest.mark.parametrize("early", [(200, 400), (400, 200), (300, 200, 400), (1200, 1300, 2500), (1200, 2500, 3800)])
@pytest.mark.parametrize("period", [10, 33])
def test_stamps_that_are_early_each_in_its_own_way_are_forgotten_one_by_one(early, period):
    times = [(k, 10**12 + period * k * MS) for k in range(3600)]
    arrivals = [(time, k, time + (early[k - 50] if 50 <= k < 50 + len(early) else 0) * MS) for k, time in times]
    copies = [one for k in range(50, 50 + len(early)) for one in [arrivals[k]] * 2]
    behind = arrivals[50 : 50 + len(early)] * 2  # each copy after the last of them
    for false in (arrivals[50 : 50 + len(early)], copies, behind):
        datagrams, now = DatagramFilter(), 0
        for arrival, k, stamp in [*arrivals[:50], *false, *arrivals[50 + len(early) :]]:
            now = max(now, arrival)
            datagrams.accept(header(k, stamp), now)
        assert datagrams.accepted >= 3600 - len(early) - 4


@st.composite
def early_stamps(draw, *, first, least):
    """Up to four that don't bear each other out: the differences are more than 50 ms apart, queues included."""
    count = draw(st.integers(1, 4))
    steps = draw(st.lists(st.one_of(st.integers(81, 150), st.integers(81, 3000)), min_size=count, max_size=count))
    places = draw(st.lists(st.integers(first, 40), min_size=count, max_size=count, unique=True))
    early = draw(st.permutations((np.cumsum(steps) - 81 + least).tolist()))
    return dict(zip(places, early, strict=True))


def several_lock_nobody_out(stamps, period, copy, seed):
    rng, begin = np.random.default_rng(seed), 10**12
    arrivals = []
    for k in range(100):
        sent = begin + k * period * MS
        arrival, stamp = sent + (2 + int(rng.integers(0, 30))) * MS, sent + stamps.get(k, 0) * MS
        arrivals.append((arrival, k, stamp))
        if k in stamps and copy is not None:
            arrivals.append((arrival + copy * MS, k, stamp))
    for k in refused_numbers(arrivals) - set(stamps):
        at = max((at for at in stamps if at < k), default=k)
        assert at < k and (k - at) * period <= 100 + 3 * period + 30


@given(
    stamps=early_stamps(first=3, least=81),
    period=st.one_of(st.integers(4, 33), st.integers(34, 1000)),
    copy=COPY,
    seed=st.integers(0, 2**32 - 1),
)
def test_nor_do_several_that_do_not_bear_each_other_out(stamps, period, copy, seed):
    """Wherever they are after the first three datagrams, close to each other or not, each delivered once or twice."""
    several_lock_nobody_out(stamps, period, copy, seed)


@given(
    stamps=early_stamps(first=0, least=250),
    period=st.integers(4, 33),
    copy=COPY,
    seed=st.integers(0, 2**32 - 1),
)
def test_nor_do_the_first_when_the_next_were_sent_before_them(stamps, period, copy, seed):
    several_lock_nobody_out(stamps, period, copy, seed)


@given(at=st.integers(3, 20), early=EARLY, period=st.integers(100, 1000))
def test_nor_where_frames_are_few(at, early, period):
    datagrams = DatagramFilter()
    sent = [10**12 + k * period * MS for k in range(40)]
    admitted = [datagrams.accept(header(k, s + early * MS if k == at else s), s + 5 * MS) for k, s in enumerate(sent)]
    assert all(admitted[:at]) and all(admitted[at + 3 :])


QUEUES = st.lists(st.tuples(st.integers(1, 30), st.integers(0, 600)), min_size=1, max_size=6)


@given(
    at=st.integers(0, 60),
    stamp=st.one_of(st.integers(-2000, 2000), st.integers(-900_000, 10**12)),
    queues=QUEUES,
)
def test_no_stamp_lets_in_what_is_too_old(at, stamp, queues):
    """Whatever one datagram says of its time, early or late: of the others only those come in that are fresh."""
    only_fresh_ones_come_in({at: stamp}, queues)


@given(
    stamps=st.dictionaries(st.integers(0, 100), st.one_of(st.integers(1, 2000), st.integers(1, 10**12)), max_size=12),
    queues=QUEUES,
    twice=st.booleans(),
)
def test_nor_do_many_stamps_that_are_early(stamps, queues, twice):
    """Up to twelve, whether they bear each other out or not."""
    only_fresh_ones_come_in(stamps, queues, twice=twice)


def only_fresh_ones_come_in(stamps, queues, *, twice=False):
    datagrams = DatagramFilter()
    waits = [0] + [wait for length, wait in queues for _ in range(length)]
    for k, wait in enumerate(waits):
        sent = 10**12 + 2 * k * PERIOD
        if k in stamps:
            for _ in range(1 + twice):
                datagrams.accept(header(2 * k, sent + stamps[k] * MS), sent + 2 * MS + wait * MS)
        if datagrams.accept(header(2 * k + 1, sent), sent + 2 * MS + wait * MS):
            assert wait <= 100
            assert datagrams.age >= 1e-3 * wait - 1e-9  # never younger than it is


def test_a_queue_that_empties_by_large_steps_is_not_a_row_of_false_stamps():
    """It fills at once, and for long; that the way had been quick once is remembered."""
    datagrams = DatagramFilter()
    waits = [900, 900, 900, *range(800, -1, -100), *[880] * 100]
    admitted = [datagrams.accept(header(k, k * 40 * MS), k * 40 * MS + wait * MS) for k, wait in enumerate(waits)]
    assert all(admitted[:12]) and not any(admitted[12:])


def test_a_way_that_was_quick_twice_is_not_forgotten():
    """All are late after it, without an end: that is a queue, not a clock that was wrong."""
    datagrams = DatagramFilter()
    waits = [80, 80, 80, 2, 2] + [250] * 1000
    admitted = [datagrams.accept(header(k, k * PERIOD), k * PERIOD + wait * MS) for k, wait in enumerate(waits)]
    assert all(admitted[:5]) and not any(admitted[5:])


@given(period=st.integers(4, 3000))
def test_a_clock_that_was_wrong_at_first_is_corrected_by_two_that_agree(period):
    """The first datagram had waited for ages: the offset that was concluded from it locks nobody out."""
    datagrams, begin = DatagramFilter(), 20_000
    datagrams.accept(header(0, 0), begin * MS)
    times = [(begin + k * period) * MS for k in range(1, 100)]
    admitted = [datagrams.accept(header(k, time), time) for k, time in enumerate(times, 1)]
    assert not admitted[0] and all(admitted[1:])
    assert datagrams.age == 0.0 and datagrams.dropped == {"clock": 1}


def test_two_senders_are_never_mixed():
    datagrams = DatagramFilter()
    admitted = []
    for k in range(400):
        for session in (1, 2):
            if datagrams.accept(header(k, k * PERIOD, session), k * PERIOD):
                admitted.append(session)
    assert set(admitted) == {1} and datagrams.dropped == {"foreign": 400}


def test_a_sender_that_was_started_again_is_let_in_after_half_a_second_of_silence_and_the_old_one_never_again():
    datagrams = DatagramFilter()
    for k in range(10):
        datagrams.accept(header(k + 5000, k * PERIOD, 1), k * PERIOD)
    begin = 9 * PERIOD
    assert not datagrams.accept(header(0, 0, 2), begin + 400 * MS)
    assert datagrams.accept(header(1, 110 * MS, 2), begin + 510 * MS)  # its clock and its numbers begin anew
    assert datagrams.n_sessions == 2 and datagrams.session == 2
    for late in (begin + 520 * MS, begin + 5000 * MS):
        assert not datagrams.accept(header(6000, late, 1), late)  # a late or a replayed one of the first
    assert datagrams.dropped == {"foreign": 1, "retired": 2}


def test_without_patience_only_begin_changes_the_session():
    datagrams = DatagramFilter(session_timeout=np.inf)
    datagrams.start_session(7)
    assert not datagrams.accept(header(0, 0, 8), 10**15)
    assert datagrams.accept(header(0, 0, 7), 10**15)


@given(data=st.binary(max_size=900))
def test_bytes_that_are_nothing_are_counted_and_change_nothing(data):
    datagrams = DatagramFilter()
    assert datagrams.receive(data, 0, SkeletonFrame) is None
    assert sum(datagrams.dropped.values()) == 1 and set(datagrams.dropped) <= set(DROP_REASONS)
    assert datagrams.session is None


def test_another_kind_is_not_wanted():
    datagrams = DatagramFilter()
    encoder = Encoder(3)
    assert datagrams.receive(encoder.encode(command(), 0), 0, SkeletonFrame) is None
    opened = datagrams.receive(encoder.encode(skeleton_frame(), 0), 0, SkeletonFrame)
    assert opened is not None and datagrams.dropped == {"kind": 1}
    assert datagrams.receive(encoder.encode(command(), 0), 0, JointCommand) is not None


@pytest.mark.parametrize("name", ["max_age", "session_timeout"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, "1 s", None])
def test_a_time_that_is_none_is_refused(name, value):
    with pytest.raises(InputError, match=f"DatagramFilter: {name}"):
        DatagramFilter(**{name: value})
