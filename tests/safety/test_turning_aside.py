"""A blocked robot turns aside if its request says so: it gets past, and its plans are verified as any others."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.robot import robot_named
from brakeline.messaging.scan import Scan
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED
from brakeline.safety.filter.turning_aside import BEYOND_EDGE, free_turn
from brakeline.safety.service.client import request_message
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import request_of
from tests.safety.asked import cylinder, fits, random_request, request, same
from tests.safety.test_scan_free_space import FAN, cast

GROUND = Filter.load("ground")


@pytest.mark.parametrize("side", [1, -1])
def test_a_blocked_robot_turns_away_from_the_obstacle(side):
    ask = request(action=(0.25, side * 0.3), obstacles=[cylinder(0.25, side * 0.05, 0.12)])
    stopped, aside = GROUND.decide(ask), GROUND.decide(replace(ask, turn_aside=True))
    assert stopped.kind == aside.kind == ADJUSTED and aside.verified
    assert side * stopped.plan[0, 1] > 0.0 > side * aside.plan[0, 1]
    assert f"turns aside to the {'right' if side > 0 else 'left'}" in aside.reason
    assert not same(stopped, GROUND.decide(replace(ask, turn_aside=True)))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_plans_that_turn_aside_are_verified_and_others_stay_as_they_are(seed):
    ask = random_request(np.random.default_rng(seed), count=3)
    plain, aside = GROUND.decide(ask), GROUND.decide(replace(ask, turn_aside=True))
    if "aside" not in aside.reason:
        assert same(plain, aside)
        return
    assert plain.kind == aside.kind == ADJUSTED and aside.verified
    assert abs(plain.plan[0, 0]) <= 0.3 * ask.action[0]
    assert fits(GROUND.model, ask, aside.plan[0]) > 0.0


def driven(turn_aside, periods=200):
    """Drive at a goal behind a pillar, as a policy that only knows the goal; return the smallest distance to it."""
    client = InProcess(GROUND)
    client.backup_plan.turn_aside = turn_aside
    pillar, goal, nearest = [cylinder(0.8, 0.01, 0.15)], np.array([1.6, 0.0]), math.inf
    x, y, heading, speed, turn = np.zeros(5)
    for _ in range(periods):
        bearing = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, math.tau)
        wanted = [0.25 * max(math.cos(bearing), 0.0), np.clip(2.0 * bearing, -0.5, 0.5)]
        speed, turn = client.decide([x, y, heading, speed, turn], wanted, pillar, known_free=True).action
        heading += 0.1 * turn
        x, y = x + 0.2 * speed * math.cos(heading), y + 0.2 * speed * math.sin(heading)
        heading += 0.1 * turn
        nearest = min(nearest, math.hypot(goal[0] - x, goal[1] - y))
    return nearest


def test_a_robot_that_turns_aside_gets_past_an_obstacle_that_it_is_stuck_at_otherwise():
    assert driven(turn_aside=False) > 0.7
    assert driven(turn_aside=True) < 0.1


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.floats(-7.0, 7.0), st.floats(0.0, math.pi / 2)), max_size=6))
def test_the_turn_is_the_smallest_to_a_free_direction(sectors):
    middles, halves = np.array(sectors).reshape(-1, 2).T
    every = np.linspace(-math.tau, math.tau, 4001)
    off = np.remainder(middles[:, None] - every + math.pi, math.tau) - math.pi
    free = every[(np.abs(off) >= halves[:, None]).all(axis=0)]
    turn = free_turn(middles, halves)
    if not math.isfinite(turn):
        off = np.remainder(middles[:, None] - every + math.pi, math.tau) - math.pi
        assert (np.abs(off) <= halves[:, None] + 2 * BEYOND_EDGE).any(axis=0).all()
        return
    assert (np.abs(np.remainder(middles - turn + math.pi, math.tau) - math.pi) >= halves - 1e-9).all()
    assert not free.size or abs(turn) <= np.abs(free).min() + 10 * BEYOND_EDGE


def test_a_scan_shows_where_to_turn():
    scan = Scan(cast([cylinder(0.27, 0.06, 0.12)], np.zeros(2), FAN), FAN, pose=(0.0, 0.0, 0.0))
    decision = GROUND.decide(replace(request(), known_free=False, scan=scan, turn_aside=True))
    assert decision.kind == ADJUSTED and decision.plan[0, 1] < -0.3


def test_robots_without_a_heading_ignore_it():
    air = Filter.load("quadrotor")
    backup = BackupPlan(air.robot, turn_aside=True)
    message = request_message(backup, np.zeros(9), [5.0, 0.0, 0.0], [], known_free=True)
    ask = request_of(message, air.robot)
    assert ask.turn_aside and same(air.decide(ask), air.decide(replace(ask, turn_aside=False)))
    assert air.decide(ask).kind == ALLOWED


def test_the_ground_task_turns_aside_and_an_unknown_asker_does_not():
    assert robot_with_task("ground").task.turn_aside and not robot_with_task("quadrotor").task.turn_aside
    assert not BackupPlan(robot_named("ground")).turn_aside
