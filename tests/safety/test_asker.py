"""Every asker answers alike: in process and over the bus."""

from dataclasses import fields

import numpy as np
import pytest

from messaging import brakeline_pb2 as pb
from messaging.shapes import Obstacle
from safety.asker import Answer, accept
from safety.client import SafetyError, read, request_message
from safety.commitment import Commitment
from safety.filter import Filter
from safety.inprocess import InProcess
from safety.service import Counts, Models, answerer
from tests.robots import GROUND
from tests.safety.asked import cylinder

LATE = GROUND.in_real_time()
AHEAD = cylinder(0.34, 0.0)
MEASURED = ("time_ms", "solve_ms", "verify_ms", "queue_ms", "vouchers")


@pytest.fixture(scope="module")
def late(data_folder):
    from deploy.data.store import model_for
    from safety.model_set import Recipe

    return model_for(LATE, Recipe())


class Wire:
    """The client's part and the service's core, without a bus."""

    def __init__(self, model):
        models = Models()
        models.install(model)
        self.ask, self.robot, self.commitment = answerer(models, Counts()), model.robot, Commitment(model.robot)

    def decide(self, state, action, obstacles):
        request = request_message(self.commitment, state, action, obstacles)
        batch = pb.ReplyBatch.FromString(self.ask(pb.RequestBatch(requests=[request]).SerializeToString()))
        answer = read(batch.replies[0], request, self.robot)
        accept(self.commitment, answer)
        return answer


def equal(one, other):
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return all(equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return one == other


def test_an_answer_in_process_is_the_answer_of_a_service(model):
    alone, asked = InProcess(Filter(model)), Wire(model)
    kinds = set()
    for action, away in (([0.1, 0.1], 3.0), ([float("nan"), 0.0], 3.0), ([0.25, 0.0], 0.4), ([0.25, 0.0], 0.3)):
        one, other = (asker.decide(np.zeros(5), action, [cylinder(away, 0.0)]) for asker in (alone, asked))
        assert type(one) is type(other) is Answer
        for field in fields(Answer):
            if field.name not in MEASURED:
                assert equal(getattr(one, field.name), getattr(other, field.name)), field.name
        kinds.add(one.kind)
    assert kinds == {"allowed", "adjusted", "failsafe"}


@pytest.mark.parametrize("ask", [lambda model: InProcess(Filter(model)), Wire], ids=["in process", "service"])
def test_the_action_of_a_late_robot_is_the_input_of_the_next_period(late, ask):
    asker = ask(late)
    far = [Obstacle("cylinder", (3.0, 0.0), (0.1,))]
    first = asker.decide(np.zeros(5), [0.25, 0.0], far)
    assert first.kind == "allowed" and not first.plan[0].any(), "zero is in force while the answer is on its way"
    assert np.array_equal(first.action, [0.25, 0.0]) and np.array_equal(first.action, asker.commitment.due)
    second = asker.decide(np.zeros(5), [0.1, 0.2], far)
    assert np.array_equal(second.plan[0], [0.25, 0.0]), "what was answered before is in force now"
    assert np.array_equal(second.action, asker.commitment.due)


def test_a_tube_that_is_none_of_this_robots_is_no_answer(model):
    asked = Wire(model)
    request = request_message(asked.commitment, np.zeros(5), [0.1, 0.0], [AHEAD])
    payload = pb.RequestBatch(requests=[request]).SerializeToString()
    for change in (lambda d: d.tube_center.pop(), lambda d: d.tube_half_width.__setitem__(0, float("inf"))):
        (reply,) = pb.ReplyBatch.FromString(asked.ask(payload)).replies
        change(reply.decision)
        with pytest.raises(SafetyError, match="tube") as caught:
            read(reply, request, GROUND)
        assert caught.value.field == "tube_center"
