"""Make requests as they come up while driving: the benchmarks of the filter decide on them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, islice

import numpy as np

from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Request
from brakeline.safety.model.model_set import DIRECT, ModelConfig, ModelSet
from brakeline.safety.service.wire import request_of
from brakeline.sim.scripted_policies import Policy
from brakeline.sim.sim_conditions import Conditions

STEPS, SEED = 1500, 5


def model(certificate: str = "residual", mode: str = DIRECT, robot: RobotWithTask | None = None) -> ModelSet:
    """Return a model set of a robot; by default of the ground robot."""
    return model_for(robot or robot_with_task("ground"), ModelConfig(certificate, mode))


def driven(
    policy: str, seed: int, robot: RobotWithTask, conditions: Conditions | None = None, mode: str = DIRECT
) -> Iterator[tuple[pb.Episode | None, DecisionOutcome, pb.Step]]:
    """Drive a policy behind the default filter, or one of another mode, without end.

    Yields:
        At each step: the message of the episode at its first step, else None; the outcome of the request; the step.
    """
    chosen = policy_named(policy, robot, seed)
    yield from driven_behind(model(mode=mode, robot=robot), chosen, seed, robot, conditions)


def driven_behind(
    safety: ModelSet, policy: Policy, seed: int, robot: RobotWithTask, conditions: Conditions | None = None
) -> Iterator[tuple[pb.Episode | None, DecisionOutcome, pb.Step]]:
    """Drive a policy behind the filter of a model set, however loose, without end; see `driven`."""
    ask = in_process(safety, accept_bound=1.0)
    driver = EpisodeRunner(robot, environment(robot, "default", seed, conditions), ActorIdentity("actor-0", 0, seed))
    for number in count():
        episode: pb.Episode | None = driver.begin(number)
        while driver.running:
            proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
            outcome = driver.decide(proposal, ask)
            assert outcome is not None
            yield episode, outcome, driver.execute(proposal, outcome)
            episode = None


def messages(
    policy: str = "random",
    robot: RobotWithTask | None = None,
    conditions: Conditions | None = None,
    mode: str = DIRECT,
) -> list[pb.Request]:
    """Return the requests of some episodes of a policy behind the default filter, or one of another mode."""
    steps = driven(policy, SEED, robot or robot_with_task("ground"), conditions, mode)
    return [outcome.request for _, outcome, _ in islice(steps, STEPS)]


def requests(safety_filter: Filter, asked: list[pb.Request]) -> Iterator[Request]:
    """Yield the requests as the filter takes them, each decoded when it is needed, as in a service.

    A plan of another model counts as the plan of a robot that stands.
    """
    for message in asked:
        message.model = message.model and safety_filter.version
        yield request_of(message, safety_filter.robot)
