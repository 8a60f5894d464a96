"""The fleet client decides for all robots of a world, or for none."""

import numpy as np
import pytest

from brakeline.errors import NoReply, SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.scan import Scan
from brakeline.messaging.topics import DECIDE
from brakeline.safety.service.fleet_client import FleetClient
from tests.messaging.conftest import endpoint, join  # noqa: F401 - fixtures
from tests.robots import GROUND
from tests.safety.served import Service
from tests.safety.unicycle import Unicycle

POST = Obstacle("cylinder", (0.0, 0.8), (0.1,))
NAMES = ("left", "right")


def facing(rng):
    """Return two robots half a metre apart that face each other."""
    return [Unicycle((-0.25, 0.0, 0.0), rng, noise=0.0), Unicycle((0.25, 0.0, np.pi), rng, noise=0.0)]


def decided(fleet, robots, actions):
    """Return the answers, after retries until the service is found."""
    while True:
        try:
            return fleet.decide([r.measure() for r in robots], actions, [[POST], [POST]])
        except NoReply:
            continue


def least_distance(robots):
    return float(np.hypot(*(robots[0].state[:2] - robots[1].state[:2])))


@pytest.fixture
def fleet(join, endpoint, model):  # noqa: F811
    join("safety", listen=True).serve(DECIDE, Service(model).answer)
    with FleetClient.open(endpoint, "ground", NAMES, deadline=5.0) as client:
        yield client


def test_two_robots_that_drive_at_each_other_do_not_meet(fleet):
    robots, moved = facing(np.random.default_rng(0)), 0.0
    for _ in range(15):
        answers = decided(fleet, robots, [[0.25, 0.0], [0.25, 0.0]])
        for robot, answer in zip(robots, answers, strict=True):
            robot.step(answer.action)
        moved = max(moved, robots[0].state[0] + 0.25)
        one, other = (backup_plan.reservation for backup_plan in fleet.backup_plans)
        assert one.distance(other) > 0.0
        assert least_distance(robots) > 2.0 * GROUND.footprint
    assert moved > 0.02, "they stood all the time"
    fleet.reset()
    assert all(backup_plan.reservation is None and not backup_plan.plan.any() for backup_plan in fleet.backup_plans)


def test_without_a_decision_for_one_robot_no_robot_has_one(fleet):
    robots = facing(np.random.default_rng(1))
    answers = decided(fleet, robots, [[0.1, 0.0], [0.1, 0.0]])
    for robot, answer in zip(robots, answers, strict=True):
        robot.step(answer.action)
    before = [(backup.plan.copy(), backup.input_in_force, backup.reservation) for backup in fleet.backup_plans]
    with pytest.raises(SafetyError) as caught:
        decided(fleet, robots, [[0.2, 0.3], [0.0]])
    assert caught.value.field == "action"
    for backup, (plan, in_force, reservation) in zip(fleet.backup_plans, before, strict=True):
        assert np.array_equal(backup.plan, plan)
        assert backup.input_in_force is in_force and backup.reservation is reservation
    inputs = fleet.fallback()
    assert all(np.array_equal(executed, plan[0]) for executed, (plan, *_) in zip(inputs, before, strict=True))
    for robot, executed in zip(robots, inputs, strict=True):
        robot.step(executed)
    assert [a.verified for a in decided(fleet, robots, [[0.1, 0.0], [0.1, 0.0]])] == [True, True]


def test_the_first_robot_changes_each_period(fleet, monkeypatch):
    queries = []
    monkeypatch.setattr(fleet.bus, "ask", lambda key, payload, *_, **__: queries.append(payload) or b"")
    for _ in range(3):
        with pytest.raises(SafetyError):
            fleet.decide([np.zeros(5), np.ones(5)], [[0.1, 0.0]] * 2, [[], []])
        fleet.fallback()
    requests = [pb.RequestBatch.FromString(payload).requests for payload in queries]
    assert [[(r.step, r.actor, tuple(r.fleet)) for r in batch] for batch in requests] == [
        [(i, name, NAMES) for name in NAMES] for i in range(3)
    ]


def test_a_fleet_needs_known_free_space(fleet):
    robots = facing(np.random.default_rng(2))
    decided(fleet, robots, [[0.0, 0.1]] * 2)
    fleet.reset()
    questions = [r.measure() for r in robots], [[0.0, 0.1]] * 2
    with pytest.raises(SafetyError, match="known_free") as caught:
        fleet.decide(*questions)
    assert caught.value.field == "obstacles"
    fleet.fallback()
    assert [answer.kind for answer in fleet.decide(*questions, known_free=True)] == ["allowed", "allowed"]
    fleet.reset()
    states, angles = questions[0], np.linspace(-np.pi, np.pi, 360, endpoint=False)
    blind = [Scan(np.full(360, 0.13), angles, tuple(state[:3])) for state in states]
    assert {answer.kind for answer in fleet.decide(*questions, scans=blind)} == {"failsafe"}


def test_a_malformed_fleet_is_refused(fleet):
    for names in ((), ("alone",), ("same", "same")):
        with pytest.raises(ValueError, match="two robots or more"):
            FleetClient(fleet.bus, "ground", names)
    with pytest.raises(ValueError, match="zip"):
        fleet.decide([np.zeros(5)], [[0.1, 0.0]] * 2, [[], []])
