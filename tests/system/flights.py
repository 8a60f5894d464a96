"""Run `brakeline autopilot` in real time, for clients of other authors."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from brakeline.messaging.free_ports import free_udp_port
from tests.system.runs import BRAKELINE


@contextmanager
def autopilot(*options: object) -> Iterator[int]:
    """Run an autopilot until the end of the block. Yields the UDP port that it sends to."""
    port = free_udp_port()
    words = [*BRAKELINE, "autopilot", "--url", f"udpout:127.0.0.1:{port}", "--truth", "", *options]
    process = subprocess.Popen([str(word) for word in words], stderr=subprocess.DEVNULL)
    try:
        yield port
    finally:
        process.terminate()
        process.wait(20.0)
