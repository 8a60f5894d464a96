"""Evaluate a network on many simulated robots at once.

The episodes have the same arenas, noise and starts as in an evaluation one by one. The inputs that the batch filter
decides on differ by at most 1e-6 from those of the filter for one robot, so a long episode may end a period earlier or
later. The time of a decision is the time of the batch, divided by the number of its robots.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from brakeline.actors.episode_runner import EPISODE_STRIDE
from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.policy_loading import network_named
from brakeline.errors import NoBatch
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.task_code import is_own_code
from brakeline.safety.filter.batch.row_by_row import BatchMethod, RowByRow
from brakeline.safety.filter.filter import Filter
from brakeline.safety.methods import Model, ready

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Evaluation

MOST_ROBOTS = 128
TURNS = 8  # episodes of each robot: with fewer, more robots drive for nothing while the last ones end
ONE_BY_ONE = "evaluate without --backend batch"


def drive_batch(
    robot: RobotWithTask,
    evaluation: Evaluation,
    first: int,
    episodes: int,
    take: Callable[[pb.Step], object],
    independent: bool = False,
) -> None:
    """Drive the episodes of an evaluation: see `drive_episodes`.

    independent: each episode begins without a widening. Otherwise, a robot's widening goes on in its next episode.

    Raises:
        NoBatch: this robot, policy, method, arena or fleet can only be evaluated one by one.
        TooLoose: see `in_process`.
    """
    from brakeline.deploy.experiments.evaluate import FRESH

    safety, policy = batch_filter(robot, evaluation), network_named(evaluation.policy, robot, evaluation.seed)
    drive_episodes(
        *(robot, safety, policy, evaluation.arena, FRESH + evaluation.seed, range(first, first + episodes), take),
        accept_bound=evaluation.accept_bound,
        conditions=evaluation.conditions,
        independent=independent,
    )


def drive_episodes(
    robot: RobotWithTask,
    safety: BatchMethod | None,
    policy: MLP,
    arena: str,
    seed_key: int,
    numbers: range,
    take: Callable[[pb.Step], object],
    begin: Callable[[pb.Episode], object] = lambda message: None,
    **others: Any,
) -> None:
    """Drive the episodes with these numbers: a robot whose episode has ended begins the next one.

    A robot that finds no episode left drives one that does not count, until all others have ended.

    Args:
        take: called with each step of these episodes. The steps of a robot (`step.actor`) come in order.
        begin: called with the description of each of these episodes, before its first step.
        others: accept_bound, conditions, independent: see `BatchRobots`.

    Raises:
        NoBatch, TooLoose: see `BatchRobots`.
    """
    upcoming, episodes = itertools.count(numbers.start), len(numbers)

    def next_episode(_: int) -> tuple[int, int]:
        number = next(upcoming)
        return number, number * EPISODE_STRIDE

    names = [f"evaluate.{i}" for i in range(min(-(-episodes // TURNS), MOST_ROBOTS))]
    robots = BatchRobots(robot, names, safety, next_episode, arena=arena, seed_key=seed_key, **others)
    ended, begun = 0, list(range(len(names)))
    try:
        while ended < episodes:
            for message in map(robots.episode_message, begun):
                if message.episode in numbers:
                    begin(message)
            robots.begin_period(policy.of_many(robots.observations))
            steps, begun = robots.end_period()
            for step in steps:
                if step.episode in numbers:
                    take(step)
                    ended += step.terminated or step.truncated
    finally:
        robots.close()


def batch_filter(robot: RobotWithTask, evaluation: Evaluation) -> BatchMethod | None:
    """Return the filter or rival; None for the method `none`. Raises NoBatch: no batch has this policy or fleet."""
    if evaluation.fleet:
        raise NoBatch(f"robots of a fleet see each other, which no batch simulates: {ONE_BY_ONE}")
    name = evaluation.policy
    if name in robot.task.policies or name.endswith(".csv") or is_own_code(name):
        raise NoBatch(f"a batch is driven by a network, not by {name}: {ONE_BY_ONE}")
    if evaluation.method == "none":
        return None
    return batch_method(method_for(robot, evaluation.method, evaluation.model_config, evaluation.accept_bound))


def batch_method(model: Model) -> BatchMethod:
    """Return the filter of a model set, or a rival that decides row by row."""
    method = ready(model)
    return method if isinstance(method, Filter) else RowByRow(method)
