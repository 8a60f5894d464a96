"""Robots of a fleet that stand with reservations that touch creep apart, and no other robot loses its plan."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from brakeline.messaging.robot import Array
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import FAILSAFE, RECOVERING
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.filter_client import Answer
from brakeline.safety.service.fleet_client import FleetClient
from tests.robots import GROUND
from tests.safety.asked import apart
from tests.safety.served import Service
from tests.safety.unicycle import Unicycle

PUSHED = 15
Period = tuple[list[Answer], list[BackupPlan], Array]


def fleet_of(model: ModelSet, count: int) -> FleetClient:
    bus: Any = Service(model)
    return FleetClient(bus, GROUND, [f"robot-{i}" for i in range(count)])


def drive(model: ModelSet, poses: Sequence[Sequence[float]], push: float, periods: int) -> Iterator[Period]:
    """Let the first two robots drive straight ahead, and push the first one forward by `push` [m] before period PUSHED.

    Yield the answers, the backup plans and the true positions after each period. The other robots want to stand.
    """
    rng = np.random.default_rng(0)
    robots, fleet = [Unicycle(pose, rng) for pose in poses], fleet_of(model, len(poses))
    actions = [[0.25, 0.0]] * 2 + [[0.0, 0.0]] * (len(poses) - 2)
    for step in range(periods):
        robots[0].state[0] += push * (step == PUSHED)
        answers = fleet.decide([robot.measure() for robot in robots], actions, known_free=True)
        for robot, answer in zip(robots, answers, strict=True):
            robot.step(answer.action)
        yield answers, fleet.backup_plans, np.array([robot.state[:2] for robot in robots])


@pytest.mark.parametrize("towards", [0.02, 0.03])
def test_robots_that_were_pushed_together_creep_apart_and_drive_on(model: ModelSet, towards: float) -> None:
    """Without that, they would stand for ever: every plan of either begins in the other's reservation."""
    facing = [(-0.3, 0.0, 0.0), (0.3, 0.0, np.pi)]
    kinds, gaps, verified = [], [], []
    for answers, _, at in drive(model, facing, towards, 80):
        kinds.append([answer.kind for answer in answers])
        verified.append(all(answer.verified for answer in answers))
        gaps.append(float(np.linalg.norm(at[0] - at[1])) - 2.0 * GROUND.footprint)
        assert not (RECOVERING in kinds[-1] and verified[-1])
    assert not verified[PUSHED] and any(RECOVERING in row for row in kinds[PUSHED + 1 :])
    assert not any(RECOVERING in row for row in kinds[:PUSHED]), "without a violation they need no recovery"
    assert min(gaps[PUSHED:]) > gaps[PUSHED] - 0.001, "they come no nearer"
    assert verified[-1] and gaps[-1] > 0.1


def test_a_way_out_takes_no_other_robots_space(model: ModelSet) -> None:
    """The third robot stands behind the one that was pushed, where that one wants to go."""
    kinds, final = [], False
    for answers, plans, _ in drive(model, [(-0.2, 0.0, 0.0), (0.12, 0.0, np.pi), (-0.46, 0.0, 0.0)], 0.03, 80):
        kinds.append([answer.kind for answer in answers])
        assert answers[2].verified
        final = all(answer.verified for answer in answers)
        one, two, third = (plan.reservation for plan in plans)
        assert one is not None and two is not None and third is not None
        assert min(apart(one, third), apart(two, third)) > 0.0
    assert any(row[0] == RECOVERING for row in kinds) and any(row[1] == RECOVERING for row in kinds) and final


def test_a_robot_whose_reservation_touches_nothing_keeps_it_although_its_sets_are_wider_now(model: ModelSet) -> None:
    """Its new reservation would touch the other robot's, which would then have no verified plan any more."""
    near, fleet = 2.0 * GROUND.footprint + 0.05, fleet_of(model, 2)
    states = [np.zeros(5), np.array([near, 0.0, np.pi, 0.0, 0.0])]
    for step, factor in enumerate((1.0, 8.0, 8.0)):
        fleet.backup_plans[0].widening.factors = factor, factor
        answers = fleet.decide(states, [[0.25, 0.0]] * 2, known_free=True)
        assert all(answer.verified for answer in answers)
        assert not step or answers[0].kind == FAILSAFE


def test_a_robot_that_was_carried_away_while_no_answers_came_keeps_no_reservation_elsewhere(model: ModelSet) -> None:
    """The others were verified against its old one: a robot drove through it, and all decisions were verified."""
    fleet = fleet_of(model, 2)
    states = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [2.0, 0.0, np.pi, 0.0, 0.0]])
    fleet.decide(states, np.zeros((2, 2)), known_free=True)
    fleet.fallback()
    states[1, 0] = 0.26  # m
    for period in range(20):
        answers = fleet.decide(states, np.tile([0.25, 0.0], (2, 1)), known_free=True)
        for answer, state, way in zip(answers, states, (1.0, -1.0), strict=True):
            assert answer.reservation is not None
            assert answer.reservation.may_contain(state[:2], GROUND.measurement_bound[:2], GROUND.footprint)
            state[0] += way * GROUND.period * answer.action[0]
        assert period or (not answers[1].verified and "has left the space" in answers[1].reason)
        assert states[1, 0] - states[0, 0] > 2.0 * GROUND.footprint


def test_a_robot_that_slides_out_of_its_reservation_is_verified_no_more(model: ModelSet) -> None:
    """It slides within its predicted sets. Another one drove into its place, and all decisions were verified."""
    fleet, verified = fleet_of(model, 2), []
    states = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [0.4, 0.0, np.pi, 0.0, 0.0]])
    for step in range(20):
        blind = [[0.25 * (step > 0), 0.0], [np.nan if step else 0.0, 0.0]]
        answers = fleet.decide(states, blind, known_free=True)
        verified.append(answers[1].verified)
        states[0, [0, 3]] = states[0, 0] + GROUND.period * answers[0].action[0], answers[0].action[0]
        states[1, 0] -= 0.002  # m
        if states[1, 0] - states[0, 0] < 2.0 * GROUND.footprint:
            break
    assert verified[0] and not verified[-1]
