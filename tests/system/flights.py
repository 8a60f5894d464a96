"""A `brakeline autopilot` in real time, for clients that were written by others."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from tests.system.runs import BRAKELINE


def free_port() -> int:
    """A UDP port that nobody has at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def autopilot(*options: object) -> Iterator[int]:
    """Runs it until the end of the block; yields the UDP port that it sends to."""
    port = free_port()
    words = [*BRAKELINE, "autopilot", "--url", f"udpout:127.0.0.1:{port}", "--truth", "", *options]
    process = subprocess.Popen([str(word) for word in words], stderr=subprocess.DEVNULL)
    try:
        yield port
    finally:
        process.terminate()
        process.wait(20.0)
