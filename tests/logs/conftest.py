"""Samples as the bus hands them to a recorder."""

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from messaging import brakeline_pb2 as pb
from messaging.bus import Sample
from messaging.bus.keys import names_of
from messaging.topics import TOPICS

Say = Callable[..., Sample]


@pytest.fixture
def say() -> Say:
    """`say("log/a", pb.LogLine(text="x"))`: numbered per key, a second after the one before."""
    numbers: dict[str, itertools.count[int]] = {}
    seconds = itertools.count(1)

    def make(key: str, message: Any, time: float = 0.0, run: int = 1) -> Sample:
        topic = next(topic for topic in TOPICS if type(message) is topic.message)
        now = next(seconds) * 10**9
        number = next(numbers.setdefault(key, itertools.count(1)))
        source = names_of(topic, key).get("source", "a")
        message.header.MergeFrom(pb.Header(sequence=number, source=source, run=run, wall_time=now, time=time))
        return Sample(topic, key, message.SerializeToString(), now + 1000)

    return make
