"""Messages that travel in bundles arrive as if each had come alone."""

import time

import pytest

from brakeline.errors import Malformed
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.bundling import HOLD, MOST_BUNDLED, Unbundler
from brakeline.messaging.bus.subscription import Listener
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import BUNDLE, BUNDLED, EPISODE, EXCHANGE, STEP
from tests.messaging.programs import Join
from tests.waiting import until

STEPS = 40


def test_bundled_messages_arrive_in_order_with_their_bytes_and_in_few_bundles(join: Join) -> None:
    recorder, learner, actor = join("launcher", listen=True), join("learner"), join("actor-0")
    got, learned, bundles = list[Sample](), list[Sample](), list[Sample]()
    for topic in BUNDLED:
        recorder.subscribe(topic, got.append)
    recorder.subscribe(BUNDLE, bundles.append)
    learner.subscribe(STEP, learned.append, robot="ground")
    time.sleep(0.3)  # until the router knows the learner's subscription
    kinds = (EPISODE, EXCHANGE, STEP)
    publishers = {t: actor.publisher(t, robot="ground", source="actor-0.1", bundled=True) for t in kinds}
    sent = []
    for number in range(STEPS):
        for topic in (EXCHANGE, STEP) if number else kinds:
            message = topic.message()
            publishers[topic].put(message)
            sent.append((f"{topic.name}/ground/actor-0.1", message.SerializeToString()))
    actor.flush()
    until(lambda: len(got) == len(sent) and len(learned) == STEPS)
    assert [(sample.key, sample.payload) for sample in got] == sent
    assert all(sample.message().header.source == "actor-0.1" for sample in got)
    assert [sample.received for sample in got] == sorted({sample.received for sample in got}), "each has its own time"
    assert [sample.payload for sample in learned] == [payload for key, payload in sent if key.startswith("step")]
    assert len(bundles) <= len(sent) / MOST_BUNDLED + 5, "a message of its own for each would cost every process more"
    assert actor.published()["step/ground/actor-0.1"] == STEPS


def test_a_message_waits_for_a_short_time_only_and_for_nobody_to_send_it(join: Join) -> None:
    router, actor = join("launcher", listen=True), join("actor-0")
    got = list[Sample]()
    router.subscribe(STEP, got.append, robot="ground", source="actor-0")
    router.subscribe(STEP, got.append, robot="ground", source="actor-1")
    actor.publisher(STEP, robot="ground", bundled=True).put(pb.Step(index=1))
    began = time.monotonic()
    until(lambda: len(got) == 1)
    assert time.monotonic() - began < 20 * HOLD


def test_what_waits_leaves_before_the_process_does(join: Join) -> None:
    router, actor = join("launcher", listen=True), join("actor-0")
    got = list[Sample]()
    router.subscribe(STEP, got.append)
    for _ in range(3):
        actor.publisher(STEP, robot="ground", bundled=True).put(pb.Step())
    actor.close()
    until(lambda: len(got) == 3)


@pytest.mark.fast
@pytest.mark.parametrize(
    "key",
    ["step/ground/actor-1", "step/ground/actor-00", "step/quadrotor/actor-0", "model/ground/actor-0", "weights/ground",
     "step/ground", "step/ground/actor-0/more", "step/*/actor-0", "", "health/actor-0"],
)  # fmt: skip
def test_a_bundle_speaks_for_its_sender_only(key: str) -> None:
    rejected, got = RejectedMessages(), list[Sample]()
    unbundler = Unbundler(rejected)
    for topic in BUNDLED:
        unbundler.add(topic, {}, _listener(topic, got).deliver)
    honest = pb.BundledMessage(key="step/ground/actor-0.7", payload=pb.Step(index=1).SerializeToString())
    forged = pb.BundledMessage(key=key, payload=honest.payload)
    bundle = pb.Bundle(messages=[forged, honest])
    unbundler.take(Sample(BUNDLE, "bundle/ground/actor-0", bundle.SerializeToString(), time.time_ns()))
    assert (rejected.count, [sample.key for sample in got]) == (1, [honest.key])


@pytest.mark.fast
def test_a_bundle_that_is_none_and_a_message_that_is_too_large_are_lost_alone() -> None:
    rejected, got = RejectedMessages(), list[Sample]()
    unbundler = Unbundler(rejected)
    unbundler.add(STEP, {}, _listener(STEP, got).deliver)
    with pytest.raises(Malformed):
        unbundler.take(Sample(BUNDLE, "bundle/ground/actor-0", b"\xff\xff", 0))
    large = pb.BundledMessage(key="step/ground/actor-0", payload=bytes(STEP.largest + 1))
    small = pb.BundledMessage(key="step/ground/actor-0", payload=b"")
    bundle = pb.Bundle(messages=[large, small])
    unbundler.take(Sample(BUNDLE, "bundle/ground/actor-0", bundle.SerializeToString(), 0))
    assert (rejected.count, len(got)) == (1, 1)


def _listener(topic, got):
    """Return a listener that hears bundled messages only."""

    class Silence:
        handler = ()

        def undeclare(self) -> None:
            pass

    return Listener(topic, topic.key, Silence(), "brakeline", got.append, RejectedMessages())
