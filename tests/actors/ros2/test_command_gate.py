"""The gate sends the answer's input if it came in time, otherwise the committed plan's."""

import numpy as np
import pytest

from brakeline.actors.ros2.command_gate import BLIND, LATE, NO_ANSWER, SCAN_DIFFERENCE, CommandGate, inflated
from brakeline.actors.ros2.ros_inputs import RawCommand
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.filter.request import NOT_FINITE
from tests.actors.conftest import no_answer
from tests.robots import GROUND

ROBOT = GROUND.in_real_time()
STATE = np.zeros(ROBOT.state_dim)


def allow(requests):
    """Allow every finite command by a plan of the input in force, the command, half of it, and a stop."""
    replies = []
    for request in requests:
        action = np.clip(request.action, ROBOT.low(), ROBOT.high())
        plan = [*request.plan[: ROBOT.action_dim], *action]
        for k in range(ROBOT.horizon - 2):
            plan += list(action * max(0.0, 1.0 - (k + 1) / ROBOT.brake_steps))
        decision = pb.Decision(kind=pb.ALLOWED, plan=plan, model="m", verified=True, contained=True, bound=0.01)
        decision.predicted_center.extend(request.state)
        decision.predicted_half_width.extend([1.0] * ROBOT.state_dim)
        if not np.isfinite(request.action).all():
            decision.kind, decision.plan[:], decision.reason = pb.FAILSAFE, request.plan, NOT_FINITE
        decision.tube_center.extend([0.0] * 2 * ROBOT.horizon)
        decision.tube_half_width.extend([0.1] * 2 * ROBOT.horizon)
        replies.append(pb.Reply(decision=decision, robot=request.robot))
    return replies


def command(speed, turn=0.0, at=0.0, number=1):
    return RawCommand(np.array([speed, turn]), at, number)


def test_a_command_is_executed_one_period_after_its_question():
    gate = CommandGate(ROBOT, allow)
    assert gate.begin(0.0).tolist() == [0.0, 0.0] and gate.kind == BLIND
    gate.decide(STATE, (), command(0.2, at=0.1), 0.0, 0)
    assert gate.begin(0.2).tolist() == [0.2, 0.0] and gate.kind == "allowed" and gate.reason == ""
    assert list(gate.stats.delays) == [pytest.approx(0.1)] and gate.stats.commands == 1


def test_without_an_answer_the_gate_brakes_along_the_plan():
    gate = CommandGate(ROBOT, allow)
    gate.decide(STATE, (), command(0.25), 0.0, 0)
    gate.begin(0.2)
    gate._ask = no_answer
    inputs = []
    for k in range(4):
        gate.decide(STATE, (), command(0.25), 0.2, 1 + k)
        inputs.append(gate.begin(0.4 + 0.2 * k)[0])
        assert gate.kind == NO_ANSWER and "gone" in gate.reason
    assert inputs == [0.0] * 4 and not gate.backup_plan.plan.any()


@pytest.mark.parametrize(
    ("in_time", "why", "kind", "reason"),
    [(False, "", LATE, "after its period"), (True, "no scan yet", BLIND, "no scan yet")],
)
def test_a_late_answer_or_one_without_inputs_is_not_executed(in_time, why, kind, reason):
    gate = CommandGate(ROBOT, allow)
    gate.decide(STATE, (), command(0.25), 0.0, 0)
    assert gate.begin(0.2, in_time, why).tolist() == [0.0, 0.0]
    assert gate.kind == kind and reason in gate.reason and gate.stats.kinds[kind] == 1


def test_a_command_that_is_not_finite_is_a_failsafe():
    gate = CommandGate(ROBOT, allow)
    gate.decide(STATE, (), command(0.2), 0.0, 0)
    assert gate.begin(0.2).tolist() == [0.2, 0.0]
    gate.decide(STATE, (), command(float("nan"), number=2), 0.2, 1)
    assert gate.begin(0.4).tolist() == [0.0, 0.0] and (gate.kind, gate.reason) == ("failsafe", NOT_FINITE)


