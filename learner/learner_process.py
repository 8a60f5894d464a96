"""PROCESS: the learner of one kind of robot on the bus, a loop around `Learner`.

The threads of the bus only fill queues. Only the loop uses the learner, so that the result depends on nothing but the
order of the messages.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

from brakeline.errors import BadStep, CheckpointError
from brakeline.learner.checkpoint import CHECKPOINT, NOT_SAVED, exists
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig
from brakeline.learner.learner_output import LearnerOutput
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.task import robot_with_task
from brakeline.messaging.topics import FLOW, JOIN, LOGGED, STEP, WEIGHTS

log = logging.getLogger("brakeline.learner")

UPDATES_A_TURN = 4  # take about 20 ms, the longest that a joining actor or a step in lockstep waits
FLOW_SPACING = 0.02  # least time between two flows [s]; in lockstep every change is published
FLOW_PERIOD = 0.5  # longest time between two flows [s]
IDLE = 0.1  # longest wait for steps and joins, if no flow is due before [s]
JOIN_PATIENCE = 10.0  # longest time to answer a join, with the time of a checkpoint [s]
LINGER = 1.0  # time for which the process announces the end of the run [s]


@dataclass(frozen=True)
class LearnerSettings:
    """Settings of the process."""

    bus: BusSettings
    robot: str = "ground"
    out: Path = Path("runs/learner")
    resume: bool = False  # True: continue from the checkpoint in `out`, which must exist
    source: str = "learner"
    learner: LearnerConfig = field(default_factory=LearnerConfig)


def main(settings: LearnerSettings) -> bool:
    """Learn as `learn` does, for a launcher that reads in the Health messages that a policy was not saved.

    Returns:
        Whether the run is complete.

    Raises:
        CheckpointError, Diverged, UnknownRobot, Unreachable: as `learn`.
    """
    return learn(settings)[0]


def learn(settings: LearnerSettings) -> tuple[bool, str]:
    """Learn until the last step of the run, SIGINT or SIGTERM. Write a checkpoint and a policy file at the end.

    Returns:
        Whether the run is complete, and why the policy was not saved; empty if it was.

    Raises:
        CheckpointError: the run cannot be resumed, or `out` holds a checkpoint and `resume` is False.
        Diverged: the weights are no longer finite; the last checkpoint and policy stay.
        UnknownRobot: there is no such robot.
        Unreachable: no router answers.
    """
    robot = robot_with_task(settings.robot)
    with Process(settings.bus, settings.source) as process:
        root = settings.out / CHECKPOINT
        if exists(root) and not settings.resume:
            raise CheckpointError(f"{root}: holds a checkpoint already; resume it, or choose another folder")
        learner = Learner(robot, settings.learner, incarnation=process.bus.run)
        if settings.resume:
            learner.restore(root)
            log.info("resumed at step %d, update %d", learner.steps, learner.updates)
        loop = LearnerLoop(process, learner, settings)
        process.announce()
        loop.run()
        return learner.done, process.notes.get(NOT_SAVED, "")


class LearnerLoop:
    """Take steps and joins from the queues, let the learner work, and publish its weights, flow and metrics."""

    def __init__(self, process: Process, learner: Learner, settings: LearnerSettings) -> None:
        self._process, self._learner, self._settings = process, learner, settings
        self._steps = Inbox()
        self._joins: deque[tuple[bytes, str, Future[bytes]]] = deque()
        self._wake = Event()
        self._last_flow = pb.Flow()  # without the header, which `put` fills in
        self._flow_at = -1e9
        self._flow_waits = False  # a flow that actors need waits for its time
        self.output = LearnerOutput(process, learner, settings.out)
        bus, robot = process.bus, learner.robot.name
        self._weights, self._flow = bus.publisher(WEIGHTS, robot=robot), bus.publisher(FLOW, robot=robot)
        self._weights.put(learner.weights())
        for topic in (STEP, LOGGED):
            bus.subscribe(topic, self._receive, robot=robot)
        bus.serve(JOIN, self._answer, robot=robot)

    # In the threads of the bus:

    def _receive(self, sample: Sample) -> None:
        self._steps.put(sample)
        self._wake.set()

    def _answer(self, payload: bytes, asker: str) -> bytes:
        answer: Future[bytes] = Future()
        self._joins.append((payload, asker, answer))
        self._wake.set()
        return answer.result(JOIN_PATIENCE)

    # In the thread of the loop:

    def run(self) -> None:
        """Run until the process stops, or for `LINGER` seconds after the end of the run."""
        end: float | None = None
        while not self._process.stop.is_set():
            if not self.turn():
                self._wake.wait(FLOW_SPACING if self._flow_waits else IDLE)
            self._wake.clear()
            if self._learner.done and not self._learner.weights_due():
                end = end or time.monotonic() + LINGER
                if time.monotonic() > end:
                    break
        self._finish()

    def turn(self) -> bool:
        """Make one pass. Return whether there was anything to do."""
        busy = self._take_joins() + self._take_steps() + self._learner.work(UPDATES_A_TURN) > 0
        if self._learner.weights_due():
            self._weights.put(self._learner.publish())
        self.output.save_if_due()
        self._publish_flow()
        self.output.publish_if_due(len(self._steps))
        return busy

    def _take_joins(self) -> int:
        taken = 0
        while self._joins:
            payload, asker, answer = self._joins.popleft()
            taken += 1
            try:
                join = pb.Join.FromString(payload)
                reply = self._learner.join(join, asker)
                outcome = f"refused: {reply.error.message}" if reply.HasField("error") else "accepted"
                log.info("actor %s: %s", headline(join.actor), outcome)
                answer.set_result(reply.SerializeToString())
                self.output.hurry()  # tell the new limits before the actor's first steps
            except Exception as error:  # the bus sends it to the actor
                answer.set_exception(error)
        return taken

    def _take_steps(self, seconds: float = FLOW_SPACING) -> int:
        taken = 0
        for sample in self._steps.drain(seconds):
            taken += 1
            with self._process.bus.rejected.skip_on_error(sample.key):
                step = sample.message()
                if names_of(sample.topic, sample.key)["source"] != step.actor:
                    raise BadStep("actor", f"{step.actor!r} published at {sample.key}")
                self._learner.insert(step, logged=sample.topic is LOGGED)
        return taken

    def _publish_flow(self) -> None:
        """Publish the flow if it is old, or if actors need it: each message costs every process some time."""
        flow, last, age = self._learner.flow(), self._last_flow, time.monotonic() - self._flow_at
        if self._settings.learner.lockstep:
            due = flow != last
        else:
            changed = (flow.warmup, flow.done) != (last.warmup, last.done) or self._learner.flow_due(last.limit)
            due, self._flow_waits = changed and age >= FLOW_SPACING, changed and age < FLOW_SPACING
        if due or age > FLOW_PERIOD:
            self._last_flow.CopyFrom(flow)
            self._flow_at = time.monotonic()
            self._flow.put(flow)

    def _finish(self) -> None:
        """Learn from the steps that arrived, as far as updates are due, and save the result."""
        self._take_joins()
        self._take_steps(LINGER)
        if self._settings.learner.lockstep:
            while self._learner.work(UPDATES_A_TURN):
                pass
        if self._learner.weights_due():
            self._weights.put(self._learner.publish())
        if self._learner.may_save():
            self.output.save()
        else:
            log.warning("stopped within an episode: in lockstep, the latest checkpoint is from before the episode")
            self.output.write_policy()
        self.output.publish(len(self._steps))
