"""Train or evaluate a policy in one process, so that `compare` is reproducible bit by bit.

The parts are those of a launched run (episode runner, core of the safety service, learner, one buffer). They are called
in turn instead of over the bus, so that only measured times depend on timing. Steps and episodes go to an MCAP log of
the same schema, without observations.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.experiments.episode_table import EpisodeTable
from brakeline.deploy.experiments.evaluate import FRESH
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.learner.learner import Learner
from brakeline.logs.segment import Entry, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.steady_clock import steady_time_ns
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, EXCHANGE, STEP, Topic
from brakeline.sim.scripted_policies import Policy, scripted

FLUSH = 2000  # messages per write
RUN = 1  # run number: a launched process has a random one

Take = Callable[[pb.Step], object]
Begin = Callable[[pb.Episode], object]


class TrialLog:
    """Writes steps, episodes and exchanges to an MCAP file as the recorder does. An existing file is replaced."""

    def __init__(
        self, path: Path, metadata: dict[str, dict[str, str]], attachments: dict[str, bytes] | None = None
    ) -> None:
        path.unlink(missing_ok=True)
        self.path = path
        self._segment = open_segment(path, metadata, attachments)
        self._waiting: list[Entry] = []
        self._count: dict[str, int] = {}

    def put(self, topic: Topic, message: pb.Step | pb.Episode | pb.Exchange) -> None:
        """Add a message, and number it."""
        about = message.request if isinstance(message, pb.Exchange) else message
        key = topic.at(robot=about.robot, source=about.actor)
        self._count[key] = number = self._count.get(key, 0) + 1
        header, now = message.header, steady_time_ns()
        header.sequence, header.source, header.run, header.wall_time = number, about.actor, RUN, now
        self._waiting.append(
            Entry(key, type(message), message.SerializeToString(), now, int(header.time * 1e9) or now, number)
        )
        if len(self._waiting) >= FLUSH:
            self._save()

    def put_step(self, step: pb.Step) -> None:
        """Add a copy of a step without observations and path."""
        copy = pb.Step()
        copy.CopyFrom(step)
        for name in ("observation", "next_observation", "path"):
            copy.ClearField(name)
        self.put(STEP, copy)

    def _save(self) -> None:
        self._segment.save(self._waiting)
        self._waiting = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._save()
        self._segment.finish()


def take_step(
    driver: EpisodeRunner, policy: Policy, ask: Ask | None, version: int = 0, requests: TrialLog | None = None
) -> pb.Step:
    """Take one step: propose an action, request a decision, execute it.

    Args:
        requests: log that gets the request with its reply.

    Raises:
        RuntimeError: there is no decision. In one process this is a defect, never the network.
    """
    before = time.perf_counter_ns()
    proposal = driver.slow_down.proposal(np.asarray(policy(driver.observation, driver.info), dtype=float))
    spent_ms = (time.perf_counter_ns() - before) * 1e-6
    outcome = driver.decide(proposal, ask)
    if outcome is not None and outcome.answer is None:
        raise RuntimeError(f"no decision: {outcome.failure}")
    if requests is not None and outcome is not None:
        requests.put(EXCHANGE, outcome.exchange(float(driver.info["time"])))
    step = driver.execute(proposal, outcome, version)
    step.propose_ms = spent_ms
    return step


def run_trial(
    driver: EpisodeRunner, policy: Policy, ask: Ask | None, episodes: int, log: TrialLog | None = None
) -> EpisodeTable:
    """Run the policy without exploration through episodes 0 to `episodes` − 1 of the environment."""
    table = EpisodeTable()
    for number in range(episodes):
        message = driver.begin(number)
        if log is not None:
            log.put(EPISODE, message)
        while driver.running:
            step = take_step(driver, policy, ask)
            table.step(step)
            if log is not None:
                log.put_step(step)
    return table


def fresh_trial(
    robot: RobotWithTask, arena: str, policy: str, ask: Ask | None, episodes: int, seed_key: int = FRESH
) -> EpisodeTable:
    """Run a policy by its name through fresh episodes, which no training has."""
    driver = EpisodeRunner(robot, environment(robot, arena, seed_key), ActorIdentity("trial", 0, 0))
    return run_trial(driver, policy_named(policy, robot, 0), ask, episodes)


def train_in_lockstep(driver: EpisodeRunner, ask: Ask | None, learner: Learner, take: Take, begin: Begin) -> MLP:
    """Train with one robot and one learner, and return the last policy.

    The learner makes all due updates before the next step.

    Args:
        driver: runs the episodes.
        ask: sends the requests to the filter; None for no filter.
        learner: learns from the steps, and ends the training.
        take: called with each step.
        begin: called with the description of each episode.
    """
    robot, episode = driver.robot, 0
    reply = learner.join(pb.Join(robot=robot.name, actor=driver.identity.actor, layout=robot.learning_layout()))
    policy = decode(reply.weights.file, robot)

    def explore(observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float64]:
        return np.asarray(random(observation, info)) if learner.warming_up else policy.explore(observation, driver.rng)

    while not learner.done:
        if not driver.running:
            begin(driver.begin(episode))
            episode, random = episode + 1, scripted("random", robot, driver.rng)
        step = take_step(driver, explore, ask, policy.version)
        learner.insert(step)
        learner.work(1 << 30)
        if learner.weights_due():
            policy = decode(learner.publish().file, robot)
        take(step)
    return policy
