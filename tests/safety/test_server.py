"""The service checks each request, and the client each reply."""

import logging
import re
import time
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.errors import BadRequest, NoModel, NoReply, Refused, SafetyError, UnknownRobot
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Disc
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.filter.request import NOT_FINITE
from brakeline.safety.service.client import SafetyClient, read_reply, request_message
from brakeline.safety.service.service_query import query_service
from brakeline.safety.service.wire import MAX_BATCH_SIZE
from tests.messaging.conftest import endpoint, join  # noqa: F401 - fixtures
from tests.robots import GROUND, QUADROTOR
from tests.safety.served import Service, with_fields

NAN = float("nan")
AHEAD = Obstacle("cylinder", (0.34, 0.0), (0.1,))


def good(**more):
    return request_message(BackupPlan(GROUND), np.zeros(5), [0.2, 0.1], [AHEAD], actor="actor-0", **more)


@pytest.fixture
def service(model):
    return Service(model)


def test_each_request_of_a_batch_has_its_reply_in_order(service, model):
    """A bad request does not affect the others."""
    replies = service.replies(good(), bad(action=[0.0]), good(time=2.0))
    assert [reply.WhichOneof("result") for reply in replies] == ["decision", "error", "decision"]
    for reply in replies[::2]:
        answer = read_reply(reply, good(), GROUND)
        assert answer.kind in ("allowed", "adjusted") and answer.verified
        assert answer.model == model.version
        assert answer.time_ms > 0
    figures = service.counts.figures()
    assert (figures["decisions"], figures["errors"]) == (2, 1) and figures["decide_ms"] > 0.0


def test_a_standing_robot_with_widened_sets_reserves_as_much_as_they_take(service):
    backup_plan, replies = BackupPlan(GROUND), {}
    for factor in (1.0, 10.0):
        backup_plan.widening.factors = factor, factor
        asked = request_message(backup_plan, np.zeros(5), [NAN, 0.0], known_free=True, actor="a", fleet=["a"])
        replies[factor] = read_reply(service.replies(asked)[0], asked, GROUND)
        reserved = replies[factor].reservation
        assert (reserved.half_width[-1] >= replies[factor].tube_half_width[-1] - 1e-12).all()
    assert (replies[10.0].reservation.half_width > replies[1.0].reservation.half_width).all()


def bad(**changes):
    return with_fields(good(), **changes)


def with_obstacle(**changes):
    message = good()
    message.obstacles.append(pb.Obstacle(**{"kind": "cylinder", "position": [0.3, 0.0], "size": [0.1]} | changes))
    return message


def verified(service, message=None):
    """Return the answer to a message, or to a good one, whose plan has to be verified."""
    message = good() if message is None else message
    answer = read_reply(service.replies(message)[0], message, GROUND)
    assert answer.verified
    return answer


@pytest.mark.parametrize(
    ("field", "message", "advice"),
    [
        ("plan", bad(plan=[0.0] * 5), "plan has 5 numbers; a plan of ground has 3 x 2"),
        ("plan", bad(plan=[3.0, 0, 0, 0, 0, 0]), r"speed \[m/s\] is 3, and its bounds are 0 and 0.25: state inputs as"),
        ("plan", bad(plan=[0, 0, 0, 0, 0.1, 0]), "does not end in a stop: append one"),
        ("input_in_force", bad(input_in_force=[0.0, 28.6]), r"turn rate \[rad/s\] is 28.6, .* -0.5 and 0.5: .* units"),
        ("state", bad(state=[0, 0, NAN, 0, 0]), "state holds NaN or infinity: follow the backup plan"),
        ("widening", bad(widening=0.5), "at least 1, not 0.5: send the factor"),
        ("past", bad(past_states=[0.0] * 5), "must have 3 states and 4 inputs of ground: send a whole window, or none"),
        ("past", bad(past_states=[NAN] * 15, past_inputs=[0.0] * 8), "past holds NaN or infinity: begin a new window"),
        ("predicted_half_width", bad(predicted_center=[0.0] * 5), r"has shape \(0,\), a ground robot's has \(5,\)"),
        (
            "predicted_half_width",
            bad(predicted_center=[0.0] * 5, predicted_half_width=[-0.1] * 5),
            "negative half-width: send the prediction",
        ),
        ("obstacles", bad(obstacles=[]), "give obstacles, or a scan, or say known_free"),
        ("model", bad(model="../../etc/passwd"), "never in use here: follow it until the robot stands"),
        ("obstacles[1].size", with_obstacle(size=[-0.1]), "above 0 and up to 10000 m"),
        ("obstacles[1].position", with_obstacle(position=[0.0] * 3), "this robot's obstacles have 2"),
        ("obstacles[1].kind", with_obstacle(kind="cloud"), "there are: box, cylinder, sphere, wall"),
    ],
)
def test_a_bad_request_gets_an_error_that_names_the_field_and_says_what_to_send(service, field, message, advice):
    """`test_filter.py` has the other numbers, and `test_obstacle.py` all malformed obstacles."""
    error = service.error(message)
    assert error.field == field and re.search(advice, error.message)
    assert error.type == ("StaleModel" if field == "model" else "BadRequest")
    assert service.counts.errors == 1
    verified(service)


