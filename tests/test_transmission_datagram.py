from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.transmission.datagram import Encoder, decode, now_ns, size_of
from imitarm.transmission.messages import CommandMode, DatagramError, JointCommand, JointState, SkeletonFrame
from wire_samples import command, joint_state, skeleton_frame

ANY = [skeleton_frame, lambda rng: command(q=rng.normal(size=7), velocity=rng.normal(size=7)), joint_state]
seeds = st.integers(0, 2**32 - 1)


def equal(a, b):
    return type(a) is type(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)


@given(seed=seeds, kind=st.integers(0, 2), session=seeds, sequence=seeds, time=st.integers(0, 2**64 - 1))
def test_what_is_sent_is_received_to_the_last_bit(seed, kind, session, sequence, time):
    message = ANY[kind](np.random.default_rng(seed))
    data = Encoder(session, sequence).encode(message, time)
    header, back = decode(data)
    assert (header.session, header.sequence, header.time_ns) == (session, sequence, time)
    assert equal(message, back)
    assert len(data) == size_of(type(message)) < 1200  # one packet, also through a tunnel


def test_the_header_is_as_the_documentation_says():
    """Byte by byte, packed here by hand."""
    frame = skeleton_frame(time=1.5, tracking=np.ones(25, np.int8), hands=(2, 3), person=7, waited_ns=9)
    payload = struct.pack("<dQQ2B", 1.5, 7, 9, 2, 3) + b"\x01" * 25 + bytes(5) + frame.positions.astype("<f8").tobytes()
    head = b"IMTR" + struct.pack("<BBHIIQ", 1, 1, 0, 0xAABBCCDD, 5, 77)
    by_hand = head + struct.pack("<I", zlib.crc32(head + payload)) + payload
    assert Encoder(0xAABBCCDD, 5).encode(frame, 77) == by_hand
    assert [size_of(kind) for kind in (SkeletonFrame, JointCommand, JointState)] == [684, 304, 828]


@given(data=st.binary(max_size=1000))
def test_random_bytes_are_no_datagram(data):
    with pytest.raises(DatagramError):
        decode(data)


@given(seed=seeds, kind=st.integers(0, 2), bit=st.integers(0, 2**31))
def test_a_flipped_bit_is_noticed(seed, kind, bit):
    data = bytearray(Encoder(1).encode(ANY[kind](np.random.default_rng(seed)), 0))
    bit %= 8 * len(data)
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(DatagramError):
        decode(bytes(data))


@given(seed=seeds, kind=st.integers(0, 2), cut=st.integers(1, 2000), longer=st.booleans())
def test_a_wrong_length_is_noticed(seed, kind, cut, longer):
    data = Encoder(1).encode(ANY[kind](np.random.default_rng(seed)), 0)
    with pytest.raises(DatagramError) as caught:
        decode(data + bytes(cut) if longer else data[: -min(cut, len(data))])
    assert caught.value.reason == "length"


def signed(data):
    """The datagram with its checksum made right: what somebody sends who knows the format."""
    return data[:24] + struct.pack("<I", zlib.crc32(data[28:], zlib.crc32(data[:24]))) + data[28:]


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [(0, b"X", "magic"), (4, b"\x02", "version"), (5, b"\x09", "kind"), (6, b"\x02", "range"), (7, b"\x80", "range")],
)
def test_a_foreign_header_is_refused_though_its_checksum_is_right(place, value, reason):
    data = Encoder(1).encode(command(), 0)
    with pytest.raises(DatagramError) as caught:
        decode(signed(data[:place] + value + data[place + 1 :]))
    assert caught.value.reason == reason


BAD = [np.nan, np.inf, -np.inf, 1e300, -1e12]


@pytest.mark.parametrize("bad", BAD)
@given(place=st.integers(0, 2**31), kind=st.integers(0, 2))
def test_no_number_may_be_infinite_huge_or_none(bad, place, kind):
    """At any place that holds one, with the right checksum."""
    message = ANY[kind](np.random.default_rng(3))
    data = bytearray(Encoder(1).encode(message, 0))
    first = len(data) - 8 * message.NUMBERS
    used = 75 if kind == 0 else 7
    vector, joint = divmod(place % (75 if kind == 0 else used * message.NUMBERS // 16), used)
    at = first + 8 * (vector * (75 if kind == 0 else 16) + joint)
    data[at : at + 8] = struct.pack("<d", bad)
    with pytest.raises(DatagramError) as caught:
        decode(signed(bytes(data)))
    assert caught.value.reason == "range"


@pytest.mark.parametrize(
    "message",
    [
        skeleton_frame(time=np.nan),
        skeleton_frame(waited_ns=10**12),
        skeleton_frame(hands=(5, 0)),
        skeleton_frame(tracking=np.full(25, 3, np.int8)),
        skeleton_frame(tracking=np.full(25, -1, np.int8)),
        skeleton_frame(positions=np.full((25, 3), 20.1)),
        command(opening=-0.1),
        command(opening=np.nan),
        joint_state(time=np.inf),
        joint_state(opening=(0.1, 2.0)),
        joint_state(reason="\x1b[2J"),
    ],
)
def test_values_that_can_not_be_are_refused(message):
    with pytest.raises(DatagramError) as caught:
        decode(Encoder(1).encode(message, 0))
    assert caught.value.reason == "range"


@pytest.mark.parametrize(("place", "value"), [(28, 0), (28, 17), (28, 255), (29, 4), (29, 255)])
def test_numbers_of_joints_and_modes_that_do_not_exist_are_refused(place, value):
    data = bytearray(Encoder(1).encode(command(), 0))
    data[place] = value
    with pytest.raises(DatagramError) as caught:
        decode(signed(bytes(data)))
    assert caught.value.reason == "range"


def test_a_long_reason_is_cut_between_letters():
    _, back = decode(Encoder(1).encode(joint_state(reason="é" * 80), 0))
    assert back.reason == "é" * 45


def test_what_can_not_be_packed_is_not_sent_and_takes_no_number():
    encoder = Encoder(1, 8)
    with pytest.raises(DatagramError, match="cannot be encoded"):
        encoder.encode(command(q=np.zeros(20), velocity=np.zeros(20)), 0)
    with pytest.raises(DatagramError, match="cannot be encoded"):
        encoder.encode(command(), -1)
    assert encoder.sequence == 8


def test_sequence_numbers_wrap_around_and_sessions_differ():
    encoder = Encoder(first=2**32 - 1)
    headers = [decode(encoder.encode(command(CommandMode.OBSERVE), 0))[0] for _ in range(3)]
    assert [header.sequence for header in headers] == [2**32 - 1, 0, 1]
    assert len({Encoder().session for _ in range(50)}) == 50 and 0 not in {Encoder().session for _ in range(50)}


def test_the_time_goes_on():
    first = now_ns()
    assert 0 <= now_ns() - first < 10**10
