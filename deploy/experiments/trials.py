"""Train or evaluate a policy in one process, so that `compare` is reproducible bit by bit.

The parts are those of a launched run (episode runner, core of the safety service, learner, one buffer). They are called
in turn instead of over the bus, so that only measured times depend on timing. Steps and episodes go to an MCAP log of
the same schema, without observations.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import EpisodeRunner
from brakeline.learner.learner import Learner
from brakeline.logs.segment import Entry, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.topics import EPISODE, STEP, Topic
from brakeline.sim.scripted_policies import Policy, scripted

FLUSH = 2000  # messages per write
RUN = 1  # run number: a launched process has a random one
CONTACTS = ("contact_moving", "contact_standing")
COLUMNS = (
    *("steps", "goal", "collision", "timeout", "reward", "speed", "fastest", "interventions", "milliseconds"),
    *CONTACTS,
)


class TrialLog:
    """Writes steps and episodes to an MCAP file as the recorder does. An existing file is replaced."""

    def __init__(self, path: Path, metadata: dict[str, dict[str, str]]) -> None:
        path.unlink(missing_ok=True)
        self.path = path
        self._segment = open_segment(path, metadata)
        self._waiting: list[Entry] = []
        self._count: dict[str, int] = {}

    def put(self, topic: Topic, message: pb.Step | pb.Episode) -> None:
        key = topic.at(robot=message.robot, source=message.actor)
        self._count[key] = number = self._count.get(key, 0) + 1
        header, now = message.header, time.time_ns()
        header.sequence, header.source, header.run, header.wall_time = number, message.actor, RUN, now
        self._waiting.append(
            Entry(key, type(message), message.SerializeToString(), now, int(header.time * 1e9) or now, number)
        )
        if len(self._waiting) >= FLUSH:
            self._save()

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
    """One row per finished episode, and statistics of the decision times.

    steps; goal, collision, timeout (0 or 1); reward without penalties; speed [m/s] summed over steps, and the highest;
    interventions; milliseconds of policy and method, summed over steps; contact with what moves, moving and standing.
    """

    rows: list[tuple[float, ...]] = field(default_factory=list)
    decisions: int = 0
    milliseconds: float = 0.0
    squares: float = 0.0  # ms²
    _running: list[float] = field(default_factory=lambda: [0.0] * len(COLUMNS))

    def step(self, step: pb.Step) -> None:
        """Add the next step."""
        row, spent = self._running, step.propose_ms + step.decide_ms
        failsafe = step.fallback or step.decision == pb.FAILSAFE
        row[0] += 1
        row[1] += step.goal
        row[2] = max(row[2], float(step.collision))
        row[3] += step.truncated and not step.terminated and not step.cut
        row[4] += step.reward
        row[5] += step.speed
        row[6] = max(row[6], step.speed)
        row[7] += failsafe or step.decision in (pb.ADJUSTED, pb.RECOVERING)
        row[8] += spent
        row[9] += step.contact_moving
        row[10] += step.contact_standing
        self.decisions += 1
        self.milliseconds += spent
        self.squares += spent * spent
        if step.terminated or step.truncated:
            self.rows.append(tuple(row))
            self._running = [0.0] * len(COLUMNS)

    def columns(self) -> dict[str, list[float]]:
        """Return the columns, rounded to four digits; counts are integers."""
        table = np.array(self.rows).reshape(-1, len(COLUMNS)).T
        whole = {"steps", "goal", "collision", "timeout", "interventions", *CONTACTS}
        return {
            name: [int(v) for v in values] if name in whole else [round(float(v), 4) for v in values]
            for name, values in zip(COLUMNS, table, strict=True)
        }

    def decision_ms(self) -> dict[str, float]:
        mean = self.milliseconds / max(self.decisions, 1)
        return {"mean": mean, "std": max(self.squares / max(self.decisions, 1) - mean * mean, 0.0) ** 0.5}


@dataclass(frozen=True)
class Proposal:
    """An action (m,) and the time that the policy needed, in ms."""

    action: NDArray[np.float64]
    ms: float


Propose = Callable[[EpisodeRunner], Proposal]


def timed_policy(policy: Policy) -> Propose:
    """Wrap a policy so that it measures its own time."""

    def propose(driver: EpisodeRunner) -> Proposal:
        before = time.perf_counter_ns()
        action = np.asarray(policy(driver.observation, driver.info), dtype=float)
        return Proposal(action, (time.perf_counter_ns() - before) * 1e-6)

    return propose


def take_step(driver: EpisodeRunner, propose: Propose, question: Ask | None, version: int = 0) -> pb.Step:
    """Take one step: propose an action, request a decision, execute it."""
    proposal = propose(driver)
    outcome = driver.decide(proposal.action, question)
    if outcome is not None and outcome.answer is None:
        raise RuntimeError(f"no decision: {outcome.failure}")  # in one process this is a defect, never the network
    step = driver.execute(proposal.action, outcome, version)
    step.propose_ms = proposal.ms
    return step


def without_observations(step: pb.Step) -> pb.Step:
    """Return a copy of a step without observations and path."""
    copy = pb.Step()
    copy.CopyFrom(step)
    for name in ("observation", "next_observation", "path"):
        copy.ClearField(name)
    return copy


def evaluate(
    driver: EpisodeRunner, policy: Policy, question: Ask | None, episodes: int, log: TrialLog | None = None
) -> EpisodeTable:
    """Run the policy without exploration through episodes 0 to `episodes` − 1 of the environment."""
    found, propose = EpisodeTable(), timed_policy(policy)
    for number in range(episodes):
        message = driver.begin(number)
        if log is not None:
            log.put(EPISODE, message)
        while driver.running:
            step = take_step(driver, propose, question)
            found.step(step)
            if log is not None:
                log.put(STEP, without_observations(step))
    return found


class Trainer:
    """One episode runner and one learner in lockstep: the learner makes all due updates before the next step."""

    def __init__(self, driver: EpisodeRunner, question: Ask | None, learner: Learner) -> None:
        self.driver, self.question, self.learner = driver, question, learner
        robot = driver.robot
        reply = learner.join(pb.Join(robot=robot.name, actor=driver.identity.actor, layout=robot.learning_layout()))
        self.policy: MLP = decode(reply.weights.file, robot)

    def run(self, log: TrialLog | None = None) -> Iterator[pb.Step]:
        """Yield the steps of the whole training."""
        episode = 0
        while not self.learner.done:
            if not self.driver.running:
                message = self.driver.begin(episode)
                episode += 1
                self._random = scripted("random", self.driver.robot, self.driver.rng)
                if log is not None:
                    log.put(EPISODE, message)
            step = take_step(self.driver, timed_policy(self._explore), self.question, self.policy.version)
            self.learner.insert(step)
            self.learner.work(1 << 30)
            if self.learner.weights_due():
                self.policy = decode(self.learner.publish().file, self.driver.robot)
            if log is not None:
                log.put(STEP, without_observations(step))
            yield step

    def _explore(self, observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float64]:
        if self.learner.warming_up:
            return np.asarray(self._random(observation, info))
        return self.policy.explore(observation, self.driver.rng)
