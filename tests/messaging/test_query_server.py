"""Questions and answers between real sessions, and real processes, on loopback."""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack

import pytest

from brakeline.errors import Late, NoReply, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.query_client import HELD, QueryClient
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import DECIDE, STEP
from tests.messaging.programs import ROUTER, SERVICE, Join, Spawn, answers
from tests.waiting import until


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


def test_a_question_that_ends_without_a_word_is_late_after_its_deadline_and_unheard_before(monkeypatch):
    monkeypatch.setattr("zenoh.SourceInfo", lambda *_: None)
    with pytest.raises(Late, match="within 20 ms"):
        QueryClient(_Silent(0.03)).ask("a/key", b"", 0.02)
    with pytest.raises(NoReply):
        QueryClient(_Silent(0.0)).ask("a/key", b"", 5.0)


def test_another_process_answers_when_one_is_killed(join: Join, spawn: Spawn, endpoint: str) -> None:
    join("launcher", listen=True)
    replicas = {name: spawn(SERVICE.format(place="connect", endpoint=endpoint, name=name)) for name in "ab"}
    actor = join("actor-0")
    until(lambda: answers(actor) is not None)
    first = (answers(actor) or b"").decode()[0]
    replicas[first].kill()
    other = "ab".replace(first, "").encode()
    until(lambda: answers(actor) == other + b":?")


def test_of_replicas_behind_linked_routers_one_works_and_another_when_it_is_slow_or_gone() -> None:
    one, other = free_endpoint(), free_endpoint()
    heard: dict[str, int] = {"a": 0, "b": 0}
    slow: set[str] = set()

    def batch_handler(name: str) -> Callable[[bytes, str], bytes]:
        def answer(payload: bytes, asker: str) -> bytes:
            heard[name] += 1
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
        until(lambda: answers(asker) is not None and min(heard.values()) > 0)
        before = sum(heard.values())
        replied = {asker.ask(DECIDE, b"?", timeout=10.0, robot="ground") for _ in range(50)}
        assert len(replied) == 1 and sum(heard.values()) - before == 50, "each question is answered once"
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
