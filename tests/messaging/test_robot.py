"""What the robots' vectors agree on."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import UnknownRobot
from brakeline.messaging.robot import Disc, robot_named
from tests.robots import GROUND, ROBOTS

pytestmark = pytest.mark.fast


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_every_robot_is_consistent(robot):
    n, m = robot.state_dim, robot.action_dim
    assert robot_named(robot.name).layout() == robot.layout()
    for bounds in (robot.action_low, robot.action_high, robot.translates, robot.action_slew):
        assert len(bounds) == m
    assert len(robot.measurement_bound) == n
    assert all(robot.position_dim <= i < n for i in robot.regressor), "displacement does not depend on position"
    assert (robot.low() <= 0).all()
    assert (robot.high() > 0).all()
    assert robot.regressor_dim == len(robot.regressor) + m
    assert robot.free_steps + robot.brake_steps <= robot.horizon


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_every_plan_ends_in_a_stop(robot):
    schedule = robot.plan_matrix()
    assert schedule.shape == (robot.horizon * robot.action_dim, robot.free_steps * robot.action_dim)
    free = np.tile(robot.high(), robot.free_steps)
    plan = (schedule @ free).reshape(robot.horizon, -1)
    assert not plan[robot.free_steps + robot.brake_steps - 1 :].any()
    assert (np.diff(plan, axis=0) <= 0).all()


def test_a_ramp_goes_down_step_by_step():
    robot = replace(GROUND, horizon=6, free_steps=2, brake_steps=4)
    plan = (robot.plan_matrix() @ [0.1, 0.2, 0.2, 0.4]).reshape(6, 2)
    assert np.allclose(plan[:, 0], [0.1, 0.2, 0.15, 0.1, 0.05, 0.0])
    assert np.allclose(plan[:, 1], [0.2, 0.4, 0.3, 0.2, 0.1, 0.0])


def test_the_layout_changes_with_whatever_two_processes_must_share():
    assert GROUND.layout() == replace(GROUND).layout()
    assert GROUND.layout() != replace(GROUND, body=(Disc((0.0, 0.0), 0.1),)).layout()
    assert GROUND.layout() != replace(GROUND, action_high=(0.25, 0.6)).layout()


def test_unknown_robots_are_refused_with_the_names_there_are():
    with pytest.raises(UnknownRobot, match="ground") as caught:
        robot_named("submarine")
    assert caught.value.field == "robot"
