"""Measure the stages of a step in one thread: of the actor, the service, the recorder, the learner and the display.

Every stage works on what the stage before made, with the bytes that cross the bus in between, but without the bus. So
the stages show what the code costs, and the difference to a process of a run is the cost of the bus.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import thread_time_ns, time_ns
from typing import Any, ParamSpec, TypeVar

import numpy as np
from google.protobuf.message import Message

from brakeline.actors.decision_guard import DecisionOutcome, request_decisions
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.run.log_contents import derive_entries
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.vehicle_factory import environment
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.metrics import Metrics
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, EXCHANGE, STEP, Topic
from brakeline.safety.methods import Method
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.plan_token import KEY_SIZE, PlanAuthenticator
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts

STEPS = 800
FLUSH = 100  # messages that the recorder writes at once
PERMITTED = 10**9
P = ParamSpec("P")
T = TypeVar("T")


class Stopwatch:
    """Sums the processor time of stages; a stage within a stage counts for the inner one only."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()  # ns
        self._running: list[str] = []
        self._mark = 0

    def timed(self, stage: str, call: Callable[P, T]) -> Callable[P, T]:
        def timed(*args: P.args, **kwargs: P.kwargs) -> T:
            self._switch()
            self._running.append(stage)
            try:
                return call(*args, **kwargs)
            finally:
                self._switch()
                self._running.pop()

        return timed

    def _switch(self) -> None:
        now = thread_time_ns()
        if self._running:
            self.spent[self._running[-1]] += now - self._mark
        self._mark = now


class _TimedMethod:
    """A method whose decisions are timed."""

    def __init__(self, method: Method, watch: Stopwatch) -> None:
        self.robot, self.version = method.robot, method.version
        self.decide = watch.timed("service: decide", method.decide)


class _TimedTokens(PlanAuthenticator):
    """Plan tokens that are timed."""

    def __init__(self, watch: Stopwatch) -> None:
        super().__init__(bytes(KEY_SIZE))
        for name in ("plan_tokens", "is_authentic"):
            setattr(self, name, watch.timed("service: plan tokens", getattr(self, name)))


def _service(robot: RobotWithTask, watch: Stopwatch) -> Callable[[Sequence[pb.Request]], list[pb.Reply]]:
    """Return a question to a service in this thread, with the bytes of a bus."""
    models: Any = ModelRegistry()
    models.install(ModelSet.load(robot.name))
    models.filters[robot.name] = _TimedMethod(models.filters[robot.name], watch)
    handler = watch.timed("service: read, reply", BatchHandler(models, ServiceCounts(), _TimedTokens(watch)).__call__)
    return lambda requests: list(
        pb.ReplyBatch.FromString(handler(pb.RequestBatch(requests=requests).SerializeToString())).replies
    )


class _Actor:
    """An actor without a bus: `samples` are the messages that it would publish."""

    def __init__(self, robot: RobotWithTask, watch: Stopwatch) -> None:
        self.samples: list[Sample] = []
        env: Any = environment(robot, "default", 0)
        env._observe = watch.timed("actor: observe", env._observe)
        env.step = watch.timed("actor: simulate", env.step)
        self._runner, self._watch = EpisodeRunner(robot, env, ActorIdentity("actor-0", 0, 0)), watch
        self._ask, self._policy = _service(robot, watch), policy_named("trained", robot, 0)

    def drive(self, steps: int) -> None:
        """Drive whole episodes of at least so many steps in all."""
        step, runner, watch = self._runner.index, self._runner, self._watch
        for episode in range(steps):
            self._publish(EPISODE, runner.begin(episode))
            while runner.running:
                proposal = watch.timed("actor: propose", self._policy)(runner.observation, runner.info)
                outcome = watch.timed("actor: ask, read the reply", self._decide)(np.asarray(proposal, float))
                watch.timed("actor: step, log", self._execute)(np.asarray(proposal, float), outcome)
            if runner.index - step >= steps:
                return

    def _decide(self, proposal: np.ndarray) -> DecisionOutcome:
        return request_decisions(self._ask, [self._runner.request(proposal)], self._runner.robot)[0]

    def _execute(self, proposal: np.ndarray, outcome: DecisionOutcome) -> None:
        step = self._runner.execute(proposal, outcome)
        self._publish(EXCHANGE, outcome.exchange(step.header.time))
        self._publish(STEP, step)

    def _publish(self, topic: Topic, message: Message) -> None:
        key = topic.at(robot=self._runner.robot.name, source="actor-0")
        header: pb.Header = message.header  # type: ignore[attr-defined]
        header.sequence, header.source = len(self.samples) + 1, "actor-0"
        self.samples.append(Sample(topic, key, message.SerializeToString(), time_ns()))


def stages(robot: RobotWithTask) -> dict[str, float]:
    """Return the processor time of each stage of a step [µs], with the trained policy."""
    watch = Stopwatch()
    actor = _Actor(robot, watch)
    actor.drive(100)
    watch.spent.clear()
    actor.samples.clear()
    actor.drive(STEPS)
    samples = actor.samples
    steps = [sample for sample in samples if sample.topic is STEP]
    with tempfile.TemporaryDirectory(prefix="stages") as folder:
        inbox, robots = Inbox(), RecordedRobots([robot])
        settings = LogSettings(Path(folder) / "run.mcap", derive=derive_entries(RunConfig.pictures, robots))
        recording = Recording(settings, inbox)

        def record() -> None:
            for begin in range(0, len(samples), FLUSH):
                for sample in samples[begin : begin + FLUSH]:
                    inbox.put(sample)
                recording.save()

        watch.timed("recorder: decode, draw, store", record)()
        recording.finish()
    learner = Learner(robot, LearnerConfig(steps=PERMITTED, window=PERMITTED))
    learner.join(pb.Join(robot=robot.name, actor="actor-0", layout=robot.learning_layout()))
    learner.flow()
    metrics = Metrics(robots=robots)
    insert = watch.timed("learner: decode, insert", lambda sample: learner.insert(sample.message()))
    count = watch.timed("display: decode, count", lambda sample: metrics.add(sample.key, sample.message(), 0))
    for sample in samples:  # a new sample is not decoded yet
        count(replace(sample))
        if sample.topic is STEP:
            insert(replace(sample))
    return {stage: spent * 1e-3 / len(steps) for stage, spent in sorted(watch.spent.items())}
