"""Requests as they come up while driving: what the benchmarks of the filter decide on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from actors.driver import Driver, Identity
from actors.guard import consult
from deploy.data.store import model_for
from deploy.policies import policy_named
from deploy.study.evaluate import in_process
from deploy.vehicles import environment
from messaging import brakeline_pb2 as pb
from messaging.tasks import RobotWithTask, robot_with_task
from safety.filter import Filter
from safety.model_set import ModelSet, Recipe
from safety.request import Request
from safety.wire import request_of
from sim.conditions import Conditions

STEPS = 1500


def model(certificate: str = "residual", mode: str = "direct", robot: RobotWithTask | None = None) -> ModelSet:
    return model_for(robot or robot_with_task("ground"), Recipe(certificate, mode))


def messages(
    policy: str = "random", seed: int = 5, robot: RobotWithTask | None = None, conditions: Conditions | None = None
) -> list[pb.Request]:
    """The questions of some episodes of a policy behind the default filter."""
    robot = robot or robot_with_task("ground")
    question = in_process(model(robot=robot))
    driver = Driver(robot, environment(robot, "default", seed, conditions), Identity("bench", 0, seed))
    choose = policy_named(policy, robot, seed)
    asked: list[pb.Request] = []
    episode = 0
    while len(asked) < STEPS:
        driver.begin(episode)
        episode += 1
        while driver.running and len(asked) < STEPS:
            proposal = np.asarray(choose(driver.observation, driver.info), dtype=float)
            asked.append(driver.request(proposal))
            driver.execute(proposal, consult(question, [asked[-1]], robot)[0])
    return asked


def requests(ready: Filter, asked: list[pb.Request]) -> Iterator[Request]:
    """The same as the filter takes them, each decoded when it is its turn, as a service does; plans of another model
    count as standing still's."""
    for message in asked:
        message.model = message.model and ready.version
        yield request_of(message, ready.robot)
