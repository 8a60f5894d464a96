"""Obstacles in the robot's frame are noticed, and obstacles in the right frame never."""

import logging

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle, rotate
from brakeline.messaging.obstacle_motion import Motion
from brakeline.safety.service.in_process import InProcess
from tests.safety.unicycle import Unicycle

POSTS = np.array([[1.2, 0.5], [0.9, -0.7]])


def own_frame(state, posts):
    return rotate(posts - state[:2], -state[2])


@pytest.fixture
def driven(ready, caplog):
    """Drive an arc for 25 periods, with the posts where `given` says; return the warnings."""

    def drive(given, start=(0.0, 0.0, 0.4), **more):
        safety, robot = InProcess(ready, accept_bound=1.0), Unicycle(start, np.random.default_rng(0))
        caplog.clear()
        with caplog.at_level(logging.WARNING, "brakeline.safety"):
            for period in range(25):
                state = robot.measure()
                at = given(state, POSTS + start[:2], period)
                posts = (Obstacle("cylinder", tuple(position), (0.05,), **more) for position in at)
                robot.step(safety.decide(state, [0.2, 0.1], posts).action)
        return [record.getMessage() for record in caplog.records]

    return drive


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.4), (3.0, -2.0, -2.0)])
def test_obstacles_in_the_robots_frame_are_noticed_once(driven, start):
    """All decisions were allowed, and ten of ten drives ended in the obstacle."""
    (said,) = driven(lambda state, posts, _: own_frame(state, posts), start)
    assert "Are they in the robot's frame?" in said and said.startswith("ground")


@pytest.mark.parametrize(
    "given",
    [
        lambda state, posts, period: posts,
        lambda state, posts, period: posts[:: 1 if period % 2 else -1],  # in another order
        lambda state, posts, period: np.add(posts, (0.0, 0.03 * period)),  # seen as they move
        lambda state, posts, period: posts[: 1 + period % 2],  # in and out of sight
        lambda state, posts, period: np.add(posts, (-0.03 * period, 0.02 * (period % 5))),
    ],
)
def test_obstacles_in_the_right_frame_are_never_taken_for_others(driven, given):
    assert driven(given) == []


def test_moving_obstacles_may_come_towards_the_robot(driven):
    motion = Motion(velocity=(-0.2, 0.0), position_error=0.01, velocity_error=0.1, speed=0.5)
    assert driven(lambda state, posts, _: own_frame(state, posts), motion=motion) == []