@pytest.mark.parametrize(
    "change", [{"body": (Disc((0.0, 0.0), 0.3),)}, {"period": 0.5}, {"state": ("y", "x", "a", "v", "w")}]
)
def test_a_robot_with_another_description_of_the_same_name_gets_no_decision(service, change):
    mine = replace(GROUND, **change)
    message = request_message(BackupPlan(mine), np.zeros(5), [0.2, 0.1], [AHEAD])
    error = service.error(message)
    assert (error.type, error.field) == ("BadRequest", "layout") and "another description of ground" in error.message
    with pytest.raises(SafetyError, match="another description"):
        read_reply(service.replies(message)[0], message, mine)
    message.layout = ""  # of a client in another language: the service cannot compare
    assert service.replies(message)[0].WhichOneof("result") == "decision"
    fleet = request_message(BackupPlan(mine), np.zeros(5), [0.2, 0.1], [AHEAD], actor="a", fleet=["a"])
    assert service.error(fleet).field == "layout"
    assert good().layout == GROUND.layout()


def test_the_service_refuses_bytes_that_are_not_a_batch_and_goes_on(service):
    rng = np.random.default_rng(0)
    whole = pb.RequestBatch(requests=[good()]).SerializeToString()
    too_large = rng.bytes(10 << 20), bytes(MAX_BATCH_SIZE + 1)
    for payload in (*too_large, b"", b"\xff" * 50, rng.bytes(500), whole[:-3], whole[:40]):
        with pytest.raises(BadRequest) as caught:
            service.answer(payload)
        assert caught.value.field in ("payload", "requests")
        verified(service)


@pytest.mark.parametrize("robot", ["submarine", "", "quadrotor"])
def test_a_batch_about_other_robots_is_refused_as_a_whole(service, robot):
    """So another service on the bus may answer: a client takes the first answer that is no error."""
    advice = r"loaded: ground\): start another service .*`brakeline safety "
    with pytest.raises((UnknownRobot, NoModel), match=advice) as caught:
        service.answer(pb.RequestBatch(requests=[bad(robot=robot)] * 2).SerializeToString())
    assert caught.value.field == "robot" and service.counts.errors == 2
    mixed = service.replies(bad(robot=robot), good())
    assert [reply.WhichOneof("result") for reply in mixed] == ["error", "decision"]
    assert mixed[0].error.field == "robot"


def test_random_damage_never_gets_an_unchecked_decision(service):
    """A changed byte may make another valid request. The reply is an error or a plan within bounds."""
    rng = np.random.default_rng(1)
    whole = bytearray(pb.RequestBatch(requests=[good()]).SerializeToString())
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        try:
            replies = pb.ReplyBatch.FromString(service.answer(bytes(damaged))).replies
        except (BadRequest, UnknownRobot):
            continue
        for reply in replies:
            if reply.WhichOneof("result") == "decision":
                read_reply(reply, good(), GROUND)
            else:
                assert reply.error.type in ("BadRequest", "StaleModel", "UnknownRobot")


