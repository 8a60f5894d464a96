"""Train or evaluate a policy in one process, so that `compare` is reproducible bit by bit.

The parts are those of a launched run (episode runner, core of the safety service, learner, one buffer). They are called
in turn instead of over the bus, so that only measured times depend on timing. Steps and episodes go to an MCAP log of
the same schema, without observations.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import add
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
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
CONTACTS = ("contact_moving", "contact_standing")
INTERVENTIONS = (pb.FAILSAFE, pb.ADJUSTED, pb.RECOVERING)


@dataclass(frozen=True)
class Column:
    """A column of an `EpisodeTable`: the value of each step, how an episode combines them, and its type in JSON."""

    value: Callable[[pb.Step], float]
    combine: Callable[[float, float], float] = add
    count: bool = False
    start: float = 0  # before the first step


COLUMNS = {
    "steps": Column(lambda step: 1, count=True),
    "goal": Column(lambda step: step.goal, count=True),
    "collision": Column(lambda step: step.collision, max, count=True),
    "timeout": Column(lambda step: step.truncated and not step.terminated and not step.cut, count=True),
    "reward": Column(lambda step: step.reward),  # without penalties
    "speed": Column(lambda step: step.speed),  # m/s, summed over steps
    "fastest": Column(lambda step: step.speed, max),
    "interventions": Column(lambda step: step.fallback or step.decision in INTERVENTIONS, count=True),
    "milliseconds": Column(lambda step: step.propose_ms + step.decide_ms),  # of policy and method
    "contact_moving": Column(lambda step: step.contact_moving, count=True),
    "contact_standing": Column(lambda step: step.contact_standing, count=True),
}


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

    def put_exchange(self, exchange: pb.Exchange) -> None:
        """Add a request with its reply."""
        self._put(EXCHANGE, exchange, exchange.request.robot, exchange.request.actor)

    def put(self, topic: Topic, message: pb.Step | pb.Episode) -> None:
        """Add a message, and number it."""
        self._put(topic, message, message.robot, message.actor)

    def _put(self, topic: Topic, message: pb.Step | pb.Episode | pb.Exchange, robot: str, actor: str) -> None:
        key = topic.at(robot=robot, source=actor)
        self._count[key] = number = self._count.get(key, 0) + 1
        header, now = message.header, steady_time_ns()
        header.sequence, header.source, header.run, header.wall_time = number, actor, RUN, now
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


@dataclass
class EpisodeTable:
    """One row per finished episode with the values of its columns, and statistics of the decision times.

    Steps of several actors may alternate.

    Attributes:
        rows: in the order in which the episodes ended.
        spans: for each row, the number of steps, of all actors, before its first step and after its last one.
    """

    which: Mapping[str, Column] = field(default_factory=lambda: COLUMNS)
    rows: list[dict[str, float]] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)
    decisions: int = 0
    milliseconds: float = 0.0
    squares: float = 0.0  # ms²
    _running: dict[str, tuple[int, dict[str, float]]] = field(default_factory=dict)  # by actor: begin, row

    def step(self, step: pb.Step) -> None:
        """Add the next step of an actor."""
        if step.actor not in self._running:
            self._running[step.actor] = self.decisions, {name: column.start for name, column in self.which.items()}
        begin, row = self._running[step.actor]
        for name, column in self.which.items():
            row[name] = column.combine(row[name], column.value(step))
        spent = COLUMNS["milliseconds"].value(step)
        self.decisions += 1
        self.milliseconds += spent
        self.squares += spent * spent
        if step.terminated or step.truncated:
            del self._running[step.actor]
            self.rows.append(row)
            self.spans.append((begin, self.decisions))

    def pop(self) -> dict[str, float]:
        """Remove the row of the episode that ended last, and return it."""
        self.spans.pop()
        return self.rows.pop()

    def columns(self) -> dict[str, list[float]]:
        """Return the columns in the order in which the episodes began, rounded to four digits; counts are integers."""
        rows = [self.rows[i] for i in self._order()]
        return {
            name: [int(row[name]) if column.count else round(float(row[name]), 4) for row in rows]
            for name, column in self.which.items()
        }

    def span_columns(self) -> dict[str, list[int]]:
        """Return the columns `begin` and `end` of `spans`, in the order of `columns`."""
        spans = [self.spans[i] for i in self._order()]
        return {"begin": [begin for begin, _ in spans], "end": [end for _, end in spans]}

    def _order(self) -> list[int]:
        return sorted(range(len(self.rows)), key=self.spans.__getitem__)

    def decision_ms(self) -> dict[str, float]:
        """Return the mean and the standard deviation of the decision times [ms]."""
        mean = self.milliseconds / max(self.decisions, 1)
        return {"mean": mean, "std": max(self.squares / max(self.decisions, 1) - mean * mean, 0.0) ** 0.5}


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
        requests.put_exchange(outcome.exchange(float(driver.info["time"])))
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


def train_in_lockstep(
    driver: EpisodeRunner,
    ask: Ask | None,
    learner: Learner,
    take: Callable[[pb.Step], object],
    begin: Callable[[pb.Episode], object],
) -> MLP:
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