def test_after_a_standstill_of_the_process_the_plan_does_not_go_on_where_it_was():
    gate = CommandGate(ROBOT, allow)
    gate.decide(STATE, (), command(0.25), 0.0, 0)
    gate.begin(0.2)
    gate.backup_plan.plan[:] = 0.1  # a robot that brakes slowly
    gate.slip(1_000_000)
    assert gate.begin(9.0).tolist() == [0.0, 0.0] and not gate.backup_plan.plan.any() and gate.stats.slips == 1


def test_without_a_command_the_proposal_is_to_stand():
    gate = CommandGate(ROBOT, allow)
    gate.decide(STATE, (), None, 0.0, 0)
    assert gate.begin(0.2).tolist() == [0.0, 0.0] and gate.reason == "no command"
    assert gate.stats.commands == 0


@pytest.mark.parametrize("aside", [True, False])
def test_the_requests_say_whether_a_blocked_robot_turns_aside(aside):
    asked = CautiousFilter(largest=1.0)
    CommandGate(ROBOT, asked, turn_aside=aside).decide(STATE, (), command(0.2), 0.0, 0)
    assert [request.turn_aside for request in asked.requests] == [aside]


class CautiousFilter:
    """Verifies nothing if obstacles are larger than `largest` [m]; its plans end `advance` m nearer to them."""

    def __init__(self, largest, advance=0.0):
        self.largest, self.advance, self.requests = largest, advance, []

    def __call__(self, requests):
        (request,) = requests
        self.requests.append(request)
        (reply,) = allow(requests)
        size = max((obstacle.size[0] for obstacle in request.obstacles), default=0.0)
        if size > self.largest:
            reply.decision.kind = pb.FAILSAFE
        reply.decision.tube_center[-2] = self.advance if request.action[0] else 0.0
        return [reply]


DISC = (Obstacle("cylinder", (0.5, 0.0), (0.1,)),)


def test_if_the_inflated_obstacles_leave_room_the_gate_asks_once():
    cautious = CautiousFilter(largest=1.0)
    gate = CommandGate(ROBOT, cautious)
    gate.decide(STATE, DISC, command(0.2, 0.1), 0.0, 0)
    (request,) = cautious.requests
    assert request.obstacles[0].size[0] == pytest.approx(0.1 + SCAN_DIFFERENCE)


def test_if_only_the_inflation_forbids_a_plan_the_robot_may_leave_and_turn_but_not_approach():
    for advance, speed in ((0.1, 0.0), (-0.1, 0.2)):
        cautious = CautiousFilter(largest=0.1 + 0.5 * SCAN_DIFFERENCE, advance=advance)
        gate = CommandGate(ROBOT, cautious)
        gate.decide(STATE, DISC, command(0.2, 0.1), 0.0, 0)
        assert gate.begin(0.2).tolist() == pytest.approx([speed, 0.1]) and gate.kind == "allowed"
        assert cautious.requests[-1].obstacles[0].size[0] == pytest.approx(0.1)


def test_without_any_verified_plan_the_robot_brakes():
    gate = CommandGate(ROBOT, CautiousFilter(largest=0.01))
    gate.decide(STATE, DISC, command(0.2), 0.0, 0)
    gate.begin(0.2)
    assert gate.kind == "failsafe"


def test_an_inflated_obstacle_is_larger_on_every_side():
    box = Obstacle("box", (1.0, 0.0), (0.2, 0.4), 0.3)
    rim = Shapes.of([box], 2).distance(np.array([[1.0, 0.6]]))
    assert Shapes.of([inflated(box, 0.05)], 2).distance(np.array([[1.0, 0.6]])) <= rim - 0.05 + 1e-9
    assert inflated(DISC[0], 0.05).size == (pytest.approx(0.15),)
