"""A learner's bus and an actor's."""

import socket
from collections.abc import Iterator

import pytest

from messaging.bus import Bus, BusSettings


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with (
        Bus(BusSettings(listen=(endpoint,)), "learner") as learner,
        Bus(BusSettings(connect=(endpoint,)), "actor-0") as actor,
    ):
        yield learner, actor
