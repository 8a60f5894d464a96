"""Passive safety: whenever the robot touches something that moves, it has been standing since before."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import MovingObstacles, split_moving
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.service.wire import obstacles_of
from brakeline.sim.arena import room_boundary
from brakeline.sim.traffic import Crowd, CrowdSensor, MoverKind
from tests.robots import GROUND
from tests.safety.asked import request, same
from tests.safety.unicycle import Unicycle

KIND = MoverKind(count=(6, 6), radius=0.2, speed=1.0, acceleration=1.0, keep=0.5)
ROOM = room_boundary(1.5, None)
PLACES = np.array([[1.0, 0.0], [-1.0, 0.5], [0.0, 1.0], [0.5, -1.0], [-0.9, -0.9], [1.0, 1.0]])
STANDING = 0.02  # m/s
DT = GROUND.period / 10


def walker(x, y=0.0, velocity=(0.0, 0.0), **more):
    motion = Motion(velocity, 0.03, 0.05, acceleration=1.0, **more)
    return Obstacle("cylinder", (x, y), (0.2,), motion=motion)


def ask(obstacles, **more):
    still, movers = split_moving(obstacles, 2)
    return request(obstacles=still, movers=movers, **more)


def test_one_that_comes_is_stopped_for_and_one_that_leaves_is_followed(ready):
    assert ready.decide(ask([walker(0.9, velocity=(-1.0, 0.0))])).kind != ALLOWED
    assert ready.decide(ask([walker(0.9, velocity=(1.0, 0.0))])).kind == ALLOWED
    assert ready.decide(request(obstacles=[Obstacle("cylinder", (0.9, 0.0), (0.2,))])).kind == ALLOWED


def test_who_can_only_come_once_it_stands_is_let_come(ready, model):
    """After two of three periods it stands: who may be there in the third stops no plan."""
    never = Filter(replace(model, stands=0))
    at = [walker(0.9 + far, velocity=(-1.0, 0.0)) for far in np.arange(0.0, 0.6, 0.02)]
    soon, late = ([f.decide(ask([one])).kind == ALLOWED for one in at] for f in (ready, never))
    assert 0.15 < 0.02 * (sum(soon) - sum(late)) < 0.4  # m: what a walker goes in a period, and its errors
    still = Obstacle("cylinder", (0.3, 0.0), (0.15,))
    assert ready.decide(ask([still, at[-1]])).kind != ALLOWED  # what stands is kept off to the end


def test_no_obstacle_that_stands_does_not_mean_that_nothing_is_near(ready):
    decision = ready.decide(ask([walker(0.35)]))
    assert decision.kind in (ADJUSTED, FAILSAFE) and decision.verified


def test_who_breaks_its_bound_is_counted_and_the_robot_brakes(ready):
    before = Sighting((5.0, 0.0), (0.0, 0.0), 0.2)
    driving = {"state": (0, 0, 0, 0.25, 0), "plan": np.zeros((3, 2)), "model": ready.version}
    good = ready.decide(ask([walker(0.9, before=replace(before, position=(0.9, 0.0)))], **driving))
    assert good.kind == ALLOWED and good.broken == 0
    bad = ready.decide(ask([walker(0.9, before=before), walker(0.0, 0.9)], **driving))
    assert bad.kind == FAILSAFE and bad.broken == 1 and "bounds" in bad.reason
    assert not bad.plan.any() and bad.verified  # from now, by where they are now
    near = ready.decide(ask([walker(0.36, before=before)], **driving))
    assert near.kind == FAILSAFE and not near.verified and not near.plan.any()


def test_who_stands_needs_nobodys_word_though_somebody_comes(ready):
    decision = ready.decide(ask([walker(0.31, velocity=(-1.0, 0.0))], action=(0.2, 0.0)))
    assert decision.kind == FAILSAFE and decision.verified and not decision.plan.any()


def test_what_cannot_move_is_as_one_that_stands(ready):
    rng = np.random.default_rng(0)
    for _ in range(40):
        at = rng.uniform(-0.6, 0.6, 2)
        if np.hypot(*at) < 0.35:
            continue
        still = Obstacle("cylinder", tuple(at), (0.2,))
        stuck = replace(still, motion=Motion((0.0, 0.0), 0.0, speed=0.0))
        action = rng.uniform(GROUND.low(), GROUND.high())
        one, other = ready.decide(request(action=action, obstacles=[still])), ready.decide(ask([stuck], action=action))
        assert one.kind == other.kind
        assert np.allclose(one.plan, other.plan, atol=1e-3)


def test_a_request_without_movers_is_decided_as_ever(ready):
    """Whether the field is there or not: to the last bit."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        near = Shapes.of([Obstacle("cylinder", tuple(rng.uniform(0.2, 0.6, 2)), (0.1,))], 2)
        plain = request(action=rng.uniform(GROUND.low(), GROUND.high()), obstacles=near)
        far = MovingObstacles.of([walker(50.0)], 2)
        assert same(ready.decide(plain), ready.decide(replace(plain, movers=far)))


