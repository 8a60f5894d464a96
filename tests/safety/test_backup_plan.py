"""The backup plan: the filter falls back to it, and only a verified one counts as verified."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan, Prediction
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.plan_search import DecisionRecord
from brakeline.safety.filter.request import ALLOWED, FAILSAFE
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND
from tests.safety.asked import STILL, cylinder, request
from tests.safety.joints import joints
from tests.safety.toys import puck

ELSEWHERE = Prediction(np.full(5, 3.0), np.full(5, 0.01), 0.0)


def moving(tail=((0, 0), (0, 0), (0, 0)), x=0.215, **more):
    """Return a request at full speed, so near an obstacle that only the backup plan is left."""
    more = {"input_in_force": np.array([0.25, 0.0]), "plan": np.array(tail, float)} | more
    return request((0, 0, 0, 0.25, 0.0), (0.25, 0.0), [cylinder(x, 0)], **more)


def test_a_failsafe_is_the_backup_plans_next_input(ready):
    tail = ((0.0, 0.1), (0, 0), (0, 0))
    decision = ready.decide(moving(tail, model=ready.version))
    assert decision.kind == FAILSAFE and decision.verified and np.array_equal(decision.plan, tail)
    assert decision.margin < 0.0 and "no verified input" in decision.reason


@pytest.mark.parametrize(
    ("version", "prediction"), [("", False), (UNVERIFIED, False), ("0123456789ab", False), ("in use", True)], ids=str
)
def test_a_plan_counts_as_unverified_without_its_model_or_prediction(ready, version, prediction):
    """The robot moves without a model's version, with another one, or outside its predicted set."""
    wrong = ELSEWHERE if prediction else None
    for tail in (((0.2, 0.0), (0, 0), (0, 0)), STILL):
        decision = ready.decide(moving(tail, model=ready.version if prediction else version, predicted=wrong))
        assert (decision.kind, decision.verified) == (FAILSAFE, False)
        assert not decision.plan.any(), "brake"
        assert decision.contained == (not prediction)


@pytest.mark.parametrize("version", ["0123456789ab", UNVERIFIED])
def test_an_older_models_tail_is_verified_anew(ready, version):
    """A tube from outside the recorded domain verifies nothing."""
    for x, in_domain, verified in ((0.6, True, True), (0.6, False, False), (0.215, True, False)):
        ask = moving(((0.1, 0.2), (0, 0), (0, 0)), x, model=version)
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        around = ready.constraints.local_map(ask, z_0, ready.builder.reachable(z_0[-2:]))
        committed = ready._committed(ask, around, z_0, DecisionRecord(0), in_domain)
        assert committed.verified == verified
        assert np.array_equal(committed.plan, ask.plan if verified else STILL)


def test_outside_the_recorded_domain_nothing_new_is_verified(ready):
    ask = request((0, 0, 0, 0.6, 0.0), (0.1, 0.0), input_in_force=np.array([0.25, 0.0]))
    decision = ready.decide(replace(ask, model="0123456789ab"))
    assert decision.kind == FAILSAFE and not decision.verified and "domain" in decision.reason
    trusted = ready.decide(replace(ask, model=ready.version))
    assert trusted.kind == FAILSAFE and trusted.verified, "the plan was verified when it was made"


def test_after_a_violation_the_proposal_may_still_be_verified_from_the_new_measurement(ready):
    decision = ready.decide(request(predicted=ELSEWHERE))
    assert decision.kind == ALLOWED and decision.compared and not decision.contained


def test_a_plan_counts_until_the_robot_stands():
    backup_plan, turning = BackupPlan(GROUND), np.array([[0.2, 0.1], [0, 0], [0, 0]])
    assert backup_plan.model == ""
    backup_plan.accept(turning, "v1", None, True)
    assert backup_plan.model == "v1" and np.array_equal(backup_plan.input_in_force, [0.2, 0.1])
    for model in ("v1", "v1", ""):  # it may coast until the plan ends
        backup_plan.fallback()
        assert backup_plan.model == model
    backup_plan.accept(turning, "v1", None, True)
    for _ in range(2):
        backup_plan.accept(STILL, "v1", None, False)
        assert backup_plan.model == UNVERIFIED
    backup_plan.fallback()
    assert backup_plan.model == "", "it has stood for a whole plan"
    backup_plan.accept(STILL, "v1", None, False)
    backup_plan.accept(turning, "v2", None, True)
    assert backup_plan.model == "v2"
    backup_plan.reset()
    assert (backup_plan.model, backup_plan.predicted) == ("", None)


@pytest.mark.parametrize("cause", ["another model set", "a broken bound"])
def test_a_robot_that_coasts_does_not_stand(cause):
    """Its inputs are zero already. It flies at 1 m/s, 0.3 m before an obstacle that the plan did not know."""
    filter = Filter.load("quadrotor")
    robot, client = filter.robot, InProcess(filter)
    flying = np.array([0.0, 0.0, 0.0, 1.0, *np.zeros(5)])
    verified_by = filter.version if cause == "a broken bound" else "0123456789ab"
    plan, expected = np.zeros((robot.horizon, 3)), Prediction(flying, np.ones(9), 0.0)
    plan[0, 0] = 0.1
    client.backup_plan.accept(plan, verified_by, expected, True)
    client.backup_plan.accept(np.zeros_like(plan), verified_by, expected, True)
    elsewhere = Sighting(position=(9.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), since=0.2)
    jumped = Motion((0.0, 0.0, 0.0), position_error=0.0, acceleration=0.0, before=elsewhere)
    motion = jumped if cause == "a broken bound" else None
    ball = Obstacle("sphere", (robot.footprint + 0.8, 0.0, 0.0), (0.5,), motion=motion)
    answer = client.decide(flying, np.full(3, np.nan), [ball])
    assert (answer.kind, answer.verified, answer.contained) == (FAILSAFE, False, True)


