"""The local socket between an actor and its vehicle server: whole messages, between processes of one user.

The socket is a Unix socket of type SOCK_SEQPACKET. The kernel keeps the boundaries of messages, so half of a message
never arrives, and it tells whose process is at the other end. The messages are protobuf: plain data, of limited size.
"""

from __future__ import annotations

import os
import select
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from brakeline.errors import BadMessage, MavlinkError

LARGEST = 2**17  # bytes of a message
SEND_TIMEOUT = 1.0  # s that the other end may take to make room for a message

M = TypeVar("M", bound=Message)


class MessageSocket:
    """One end of a connection. Two threads may use it at once: one sends, one receives."""

    def __init__(self, connection: socket.socket) -> None:
        connection.settimeout(SEND_TIMEOUT)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)  # the kernel makes it twice as large
        self._socket = connection

    def send(self, message: Message) -> None:
        """Send a message.

        Raises:
            BadMessage: it is empty or too large.
            OSError: the other end is gone, or makes no room within `SEND_TIMEOUT`.
        """
        data = message.SerializeToString()
        if not 0 < len(data) <= LARGEST:  # an empty one would look like the end of the connection
            raise BadMessage(f"a message has 1 to {LARGEST} bytes, not {len(data)}")
        self._socket.send(data)

    def poll(self, seconds: float | None = 0.0) -> bool:
        """Wait until a message has arrived, or the other end is gone; None: without a timeout."""
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        return bool(poll.poll(None if seconds is None else 1e3 * seconds))

    def receive(self, kind: type[M]) -> M:
        """Return the next message.

        Raises:
            BadMessage: it is too large, or no message of this kind; the next one may be valid.
            EOFError, OSError: the other end is gone.
        """
        data, _, flags, _ = self._socket.recvmsg(LARGEST)
        if flags & socket.MSG_TRUNC:
            raise BadMessage(f"a message of more than {LARGEST} bytes")
        if not data:
            raise EOFError
        try:
            return kind.FromString(data)
        except DecodeError as error:
            raise BadMessage(f"not a {kind.DESCRIPTOR.name}: {error}") from error

    def hang_up(self) -> None:
        """End the connection in both directions; a thread that polls it wakes up. Raises OSError: it has ended."""
        self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._socket.close()


def address(url: str, system: int) -> str:
    """Return the address of a vehicle's server: an abstract name, which ends with its process and is not a file."""
    link = url.replace("//", "").replace("localhost", "127.0.0.1")
    return f"\0brakeline/{os.getuid()}/{link[-80:]}/{system}"


def same_user(peer: socket.socket) -> bool:
    """Return whether a process of this user is at the other end."""
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return bool(user == os.getuid())


@contextmanager
def listening(url: str, system: int) -> Iterator[socket.socket]:
    """Listen for the actors of a vehicle. Raises MavlinkError: another process here flies the vehicle."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        try:
            server.bind(address(url, system))
        except OSError as error:
            raise MavlinkError(f"another process here flies vehicle {system} at {url}") from error
        server.listen()
        yield server


def connect(url: str, system: int) -> MessageSocket | None:
    """Connect to a vehicle's server; None if there is none. Raises MavlinkError: it is a process of another user."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.connect(address(url, system))
    except OSError:
        connection.close()
        return None
    if not same_user(connection):
        connection.close()
        raise MavlinkError("another user's process flies this vehicle")
    return MessageSocket(connection)
