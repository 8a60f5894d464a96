"""Questions and answers between real sessions on loopback: whose turn it is, and that nobody answers where nobody
waits.
"""

import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from brakeline.errors import BusError, Late, NoReply, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, configuration, fair_queue, query_client, query_server
from brakeline.messaging.bus.fair_queue import MAX_PER_CLIENT, FairQueue, T
from brakeline.messaging.bus.query_client import HELD, PATIENT, QueryClient
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import DECIDE, STEP
from tests.messaging.programs import ROUTER, Join, Spawn, answers
from tests.waiting import PATIENCE, until


def test_failures_of_a_question_are_typed(
    join: Join, caplog: pytest.LogCaptureFixture, stalled: Callable[[], float]
) -> None:
    join("launcher", listen=True)
    actor, safety = join("actor-0"), join("safety")
    start = time.perf_counter()
    with pytest.raises(NoReply, match="is the service running"):
        actor.ask(DECIDE, b"?", timeout=5.0, robot="ground")
    assert time.perf_counter() - start < 1.0 + stalled(), "that nobody answers is known at once"

    class BadRequest(ValueError):
        field = "state"

    release = threading.Event()

    def handler(payload: bytes, asker: str) -> bytes:
        if payload == b"wrong":
            raise BadRequest("not finite")
        if payload == b"slow":
            release.wait(5.0)
        return payload

    service = safety.serve(DECIDE, handler)
    until(lambda: answers(actor) == b"?")
    with pytest.raises(Refused, match="BadRequest: not finite") as refused:
        actor.ask(DECIDE, b"wrong", timeout=10.0, robot="ground")
    assert (refused.value.type, refused.value.field, refused.value.text) == ("BadRequest", "state", "not finite")
    until(lambda: "not finite" in caplog.text)
    start = time.perf_counter()
    with pytest.raises(Late, match="within 100 ms"):
        actor.ask(DECIDE, b"slow", timeout=0.1, robot="ground")
    assert 0.09 < time.perf_counter() - start < 1.0 + stalled()
    release.set()
    noise = bytes(range(256)) * 40_000  # 10 MB
    assert actor.ask(DECIDE, noise, timeout=5.0, robot="ground") == noise
    assert actor.ask(DECIDE, b"", timeout=10.0, robot="ground") == b""
    service.close()
    with pytest.raises(NoReply):
        actor.ask(DECIDE, b"?", timeout=2.0, robot="ground")


class _Silent:
    """A Zenoh session whose questions end without any reply, after so many seconds."""

    id = None

    def __init__(self, after):
        self._after = after

    def declare_querier(self, *_, **__):
        return self

    def get(self, **_):
        time.sleep(self._after)
        return iter(())


def test_an_error_reply_that_is_no_message_is_a_refusal(join: Join, endpoint: str) -> None:
    """It was an error of protobuf, on which an actor ended instead of braking its robot."""
    join("launcher", listen=True)
    actor = join("actor-0")
    service = zenoh.open(configuration(BusSettings(connect=(endpoint,)), "safety"))
    service.declare_queryable(
        "brakeline/safety/ground/decide/*",
        lambda query: query.reply_err(b"\xff\xff", encoding=zenoh.Encoding.APPLICATION_PROTOBUF),
    )

    def refusal() -> Refused | None:
        try:
            actor.ask(DECIDE, b"", PATIENCE, robot="ground")
        except NoReply:  # the router does not know the service yet
            return None
        except Refused as error:
            return error
        raise AssertionError("an answer")

    assert until(refusal).type == "BadReply"
    service.close()  # type: ignore[no-untyped-call]


def test_a_question_that_ends_without_a_word_is_late_after_its_deadline_and_unheard_before():
    with pytest.raises(Late, match="within 20 ms"):
        QueryClient(_Silent(0.03)).ask("a/key", b"", 0.02)
    with pytest.raises(NoReply):
        QueryClient(_Silent(0.0)).ask("a/key", b"", 5.0)