def test_without_a_model_and_after_an_unexpected_failure_the_reply_is_an_error(service, monkeypatch, caplog):
    with pytest.raises(NoModel) as caught:
        Service().error(good())
    assert caught.value.field == "robot"

    def broken(request):
        raise ArithmeticError("boom")

    monkeypatch.setattr(service.models.filters["ground"], "decide", broken)
    with caplog.at_level(logging.ERROR):
        error = service.error(good())
    assert error.type == "ArithmeticError"
    assert "decide failed for actor-0" in caplog.text
    monkeypatch.undo()
    verified(service)


def test_a_model_is_replaced_while_the_service_runs(model, tmp_path):
    newer, service = replace(model, stands=3), Service(model, archive=tmp_path)
    moving = good()
    moving.ClearField("obstacles")
    moving.known_free = True
    moving.model, moving.input_in_force[0], moving.plan[0] = model.version, 0.2, 0.1
    assert verified(service, moving).model == model.version
    service.models.install(newer)
    assert verified(service, moving).model == newer.version
    assert service.error(bad(model="ffffffffffff")).type == "StaleModel"
    other = Service(newer, archive=tmp_path)  # a replica that shares the archive knows what this one has used
    for name in (UNVERIFIED, model.version):
        moving.model = name
        for replica in (service, other):
            assert verified(replica, moving).model == newer.version


def test_violations_and_unverified_decisions_are_counted(service, caplog):
    message = good()
    message.predicted_center.extend([9.0] * 5)
    message.predicted_half_width.extend([0.1] * 5)
    answer = read_reply(service.replies(message)[0], message, GROUND)
    assert answer.compared
    assert not answer.contained
    assert "outside the predicted set" in caplog.text
    message.obstacles.append(pb.Obstacle(kind="cylinder", position=[0.2, 0.0], size=[0.1]))
    assert not read_reply(service.replies(message)[0], message, GROUND).verified
    figures = service.counts.figures()
    assert (figures["violations"], figures["compared"], figures["unverified"]) == (2, 2, 1)


# --- replies that the client refuses ----------------------------------------------------------------------------------


def test_the_client_names_the_field_of_a_bad_reply(service):
    """`test_malformed_replies.py` has all values that it refuses."""
    reply = service.replies(good())[0]
    for change, field in (
        (lambda d: d.plan.append(0.0), "plan"),
        (lambda d: d.plan.__setitem__(4, 0.1), "plan"),
        (lambda d: setattr(d, "kind", pb.UNKNOWN), "kind"),
        (lambda d: d.predicted_center.pop(), "predicted_center"),
        (lambda d: d.tube_center.pop(), "tube_center"),
        (lambda d: setattr(d, "model", ""), "model"),
    ):
        damaged = pb.Reply()
        damaged.CopyFrom(reply)
        change(damaged.decision)
        with pytest.raises(SafetyError) as caught:
            read_reply(damaged, good(), GROUND)
        assert caught.value.field == field
    for answer in (b"\xff\xff", pb.ReplyBatch().SerializeToString(), b""):
        with pytest.raises(SafetyError, match="BadReply"):
            query_service(answering(answer), [good()], 0.1)


def answering(answer):
    """Return a bus that gives the same answer to everything."""
    return SimpleNamespace(ask=lambda *_, **__: answer)


def test_a_replayed_reply_is_refused(service):
    """Even for an equal request: each batch has a nonce, and the reply names the digest of its batch."""
    recorded = []

    class Recording:
        def ask(self, topic, payload, timeout, **names):
            recorded.append(service.answer(payload))
            return recorded[-1]

    assert read_reply(query_service(Recording(), [good()], 0.1)[0], good(), GROUND).verified
    elsewhere = request_message(BackupPlan(GROUND), np.ones(5) * 0.1, [0.2, 0.1], [AHEAD])
    for question in (good(), elsewhere):
        with pytest.raises(SafetyError) as caught:
            query_service(answering(recorded[0]), [question], 0.1)
        assert caught.value.field == "request"


