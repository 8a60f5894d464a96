"""What one identity may say and take: not for others, not all of a table, not more bytes than its topic allows."""

import socket
import time
from contextlib import ExitStack

import pytest
import zenoh

from brakeline.errors import Implausible, Malformed
from brakeline.logs import metrics as metrics_module
from brakeline.logs.metrics import Metrics
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, Sample, configuration
from brakeline.messaging.bus.identity import identity_of, speaks_for
from brakeline.messaging.bus.subscription import MOST_KEYS_OF_ONE
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.message_checks import MAX_ENTRIES
from brakeline.messaging.topics import EXCHANGE, HEALTH, LOG, STEP, Topic
from tests.waiting import until


def message(topic: Topic, key: str, content: object) -> object:
    return Sample(topic, key, content.SerializeToString(), 1).message()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("topic", "key", "content"),
    [
        (EXCHANGE, "exchange/ground/actor-1", pb.Exchange(request=pb.Request(actor="actor-0"))),
        (EXCHANGE, "exchange/ground/actor-1", pb.Exchange(request=pb.Request(robot="quadrotor"))),
        (STEP, "step/ground/actor-1", pb.Step(actor="actor-0")),
        (STEP, "step/ground/actor-1", pb.Step(header=pb.Header(source="actor-10"))),
        (HEALTH, "health/actor-1", pb.Health(process="safety")),
        (HEALTH, "health/actor-1", pb.Health(process="actor-1.7")),
        (HEALTH, "health/actor-1", pb.Health(published={"step/ground/actor-0": 10**9})),
        (HEALTH, "health/actor-1", pb.Health(published={"metrics/ground": 10**9})),
        (HEALTH, "health/actor-1", pb.Health(published={"logged/ground/actor-1": 10**9})),
        (HEALTH, "health/actor-1", pb.Health(published={"elsewhere/actor-1": 10**9})),
        (LOG, "log/actor-1", pb.LogLine(process="launcher")),
    ],
)
def test_a_message_that_speaks_for_another_is_malformed(topic: Topic, key: str, content: object) -> None:
    with pytest.raises(Malformed, match="says that"):
        message(topic, key, content)


def test_a_process_speaks_for_itself_and_its_robots() -> None:
    published = {"health/actor-1": 1, "step/ground/actor-1.3": 2}
    message(HEALTH, "health/actor-1", pb.Health(process="actor-1", published=published))
    message(HEALTH, "health/feeder.a", pb.Health(process="feeder.a", published={"logged/ground/actor-0": 2}))
    message(HEALTH, "health/learner-ground", pb.Health(process="learner-ground", published={"metrics/ground": 3}))
    message(EXCHANGE, "exchange/ground/actor-1.3", pb.Exchange(request=pb.Request(robot="ground", actor="actor-1.3")))
    assert speaks_for("actor-1", "actor-1.3") and not speaks_for("actor-1", "actor-10")


@pytest.mark.parametrize("field", ["published", "figures", "notes"])
def test_a_map_with_very_many_entries_is_malformed(field: str) -> None:
    """Else each costs every receiver time: 45,000 keys of published messages took about a second."""
    of_type = {"published": 1, "figures": 1.0, "notes": ""}[field]
    for count in (MAX_ENTRIES, MAX_ENTRIES + 1):
        content = pb.Health(**{field: {f"step/r{i}/actor-1": of_type for i in range(count)}})  # type: ignore[arg-type]
        if count == MAX_ENTRIES:
            message(HEALTH, "health/actor-1", content)
        else:
            with pytest.raises(Malformed, match=f"{count} {field}"):
                message(HEALTH, "health/actor-1", content)


@pytest.mark.parametrize(
    ("source", "identity"),
    [("actor-1.3", "actor-1"), ("actor-1", "actor-1"), ("actor.pod-7.3", "actor.pod-7"), ("client.q-1", "client.q-1")],
)  # fmt: skip
def test_who_answers_for_a_source(source: str, identity: str) -> None:
    assert identity_of(source) == identity


