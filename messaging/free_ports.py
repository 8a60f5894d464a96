"""Find free ports on this machine, and endpoints at which nobody listens."""

from __future__ import annotations

import socket

HERE = "127.0.0.1"
CONNECT_TIMEOUT = 1.0  # s


def free_udp_port() -> int:
    """Return a free UDP port."""
    return _free(socket.SOCK_DGRAM)


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a free endpoint to listen on, in the form of `BusSettings`; with keys the protocol is `tls`."""
    return f"{protocol}/{HERE}:{_free(socket.SOCK_STREAM)}"


def closed(endpoint: str) -> bool:
    """Return whether nobody listens at a TCP or TLS endpoint of this machine. Of other endpoints nothing is known."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("#")[0].rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdecimal():
        return False
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()
    except ConnectionRefusedError:
        return True
    except (OSError, OverflowError):
        pass
    return False


def _free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HERE, 0))
        return int(probe.getsockname()[1])
