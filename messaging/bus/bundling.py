"""Send messages of several topics together, and take them apart where they arrive.

Every message on the bus costs each process that it passes 0.1 to 0.2 ms of processor time, whatever its size. An
actor's messages wait for at most `HOLD` seconds, and leave in one bundle for each kind of robot. A receiver gets the
same samples as without bundles, with the same bytes, in the order in which they were put.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress

from brakeline.errors import BusError, Malformed
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.identity import speaks_for
from brakeline.messaging.bus.publisher import Publisher
from brakeline.messaging.bus.subscription import Sample
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import BUNDLE, BUNDLED, Topic, topic_of

HOLD = 0.2  # longest time for which a message waits [s]
MOST_BUNDLED = 16  # messages of a bundle: half of what a learner permits an actor in advance, with the decisions
LARGE = 2**18  # bytes from which a bundle leaves at once
MOST_ROUTES = 4096  # that a receiver remembers

Deliver = Callable[[str, bytes, int], None]  # takes a key, a payload and the time of receipt [ns]


class BundlePublisher:
    """Collects messages, and sends them when they are many, or `HOLD` seconds old at most."""

    def __init__(self, publisher: Publisher) -> None:
        """publisher: of the topic BUNDLE."""
        self._publisher = publisher
        self._bundle, self._size = pb.Bundle(), 0
        self._lock = threading.Lock()
        self._closed = threading.Event()
        threading.Thread(target=self._run, name=f"bus {publisher.key}", daemon=True).start()

    def add(self, key: str, payload: bytes) -> None:
        """Add a message. With a slow receiver, the call blocks as `Publisher.put`. Raises BusError."""
        with self._lock:
            self._bundle.messages.add(key=key, payload=payload)
            self._size += len(payload)
            if len(self._bundle.messages) >= MOST_BUNDLED or self._size >= LARGE:
                self._send()

    def flush(self) -> None:
        """Send what waits. Raises BusError."""
        with self._lock:
            if self._bundle.messages:
                self._send()

    def close(self) -> None:
        """Send what waits, and end the thread."""
        self._closed.set()
        with suppress(BusError):
            self.flush()

    def _send(self) -> None:
        bundle, self._bundle, self._size = self._bundle, pb.Bundle(), 0
        self._publisher.put(bundle)

    def _run(self) -> None:
        while not self._closed.wait(HOLD):
            try:
                self.flush()
            except BusError:  # the bus is closed
                return


class Unbundler:
    """Hands the messages of bundles to the listeners of their topics, as if each had come alone."""

    def __init__(self, rejected: RejectedMessages) -> None:
        self._rejected = rejected
        self._listeners: dict[str, list[tuple[Mapping[str, str], Deliver]]] = {}
        self._routes: dict[tuple[str, str], list[Deliver]] = {}  # by the key of a bundle and of a message in it

    def add(self, topic: Topic, names: Mapping[str, str], deliver: Deliver) -> None:
        """Call `deliver` with the messages of a topic, too. names: those that it wants, of the key."""
        self._listeners.setdefault(topic.name, []).append((names, deliver))
        self._routes = {}

    def take(self, sample: Sample) -> None:
        """Take a bundle apart. A message that its sender may not publish is rejected, the others are not.

        Raises:
            Malformed: the bundle holds more messages than a publisher bundles: each takes the receiver's time, empty
                ones too.
        """
        messages = sample.message().messages
        if len(messages) > MOST_BUNDLED:
            raise Malformed(f"{sample.key}: a bundle of {len(messages)} messages; it has at most {MOST_BUNDLED}")
        for number, one in enumerate(messages):
            with self._rejected.skip_on_error(sample.key):
                key = one.key
                routes = self._routes.get((sample.key, key))
                if routes is None:
                    routes = self._route(sample.key, key)
                for deliver in routes:
                    deliver(key, one.payload, sample.received + number)

    def _route(self, bundle: str, key: str) -> list[Deliver]:
        """Return who wants the messages at a key in the bundles at another. Raises Malformed."""
        sender, topic = names_of(BUNDLE, bundle), topic_of(key)
        names = {} if topic is None else names_of(topic, key)
        if topic not in BUNDLED or key != topic.at(**names) or names["robot"] != sender["robot"]:
            raise Malformed(f"a bundle holds a message at {key[:200]!r}")
        if not speaks_for(sender["source"], names["source"]):
            raise Malformed(f"a bundle holds a message of {names['source'][:100]!r}")
        listeners = self._listeners.get(topic.name, ())
        routes = [deliver for wanted, deliver in listeners if wanted.items() <= names.items()]
        if len(self._routes) < MOST_ROUTES:
            self._routes[bundle, key] = routes
        return routes