@pytest.mark.parametrize("many", [{"obstacles": [AHEAD] * 60}, {"observation": np.zeros(4096, np.float32)}])
def test_requests_that_are_too_large_for_one_batch_go_in_several(service, many):
    """Forty robots with range images asked in vain. A fleet's requests stay together, so these are refused."""

    class Asked:
        batches = 0

        def ask(self, topic, payload, timeout, **names):
            self.batches += 1
            return service.answer(payload)

    bus, requests = Asked(), []
    for i in range(64):
        action = [0.003 * i, 0.0]
        requests.append(request_message(BackupPlan(GROUND), np.zeros(5), action, known_free=True, **many))
    replies = query_service(bus, requests, 1.0)
    wanted = [request.action[0] for request in requests]
    assert bus.batches > 1 and [reply.decision.plan[0] for reply in replies] == pytest.approx(wanted)
    for i, request in enumerate(requests):
        request.actor, request.fleet[:] = f"robot-{i}", [f"robot-{k}" for k in range(64)]
    with pytest.raises(BadRequest):
        query_service(bus, requests, 1.0)


def test_a_plan_that_violates_the_slew_limit_is_refused():
    """The client compares each input with the one before, and the robot's name with its own."""
    flying = BackupPlan(QUADROTOR)
    question = request_message(flying, np.zeros(QUADROTOR.state_dim), [1.0, 0.0, 0.0], known_free=True)
    zero = np.zeros(QUADROTOR.state_dim)

    def reply(plan, robot="quadrotor"):
        decision = pb.Decision(kind=pb.ALLOWED, plan=plan.ravel(), predicted_center=zero, predicted_half_width=zero)
        return pb.Reply(decision=decision, robot=robot)

    plan = np.zeros((QUADROTOR.horizon, QUADROTOR.action_dim))
    plan[:3, 0] = 0.7, 0.7, 0.1
    assert read_reply(reply(plan), question, QUADROTOR).action[0] == 0.7
    for row, value in ((0, 0.9), (1, 1.6), (2, -0.2)):
        broken = plan.copy()
        broken[row, 0] = value
        with pytest.raises(SafetyError, match="does not follow") as caught:
            read_reply(reply(broken), question, QUADROTOR)
        assert caught.value.field == "plan"
    with pytest.raises(SafetyError) as caught:
        read_reply(reply(plan, robot="ground"), question, QUADROTOR)
    assert caught.value.field == "robot"


def test_a_client_over_the_bus(join, endpoint, service):  # noqa: F811
    router = join("safety", listen=True)
    with SafetyClient.open(endpoint, "ground", deadline=5.0) as client:
        with pytest.raises(NoReply):
            client.decide(np.zeros(5), [0.25, 0.0], [AHEAD])
        assert not client.fallback().any()
        router.serve(DECIDE, service.answer)
        while not client.backup_plan.model:
            with suppress(NoReply):  # the service is not yet known on this side
                answer = client.decide(np.zeros(5), [0.25, 0.05], [AHEAD])
        assert answer.verified and answer.action[0] > 0.02 and client.backup_plan.model == answer.model
        refused = client.decide(answer.predicted.center, [NAN, 0.0], [AHEAD])
        assert (refused.kind, refused.reason) == ("failsafe", NOT_FINITE)
        assert service.counts.figures()["not_finite"] == 1
        with pytest.raises(SafetyError) as caught:
            client.decide(answer.predicted.center, [0.0], [AHEAD])
        assert caught.value.field == "action"
        assert not client.fallback().any(), "the committed plan brakes"
        with pytest.raises(Refused):
            client.bus.ask(DECIDE, b"\xff" * 20, 5.0, robot="ground")
        assert client.decide(answer.predicted.center, [0.0, 0.1], [AHEAD]).verified


def test_a_service_of_other_robots_takes_no_client_from_the_one_that_can_answer(join, endpoint, service):  # noqa: F811
    """Its refusal comes first, since it decides nothing."""

    def slowly(payload, asker):
        time.sleep(0.2)
        return service.answer(payload, asker)

    with_another_robot = Service()
    join("safety", listen=True).serve(DECIDE, with_another_robot.answer)
    join("safety-1").serve(DECIDE, slowly)
    with SafetyClient.open(endpoint, "ground", deadline=5.0) as client:
        for _ in range(100):
            with suppress(Refused, NoReply):  # the second service is not yet known to the first
                client.decide(np.zeros(5), [0.25, 0.05], [AHEAD])
                break
            time.sleep(0.02)
        for _ in range(3):
            client.reset()
            assert client.decide(np.zeros(5), [0.25, 0.05], [AHEAD]).verified
        assert with_another_robot.counts.errors, "it was asked, too"
