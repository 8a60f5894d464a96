"""A learner's bus and an actor's."""

from collections.abc import Iterator

import pytest

from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    endpoint = free_endpoint()
    with (
        Bus(BusSettings(listen=(endpoint,)), "learner") as learner,
        Bus(BusSettings(connect=(endpoint,)), "actor-0") as actor,
    ):
        yield learner, actor
