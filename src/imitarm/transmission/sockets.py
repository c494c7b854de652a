"""UDP sockets: addresses as people type them, sockets that listen or send, and reading without waiting forever."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator

from imitarm.errors import InputError

LOOPBACK = "127.0.0.1"
Address = tuple[str, int]

_LARGEST = 2048  # [bytes] more than any datagram has, so that one that is too long is seen to be
_BUFFER = 1 << 18  # [bytes] a few hundred datagrams: more would only grow old
_AT_ONCE = 256  # datagrams taken from a socket before something else gets its turn


def parse_address(text: str, *, host: str = LOOPBACK) -> Address:
    """Return host and port of ``HOST:PORT`` or ``PORT``.

    Args:
        text: as typed.
        host: what is meant when only a port is given.

    Raises:
        InputError: when it is neither.
    """
    name, colon, port = text.rpartition(":")
    if (colon and not name) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"{text!r} is no address; say HOST:PORT, for example 127.0.0.1:7400")
    return name or host, int(port)


def resolved(address: Address) -> Address:
    """Return an address with the host's number instead of its name.

    Raises:
        InputError: when there is no such host.
    """
    host, port = address
    try:
        return str(socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0]), port
    except (OSError, UnicodeError) as error:
        raise InputError(f"{host}: there is no such host; check its name or give its number") from error


def listening(address: Address) -> socket.socket:
    """Return a socket that receives at an address; port 0: any that is free.

    Raises:
        InputError: when the port is taken, or the address is not one of this machine's.
    """
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setblocking(False)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        one.bind(resolved(address))
    except (OSError, InputError) as error:
        one.close()
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{address[0]}:{address[1]}: can't listen there ({error.strerror or error}); take another port, or an "
            "address of this machine"
        ) from error
    return one


def connected(address: Address) -> socket.socket:
    """Return a socket that sends to an address, and receives only from there.

    Raises:
        InputError: when there is no such host, or no way there.
    """
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setblocking(False)
    try:
        one.connect(resolved(address))
    except (OSError, InputError) as error:
        one.close()
        if isinstance(error, InputError):
            raise
        raise InputError(f"{address[0]}:{address[1]}: no way there ({error.strerror or error})") from error
    return one


def waiting(one: socket.socket, most: int = _AT_ONCE) -> Iterator[tuple[bytes, Address]]:
    """Give what has come so far, with where each is from; at most ``most`` datagrams, and it never waits."""
    for _ in range(most):
        try:
            yield one.recvfrom(_LARGEST)
        except BlockingIOError:
            return
        except ConnectionError:  # what was sent before has found nobody
            continue


def wait_for(one: socket.socket, seconds: float) -> bool:
    """Wait until something has come; False when nothing did in that time."""
    return bool(select.select([one], [], [], max(seconds, 0.0))[0])


def try_to_send(one: socket.socket, data: bytes, address: Address | None = None) -> bool:
    """Send without waiting; False when nobody is there, or the system can't take more."""
    try:
        if address is None:
            one.send(data)
        else:
            one.sendto(data, address)
    except OSError:
        return False
    return True
