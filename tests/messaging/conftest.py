"""Buses on free loopback ports, closed after the test."""

import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from tests.messaging.programs import Join


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def join(endpoint: str) -> Iterator[Join]:
    """`join("actor-0")` joins the bus, `join("launcher", listen=True)` is its router."""
    buses: list[Bus] = []

    def make(source: str, listen: bool = False, patience: float = 5.0) -> Bus:
        place = {"listen": (endpoint,)} if listen else {"connect": (endpoint,)}
        buses.append(Bus(BusSettings(**place, patience=patience), source))
        return buses[-1]

    yield make
    for bus in reversed(buses):
        bus.close()


@pytest.fixture
def spawn() -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Run Python text in another process and wait until it prints `ready`; it is killed after the test."""
    children: list[subprocess.Popen[str]] = []

    def start(text: str) -> subprocess.Popen[str]:
        child = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
        children.append(child)
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        return child

    yield start
    for child in children:
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()
