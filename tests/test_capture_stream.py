from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.capture.skeleton import JOINTS, Skeleton
from imitarm.capture.stream import SkeletonSender, UdpSource, frame_of
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError
from imitarm.transmission.datagram import Encoder, decode
from recording_samples import same, skeletons
from wire_samples import MS, Clock, command, skeleton_frame

PERIOD = 33 * MS


class Link:
    """A sender and a source on loopback, with a time that is set by hand."""

    def __init__(self):
        self.clock = Clock()
        self.source = UdpSource(0, clock_ns=self.clock)
        self.sender = self.another()

    def another(self):
        return SkeletonSender(self.source.address, clock_ns=self.clock)

    def send_raw(self, data):
        self.sender._socket.send(data)

    def pass_on(self, skeleton, after=PERIOD, **options):
        self.clock.ns += after
        self.sender.send(skeleton, **options)
        return self.source.read(0.0)


@pytest.fixture
def link():
    link = Link()
    with link.source:
        yield link
        link.sender.close()


def test_what_comes_out_is_what_went_in_to_the_last_bit(link):
    for skeleton in list(SyntheticSource.from_seed(4))[:60]:
        assert same(link.pass_on(skeleton), skeleton)
    assert link.sender.sent == 60 and link.sender.failed == 0 and not link.source.datagram_filter.dropped


@given(seed=st.integers(0, 2**32 - 1), person=st.integers(0, 2**64 - 1))
def test_any_skeleton_survives_the_wire(seed, person):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-25, 25, (len(JOINTS), 3)) * rng.choice([1.0, np.nan, np.inf, 0.0], (len(JOINTS), 1))
    hands = (int(rng.integers(0, 5)), int(rng.integers(0, 5)))
    skeleton = Skeleton(float(rng.normal(0, 1e6)), positions, rng.integers(0, 3, len(JOINTS)), hands, person)
    frame = decode(Encoder(1).encode(frame_of(skeleton), 0))[1]
    assert same(Skeleton(frame.time, frame.positions, frame.tracking, frame.hands, frame.person), skeleton)


def test_several_persons_come_one_after_the_other(link):
    one, two = skeletons(1, person=1)[0], skeletons(1, person=2, away=0.8)[0]
    for skeleton in (one, two):
        link.sender.send(skeleton)
    assert [link.source.read(0.0).person for _ in range(2)] == [1, 2]
    assert link.source.read(0.0) is None and not link.source.over


def test_what_is_no_skeleton_is_dropped_and_what_follows_is_read_at_once(link):
    for data in (
        b"",
        b"hello",
        bytes(684),
        Encoder(1).encode(command(), 0),
        Encoder(1).encode(skeleton_frame(), 0)[:-1],
    ):
        link.send_raw(data)
    assert same(link.pass_on(skeletons(1)[0]), skeletons(1)[0])
    assert sum(link.source.datagram_filter.dropped.values()) == 5


@given(junk=st.lists(st.binary(max_size=800), max_size=20))
def test_hostile_bytes_give_no_skeleton(junk):
    link = Link()
    with link.source, link.sender:
        for data in junk:
            link.send_raw(data)
        assert link.source.read(0.0) is None
        assert sum(link.source.datagram_filter.dropped.values()) == len(junk)


def test_frames_that_waited_too_long_are_dropped(link):
    frames = skeletons(12)
    assert link.pass_on(frames[0]) is not None
    for frame in frames[1:11]:
        link.clock.ns += 10 * MS
        link.sender.send(frame)
    link.clock.ns += 60 * MS  # nobody has read for a while: the first of them are older than 100 ms by now
    read = []
    while (skeleton := link.source.read(0.0)) is not None:
        read.append(skeleton)
    assert len(read) == 5 and same(read[-1], frames[10])
    assert link.source.datagram_filter.dropped == {"stale": 5}


def test_what_came_before_somebody_listened_can_be_forgotten(link):
    for skeleton in skeletons(5):
        link.sender.send(skeleton)
    link.clock.ns += 10_000 * MS
    link.source.flush()
    assert link.source.read(0.0) is None
    assert same(link.pass_on(skeletons(1)[0]), skeletons(1)[0])


def test_how_it_came_is_told(link):
    skeleton = skeletons(1)[0]
    link.pass_on(skeleton)
    link.clock.ns += 50 * MS
    link.sender.send(skeleton, exposed_ns=link.clock.ns - 20 * MS)
    link.clock.ns += 7 * MS
    link.source.read(0.0)
    assert link.source.arrival.waited == pytest.approx(0.020)
    assert link.source.arrival.queued == pytest.approx(0.007)
    assert link.source.arrival.received_ns == link.clock.ns


def test_a_capture_process_that_is_started_again_goes_on_with_the_gap_in_the_times(link):
    frames = skeletons(5, start=500.0)
    last = [link.pass_on(frame) for frame in frames][-1]
    assert last.time == frames[-1].time  # the first session's times are its own
    link.sender.close()  # killed
    link.sender = link.another()
    again = skeletons(5)  # whose time begins at 0
    assert link.pass_on(again[0], after=300 * MS) is None  # the first might still live
    first = link.pass_on(again[1], after=400 * MS)
    assert first.time - last.time == pytest.approx(0.7)
    assert link.pass_on(again[2]).time - first.time == pytest.approx(again[2].time - again[1].time)
    assert link.source.datagram_filter.dropped == {"foreign": 1}


def test_two_capture_processes_are_not_mixed(link):
    other = link.another()
    with other:
        for one, two in zip(skeletons(20), skeletons(20, away=1.0), strict=True):
            assert same(link.pass_on(one), one)
            other.send(two)
            assert link.source.read(0.0) is None


def test_a_source_that_is_closed_is_over(link):
    assert not link.source.over
    link.source.close()
    link.source.close()
    assert link.source.over and link.source.read(0.1) is None and list(link.source) == []


def test_nobody_listening_is_counted_and_harms_nothing(link):
    link.source.close()
    for skeleton in skeletons(6):
        link.sender.send(skeleton)
    assert link.sender.failed >= 1 and link.sender.sent + link.sender.failed == 6


def test_it_hears_this_machine_only_unless_told_otherwise():
    with UdpSource(0) as near, UdpSource(0, "0.0.0.0") as far:
        assert near.address[0] == "127.0.0.1" and far.address[0] == "0.0.0.0"
        with pytest.raises(InputError, match="cannot listen at this address"):
            UdpSource(near.address[1])
    with pytest.raises(InputError, match="cannot listen at this address"):
        UdpSource(0, "192.0.2.1")  # an address that no machine has