def test_predictions_are_boxes_in_their_own_frame():
    box = Prediction(np.array([1.0, 2.0, 3.1, 0.1, 0.0]), np.array([0.2, 0.01, 0.1, 0.1, 0.1]), np.pi / 2)
    assert box.contains(GROUND, np.array([1.0, 2.15, -3.1, 0.1, 0.0]))  # the heading wraps
    assert not box.contains(GROUND, np.array([1.15, 2.0, 3.1, 0.1, 0.0]))
    assert not box.contains(GROUND, np.array([1.0, 2.0, 3.1, 0.3, 0.0]))
    assert not box.contains(GROUND, np.array([np.nan, 2.0, 3.1, 0.1, 0.0]))


@pytest.mark.parametrize(("x", "verified"), [(0.05, True), (0.2, False), (None, True)], ids=["in", "out", "unmeasured"])
def test_a_robot_outside_its_predicted_set_has_no_verified_plan_after_a_missing_reply(ready, x, verified):
    driven = Prediction(np.array([0.05, 0.0, 0.0, 0.25, 0.0]), np.full(5, 0.01), 0.0)
    backup_plan, plan = BackupPlan(GROUND), np.array([[0.25, 0.0], [0.2, 0.0], [0.0, 0.0]])
    backup_plan.accept(plan, ready.version, driven, True, (b"word",) * 3)
    if x is not None:
        backup_plan.measured(np.array([x, 0.0, 0.0, 0.25, 0.0]))
    backup_plan.fallback()
    assert backup_plan.model == (ready.version if verified else UNVERIFIED)
    assert bool(backup_plan.plan_token) == verified


@pytest.mark.parametrize("missing", [1, 2, 3, 14])  # a plan has 12 periods
def test_a_robot_outside_its_tube_after_missing_replies_has_no_verified_plan(missing):
    """Nothing compared its states any more: 2.5 m away, behind a wall, its plan counted as verified to its end."""
    client, wall = InProcess(Filter.load("quadrotor")), [Obstacle("wall", (6.0, 0.0, 0.0), yaw=np.pi)]
    state, blind = np.zeros(9), np.full(3, np.nan)
    for _ in range(12):
        answer = client.decide(state, [5.0, 0.0, 0.0], wall)
        state = answer.predicted.center
    last = len(answer.tube_center) - 1
    for k in range(missing):
        client.request(client.backup_plan, state, blind, wall)  # it gets no answer
        client.fallback()
        state = np.concatenate([answer.tube_center[min(k + 1, last)], state[3:]])
    assert client.backup_plan.still_verified
    for off, verified in ((0.9, True), (1.1, False)):
        away = np.concatenate([off * answer.tube_half_width[min(missing, last)], np.zeros(6)])
        request = client.request(client.backup_plan, state + away, blind, wall)
        assert request.model == (client.method.version if verified else UNVERIFIED)
    answer = client.decide(state + 2.5 * np.eye(9)[0], blind, wall)
    assert (answer.kind, answer.verified, answer.contained) == (FAILSAFE, False, True)


@pytest.mark.parametrize("measured", [False, True])
def test_in_joint_space_nothing_shows_that_a_robot_follows_its_plan_after_a_missing_reply(measured):
    """Its tube has no boxes: after a second measured state without a decision, any state counted as in the tube."""
    backup_plan, state = BackupPlan(joints()), np.zeros(4)
    plan = np.zeros((backup_plan.robot.horizon, 2))
    plan[:2] = 0.5
    boxes = np.zeros((0, 0)), np.zeros((0, 0))
    backup_plan.accept(plan, "v1", Prediction(state, np.full(4, 0.1), 0.0), True, (b"word",) * 6, tube=boxes)
    backup_plan.measured(state)
    backup_plan.fallback()
    assert backup_plan.model == "v1" and backup_plan.plan_token, "the state is in the predicted set"
    if measured:
        backup_plan.measured(state + 3.0)
    assert (backup_plan.model, bool(backup_plan.plan_token)) == ((UNVERIFIED, False) if measured else ("v1", True))
    for _ in range(2 * len(plan)):
        backup_plan.fallback()
    assert backup_plan.model == "", "it stands"


def test_without_a_measured_state_nothing_is_fed_back():
    backup_plan = BackupPlan(puck("puck"))
    plan, state = np.zeros((backup_plan.robot.horizon, 2)), np.array([0.0, 0.0, 0.5, 0.0])
    plan[0] = 0.3, 0.0
    backup_plan.measured(state)
    backup_plan.accept(plan, "v1", None, True)
    backup_plan.measured(state)
    assert backup_plan.fallback()[0] < 0.0 and backup_plan.model == "v1", "it brakes by the measured speed"
    for _ in range(2 * len(plan)):
        backup_plan.measured(np.full(4, np.nan))
        assert not backup_plan.fallback().any() and backup_plan.model == UNVERIFIED


@pytest.mark.parametrize(
    "bad", [np.full(5, np.nan), np.zeros(4), np.full(5, 1.1e4), np.array([0.0, 0.0, np.inf, 0.0, 0.0])]
)
def test_a_state_that_the_filter_refuses_is_ignored(bad):
    backup_plan = BackupPlan(GROUND)
    backup_plan.measured(np.arange(5.0))
    backup_plan.measured(bad)
    assert np.array_equal(backup_plan.seen, np.arange(5.0))
