"""PROCESS: publish the steps of logs as actors would, at the pace that the learner allows.

The learner thus rebuilds its replay buffer from MCAP: from logs alone, or before robots start. Like an actor that
reconnects, a replayed actor resumes at the episode that the learner names, so the learner gets no step twice.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from brakeline.actors.learner_client import LearnerClient
from brakeline.deploy.data.run_dataset import check_logs
from brakeline.errors import BadStep
from brakeline.learner.step_ledger import StepLedger
from brakeline.learner.transition_reader import StepReader
from brakeline.logs.reader import by_run, find, open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Publisher
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import LOGGED

log = logging.getLogger("brakeline.feeder")

# Observations and actions of steps are shares of these. A word for each.
SCALES = {"action_low": "lower bounds of inputs", "action_high": "upper bounds of inputs"}
LAST_UPDATES_TIMEOUT = 10.0  # s for the updates that the learner makes after the last step


@dataclass(frozen=True)
class FeederSettings:
    """Settings of a feeder process."""

    bus: BusSettings
    logs: tuple[str, ...]  # files or folders
    robot: str = "ground"
    name: str = "feeder"
    alone: bool = False  # no robot learns after the logs


@dataclass
class LoggedSteps:
    """The steps of a robot kind in logs that a learner can use, each once, in the order of the log.

    A copy of a log in the same folder, such as one that `brakeline export --foxglove` wrote, adds nothing.

    The names of actors of the n-th run, from the second on, end in `.run<n>`. An actor that was started again and
    counted its episodes anew is another one, whose name has `.session<n>`. After the iteration `counts` has the numbers
    of `taken`, `duplicate` and `unusable` steps; an unusable step has wrong sizes or values, and `reason` says what is
    wrong with the first one. `damage` has a line for each part that could not be read.
    """

    logs: Sequence[str]
    robot: RobotWithTask
    counts: Counter[str] = field(default_factory=Counter)
    damage: list[str] = field(default_factory=list)
    reason: str = ""

    def __iter__(self) -> Iterator[pb.Step]:
        check_logs(self.logs, self.robot, SCALES)
        intake, earlier = StepReader(self.robot), _EarlierLogs()
        for number, files in enumerate(by_run(find(self.logs)).values(), 1):
            ledger, sessions = StepLedger(), _Sessions()
            earlier.begin_log()
            log_of_run = open_log(files)
            for record in log_of_run:
                if record.topic != "step" or record.message.robot != self.robot.name:
                    continue
                step: pb.Step = record.message
                try:
                    intake.move(step)
                except BadStep as error:
                    self.counts["unusable"] += 1
                    self.reason = self.reason or str(error)
                    continue
                if earlier.is_copied(step):
                    self.counts["duplicate"] += 1
                    continue
                step.actor = sessions.name(step)
                if not ledger.record(step.actor, step.episode, step.step, step.index):
                    self.counts["duplicate"] += 1
                    continue
                self.counts["taken"] += 1
                if number > 1:
                    step.actor = f"{step.actor}.run{number}"
                yield step
            self.damage += log_of_run.damage.lines


class _EarlierLogs:
    """Tells which steps of a log are in an earlier log. A folder may hold a copy of a log, or of its first part."""

    def __init__(self) -> None:
        self._earlier: dict[tuple[str, int], tuple[int, int]] = {}  # by start of an actor: its first and last step [ns]
        self._here: dict[tuple[str, int], tuple[int, int]] = {}

    def begin_log(self) -> None:
        """Begin the next log."""
        for start, (first, last) in self._here.items():
            known = self._earlier.get(start)
            self._earlier[start] = (first, last) if known is None or known[0] != first else (first, max(last, known[1]))
        self._here = {}

    def is_copied(self, step: pb.Step) -> bool:
        """Return whether an earlier log has this step: its steps of this actor begin alike, and end no sooner."""
        start, now = (step.actor, step.header.run), step.header.wall_time
        first, last = self._here.get(start, (now, now))
        self._here[start] = first, max(last, now)
        known = self._earlier.get(start)
        return known is not None and now > 0 and known[0] == first and now <= known[1]


class _Sessions:
    """Tells apart the sessions of an actor within one log."""

    def __init__(self) -> None:
        self._names: dict[tuple[str, int], str] = {}  # of each actor and process
        self._latest: dict[str, tuple[int, int]] = {}  # of each actor: its session, and the highest episode of that

    def name(self, step: pb.Step) -> str:
        """Return the name of a step's actor. A restarted actor keeps its name if its episodes go on."""
        actor, process = step.actor, (step.actor, step.header.run)
        session, episode = self._latest.get(actor, (1, -1))
        if process not in self._names:
            if step.episode <= episode:
                session, episode = session + 1, -1
            self._names[process] = actor if session == 1 else f"{actor}.session{session}"
        self._latest[actor] = session, max(episode, step.episode)
        return self._names[process]


