"""`brakeline evaluate`: a policy through the filter, in process, on fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from actors.driver import Driver, Identity
from actors.guard import Ask, consult
from deploy.data.store import method_for
from deploy.policies import policy_named
from deploy.vehicles import environment
from logs.metrics import Tally, closed_loop
from messaging import brakeline_pb2 as pb
from messaging.robots import Robot
from safety.methods import DDPC, Model
from safety.model_set import Recipe
from safety.service import Counts, Models, answerer
from sim.conditions import Conditions
from sim.policies import Policy

FRESH = 1_000_000  # added to the seed: no training run draws its episodes from there


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate."""

    policy: str = "astar"  # a file, or trained | untrained | random | greedy | adversary | astar
    method: str = "ddpc"
    recipe: Recipe = field(default_factory=Recipe)
    arena: str = "default"
    episodes: int = 100
    seed: int = 0
    conditions: Conditions = field(default_factory=Conditions)


def in_process(model: Model) -> Ask:
    """The safety service's own core, called directly: the same bytes, no bus."""
    models = Models()
    models.install(model)
    answer = answerer(models, Counts())

    def ask(requests: Sequence[pb.Request]) -> list[pb.Reply]:
        payload = pb.RequestBatch(requests=requests).SerializeToString()
        return list(pb.ReplyBatch.FromString(answer(payload)).replies)

    return ask


def episode(driver: Driver, policy: Policy, question: Ask | None, number: int) -> Iterator[pb.Step]:
    """The steps of one episode."""
    driver.begin(number)
    while driver.running:
        proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
        outcome = None
        if question is not None:
            outcome = consult(question, [driver.request(proposal)], driver.robot)[0]
        yield driver.execute(proposal, outcome)


def prepared(robot: Robot, what: Evaluation) -> tuple[Driver, Policy, Ask | None]:
    """What an evaluation is made of: the driver in a fresh environment, the policy, and whom it asks."""
    policy = policy_named(what.policy, robot, what.seed)
    env = environment(robot, what.arena, FRESH + what.seed, what.conditions)
    question = None if what.method == "none" else in_process(method_for(robot, what.method, what.recipe))
    driver = Driver(robot, env, Identity("evaluate", 0, what.seed), filtered=question is not None)
    return driver, policy, question


def evaluate(robot: Robot, what: Evaluation, each: Callable[[Tally], Any] = lambda tally: None) -> dict[str, Any]:
    """The shared figures of `what.episodes` episodes; `each` is called after every one."""
    driver, policy, question = prepared(robot, what)
    tally = Tally()
    for number in range(what.episodes):
        for step in episode(driver, policy, question, number):
            tally.step(step)
        each(tally)
    return closed_loop([tally]) | {
        "method": what.method,
        "certificate": what.recipe.certificate if what.method == DDPC else None,
        "mode": what.recipe.mode if what.method == DDPC else None,
        "policy": what.policy,
        "arena": what.arena,
        "seed": what.seed,
        "conditions": what.conditions.describe(),
    }
