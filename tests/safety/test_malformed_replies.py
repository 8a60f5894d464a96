"""A reply with any malformed field brakes the robot with a reason: it neither raises nor counts as verified."""

from collections.abc import Iterator
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.actors.decision_guard import next_input, request_decisions
from brakeline.actors.slow_down import SlowDown
from brakeline.errors import SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.service.client import read_reply, request_message
from brakeline.safety.service.filter_client import accept
from brakeline.safety.service.service_query import query_service
from brakeline.safety.service.wire import digest, request_of
from tests.safety.served import Service, with_fields

NUMBERS = (nan, inf, -inf)
# What these fields may not hold, beside what their types say.
MALFORMED: dict[str, tuple[Any, ...]] = {
    "kind": (pb.UNKNOWN, pb.RECOVERING, 99),
    "model": ("", UNVERIFIED),
    "robot": ("", "quadrotor+tracks", "a" * 10_000),
    "bound": (*NUMBERS, -1e-9, 1.001),
    "outside_share": (*NUMBERS, -1e-9, 0.5),
    "score": (nan, -inf, -1e-9),
    "plan_score": (nan, -inf, -1e-9),
    "room": (nan,),
}
NOT_NEGATIVE = ("half_width", "radius", "tube_half_width", "predicted_half_width")
# No value of these is malformed: texts for people, flags, and counts.
ANY = (
    *("reason", "solver", "by", "at_least", "contained", "compared", "judges", "for_clearance", "token_rejected"),
    *("verified", "iterations", "broken"),
)
MAY_BE_MISSING = (*ANY, "stopped", "score", "plan_score", "plan_tokens", "normal", "at")


class Asked:
    """A robot that drives by a verified plan, its next request, and the valid reply to it, with every field set."""

    def __init__(self, name: str, fleet: tuple[str, ...]) -> None:
        model = Filter.load(name).model
        self.robot, service = model.robot, Service(model, key=bytes(32))
        self.plan = BackupPlan(self.robot)
        first, state = self.robot.zero_input(), np.zeros(self.robot.state_dim)
        first[0] = 0.1
        near = [Obstacle("sphere", (1.0, *np.zeros(self.robot.position_dim - 1)), (0.1,))]
        message = request_message(self.plan, state, first, near, actor="a", fleet=fleet)
        accept(self.plan, read_reply(service.replies(message)[0], message, self.robot))
        self.request = request_message(self.plan, state, 100.0 * first, near, actor="a", fleet=fleet)
        self.reply = service.replies(self.request)[0]
        decision = self.reply.decision
        decision.score, decision.for_clearance = 0.5, True
        if not decision.HasField("stopped"):
            at = [0.0] * self.robot.position_dim
            decision.stopped.CopyFrom(pb.Stopped(by="sphere", room=-0.1, after=0.2, normal=at, at=at))
        assert decision.verified and decision.plan_tokens and any(decision.plan)

    def acted(self, reply: pb.Reply) -> tuple[bool, str]:
        """Act on a reply as an actor does. Return whether it gave an answer, and otherwise the reason."""
        plan = BackupPlan(self.robot)
        for name in ("plan", "input_in_force", "predicted", "reservation", "model"):
            setattr(plan, name, getattr(self.plan, name))
        plan.measured(np.zeros(self.robot.state_dim))
        expected = plan.plan[self.robot.committed_steps].copy()
        outcome = request_decisions(lambda requests: [reply], [self.request], self.robot)[0]
        action = next_input(plan, outcome)
        if outcome.answer is None:
            assert np.array_equal(action, expected), "the robot goes on with its backup plan"
        else:
            SlowDown(self.robot, "a").update(plan.widening.left, outcome.answer.bound)
        outcome.exchange(0.0).SerializeToString()
        request_message(plan, np.zeros(self.robot.state_dim), action, known_free=True).SerializeToString()
        return outcome.answer is not None, outcome.failure


@pytest.fixture(scope="module", params=[("ground", ()), ("ground", ("a",)), ("quadrotor", ())], ids=str)
def asked(request: pytest.FixtureRequest) -> Asked:
    return Asked(*request.param)


