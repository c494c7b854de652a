"""UDP sockets: parsing addresses, opening sockets, and sending and receiving without blocking."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator

from imitarm.errors import InputError

LOOPBACK = "127.0.0.1"
Address = tuple[str, int]

_LARGEST = 2048  # [bytes] longer than any datagram, so that one that is too long is noticed
_BUFFER = 1 << 18  # [bytes] a few hundred datagrams; more would only become stale
_AT_ONCE = 256  # datagrams read from a socket before control returns to the caller


def parse_address(text: str, *, host: str = LOOPBACK) -> Address:
    """Parse ``HOST:PORT`` or ``PORT``, and return host and port.

    Args:
        text: text typed by a user.
        host: host to return if ``text`` contains only a port.

    Raises:
        InputError: when the text does not have one of these two forms.
    """
    name, colon, port = text.rpartition(":")
    if (colon and not name) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"{text!r} is not an address; write HOST:PORT, for example 127.0.0.1:7400")
    return name or host, int(port)


def resolved(address: Address) -> Address:
    """Return ``address`` with the host name replaced by its IP address.

    Raises:
        InputError: when the host is unknown.
    """
    host, port = address
    try:
        return str(socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0]), port
    except (OSError, UnicodeError) as error:
        raise InputError(f"{host}: there is no such host; check its name or give its IP address") from error


def listening(address: Address) -> socket.socket:
    """Return a socket that receives datagrams at an address of this machine; port 0 stands for any free port.

    Raises:
        InputError: when the port is in use, or the address does not belong to this machine.
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
            f"{address[0]}:{address[1]}: cannot listen at this address ({error.strerror or error}); "
            "choose another port, or "
            "an address of this machine"
        ) from error
    return one


def connected(address: Address) -> socket.socket:
    """Return a socket that sends datagrams to an address, and receives datagrams only from this address.

    Raises:
        InputError: when the host is unknown, or there is no route to it.
    """
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setblocking(False)
    try:
        one.connect(resolved(address))
    except (OSError, InputError) as error:
        one.close()
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{address[0]}:{address[1]}: no route to this address ({error.strerror or error}); check the network"
        ) from error
    return one


def waiting(one: socket.socket, most: int = _AT_ONCE) -> Iterator[tuple[bytes, Address]]:
    """Yield the datagrams that have already arrived, at most ``most``, with their senders' addresses; never wait."""
    for _ in range(most):
        try:
            yield one.recvfrom(_LARGEST)
        except BlockingIOError:
            return
        except ConnectionError:  # an earlier datagram did not reach a listener
            continue


def wait_for(one: socket.socket, seconds: float) -> bool:
    """Wait until a datagram has arrived; return False if none has arrived within ``seconds`` seconds."""
    return bool(select.select([one], [], [], max(seconds, 0.0))[0])


def try_to_send(one: socket.socket, data: bytes, address: Address | None = None) -> bool:
    """Send ``data`` without waiting; return False if nobody listens, or if the system's send buffer is full."""
    try:
        if address is None:
            one.send(data)
        else:
            one.sendto(data, address)
    except OSError:
        return False
    return True
