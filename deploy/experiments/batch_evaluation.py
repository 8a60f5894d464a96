"""Evaluate a network on many simulated robots at once.

The episodes are those of an evaluation one by one: the same arenas, noise and starts. Decisions are those of the batch
filter, which agree with single ones to within 1e-6 of an input, so long episodes may end a period earlier or later. A
decision has no time of its own; its time is the batch's, divided by its robots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from brakeline.actors.episode_runner import EPISODE_STRIDE
from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.policy_loading import network_named
from brakeline.errors import NoBatch
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_config import DDPC
from brakeline.safety.model.model_set import ModelSet

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Evaluation

MOST_ROBOTS = 128
TURNS = 8  # episodes of each robot: while the last ones end, the others drive for nothing
ONE_BY_ONE = "evaluate without --backend batch"


def drive_batch(
    robot: RobotWithTask, what: Evaluation, first: int, episodes: int, take: Callable[[pb.Step], object]
) -> None:
    """Drive episodes `first`, `first + 1`, …; whichever robot is free begins the next one.

    A robot that finds no episode left drives one that does not count, until all others have ended.

    Args:
        take: called with each step of these episodes. The steps of a robot (`step.actor`) come in order.

    Raises:
        NoBatch: this robot, policy, method, arena or fleet can only be evaluated one by one.
        TooLoose: see `in_process`.
    """
    from brakeline.deploy.experiments.evaluate import FRESH

    safety, policy = batch_filter(robot, what), network_named(what.policy, robot, what.seed)
    numbers = iter(range(first, 2**31))

    def next_episode(_: int) -> tuple[int, int]:
        number = next(numbers)
        return number, number * EPISODE_STRIDE

    robots = BatchRobots(
        robot,
        [f"evaluate.{i}" for i in range(min(-(-episodes // TURNS), MOST_ROBOTS))],
        safety,
        next_episode,
        arena=what.arena,
        seed_key=FRESH + what.seed,
        accept_bound=what.accept_bound,
        conditions=what.conditions,
    )
    ended = 0
    try:
        while ended < episodes:
            robots.begin_period(policy.of_many(robots.observations))
            for step in robots.end_period()[0]:
                if step.episode < first + episodes:
                    take(step)
                    ended += step.terminated or step.truncated
    finally:
        robots.close()


def batch_filter(robot: RobotWithTask, what: Evaluation) -> Filter | None:
    """Return the filter, or None for the method `none`. Raises NoBatch if no batch decides by this method."""
    if what.fleet:
        raise NoBatch(f"robots of a fleet see each other, which no batch simulates: {ONE_BY_ONE}")
    if what.policy in robot.task.policies or what.policy.endswith(".csv"):
        raise NoBatch(f"a batch is driven by a network, not by {what.policy}: {ONE_BY_ONE}")
    if what.method == "none":
        return None
    model = method_for(robot, what.method, what.model_config, what.accept_bound)
    if what.method != DDPC or not isinstance(model, ModelSet):
        raise NoBatch(f"a batch filters by {DDPC}, not by {what.method}: {ONE_BY_ONE}")
    return Filter(model)
