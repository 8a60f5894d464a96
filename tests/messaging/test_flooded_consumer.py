"""A consumer that logs the messages that it refuses goes on: its log lines come back into the queue that it empties."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample, configuration, session
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.process_runtime import MAX_WAITING_LINES, BusHandler, Process
from brakeline.messaging.topics import HEALTH, LOG, RECORDED, STEP
from tests.waiting import until

QUEUE = 8  # samples, instead of thousands


@pytest.fixture
def flooded(monkeypatch: pytest.MonkeyPatch) -> Callable[[Process], Any]:
    """`flooded(process)`: the session of a client that has sent junk to all its subscriptions."""
    monkeypatch.setattr(session, "FIFO", QUEUE)
    monkeypatch.setattr("brakeline.messaging.rejected_messages.LOG_PERIOD", 0.0)  # each refusal is logged

    def flood(process: Process) -> Any:
        client: Any = zenoh.open(configuration(BusSettings(connect=process.settings.listen), "client"))
        block = zenoh.CongestionControl.BLOCK
        health = pb.Health(header=pb.Header(source="client"), process="client").SerializeToString()

        def send() -> None:
            for _ in range(20 * QUEUE):
                for key, payload in (("log/client.$*", b"\xff"), ("log/client", b"\xff"), ("health/client", health)):
                    client.put(f"brakeline/{key}", payload, congestion_control=block)

        sender = threading.Thread(target=send, daemon=True)
        sender.start()
        sender.join(10.0)
        assert not sender.is_alive(), "its messages are taken in"
        return client

    return flood


@pytest.mark.parametrize("works_in", ["handler", "inbox"])
def test_refusals_of_a_flood_do_not_block_the_process_that_logs_them(
    flooded: Callable[[Process], Any], works_in: str
) -> None:
    """In the handler, as the safety service works, or in the main thread, as launcher and recorder do."""
    inbox, honest = Inbox(), list[pb.LogLine]()

    def take(sample: Sample) -> None:
        with process.bus.rejected.skip_on_error(sample.key):
            message = sample.message()
            if isinstance(message, pb.LogLine) and message.process == "client":
                honest.append(message)

    with Process(BusSettings(listen=(free_endpoint(),)), "launcher", stderr=False) as process:
        for topic in RECORDED:
            process.bus.subscribe(topic, take if works_in == "handler" else inbox.put)
        client = flooded(process)

        def arrived() -> bool:
            for sample in inbox.drain(1.0):
                take(sample)
            return bool(honest)

        line = pb.LogLine(header=pb.Header(source="client"), process="client", text="still heard")
        client.put("brakeline/log/client", line.SerializeToString())
        until(arrived, "an honest line", seconds=10.0)
        assert process.bus.rejected.count >= 20 * QUEUE
        client.close()
        begun = time.monotonic()
    assert time.monotonic() - begun < 10.0, "and the process ends"


def test_a_thread_that_logs_never_waits_for_the_bus() -> None:
    """A link that takes nothing costs log lines, which are counted, and no time of the thread that drives a robot."""
    stuck, released = threading.Event(), threading.Event()

    class Stuck:
        def put(self, line: pb.LogLine) -> None:
            stuck.set()
            released.wait(30.0)

    handler = BusHandler(Stuck(), "actor-0")  # type: ignore[arg-type]
    record = logging.LogRecord("a", logging.INFO, "", 0, "words", (), None)
    handler.emit(record)
    assert stuck.wait(10.0)
    for _ in range(MAX_WAITING_LINES + 7):
        handler.emit(record)
    assert handler.lost == 7
    released.set()
    handler.close()


def sample(key: str, size: int) -> Sample:
    topic = {"step": STEP, "log": LOG, "health": HEALTH}[key.split("/")[0]]
    return Sample(topic, key, bytes(size), 0)


def test_one_sender_cannot_take_the_place_of_the_others_in_an_inbox() -> None:
    inbox = Inbox(limit=100_000)
    for number in range(1000):
        inbox.put(sample(f"step/r{number}/actor-0.{number % 64}", 900))
    for _ in range(40):
        inbox.put(sample("step/ground/actor-1", 900))
    assert inbox.bytes == 90_000 and inbox.dropped.total() == 950
    assert not inbox.dropped["step/ground/actor-1"]
    taken = list(inbox.drain(10.0))
    assert len(taken) == 90 and not inbox.bytes and not inbox
    inbox.put(sample("step/ground/actor-0", 900))
    assert len(inbox) == 1, "and there is room again"


def test_a_flood_does_not_keep_a_thread_at_its_inbox() -> None:
    inbox = Inbox()
    inbox.put(sample("log/a", 1))
    taken = 0
    for _ in inbox.drain(0.05):  # each one that is taken is followed by another
        taken += 1
        inbox.put(sample("log/a", 1))
    assert taken > 10 and len(inbox) == 1
