"""Robots that share a world: their reservations stay disjoint, and no robot touches another."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from brakeline.actors.decision_guard import request_decisions
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner, RobotGroup, decide
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.wire import reservation_of
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.shared_world import FleetEnv
from tests.actors.conftest import no_answer
from tests.robots import GROUND
from tests.safety.asked import apart
from tests.safety.served import Service

SIZE = 4
ROUNDING = 1e-6  # m


def fleet_of(size=SIZE, arena="crossing", reserving=True):
    world = FleetEnv(GROUND, arena, size, 0)
    runners = [
        EpisodeRunner(GROUND, member, ActorIdentity(f"robot.{i}", i, 0)) for i, member in enumerate(world.members)
    ]
    return RobotGroup(runners, world, reserving)


def close_fleet(reserving=True):
    """Return robots that begin an episode on a small circle around a free position."""
    fleet = fleet_of(reserving=reserving)
    fleet.begin(0)
    arena = fleet.world.world.robots[0].arena
    spots = np.random.default_rng(0).uniform(-1.5, 1.5, (2000, 2))
    spot = spots[np.argmax(arena.shapes.distance(spots).min(axis=0))]
    for i, robot in enumerate(fleet.world.world.robots):
        angle = 2.0 * np.pi * i / SIZE
        robot._qpos[:2] = spot + 0.4 * np.array([np.cos(angle), np.sin(angle)])
        robot.start_estimation(None, np.random.default_rng(i))
        runner = fleet.runners[i]
        runner.info = runner.info | {"state": robot.measured, "others": fleet.world.other_states(i)}
    return fleet


def least_distance(fleet):
    """Return the least distance between two reservations [m]."""
    reservations = [r.backup_plan.reservation for r in fleet.runners if r.backup_plan.reservation is not None]
    return min((apart(a, b) for a, b in combinations(reservations, 2)), default=np.inf)


def drive(fleet, ask, policy, periods, lost=0.0, seed=0):
    """Return the least distance of reservations [m] and the decisions; lost: probability that answers begin to fail."""
    proposers = [scripted(policy, GROUND, np.random.default_rng(seed + i)) for i in range(len(fleet.runners))]
    rng, least, kinds = np.random.default_rng(seed), np.inf, []
    silent = 0  # periods that the service is silent for
    for _ in range(periods):
        proposals = [policy(r.observation, r.info) for policy, r in zip(proposers, fleet.runners, strict=True)]
        silent = silent - 1 if silent else int(rng.integers(1, 4)) * (rng.random() < lost)
        (outcomes,) = decide([fleet], [proposals], no_answer if silent else ask)
        steps = fleet.execute(proposals, outcomes)
        kinds += [step.decision for step in steps if step is not None]
        least = min(least, least_distance(fleet))
        for runner in fleet.runners:
            runner.running = True  # this test goes on after goals and timeouts
    return least, kinds


@pytest.mark.parametrize("policy", ["adversary", "random"])
def test_no_robots_touch_and_reservations_stay_disjoint_though_answers_fail(ask, policy):
    fleet = close_fleet()
    least, kinds = drive(fleet, ask, policy, 100, lost=0.15)
    assert fleet.world.touches == 0
    assert least >= -ROUNDING
    assert {pb.ALLOWED, pb.ADJUSTED, pb.FAILSAFE} <= set(kinds)


def test_robots_whose_reservations_touch_do_not_count_as_verified():
    """The service changes to wider sets and back, and the robots ask for wider sets: some get no verified plan."""
    narrow = ModelSet.load("ground")
    wide = replace(narrow, steps=tuple(replace(step, w=10.0 * step.w) for step in narrow.steps), in_place=None)
    service, rng, reasons, fleet = Service(wide, narrow), np.random.default_rng(0), [], close_fleet()

    def ask(requests):
        if rng.random() < 0.2:
            service.models.install((narrow, wide)[rng.integers(2)])
        for request in requests:
            request.widening = rng.choice([1.0, 5.0])
        replies = service.replies(*requests)
        for one, other in combinations([reply.decision for reply in replies], 2):
            reserved = [reservation_of(decision.reservation, GROUND) for decision in (one, other)]
            if apart(*reserved) < -2.0 * ROUNDING:
                reasons.append(one.reason + other.reason)
                assert not one.verified and not other.verified
        return replies

    drive(fleet, ask, "random", 100)
    assert fleet.world.touches == 0
    assert any("touches another robot's" in reason for reason in reasons)


def test_without_reservations_the_same_robots_touch(ask):
    fleet = close_fleet(reserving=False)
    drive(fleet, ask, "adversary", 60)
    assert fleet.world.touches > 0


def test_without_answers_all_robots_stop_within_their_reservations(ask):
    fleet = close_fleet()
    drive(fleet, ask, "random", 15)
    reservations = [runner.backup_plan.reservation for runner in fleet.runners]
    outcomes = request_decisions(no_answer, fleet.requests([np.zeros(2)] * SIZE), GROUND)
    for k in range(6):
        fleet.execute([np.zeros(2)] * SIZE, outcomes)
        for reservation, robot in zip(reservations, fleet.world.world.robots, strict=True):
            at = min(k, len(reservation.center) - 1)
            body = reservation.radius[at] - GROUND.footprint
            assert (np.abs(robot.true[:2] - reservation.center[at]) <= reservation.half_width[at] + body).all()
    assert all(abs(robot.true[3]) < 0.01 for robot in fleet.world.world.robots) and fleet.world.touches == 0


def test_the_filter_decides_about_the_robots_in_turn(ask, monkeypatch):
    order, decide_one = [], Filter.decide

    def record(self, request):
        order.append(tuple(request.state[:2]))
        return decide_one(self, request)

    monkeypatch.setattr(Filter, "decide", record)
    fleet = fleet_of(3)
    fleet.begin(0)
    for turn in range(4):
        order.clear()
        requests = fleet.requests([np.zeros(2)] * 3)
        ask(requests)
        states = [tuple(request.state[:2]) for request in requests]
        assert order == states[turn % 3 :] + states[: turn % 3]
        fleet.execute([np.zeros(2)] * 3, request_decisions(ask, requests, GROUND))


def replies(ask, requests):
    return [reply.error.type if reply.HasField("error") else "decided" for reply in ask(requests)]


def test_a_fleet_that_is_not_in_one_question_is_refused_with_a_reason(ask):
    fleet = fleet_of()
    fleet.begin(0)
    requests = fleet.requests([np.array([0.2, 0.0])] * SIZE)
    assert replies(ask, requests) == ["decided"] * SIZE
    apart = ask(requests[:3])
    assert [reply.error.type for reply in apart] == ["AskedApart"] * 3
    assert "robot.3" in apart[0].error.message and apart[0].error.field == "fleet"
    # The other robots of the batch still get their decisions.
    alone = pb.Request()
    alone.CopyFrom(requests[3])
    alone.fleet[:] = []
    assert replies(ask, [*requests[:2], alone]) == ["AskedApart"] * 2 + ["decided"]
    twice = [*requests, requests[0]]
    assert set(replies(ask, twice)) == {"AskedApart"}
    late = [pb.Request.FromString(request.SerializeToString()) for request in requests]
    late[1].step += 1
    assert set(replies(ask, late)) == {"AskedApart"}


def test_a_moving_robot_without_a_reservation_is_refused(ask):
    fleet = fleet_of(2)
    fleet.begin(0)
    requests = fleet.requests([np.array([0.2, 0.0])] * 2)
    moving = pb.Request.FromString(requests[0].SerializeToString())
    moving.input_in_force[0], moving.model = 0.2, "unverified"
    refused = ask([moving, requests[1]])
    assert {reply.error.field for reply in refused} == {"reservation"} and "robot.0 moves" in refused[1].error.message
    for change in ({"center": [0.0]}, {"radius": [float("nan")] * 3}, {"half_width": [-1.0] * 6}):
        bad = pb.Request.FromString(requests[1].SerializeToString())
        bad.reservation.center[:], bad.reservation.half_width[:] = [0.0] * 6, [0.0] * 6
        bad.reservation.radius[:] = [0.1] * 3
        assert replies(ask, [requests[0], bad]) == ["decided"] * 2
        for name, value in change.items():
            getattr(bad.reservation, name)[:] = value
        assert [reply.error.field for reply in ask([requests[0], bad])] == ["reservation"] * 2
        assert set(replies(ask, [requests[0], bad])) == {"BadRequest"}


def test_if_one_robot_has_no_answer_none_has(ask):
    """The other robots' new plans may rest on a plan that this robot does not know."""
    fleet = close_fleet()
    drive(fleet, ask, "random", 8)

    def garbled(requests):
        replies = ask(requests)
        replies[2] = pb.Reply()
        return replies

    before = [runner.backup_plan.plan.copy() for runner in fleet.runners]
    (outcomes,) = decide([fleet], [[np.array([0.2, 0.1])] * SIZE], garbled)
    steps = fleet.execute([np.zeros(2)] * SIZE, outcomes)
    assert all("no answer about robot.2" in outcomes[i].failure for i in (0, 1, 3))
    assert all(step.fallback for step in steps)
    assert all(np.allclose(step.action, plan[0]) for step, plan in zip(steps, before, strict=True))
    assert least_distance(fleet) >= -ROUNDING


def test_a_robot_at_its_goal_stands_and_is_avoided(ask):
    fleet = fleet_of(2, arena="open")
    fleet.begin(0)
    first, second = fleet.runners
    first.running = False
    results = fleet.execute([np.zeros(2)] * 2, *decide([fleet], [[np.zeros(2)] * 2], ask))
    assert results[0] is None and results[1].actor == "robot.1" and results[1].fleet == 2
    assert (first.step, second.step) == (1, 1) and first.backup_plan.reservation is not None
