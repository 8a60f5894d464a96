"""The blocking constraint names the right obstacle, its true edge and the true violation."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.robot import Limit
from brakeline.safety.filter.blocking_constraint import SIGHT
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ALLOWED
from tests.safety.asked import cylinder, random_request, request


def blocked(ready, requests):
    for question in requests:
        decision = ready.decide(question)
        if decision.kind != ALLOWED and decision.blocked_by is not None:
            yield question, decision
        else:
            assert decision.blocked_by is None


def test_the_edge_touches_the_blocking_obstacle_and_has_all_of_it_behind(ready):
    rng, seen = np.random.default_rng(0), 0
    for question, decision in blocked(ready, (random_request(rng, 6, 0.22) for _ in range(120))):
        stopped, shapes = decision.blocked_by, question.obstacles
        assert stopped.by == "cylinder" and 0.0 <= stopped.after <= ready.robot.horizon * ready.robot.period + 1e-9
        levels = (shapes.center - stopped.at) @ stopped.normal - shapes.rho  # of the nearest point of each
        assert np.abs(levels).min() < 1e-6, "it is the supporting half-space of one of them"
        assert np.linalg.norm(stopped.normal) == pytest.approx(1.0)
        assert (question.state[:2] - stopped.at) @ stopped.normal < 0.0, "the robot is on the free side"
        seen += 1
    assert seen > 30


def test_the_room_is_the_margin_of_the_proposals_tube(ready):
    rng = np.random.default_rng(1)
    for question, decision in blocked(ready, (random_request(rng) for _ in range(60))):
        z_0 = np.concatenate([question.state[ready.regressor], question.input_in_force])
        z = ready.inputs.regressors(z_0, ready.inputs.limited(question.action, question.input_in_force))
        scene = ready.constraints.local_map(question, z_0, ready.builder.reachable(question.input_in_force))
        assert decision.blocked_by.room == pytest.approx(ready.constraints.margin(ready.constraints.rows(scene, z), z))


def test_a_wall_a_box_a_mover_a_limit_and_the_sight_have_their_names(ready):
    def name(filter=ready, movers=None, obstacles=(), state=(0, 0, 0, 0.25, 0)):
        return filter.decide(request(state, (0.25, 0.0), obstacles, movers=movers)).blocked_by.by

    assert name(obstacles=[Obstacle("wall", (0.16, 0.0), (), np.pi), cylinder(-1.0, 0.0)]) == "wall"
    assert name(obstacles=[cylinder(-1.0, 0.0), Obstacle("box", (0.3, 0.0), (0.3, 0.3))]) == "box"
    walker = Obstacle("cylinder", (0.45, 0.0), (0.1,), motion=Motion((0.0, 0.0), 0.0, 0.0, speed=0.5))
    assert name(movers=MovingObstacles.of([walker], 2), obstacles=[cylinder(-1.0, 0.0)]) == "moving cylinder"
    slow = replace(ready.robot, limits=(Limit("walking pace", (0.0, 0.0, 0.0, 1.0, 0.0), 0.1),))
    assert name(Filter(replace(ready.model, robot=slow)), state=(0, 0, 0, 0.05, 0)) == "walking pace"
    assert name(Filter(replace(ready.model, robot=replace(ready.robot, sight=0.15)))) == SIGHT
