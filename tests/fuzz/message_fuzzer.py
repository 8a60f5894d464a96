"""Draw hostile messages of every topic: extreme values, wrong sizes, turned bits, noise."""

from __future__ import annotations

import itertools
import math
import time
from random import Random
from typing import Any

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.topics import TOPICS, Topic
from tests.fuzz.mutations import mutated

ACTORS = 60  # number of names; so few that tables by name are soon full
CORPUS = 200  # valid messages of each topic, which the mutated ones come from
NUMBERS = (0.0, 1.0, -1.0, 0.1, 1e-300, 1e300, -1e300, 1e9, math.inf, -math.inf, math.nan)
INTEGERS = (0, 1, 2, 3, 7, 1000, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -1, -(2**63))
TEXTS = ("", "ground", "ground", "quadrotor", "actor-0", "actor-0", "ERROR", "box", "wall", "sphere", "cylinder")
STRANGE = ("a/b", "../../etc", "\x1b[2J\n", "<script>", "\n", "é" * 40, "a" * 101)
# By the wire's kind of number: C++'s int32, int64, uint32, uint64.
LIMITS = {1: (-(2**31), 2**31 - 1), 2: (-(2**63), 2**63 - 1), 3: (0, 2**32 - 1), 4: (0, 2**64 - 1)}


class MessageFuzzer:
    """Draws messages."""

    def __init__(self, seed: int) -> None:
        self.random, self._numbers = Random(seed), itertools.count(1)
        self._corpus = {topic.name: [self._message(topic.message()) for _ in range(CORPUS)] for topic in TOPICS}

    def sample(self, topic: Topic) -> Sample:
        """Draw a message of a topic, received now, mostly from a known actor."""
        random = self.random
        key = topic.at(robot="ground", source="actor-0")
        if random.random() < 0.3:
            key = topic.at(robot=self._text(), source=f"actor-{random.randrange(ACTORS)}")
        return Sample(topic, key, self.payload(topic), time.time_ns())

    def payload(self, topic: Topic) -> bytes:
        random, corpus = self.random, self._corpus[topic.name]
        kind, at = random.random(), random.randrange(CORPUS)
        if kind < 0.1:
            return random.randbytes(random.randrange(200))
        if kind < 0.4:
            corpus[at] = self._altered(topic, corpus[at])
            return corpus[at]
        return (mutated(corpus[at], random) if kind < 0.8 else corpus[at])[:4096]

    def _altered(self, topic: Topic, payload: bytes) -> bytes:
        """Return a valid message with some fields drawn anew."""
        message = topic.message.FromString(payload)
        if self.random.random() < 0.02:
            return self._message(topic.message())
        for _ in range(self.random.randrange(1, 4)):
            fields: list[Any] = list(message.DESCRIPTOR.fields)
            chosen = self.random.choice(fields)
            message.ClearField(chosen.name)
            self.fill(message, chosen, 0)
        return self._honest(message)

    def _message(self, message: Message) -> bytes:
        self._filled(message, 0)
        return self._honest(message)

    def _honest(self, message: Any) -> bytes:
        """Serialize a message, mostly with a valid sender, so that its receivers read on."""
        names = message.DESCRIPTOR.fields_by_name
        if self.random.random() < 0.8:
            for name, value in (("robot", "ground"), ("actor", "actor-0"), ("process", "actor-0")):
                if name in names:
                    setattr(message, name, value)
            if "header" in names:
                header = pb.Header(sequence=next(self._numbers), source="actor-0", time=1.0, wall_time=time.time_ns())
                message.header.CopyFrom(header)
        data: bytes = message.SerializeToString()
        return data if len(data) < 4096 else b""

    def _filled(self, message: Message, depth: int) -> None:
        for one in message.DESCRIPTOR.fields:
            if self.random.random() < 0.8:
                self.fill(message, one, depth)

    def fill(self, message: Any, one: Any, depth: int = 0) -> None:
        """Draw one field of a message."""
        random = self.random
        kind = one.message_type
        if kind is not None and kind.GetOptions().map_entry:
            table = getattr(message, one.name)
            for _ in range(random.randrange(3)):
                table[self._text()] = self._value(kind.fields_by_name["value"])
        elif kind is not None and one.is_repeated:
            for _ in range(random.randrange(4) if depth < 2 else 0):
                self._filled(getattr(message, one.name).add(), depth + 1)
        elif kind is not None:
            getattr(message, one.name).SetInParent()
            self._filled(getattr(message, one.name), depth + 1)
        elif one.is_repeated:
            values = [self._value(one) for _ in range(3)]
            size = random.choice((0, 1, 2, 3, 5, 5, 5, 9, 10, 20, 26, 70))
            getattr(message, one.name).extend(random.choices(values, k=size))
        else:
            setattr(message, one.name, self._value(one))

    def _value(self, one: Any) -> Any:
        random, kind = self.random, one.cpp_type
        if kind in (one.CPPTYPE_DOUBLE, one.CPPTYPE_FLOAT):
            return random.gauss() if random.random() < 0.8 else random.choice(NUMBERS)
        if kind == one.CPPTYPE_BOOL:
            return random.random() < 0.5
        if kind == one.CPPTYPE_ENUM:
            return random.randrange(6)
        if kind == one.CPPTYPE_STRING:
            return self._text() if one.type == one.TYPE_STRING else random.randbytes(random.randrange(60))
        low, high = LIMITS[kind]
        value = random.choice(INTEGERS) if random.random() < 0.2 else random.randrange(100)
        return value if low <= value <= high else 0

    def _text(self) -> str:
        random = self.random
        if random.random() < 0.1:
            return random.choice(STRANGE)
        return random.choice(TEXTS) if random.random() < 0.7 else f"name-{random.randrange(ACTORS)}"