def count(logs: Sequence[str], robot: RobotWithTask) -> int:
    """Count the steps of a robot kind that a learner can use from these logs.

    Raises:
        LogError: a path is no log.
        BadData: a file was recorded with another description of the robot.
        ValueError: the logs have no steps of this robot, or none that teaches anything.
    """
    steps, named = LoggedSteps(logs, robot), ", ".join(map(str, logs))
    total = sum(1 for _ in steps)
    if not total and (unusable := steps.counts["unusable"]):
        raise ValueError(
            f"none of the {unusable} steps of {robot.name} in {named} can be learned from ({steps.reason}): name "
            "the log of a run, whose steps have what the robot's task observes"
        )
    if not total:
        raise ValueError(f"no steps of {robot.name} in {named}: name a log that recorded this robot")
    return total


@dataclass
class ReplayedActor:
    """An actor of a log: its client of the learner, and its publisher."""

    client: LearnerClient
    publisher: Publisher
    first_episode: int  # to publish
    index: int = 0  # number of the last published step


def main(settings: FeederSettings) -> bool:
    """Run a feeder process until the end of the logs or of the training. Returns False if a signal stopped it.

    The health figures have the numbers of `published`, `known` (the learner has them already),
    `duplicate` and `unusable` steps, and of the places where the logs are `damaged`.

    Raises:
        RefusedByLearner: the learner does not accept the actors of the log.
        LogError: a path is no log.
        BadData: a file was recorded with another description of the robot.
    """
    with Process(settings.bus, settings.name) as process:
        return _feed(process, settings)


def _feed(process: Process, settings: FeederSettings) -> bool:
    robot, stop = robot_with_task(settings.robot), process.stop.is_set
    steps, actors, figures = LoggedSteps(settings.logs, robot), dict[str, ReplayedActor](), Counter[str]()

    def refresh() -> None:
        process.figures.update({name: float(figures[name]) for name in ("published", "known")})
        process.figures.update({name: float(steps.counts[name]) for name in ("duplicate", "unusable")})
        process.figures["damaged"] = float(len(steps.damage))

    process.refresh = refresh
    process.announce()
    for step in steps:
        if step.actor not in actors:
            client = LearnerClient(process.bus, robot, step.actor)
            first_episode = client.join(0, step.episode, stop)
            if first_episode is None:
                return False
            publisher = process.bus.publisher(LOGGED, robot=robot.name, source=step.actor)
            # A learner that does not know this actor returns the log's first episode.
            actors[step.actor] = ReplayedActor(client, publisher, first_episode)
        actor = actors[step.actor]
        if step.episode < actor.first_episode:
            figures["known"] += 1
            continue
        if not actor.client.wait(actor.index + 1, step.episode, stop):
            break
        actor.index += 1
        _renumber(step, actor)
        actor.publisher.put(step)
        figures["published"] += 1
    for line in steps.damage:
        log.warning("not learned from: %s", line)
    if unusable := steps.counts["unusable"]:
        log.warning("not learned from: %d unusable steps (%s)", unusable, steps.reason)
    log.info("published %d logged steps; the learner knew %d", figures["published"], figures["known"])
    deadline = time.monotonic() + (LAST_UPDATES_TIMEOUT if settings.alone else 0.0)
    while time.monotonic() < deadline and not stop() and not any(p.client.done for p in actors.values()):
        time.sleep(0.05)
    return not stop()


def _renumber(step: pb.Step, actor: ReplayedActor) -> None:
    """Number the step, and name the version of the weights, as the present learner counts them."""
    time_of_step = step.header.time
    step.ClearField("header")
    step.header.time = time_of_step
    step.index = actor.index
    step.weights_version = 0 if actor.client.policy is None else actor.client.policy.version
