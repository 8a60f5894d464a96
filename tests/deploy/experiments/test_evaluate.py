"""`evaluate --fleet`: figures of robots that share a world."""

import pytest

from brakeline.deploy.experiments.evaluate import Evaluation, evaluate
from brakeline.deploy.run.replay_run import _joint_requests
from brakeline.messaging import brakeline_pb2 as pb
from tests.robots import GROUND


def test_a_fleet_of_planners_gets_past_each_other(data_folder):
    figures = evaluate(GROUND, Evaluation("astar", arena="crossing", episodes=3, fleet=3))
    assert figures["fleet"] == 3 and figures["episodes"] == 3
    assert figures["goals"] == 3 and figures["collisions"] == figures["contacts_robots"] == 0
    assert set(figures["actors"]) == {"evaluate.0", "evaluate.1", "evaluate.2"}
    assert figures["robots"]["ground"]["steps"] == sum(one["steps"] for one in figures["actors"].values())
    worlds = figures["worlds"]
    assert worlds["count"] == 1 and worlds["touches"] == 0 and worlds["goals_per_minute"] > 0.0
    assert worlds["robot_steps"] >= figures["steps"], "who is at its goal stands there until the others are"


@pytest.mark.parametrize("method", ["secas", "sailr"])
def test_rivals_promise_nothing(method):
    with pytest.raises(ValueError, match="promises"):
        evaluate(GROUND, Evaluation(method=method, arena="crossing", fleet=2))


def test_what_was_one_question_is_asked_again_as_one():
    def one(actor, step):
        return pb.Request(actor=actor, step=step, fleet=["a", "b"]), pb.Reply()

    waiting = {}
    assert _joint_requests(waiting, *one("b", 1)) == [] == _joint_requests(waiting, *one("a", 2))
    asked = _joint_requests(waiting, *one("a", 1))
    assert [request.actor for request, _ in asked] == ["a", "b"] and {request.step for request, _ in asked} == {1}
    assert len(_joint_requests(waiting, *one("b", 2))) == 2 and not waiting
    alone = pb.Request(actor="a"), pb.Reply()
    assert _joint_requests(waiting, *alone) == [alone]