def malformed(message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield changes of a message, each of which makes a single field malformed: its path, and what to do with it."""
    for item in message.DESCRIPTOR.fields:
        name, place = item.name, f"{path}{item.name}"
        if item.is_repeated:
            yield from _malformed_list(item, place, len(getattr(message, name)))
        elif item.type == FieldDescriptor.TYPE_MESSAGE:
            if message.HasField(name):
                yield from malformed(getattr(message, name), f"{place}.")
        elif name not in ANY:
            values = MALFORMED.get(name, NUMBERS if item.type == FieldDescriptor.TYPE_DOUBLE else None)
            assert values is not None, f"{place}: say which of its values are malformed"
            yield from ((place, value) for value in values)
        present = item.is_repeated or (item.has_presence and message.HasField(name))
        if present and name not in MAY_BE_MISSING:
            yield place, None


def _malformed_list(item: FieldDescriptor, place: str, length: int) -> Iterator[tuple[str, Any]]:
    if item.type == FieldDescriptor.TYPE_BYTES:
        yield from ((place, tokens) for tokens in ([b""], [b"a" * 15], [b"a" * 10_000], [b"a" * 16] * 1000))
        return
    yield from ((place, [0.0] * count) for count in {1, length - 1, length + 1, 4 * length + 1} - {0, length})
    for at in range(0, length, max(length // 4, 1)):
        numbers = [*NUMBERS, -1.0] if item.name in NOT_NEGATIVE else NUMBERS
        yield from ((place, (at, value)) for value in (*numbers, *((1e6,) if item.name == "plan" else ())))


def changed(reply: pb.Reply, path: str, value: Any) -> pb.Reply:
    """Return the reply with another value of a field; None: without it; (place, value): an element of a list."""
    reply = pb.Reply.FromString(reply.SerializeToString())
    *way, name = path.split(".")
    message: Any = reply
    for part in way:
        message = getattr(message, part)
    if value is None:
        message.ClearField(name)
    elif isinstance(value, tuple):
        getattr(message, name)[value[0]] = value[1]
    else:
        with_fields(message, **{name: value})
    return reply


def test_every_malformed_field_of_a_reply_brakes_the_robot_with_a_reason(asked: Asked) -> None:
    assert asked.acted(asked.reply) == (True, "")
    paths = set()
    for path, value in malformed(asked.reply):
        answered, why = asked.acted(changed(asked.reply, path, value))
        assert not answered and len(why) > 10, f"{path} = {str(value)[:50]}: {why}"
        paths.add(path)
    assert {"robot", "decision", "decision.kind", "decision.bound", "decision.stopped.normal"} <= paths
    assert ("decision.reservation.center" in paths) == bool(asked.request.fleet)


@pytest.mark.parametrize("part", ["tube", "predicted"])
def test_a_verified_plan_without_a_set_is_refused_and_an_unverified_one_is_not(asked: Asked, part: str) -> None:
    reply = asked.reply
    for name in (f"{part}_center", f"{part}_half_width"):
        reply = changed(reply, f"decision.{name}", None)
    answered, why = asked.acted(reply)
    assert not answered and f"{part}" in why and "without" in why
    rival = changed(changed(reply, "decision.verified", False), "decision.bound", None)
    assert asked.acted(rival) == (True, "")


def test_answers_are_compared_by_their_values(asked: Asked) -> None:
    first, same = (read_reply(asked.reply, asked.request, asked.robot) for _ in range(2))
    other = read_reply(changed(asked.reply, "decision.margin", 0.123), asked.request, asked.robot)
    assert first == same and first != other and first != "an answer"
    assert first.predicted == same.predicted and first.blocked_by == same.blocked_by
    one, two = (request_of(asked.request, asked.robot) for _ in range(2))
    assert one == two and one != replace(one, action=-one.action)


def test_an_error_without_words_and_a_reply_without_a_result_have_a_reason(asked: Asked) -> None:
    for reply in (pb.Reply(), pb.Reply(error=pb.Error()), pb.Reply(robot="ground"), pb.Reply(error=pb.Error(type="x"))):
        answered, why = asked.acted(reply)
        assert not answered and ("reason" in why or "neither" in why)


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_no_value_of_any_field_raises_through_the_actor(asked: Asked, data: st.DataObject) -> None:
    """Values of all kinds, well formed or not: of what counts as verified, every number is finite."""
    reply = pb.Reply.FromString(asked.reply.SerializeToString())
    message: Any = reply
    while True:
        item = data.draw(st.sampled_from(list(message.DESCRIPTOR.fields)))
        if item.type != FieldDescriptor.TYPE_MESSAGE or data.draw(st.integers(0, 9)) == 0:
            break
        message = getattr(message, item.name)
    message.ClearField(item.name)
    if item.type != FieldDescriptor.TYPE_MESSAGE and data.draw(st.integers(0, 9)):
        value = {
            FieldDescriptor.TYPE_DOUBLE: st.floats(),
            FieldDescriptor.TYPE_STRING: st.text(max_size=50),
            FieldDescriptor.TYPE_BYTES: st.binary(max_size=40),
            FieldDescriptor.TYPE_BOOL: st.booleans(),
            FieldDescriptor.TYPE_UINT32: st.integers(0, 2**32 - 1),
            FieldDescriptor.TYPE_ENUM: st.integers(-(2**31), 2**31 - 1),
        }[item.type]
        if item.is_repeated:
            getattr(message, item.name).extend(data.draw(st.lists(value, max_size=50)))
        else:
            setattr(message, item.name, data.draw(value))
    answered, why = asked.acted(reply)
    if answered and (answer := read_reply(reply, asked.request, asked.robot)).verified:
        assert answer.bound is not None and 0.0 <= answer.bound <= 1.0
        parts = (answer.plan, answer.tube_center, answer.tube_half_width, answer.predicted.center)
        assert all(part.size and np.isfinite(part).all() for part in parts)
        assert (answer.tube_half_width >= 0.0).all() and (answer.predicted.half_width >= 0.0).all()
    assert answered or len(why) > 3


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_bytes_that_are_damaged_on_the_way_raise_nothing_but_an_error_of_the_bus(
    asked: Asked, data: st.DataObject
) -> None:
    def damaged(topic: Any, payload: bytes, timeout: float, **names: str) -> bytes:
        whole = bytearray(pb.ReplyBatch(replies=[asked.reply], request=digest(payload)).SerializeToString())
        for _ in range(data.draw(st.integers(1, 3))):
            whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
        return bytes(whole[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else whole)

    class DamagedLink:
        ask = staticmethod(damaged)

    bus: Any = DamagedLink()
    try:
        reply = query_service(bus, [asked.request], 0.1)[0]
    except SafetyError as error:
        assert "BadReply" in str(error)
    else:
        asked.acted(reply)
