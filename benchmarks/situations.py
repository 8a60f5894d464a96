"""Requests as they come up while driving: what the benchmarks of the filter decide on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Request
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.service.wire import request_of
from brakeline.sim.sim_conditions import Conditions

STEPS = 1500


def model(certificate: str = "residual", mode: str = "direct", robot: RobotWithTask | None = None) -> ModelSet:
    return model_for(robot or robot_with_task("ground"), ModelConfig(certificate, mode))


def messages(
    policy: str = "random", seed: int = 5, robot: RobotWithTask | None = None, conditions: Conditions | None = None
) -> list[pb.Request]:
    """The questions of some episodes of a policy behind the default filter."""
    robot = robot or robot_with_task("ground")
    question = in_process(model(robot=robot))
    driver = EpisodeRunner(robot, environment(robot, "default", seed, conditions), ActorIdentity("bench", 0, seed))
    choose = policy_named(policy, robot, seed)
    asked: list[pb.Request] = []
    episode = 0
    while len(asked) < STEPS:
        driver.begin(episode)
        episode += 1
        while driver.running and len(asked) < STEPS:
            proposal = np.asarray(choose(driver.observation, driver.info), dtype=float)
            outcome = driver.decide(proposal, question)
            assert outcome is not None
            asked.append(outcome.request)
            driver.execute(proposal, outcome)
    return asked


def requests(ready: Filter, asked: list[pb.Request]) -> Iterator[Request]:
    """The same as the filter takes them, each decoded when it is its turn, as a service does; plans of another model
    count as standing still's."""
    for message in asked:
        message.model = message.model and ready.version
        yield request_of(message, ready.robot)