def test_movers_of_another_dimension_are_refused(ready):
    wrong = MovingObstacles.of(
        [Obstacle("sphere", (1.0, 0.0, 0.0), (0.2,), motion=Motion((0.0,) * 3, 0.0, speed=1.0))], 3
    )
    with pytest.raises(BadRequest) as error:
        ready.decide(request(movers=wrong))
    assert error.value.field == "obstacles"


def test_a_motion_crosses_the_wire_whole():
    sent = [
        Obstacle("wall", (1.0, 0.0)),
        walker(0.5, age=0.1),
        walker(0.5, before=Sighting((0.4, 0.0), (0.1, 0.2), 0.2)),
        Obstacle("box", (1.0, 2.0), (0.1, 0.2), 0.3, motion=Motion((0.0, 0.0), 0.01, speed=1.6)),
    ]
    assert obstacles_of(obstacle_messages(sent), 2) == sent


# --- closed loop ----------------------------------------------------------------------------------------------------


def wild(k, rng, near):
    return np.array([0.25, -0.5]) + (np.array([0.25, 0.5]) - np.array([0.25, -0.5])) * rng.random() * (k % 7 < 5)


def pushing(k, rng, near):
    return np.array([0.25, np.clip(near, -0.5, 0.5)])


def contacts(ready, policy, seed, sees=True, steps=300):
    """(touched while moving, touched while standing), judged by the discs at every substep."""
    crowd = Crowd(KIND, PLACES, Shapes.of(ROOM, 2), seed)
    rng = np.random.default_rng(seed)
    robot, watch, kept = Unicycle((0.0, 0.0, 0.0), rng), CrowdSensor(crowd, rng), BackupPlan(GROUND)
    moving = standing = 0
    touching = False
    for k in range(steps):
        state = robot.measure()
        seen = watch.measure(k * GROUND.period)
        still, movers = split_moving([*ROOM, *(seen if sees else ())], 2)
        places = np.array([o.position for o in seen]) - state[:2]
        nearest = places[np.argmin(np.linalg.norm(places, axis=1))]
        bearing = (np.arctan2(nearest[1], nearest[0]) - state[2] + np.pi) % (2 * np.pi) - np.pi
        decision = ready.decide(
            request(
                state,
                policy(k, rng, bearing),
                still,
                input_in_force=kept.input_in_force,
                plan=kept.plan,
                model=kept.model,
                predicted=kept.predicted,
                movers=movers,
            )
        )
        u = kept.accept(decision.plan, decision.model, decision.predicted, decision.verified)
        start, before = robot.state.copy(), robot.state[3]
        path, _ = robot.step(u)
        cos, sin = np.cos(start[2]), np.sin(start[2])
        for i, (x, y) in enumerate(path):
            at = start[:2] + np.array([cos * x - sin * y, sin * x + cos * y])
            there, _ = crowd.at(k * GROUND.period + (i + 1) * DT)
            now = bool((np.linalg.norm(there - at, axis=1) < KIND.radius + GROUND.footprint).any())
            if now and not touching:
                still_stood = not u.any() and max(abs(before), abs(robot.state[3])) <= STANDING
                moving, standing = moving + (not still_stood), standing + still_stood
            touching = now
    return moving, standing


def test_a_filter_that_takes_a_robot_for_standing_too_soon_touches_them(model):
    early = Filter(replace(model, stands=1))
    assert sum(contacts(early, policy, seed)[0] for policy in (wild, pushing) for seed in range(2)) > 0


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("seed", [0, 1])
def test_it_never_touches_anybody_while_it_moves(ready, policy, seed):
    moving, standing = contacts(ready, policy, seed)
    assert moving == 0
    assert standing > 0  # else nobody came near, and this says nothing


def test_who_does_not_see_them_does(ready):
    assert contacts(ready, pushing, 0, sees=False)[0] > 0


def test_a_filter_that_takes_them_for_standing_touches_them(model, monkeypatch):
    """The mutant: as if nothing moved after it was measured."""
    monkeypatch.setattr(MovingObstacles, "moved", lambda self, times: np.zeros((len(self), len(times), 2)))
    monkeypatch.setattr(MovingObstacles, "radius", lambda self, times: np.zeros((len(self), len(times))))
    blind = Filter(model)
    assert sum(contacts(blind, policy, seed)[0] for policy in (wild, pushing) for seed in range(2)) > 0
