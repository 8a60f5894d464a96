"""Without a valid answer, the robot brakes along its committed plan and stands; with the next answer it drives on."""

import numpy as np
import pytest

from brakeline.actors.decision_guard import at_rest, next_input, request_decisions
from brakeline.errors import BusError, Late, NoReply, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import request_message
from tests.actors.conftest import no_answer
from tests.robots import GROUND

PLAN = np.array([[0.2, 0.3], [0.1, 0.15], [0.0, 0.0]])
REQUEST = pb.Request(robot="ground", input_in_force=[0.0, 0.0])


def decision(plan=PLAN, **fields):
    values = {"kind": pb.ALLOWED, "plan": np.ravel(plan), "model": "abc", "verified": True}
    predicted = {"predicted_center": [0.0] * 5, "predicted_half_width": [1.0] * 5}
    return pb.Reply(robot="ground", decision=pb.Decision(**(values | predicted | fields)))


def outcome_of(reply):
    """Return the outcome of a question whose answer is `reply`, or which fails with it."""

    def ask(requests):
        if isinstance(reply, BusError):
            raise reply
        return [reply] * len(requests)

    return request_decisions(ask, [REQUEST], GROUND)[0]


def committed():
    """Return the backup plan of a robot that executes the first input of PLAN."""
    backup_plan = BackupPlan(GROUND)
    assert (next_input(backup_plan, outcome_of(decision())) == PLAN[0]).all()
    return backup_plan


FAILURES = {
    "late": Late("no answer within 100 ms"),
    "nobody": NoReply("nobody answers"),
    "refused": Refused(pb.Error(type="BadRequest", field="payload", message="not a request batch")),
    "error": pb.Reply(error=pb.Error(type="StaleModel", field="model", message="never in use here")),
    "empty": pb.Reply(),
    "no kind": decision(kind=pb.UNKNOWN),
    "short plan": decision(PLAN[:2]),
    "not a number": decision(np.where(PLAN == 0.1, np.nan, PLAN)),
    "infinite": decision(np.where(PLAN == 0.1, np.inf, PLAN)),
    "out of bounds": decision(PLAN * 10),
    "backwards": decision(-PLAN),
    "no stop at its end": decision(np.ones((3, 2)) * 0.1),
    "no prediction": decision(predicted_center=[]),
    "another robot's": pb.Reply(robot="quadrotor", decision=decision().decision),
}


@pytest.mark.parametrize("failure", FAILURES.values(), ids=FAILURES.keys())
def test_without_a_decision_the_robot_follows_its_plan_to_the_end_and_stands(failure):
    backup_plan, executed = committed(), []
    for _ in range(5):
        outcome = outcome_of(failure)
        assert outcome.answer is None and outcome.failure
        executed.append(next_input(backup_plan, outcome))
    assert np.array(executed).tolist() == [[0.1, 0.15], [0, 0], [0, 0], [0, 0], [0, 0]]
    assert backup_plan.predicted is None, "no prediction holds any more"


def test_the_exchange_contains_the_failure_and_the_reply():
    assert outcome_of(FAILURES["late"]).exchange(1.0).failure.startswith("Late: no answer within 100 ms")
    refused = outcome_of(FAILURES["error"]).exchange(1.0)
    assert refused.failure == "StaleModel: never in use here"
    assert refused.reply.error.field == "model"
    allowed = outcome_of(decision()).exchange(2.5)
    assert (allowed.failure, allowed.header.time, allowed.reply.decision.model) == ("", 2.5, "abc")
    assert allowed.round_trip_ms > 0.0


def test_a_robot_is_at_rest_only_if_its_input_and_its_plan_are_zero():
    backup_plan = BackupPlan(GROUND)
    assert at_rest(backup_plan)
    next_input(backup_plan, outcome_of(decision()))
    moving = []
    for _ in range(3):
        moving.append(at_rest(backup_plan))
        next_input(backup_plan, outcome_of(FAILURES["nobody"]))
    assert moving == [False, False, True], "it still moves while the last but one input, the first zero, is executed"
    backup_plan = BackupPlan(GROUND)
    next_input(backup_plan, outcome_of(decision(np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]]))))
    assert not at_rest(backup_plan), "it stands, but has committed to move"


def test_the_robot_drives_on_when_the_service_answers_again():
    backup_plan = committed()
    next_input(backup_plan, outcome_of(FAILURES["late"]))
    again = np.array([[0.25, -0.5], [0.0, 0.0], [0.0, 0.0]])
    assert (next_input(backup_plan, outcome_of(decision(again))) == again[0]).all()
    assert backup_plan.model == "abc" and backup_plan.predicted is not None
    for _ in range(3):
        next_input(backup_plan, outcome_of(FAILURES["late"]))
    request = request_message(backup_plan, np.zeros(5), np.zeros(2), known_free=True)
    assert request.model == "" and not any(request.plan), "standing still needs no verification"


def test_an_invalid_reply_about_one_robot_does_not_affect_the_others():
    replies = [decision(), FAILURES["error"], decision()]
    outcomes = request_decisions(lambda requests: replies, [REQUEST] * 3, GROUND)
    assert [outcome.answer is not None for outcome in outcomes] == [True, False, True]
    lost = request_decisions(no_answer, [REQUEST] * 3, GROUND)
    assert [outcome.failure for outcome in lost] == ["NoReply: gone"] * 3
