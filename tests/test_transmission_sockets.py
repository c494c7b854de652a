from __future__ import annotations

import time

import pytest

from imitarm.errors import InputError
from imitarm.transmission.sockets import connected, listening, parse_address, resolved, try_to_send, wait_for, waiting


@pytest.mark.parametrize(
    ("text", "address"),
    [("127.0.0.1:7400", ("127.0.0.1", 7400)), ("robot:1", ("robot", 1)), ("65535", ("127.0.0.1", 65535))],
)
def test_addresses(text, address):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "robot", "robot:", ":7400", "robot:0", "robot:65536", "robot:-1", "robot:12x"])
def test_what_is_no_address(text):
    with pytest.raises(InputError, match="is not an address; write HOST:PORT"):
        parse_address(text)


@pytest.mark.parametrize("host", ["no.such.host.invalid", "x" * 80, "\x00"])
def test_a_host_that_is_not_there(host):
    for make in (resolved, listening, connected):
        with pytest.raises(InputError, match="there is no such host"):
            make((host, 7400))


def test_what_is_sent_is_there_and_nothing_waits():
    with listening(("127.0.0.1", 0)) as here, connected(here.getsockname()) as there:
        assert list(waiting(here)) == []
        assert not wait_for(here, 0.0)
        assert try_to_send(there, b"one") and try_to_send(there, b"two")
        assert wait_for(here, 5.0)
        assert [data for data, _ in waiting(here)] == [b"one", b"two"]
        assert try_to_send(here, b"back", there.getsockname()) and wait_for(there, 5.0)
        assert [data for data, _ in waiting(there)] == [b"back"]
        for _ in range(10):
            try_to_send(there, b"more")
        assert len(list(waiting(here, 3))) == 3


def test_a_datagram_that_is_too_long_is_seen_to_be():
    with listening(("127.0.0.1", 0)) as here, connected(here.getsockname()) as there:
        try_to_send(there, bytes(9000))
        assert wait_for(here, 5.0)
        assert [len(data) for data, _ in waiting(here)] == [2048]


def test_a_socket_whose_other_end_has_gone_goes_on():
    here = listening(("127.0.0.1", 0))
    address = here.getsockname()
    here.close()
    with connected(address) as there:
        results = [try_to_send(there, b"x") for _ in range(4)]
        assert not all(results)
        try_to_send(there, b"x")
        assert list(waiting(there)) == []
        assert not try_to_send(there, b"x" * 100_000)


def test_waiting_takes_no_longer_than_it_may():
    with listening(("127.0.0.1", 0)) as here:
        begin = time.monotonic()
        assert not wait_for(here, 0.02)
        assert time.monotonic() - begin >= 0.019
