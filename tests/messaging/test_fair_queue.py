"""Whose turn it is, and that nobody answers where nobody waits."""

import contextlib
import logging
import threading
import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from brakeline.errors import BusError
from brakeline.messaging.bus import fair_queue as module
from brakeline.messaging.bus import query_server
from brakeline.messaging.bus.fair_queue import MAX_PER_CLIENT, FairQueue, T
from brakeline.messaging.bus.query_client import PATIENT
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import DECIDE
from tests.messaging.test_bus import Join
from tests.waiting import PATIENCE, until


def test_each_askers_questions_are_answered_in_turn() -> None:
    turns = FairQueue[str]()
    for question in ("a1", "a2", "a3", "b1", "c1", "c2"):
        assert turns.add(question[0], question) is None
    assert len(turns) == 6
    assert [turns.next() for _ in range(4)] == ["a3", "b1", "c2", "a2"], "the newest first: it can still be in time"
    turns.add("b", "b2")
    assert [turns.next() for _ in range(3)] == ["c1", "a1", "b2"]
    assert not len(turns)


def test_of_too_many_the_oldest_of_the_same_asker_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = FairQueue[int]()
    gone = [turns.add("a", number) for number in range(MAX_PER_CLIENT + 3)]
    assert gone == [None] * MAX_PER_CLIENT + [0, 1, 2]
    monkeypatch.setattr(module, "MAX_CLIENTS", 1)
    assert turns.add("b", 7) == 7 and turns.add("a", 99) == 3


def test_an_asker_is_not_delayed_by_the_many_questions_of_another(join: Join) -> None:
    router, patient, flood = join("launcher", listen=True), join("actor-0"), join("actor-1")
    order: list[bytes] = []

    def work(payload: bytes, asker: str) -> bytes:
        order.append(payload)
        time.sleep(0.05)
        return payload

    router.serve(DECIDE, work)
    until(lambda: patient.ask(DECIDE, b"ready", timeout=10.0, robot="ground") == b"ready")

    def ask(number: int) -> None:
        with contextlib.suppress(BusError):
            flood.ask(DECIDE, b"flood", timeout=5.0, robot="ground")

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(MAX_PER_CLIENT)]
    for thread in threads:
        thread.start()
    until(lambda: b"flood" in order)
    assert patient.ask(DECIDE, b"patient", timeout=10.0, robot="ground") == b"patient"
    ahead = order[order.index(b"flood") : order.index(b"patient")]
    assert len(ahead) <= 3, "the one in hand, and one whose turn had come"
    for thread in threads:
        thread.join()


def test_a_question_for_which_nobody_waits_is_dropped_with_a_warning(
    join: Join, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A machine that stalls is no error of the service: it is said in a line, and counted."""
    came_in: list[Any] = []

    class Noted(FairQueue[T]):
        def add(self, who: str, question: T) -> T | None:
            came_in.append(question)
            return super().add(who, question)

    monkeypatch.setattr(query_server, "FairQueue", Noted)
    router, actor = join("launcher", listen=True), join("actor-0")
    answered: list[bytes] = []
    held, release = threading.Event(), threading.Event()

    def work(payload: bytes, asker: str) -> bytes:
        if payload == b"slow":
            held.set()
            assert release.wait(PATIENCE)
        answered.append(payload)
        return payload

    router.serve(DECIDE, work)
    until(lambda: actor.ask(DECIDE, b"ready", timeout=10.0, robot="ground") == b"ready")
    slow = threading.Thread(target=lambda: actor.ask(DECIDE, b"slow", timeout=PATIENCE, robot="ground"))
    slow.start()
    assert held.wait(PATIENCE)
    came_in.clear()
    with pytest.raises(BusError):
        actor.ask(DECIDE, b"dead", timeout=PATIENT, robot="ground")  # so long that no busy link drops it
    # Its time counts from when it came in, which on a busy machine may be after who asked gave up.
    until(lambda: came_in and all(time.monotonic() > question.until for question in came_in))
    release.set()
    slow.join()
    until(lambda: actor.ask(DECIDE, b"after", timeout=10.0, robot="ground") == b"after")
    assert b"dead" not in answered and {b"slow", b"after"} <= {*answered}
    assert router.rejected.count == 1
    records = [record for record in caplog.records if "Expired" in record.getMessage()]
    assert [(record.levelno, record.exc_info) for record in records] == [(logging.WARNING, None)]


class _Query:
    """A query of Zenoh that notes its answer."""

    key_expr, attachment = "safety/ground/decide/actor-0", None

    def __init__(self, number: int, answered: list[bytes]) -> None:
        self.payload = SimpleNamespace(to_bytes=lambda: b"%d" % number)
        self.reply = lambda key, answer, express: answered.append(answer)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_what_has_arrived_is_taken_over_at_once_and_the_newest_is_answered_first() -> None:
    """A thread that takes one query at a time waits for the interpreter's lock before each, and all come too late."""
    answered: list[bytes] = []
    arrived = deque(_Query(number, answered) for number in range(5))

    def recv():
        if not arrived:
            raise zenoh.ZError("closed")
        return arrived.popleft()

    handler = SimpleNamespace(recv=recv, try_recv=lambda: arrived.popleft() if arrived else None)
    receiver = SimpleNamespace(handler=handler)
    query_server.QueryServer("q", [receiver], lambda payload, _: payload, lambda _: "a", RejectedMessages())
    until(lambda: len(answered) == 5)
    assert answered == [b"4", b"3", b"2", b"1", b"0"]
