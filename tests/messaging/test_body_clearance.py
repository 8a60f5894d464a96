"""The clearance of a body is that of its nearest disc, turned by the heading."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.body_clearance import body_clearance
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.robot import Disc, robot_named
from brakeline.messaging.robot_description import robot_from_description

GROUND = robot_named("ground")
LONG = replace(GROUND, body=(Disc((0.2, 0.0), 0.1), Disc((-0.3, 0.0), 0.1)))
WALL = Shapes.of([Obstacle("wall", (1.0, 0.0), yaw=math.pi)], 2)


def test_each_disc_turns_with_the_heading() -> None:
    states = np.array([[0.0, 0.0, heading, 0.0, 0.0] for heading in (0.0, math.pi / 2.0, math.pi)])
    assert body_clearance(LONG, WALL, states) == pytest.approx([0.7, 0.9, 0.6])
    assert body_clearance(LONG, WALL, states[:, None]).shape == (3, 1)
    assert body_clearance(GROUND, WALL, states[:, :2]) == pytest.approx(3 * [1.0 - GROUND.footprint])


def test_without_obstacles_or_a_body_the_clearance_is_infinite() -> None:
    arm = robot_from_description(
        {
            "name": "arm",
            "period": 0.1,
            "state": {"q": {"unit": "rad", "error": 0.01}},
            "input": {"v": {"unit": "rad/s", "low": -1.0, "high": 1.0}},
            "plan": {"horizon": 4, "brake": 1},
            "limit": [{"name": "up", "weights": {"q": 1.0}, "most": 1.0}],
        }
    )
    for robot in (GROUND, arm):
        assert body_clearance(robot, Shapes.of([], robot.position_dim), np.zeros(robot.state_dim)) == math.inf
