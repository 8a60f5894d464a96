"""Find free ports on this machine."""

from __future__ import annotations

import socket

HERE = "127.0.0.1"


def free_udp_port() -> int:
    """Return a free UDP port."""
    return _free(socket.SOCK_DGRAM)


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a free endpoint to listen on, in the form of `BusSettings`; with keys the protocol is `tls`."""
    return f"{protocol}/{HERE}:{_free(socket.SOCK_STREAM)}"


def _free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HERE, 0))
        return int(probe.getsockname()[1])