def test_of_replicas_behind_linked_routers_one_works_and_another_when_it_is_slow_or_gone(monkeypatch) -> None:
    one, other = free_endpoint(), free_endpoint()
    heard: dict[str, list[bytes]] = {"a": [], "b": []}
    slow: set[str] = set()

    def batch_handler(name: str) -> Callable[[bytes, str], bytes]:
        def answer(payload: bytes, asker: str) -> bytes:
            heard[name].append(payload)
            if name in slow:
                time.sleep(0.5)
            return name.encode()

        return answer

    with ExitStack() as stack:
        stack.enter_context(Bus(BusSettings(listen=(one,)), "router-0"))
        stack.enter_context(Bus(BusSettings(listen=(other,), connect=(one,)), "router-1"))
        there = {"a": one, "b": other}
        services = {
            name: stack.enter_context(Bus(BusSettings(connect=(at,)), f"safety-{name}")) for name, at in there.items()
        }
        for name, bus in services.items():
            bus.serve(DECIDE, batch_handler(name))
        asker = stack.enter_context(Bus(BusSettings(connect=(other,)), "actor-0"))
        with monkeypatch.context() as patch:
            patch.setattr(query_client, "RENEWED", 0.0)  # each question goes to all that are known so far
            until(lambda: answers(asker) is not None and all(heard.values()))
        questions = [b"%d" % number for number in range(50)]
        replied = {asker.ask(DECIDE, question, timeout=10.0, robot="ground") for question in questions}
        answered = [question for name in heard for question in heard[name] if question != b"?"]
        assert len(replied) == 1 and sorted(answered) == sorted(questions), "each question is answered once"
        first = replied.pop().decode()
        second = "ab".replace(first, "")
        slow.add(first)
        time.sleep(HELD)
        with pytest.raises(Late):
            asker.ask(DECIDE, b"?", timeout=0.1, robot="ground")
        for _ in range(2):  # the next goes to all, and who is quick is asked from then on
            assert asker.ask(DECIDE, b"?", timeout=10.0, robot="ground") == second.encode()
        services[second].close()
        slow.clear()
        assert asker.ask(DECIDE, b"?", timeout=10.0, robot="ground") == first.encode(), "it is known who is gone"


def test_a_question_does_not_wait_behind_telemetry(join: Join, stalled: Callable[[], float]) -> None:
    router, actor, safety = join("launcher", listen=True), join("actor-0"), join("safety")
    release = threading.Event()
    safety.serve(DECIDE, lambda payload, asker: payload)
    router.subscribe(STEP, lambda _: release.wait(10.0) and None)
    safety.subscribe(STEP, lambda _: release.wait(10.0) and None)
    until(lambda: answers(actor) == b"?")
    publisher = actor.publisher(STEP, robot="ground")
    worst = 0.0
    for _ in range(300):
        publisher.put(pb.Step(observation=[0.0] * 100))
        start = time.perf_counter()
        actor.ask(DECIDE, b"?", timeout=10.0, robot="ground")
        worst = max(worst, time.perf_counter() - start)
    release.set()
    assert worst < 0.25 + stalled()


def test_who_has_the_patience_gets_an_answer_though_the_link_stalls(join: Join, spawn: Spawn, endpoint: str) -> None:
    """Zenoh drops what a busy link does not take in time: once an answer, and a run in lockstep braked for nothing."""
    router = spawn(ROUTER.format(endpoint=endpoint))
    actor, safety = join("actor-0"), join("safety")
    safety.serve(DECIDE, lambda payload, asker: payload[:10], robot="ground")
    until(lambda: answers(actor, b"x") == b"x")
    router.send_signal(signal.SIGSTOP)
    wake = threading.Timer(0.3, router.send_signal, [signal.SIGCONT])
    wake.start()
    assert actor.ask(DECIDE, bytes(2**24), 30.0, robot="ground") == bytes(10)
    wake.join()


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
    monkeypatch.setattr(fair_queue, "MAX_CLIENTS", 1)
    assert turns.add("b", 7) == 7 and turns.add("a", 99) == 3


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
    until(lambda: answers(actor, b"ready", 10.0) == b"ready")
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
    until(lambda: router.rejected.count == 1, "another thread drops the dead question")
    records = [record for record in caplog.records if "Expired" in record.getMessage()]
    assert [(record.levelno, record.exc_info) for record in records] == [(logging.WARNING, None)]


class _Query:
    """A query of Zenoh that notes its answer."""

    attachment = None

    def __init__(self, asker: str, number: int, answered: list[bytes]) -> None:
        self.key_expr = f"safety/ground/decide/{asker}"
        self.payload = SimpleNamespace(to_bytes=lambda: b"%d" % number)
        self.reply = lambda key, answer, express: answered.append(answer)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_all_that_has_arrived_is_taken_over_at_once_and_askers_take_turns() -> None:
    """A thread that takes one query at a time waits for the interpreter's lock before each, and all come too late."""
    answered: list[bytes] = []
    askers = ["flood", "flood", "patient", "flood", "flood", "flood"]
    arrived = deque(_Query(asker, number, answered) for number, asker in enumerate(askers))

    def recv():
        if not arrived:
            raise zenoh.ZError("closed")
        return arrived.popleft()

    handler = SimpleNamespace(recv=recv, try_recv=lambda: arrived.popleft() if arrived else None)
    receiver = SimpleNamespace(handler=handler)
    query_server.QueryServer(
        "q", [receiver], lambda payload, _: payload, lambda key: key.split("/")[-1], RejectedMessages()
    )
    until(lambda: len(answered) == 6)
    assert answered == [b"5", b"2", b"4", b"3", b"1", b"0"]
