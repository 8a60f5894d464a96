"""PROCESS: publishes the steps of logs as actors would, each at the pace that the learner allows.

The replay buffer is thus rebuilt from MCAP: offline, with no robot at all, or before live actors go on. Steps that the
learner took in before an interruption are not published again: a log's actor, like a live one that comes back, goes on
with the episode that the learner names.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from brakeline.actors.learner_client import LearnerClient
from brakeline.learner.step_ledger import StepLedger
from brakeline.learner.transition_reader import BadStep, StepReader
from brakeline.logs.reader import by_run, find, open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Publisher
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import LOGGED

log = logging.getLogger("brakeline.feeder")

LAST_UPDATES = 10.0  # s that the learner may take for the updates that are due after the last step


@dataclass(frozen=True)
class FeederSettings:
    bus: BusSettings
    logs: tuple[str, ...]  # files or folders
    robot: str = "ground"
    name: str = "feeder"
    alone: bool = False  # no robot goes on after the logs


@dataclass
class Steps:
    """The steps of a robot kind in logs that a learner can take in, each once, in the order in which they came.

    Actors of different runs are told apart: of the first they keep their names, of the n-th theirs end in `.run<n>`.
    `counts` tells, once iterated: `taken`, `duplicate`, and `unusable` (sizes or values that nobody can learn from).
    """

    logs: Sequence[str]
    robot: RobotWithTask
    counts: Counter[str] = field(default_factory=Counter)

    def __iter__(self) -> Iterator[pb.Step]:
        intake = StepReader(self.robot)
        for number, files in enumerate(by_run(find(self.logs)).values(), 1):
            seen = StepLedger()
            for record in open_log(files):
                if record.topic != "step" or record.message.robot != self.robot.name:
                    continue
                step: pb.Step = record.message
                try:
                    intake.move(step)
                except BadStep:
                    self.counts["unusable"] += 1
                    continue
                if not seen.record(step.actor, step.episode, step.step, step.index):
                    self.counts["duplicate"] += 1
                    continue
                self.counts["taken"] += 1
                if number > 1:
                    step.actor = f"{step.actor}.run{number}"
                yield step


def count(logs: Sequence[str], robot: RobotWithTask) -> int:
    """How many steps of a robot kind a learner can take from these logs.

    Raises:
        NoLog, NotALog: there is none; ValueError: there are none of this robot.
    """
    total = sum(1 for _ in Steps(logs, robot))
    if not total:
        raise ValueError(f"no steps of {robot.name} in {', '.join(map(str, logs))}: was it recorded?")
    return total


@dataclass
class LearnedPolicy:
    """A logged actor's link to the learner, and its publisher."""

    student: LearnerClient
    steps: Publisher
    begin: int  # the episode to go on with
    index: int = 0


def feed(process: Process, settings: FeederSettings) -> bool:
    """Publish until the logs' end or the run's (True), or until told to stop.

    Health figures: `published` steps, and those that were `known` to the learner, `duplicate` or `unusable`.

    Raises:
        RefusedByLearner, NoLog, NotALog: as they say.
    """
    robot, stop = robot_with_task(settings.robot), process.stop.is_set
    steps, pupils, figures = Steps(settings.logs, robot), dict[str, LearnedPolicy](), Counter[str]()

    def refresh() -> None:
        process.figures.update({name: float(figures[name]) for name in ("published", "known")})
        process.figures.update({name: float(steps.counts[name]) for name in ("duplicate", "unusable")})

    process.refresh = refresh
    process.announce()
    for step in steps:
        if step.actor not in pupils:
            student = LearnerClient(process.bus, robot, step.actor)
            begin = student.join(0, step.episode, stop)
            if begin is None:
                return False
            publisher = process.bus.publisher(LOGGED, robot=robot.name, source=step.actor)
            # A learner that knows nothing of this actor lets it begin where the log does.
            pupils[step.actor] = LearnedPolicy(student, publisher, begin)
        pupil = pupils[step.actor]
        if step.episode < pupil.begin:
            figures["known"] += 1
            continue
        if not pupil.student.wait(pupil.index + 1, step.episode, stop):
            break
        pupil.index += 1
        _readdress(step, pupil)
        pupil.steps.put(step)
        figures["published"] += 1
    log.info("published %d logged steps; the learner knew %d", figures["published"], figures["known"])
    if settings.alone:
        _await_the_end(pupils, stop)
    return not stop()


def _readdress(step: pb.Step, pupil: LearnedPolicy) -> None:
    """The number among this actor's steps, and the weights' version, are the present learner's to count."""
    moment = step.header.time
    step.ClearField("header")
    step.header.time = moment
    step.index = pupil.index
    step.weights_version = 0 if pupil.student.policy is None else pupil.student.policy.version


def _await_the_end(pupils: dict[str, LearnedPolicy], stop: Callable[[], bool]) -> None:
    """Leave the learner the time to make its last updates."""
    deadline = time.monotonic() + LAST_UPDATES
    while time.monotonic() < deadline and not stop() and not any(p.student.done for p in pupils.values()):
        time.sleep(0.05)


def main(settings: FeederSettings) -> bool:
    """The feeder's process; True: its work is done."""
    with Process(settings.bus, settings.name) as process:
        return feed(process, settings)