def test_one_identity_cannot_take_all_keys_of_a_subscription() -> None:
    endpoint, got = free_endpoint(), set[str]()
    with Bus(BusSettings(listen=(endpoint,)), "launcher") as router:
        router.subscribe(STEP, lambda sample: got.add(sample.key))
        client = zenoh.open(configuration(BusSettings(connect=(endpoint,)), "actor-0"))
        for number in range(MOST_KEYS_OF_ONE + 50):
            client.put(f"brakeline/step/robot-{number}/actor-0", b"", congestion_control=zenoh.CongestionControl.BLOCK)
        client.put("brakeline/step/ground/actor-1", b"", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: "step/ground/actor-1" in got)
        assert len(got) == MOST_KEYS_OF_ONE + 1 and router.rejected.count == 50
        client.close()  # type: ignore[no-untyped-call]


def test_one_identity_cannot_take_all_places_of_the_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_module, "MOST_STREAMS_OF_ONE", 10)
    metrics = Metrics()
    for run in range(10):
        metrics.add("log/actor-0", pb.LogLine(header=pb.Header(sequence=1, run=run)))
    with pytest.raises(Implausible, match="actor-0 has 10"):
        metrics.add("log/actor-0", pb.LogLine(header=pb.Header(sequence=1, run=10)))
    metrics.add("log/actor-1", pb.LogLine(header=pb.Header(sequence=1, run=1)))


def test_one_identity_cannot_take_all_names_of_the_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """It took the 4,000 places of the actors, and every actor that joined later had no figures."""
    monkeypatch.setattr(metrics_module, "MOST_NAMES_OF_ONE", 10)
    metrics = Metrics()
    for number in range(10):
        metrics.add(f"step/ground/actor-0.{number}", pb.Step(actor=f"actor-0.{number}"))
    with pytest.raises(Implausible, match="actor-0 has 10 names"):
        metrics.add("step/ground/actor-0.10", pb.Step(actor="actor-0.10"))
    metrics.add("step/ground/actor-1", pb.Step(actor="actor-1"))
    assert len(metrics.actors) == 11


def test_two_processes_with_one_name_are_two_starts() -> None:
    """Their Health messages alternate; each is not a start of its own."""
    metrics = Metrics()
    for number in range(1, 11):
        for run in (7, 8):
            header = pb.Header(sequence=number, run=run, wall_time=number * 10**9)
            metrics.add("health/safety", pb.Health(header=header, process="safety"))
    assert metrics.figures()["processes"]["safety"]["starts"] == 2


def test_a_router_passes_no_message_on_that_is_larger_than_its_topic_allows() -> None:
    """Else each of its subscribers holds the bytes before it refuses them."""
    endpoint, got = free_endpoint(), list[int]()
    with Bus(BusSettings(listen=(endpoint,)), "launcher") as router:
        router.subscribe(LOG, lambda sample: got.append(len(sample.payload)))
        client = zenoh.open(configuration(BusSettings(connect=(endpoint,)), "client"))
        for size in (LOG.largest + 1, 8 * LOG.largest, LOG.largest, 1):
            client.put("brakeline/log/client", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: got[-1:] == [1])
        assert got == [LOG.largest, 1] and router.rejected.count == 0
        client.close()  # type: ignore[no-untyped-call]


def test_silent_connections_do_not_delay_a_process_that_joins() -> None:
    """300 of them took all places of those that had not authenticated themselves yet, for ten seconds."""
    endpoint = free_endpoint()
    port = int(endpoint.rsplit(":", 1)[1])
    with ExitStack() as stack:
        stack.enter_context(Bus(BusSettings(listen=(endpoint,)), "launcher"))
        for _ in range(300):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), 10.0))
        begun = time.monotonic()
        stack.enter_context(Bus(BusSettings(connect=(endpoint,), patience=30.0), "actor-0"))
        assert time.monotonic() - begun < 5.0
