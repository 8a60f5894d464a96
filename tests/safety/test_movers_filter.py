"""Passive safety: whenever the robot touches something that moves, it has been standing since before."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import MovingObstacles, split_moving
from brakeline.messaging.obstacle import Obstacle, Shapes, rotate
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.service.in_process import InProcess
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


def test_the_robot_stops_for_a_mover_that_comes_and_follows_one_that_leaves(ready):
    assert ready.decide(ask([walker(0.9, velocity=(-1.0, 0.0))])).kind != ALLOWED
    assert ready.decide(ask([walker(0.9, velocity=(1.0, 0.0))])).kind == ALLOWED
    assert ready.decide(request(obstacles=[Obstacle("cylinder", (0.9, 0.0), (0.2,))])).kind == ALLOWED
    near = ready.decide(ask([walker(0.35)]))
    assert near.kind in (ADJUSTED, FAILSAFE) and near.verified


def test_a_mover_that_arrives_after_the_robot_stands_stops_no_plan(ready, model):
    """The robot stands after two of three periods."""
    never = Filter(replace(model, stands=0))
    at = [walker(0.9 + far, velocity=(-1.0, 0.0)) for far in np.arange(0.0, 0.6, 0.02)]
    soon, late = ([f.decide(ask([one])).kind == ALLOWED for one in at] for f in (ready, never))
    assert 0.15 < 0.02 * (sum(soon) - sum(late)) < 0.4  # m: what a walker goes in a period, and its errors
    still = Obstacle("cylinder", (0.3, 0.0), (0.15,))
    assert ready.decide(ask([still, at[-1]])).kind != ALLOWED  # what stands is kept off to the end


def test_a_changed_robot_may_stand_later_so_movers_count_in_every_period_of_its_plans(ready, model):
    """A robot with twice the lag touched walkers under verified plans, while its sets were widened."""
    never = Filter(replace(model, stands=0))
    at = [walker(0.9 + far, velocity=(-1.0, 0.0)) for far in np.arange(0.0, 0.6, 0.02)]
    for widening, same_rows in ((1.0, False), (1.2, False), (1.4, True)):
        allowed = [[f.decide(ask([one], widening=widening)).kind == ALLOWED for one in at] for f in (ready, never)]
        assert 0 < sum(allowed[1]) < len(at) and (allowed[0] == allowed[1]) is same_rows


@pytest.mark.parametrize(("ahead", "safe"), [(0.0, False), (GROUND.horizon * GROUND.period, True)])
def test_a_fast_mover_must_be_listed_before_it_is_within_sight(ready, ahead, safe):
    """With movers that are listed once they are within sight, as the pages said, they hit a robot that drove."""
    hits, disc, speed = 0, 0.3, 4.0  # m, m/s
    for seed in range(20):
        rng, client = np.random.default_rng(seed), InProcess(ready, accept_bound=1.0)
        robot, angle = Unicycle((0.0, 0.0, 0.0), rng), rng.uniform(-np.pi, np.pi)
        at = rng.uniform(2.0, 4.0) * np.array([np.cos(angle), np.sin(angle)])
        way = rng.normal([0.15, 0.0], 0.1) - at
        velocity = speed * way / np.linalg.norm(way)
        for _ in range(6):
            motion = Motion(tuple(velocity), 0.0, acceleration=0.0)
            far = float(np.linalg.norm(at - robot.state[:2])) - disc - speed * ahead
            near = [Obstacle("cylinder", tuple(at), (disc,), motion=motion)] if far <= GROUND.sight else []
            answer, start = client.decide(robot.measure(), [0.25, 0.0], near, known_free=True), robot.state
            path, _ = robot.step(answer.action)
            times = DT * np.arange(1, len(path) + 1)[:, None]
            gap = np.linalg.norm(start[:2] + rotate(path, start[2]) - at - velocity * times, axis=1)
            driving = np.linalg.norm(np.diff(path, axis=0, prepend=0.0), axis=1) > STANDING * DT
            if (touching := np.flatnonzero(gap < disc + GROUND.footprint)).size:
                hits += bool(driving[touching[0]] and answer.verified)
                break
            at = at + GROUND.period * velocity
    assert (hits == 0) == safe


def test_a_mover_that_breaks_its_bound_is_counted_and_the_robot_brakes(ready):
    before = Sighting((5.0, 0.0), (0.0, 0.0), 0.2)
    driving = {"state": (0, 0, 0, 0.25, 0), "plan": np.zeros((3, 2)), "model": ready.version}
    good = ready.decide(ask([walker(0.9, before=replace(before, position=(0.9, 0.0)))], **driving))
    assert good.kind == ALLOWED and good.broken == 0
    bad = ready.decide(ask([walker(0.9, before=before), walker(0.0, 0.9)], **driving))
    assert bad.kind == FAILSAFE and bad.broken == 1 and "bounds" in bad.reason
    assert not bad.plan.any() and bad.verified  # from now, by where they are now
    near = ready.decide(ask([walker(0.36, before=before)], **driving))
    assert near.kind == FAILSAFE and not near.verified and not near.plan.any()


def test_a_standing_robot_needs_no_verified_plan_when_a_mover_comes(ready):
    decision = ready.decide(ask([walker(0.31, velocity=(-1.0, 0.0))], action=(0.2, 0.0)))
    assert decision.kind == FAILSAFE and decision.verified and not decision.plan.any()


def test_a_mover_out_of_reach_changes_no_bit_of_the_decision(ready):
    rng = np.random.default_rng(1)
    for _ in range(20):
        near = Shapes.of([Obstacle("cylinder", tuple(rng.uniform(0.2, 0.6, 2)), (0.1,))], 2)
        plain = request(action=rng.uniform(GROUND.low(), GROUND.high()), obstacles=near)
        far = MovingObstacles.of([walker(50.0)], 2)
        assert same(ready.decide(plain), ready.decide(replace(plain, movers=far)))


def test_movers_of_another_dimension_are_refused(ready):
    ball = Obstacle("sphere", (1.0, 0.0, 0.0), (0.2,), motion=Motion((0.0,) * 3, 0.0, speed=1.0))
    with pytest.raises(BadRequest) as error:
        ready.decide(request(movers=MovingObstacles.of([ball], 3)))
    assert error.value.field == "obstacles"


def test_a_motion_survives_the_wire():
    sent = [
        Obstacle("wall", (1.0, 0.0)),
        walker(0.5, age=0.1),
        walker(0.5, before=Sighting((0.4, 0.0), (0.1, 0.2), 0.2)),
        Obstacle("box", (1.0, 2.0), (0.1, 0.2), 0.3, motion=Motion((0.0, 0.0), 0.01, speed=1.6)),
    ]
    assert obstacles_of(obstacle_messages(sent), 2) == sent


# --- closed loop ----------------------------------------------------------------------------------------------------


def wild(k, rng, near):
    return np.array([0.25, rng.random() * (k % 7 < 5) - 0.5])


def pushing(k, rng, near):
    return np.array([0.25, np.clip(near, -0.5, 0.5)])


def contacts(ready, policy, seed, sees=True):
    """Return the contacts while the robot moved and while it stood, judged by the discs at every substep.

    The drive ends with the first contact while the robot moves.
    """
    crowd = Crowd(KIND, PLACES, Shapes.of(ROOM, 2), seed)
    rng = np.random.default_rng(seed)
    robot, watch, safety = Unicycle((0.0, 0.0, 0.0), rng), CrowdSensor(crowd, rng), InProcess(ready, accept_bound=1.0)
    standing, touching = 0, False
    for k in range(300):
        state = robot.measure()
        measured = watch.measure(k * GROUND.period)
        places = np.array([o.position for o in measured]) - state[:2]
        nearest = places[np.argmin(np.linalg.norm(places, axis=1))]
        bearing = (np.arctan2(nearest[1], nearest[0]) - state[2] + np.pi) % (2 * np.pi) - np.pi
        u = safety.decide(state, policy(k, rng, bearing), [*ROOM, *(measured if sees else ())]).action
        start = robot.state.copy()
        path, _ = robot.step(u)
        for i, at in enumerate(start[:2] + rotate(path, start[2])):
            there, _ = crowd.at(k * GROUND.period + (i + 1) * DT)
            now = bool((np.linalg.norm(there - at, axis=1) < KIND.radius + GROUND.footprint).any())
            if now and not touching:
                still_stood = not u.any() and max(abs(start[3]), abs(robot.state[3])) <= STANDING
                if not still_stood:
                    return 1, standing
                standing += 1
            touching = now
    return 0, standing


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_robot_touches_no_mover_while_it_moves(ready, policy, seed):
    moving, standing = contacts(ready, policy, seed)
    assert moving == 0
    assert standing > 0, "no mover came near"


def test_a_filter_touches_movers_that_it_does_not_see_if_it_stands_too_soon_or_if_it_ignores_motion(
    ready, model, monkeypatch
):
    assert contacts(ready, pushing, 0, sees=False)[0] > 0
    assert contacts(Filter(replace(model, stands=1)), pushing, 0)[0] > 0
    monkeypatch.setattr(MovingObstacles, "moved", lambda self, times: np.zeros((len(self), len(times), 2)))
    monkeypatch.setattr(MovingObstacles, "radius", lambda self, times: np.zeros((len(self), len(times))))
    assert contacts(Filter(model), wild, 0)[0] > 0


WRONG = [
    *(("growth", np.full((1, 3), value)) for value in (-10.0, np.nan)),
    *(("age", np.array([value])) for value in (-1e9, np.nan, np.inf)),
    *(("drift", np.array([[value, 0.0]])) for value in (np.nan, np.inf)),
    *(("drift", np.zeros((0, 2))), ("growth", np.zeros((0, 3))), ("growth", np.zeros((1, 2)))),
    *(("age", np.zeros(0)), ("consistent", np.zeros(0, dtype=bool)), ("consistent", np.ones(1))),
]


@pytest.mark.parametrize(("part", "value"), WRONG)
def test_arrays_of_motions_that_leave_an_obstacle_out_are_refused(ready, part, value):
    """Without a drift, or with a negative growth, a mover ahead was nowhere, and full speed was allowed."""
    _, movers = split_moving([walker(0.35)], 2)
    with pytest.raises(BadRequest, match="mov"):
        ready.decide(request(obstacles=Shapes.of([], 2), movers=replace(movers, **{part: value})))
