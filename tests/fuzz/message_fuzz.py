"""Send messages of all kinds to every process that listens to them, in this process: nothing may raise, or grow.

For each topic there are valid messages with every field drawn (extremes, wrong sizes, unknown names), the same with
bits turned, bytes cut off or doubled, and noise. A process must skip what it can't handle, and still report figures.
`python -m benchmarks fuzz` sends a million messages, the tests some thousands.
"""

from __future__ import annotations

import logging
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import psutil
from google.protobuf.message import DecodeError

from benchmarks.timing import Figures
from brakeline.actors.learner_client import LearnerClient
from brakeline.deploy.commands.watch_command import show_received
from brakeline.deploy.run.display import line
from brakeline.deploy.run.launcher import Launcher
from brakeline.deploy.run.log_contents import derive_entries
from brakeline.deploy.run.run_config import RunConfig
from brakeline.errors import BadModel, BadRequest, BusError, UnknownRobot
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig
from brakeline.learner.learner_process import LearnerLoop, LearnerSettings
from brakeline.logs.foxglove import RATE
from brakeline.logs.log_analysis import AnalysisOptions, RunAnalysis
from brakeline.logs.reader import Log
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.logs.report_page import render
from brakeline.logs.segment_rotation import Rotation
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.live_page_server import encode
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.bus.bundling import Unbundler
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import BUNDLE, DECIDE, FLOW, JOIN, MODEL, RECORDED, TOPICS, WEIGHTS, Topic
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.methods import decode
from brakeline.safety.service.client import read_reply, request_message
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from tests.fuzz.message_fuzzer import MessageFuzzer

LOOK = 25_000  # most messages between two looks at the processes' figures
SETTLED = 0.3  # share of the messages after which tables are full
LATER = 0.67  # share of the messages after which growth is a leak


class Wire:
    """A bus without a network: it drops published messages, and stores handlers."""

    run = 1

    def __init__(self) -> None:
        self.rejected = RejectedMessages()
        self._unbundler = Unbundler(self.rejected)
        self.handlers: dict[str, Callable[[Sample], None]] = {BUNDLE.name: self._unbundler.take}

    def publisher(self, topic: Topic, **names: str) -> Any:
        return SimpleNamespace(put=lambda message: message.SerializeToString(), count=0)

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], **names: str) -> None:
        self.handlers[topic.name] = handler
        self._unbundler.add(topic, {}, lambda key, payload, received: handler(Sample(topic, key, payload, received)))

    def serve(self, topic: Topic, handler: Callable[[bytes], bytes], **names: str) -> None: ...


@dataclass
class Party:
    """A process: it takes samples, `look` makes its figures, `rejected` counts the messages that it skipped."""

    topics: tuple[Topic, ...]
    take: Callable[[Sample], None]
    look: Callable[[], object]
    rejected: RejectedMessages = field(default_factory=RejectedMessages)
    close: Callable[[], object] = lambda: None
    messages: int = 0
    crashes: Counter[str] = field(default_factory=Counter)

    def try_(self, work: Callable[[], object]) -> None:
        try:
            work()
        except Exception as error:  # it would have ended the process
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.crashes[f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {error}"[:200]] += 1


def launcher(folder: Path) -> Party:
    one = Launcher(RunConfig(), folder, BusSettings(listen=("tcp/127.0.0.1:1",)))

    def take(sample: Sample) -> None:
        one._inbox.put(sample)
        one._drain()

    return Party(RECORDED, take, lambda: (line(one.metrics.figures()), one.figures()), one._rejected)


def recorder(folder: Path) -> Party:
    """Record into files that are deleted after the next one begins, so that the disk does not fill up."""
    rejected, inbox = RejectedMessages(), Inbox()
    settings = LogSettings(folder / "fuzz.mcap", derive=derive_entries(RATE), rotation=Rotation(mib=16.0))
    recording = Recording(settings, inbox, rejected)

    def take(sample: Sample) -> None:
        inbox.put(sample)
        if inbox.bytes > 2**16:
            recording.save()
            for path in folder.glob("fuzz*.mcap"):
                if path != recording.path:
                    path.unlink()

    return Party(RECORDED, take, recording.save, rejected, recording.finish)


def watch() -> Party:
    board, rejected, inbox = Dashboard(), RejectedMessages(), Inbox()

    def take(sample: Sample) -> None:
        inbox.put(sample)
        show_received(inbox, board, None, rejected)

    return Party(RECORDED, take, lambda: encode(board.view()), rejected)


def learning(robot: RobotWithTask, folder: Path) -> Party:
    """Run the learner's loop: it receives steps and joins, and makes no updates."""
    wire = Wire()
    config = LearnerConfig(steps=10**9, capacity=1000)
    learner = Learner(robot, config)
    learner.join(pb.Join(robot=robot.name, actor="actor-0", layout=robot.learning_layout()))
    process: Any = SimpleNamespace(bus=wire, stop=Event(), figures={}, notes={})
    loop = LearnerLoop(process, learner, LearnerSettings(BusSettings(), robot.name, folder, learner=config))

    def take(sample: Sample) -> None:
        if sample.topic is JOIN:
            try:
                join = pb.Join.FromString(sample.payload)
            except DecodeError:
                return
            learner.join(join).SerializeToString()
        else:
            with wire.rejected.skip_on_error(sample.key):
                wire.handlers[sample.topic.name](sample)
            loop._take_steps()

    topics = tuple(topic for topic in TOPICS if "learner" in topic.subscribers)

    def look() -> None:
        loop._publish_flow()
        loop.output.publish()

    return Party(topics, take, look, wire.rejected)


def actor(robot: RobotWithTask) -> Party:
    wire: Any = Wire()
    student = LearnerClient(wire, robot, "actor-0")

    def take(sample: Sample) -> None:
        with wire.rejected.skip_on_error(sample.key):
            wire.handlers[sample.topic.name](sample)

    return Party((WEIGHTS, FLOW), take, lambda: (student.joined, student.done), wire.rejected)


def safety() -> Party:
    """Serve requests and install models; a refusal goes back to the client."""
    models, rejected = ModelRegistry(), RejectedMessages()
    answer = BatchHandler(models, ServiceCounts())

    def take(sample: Sample) -> None:
        try:
            if sample.topic is DECIDE:
                answer(sample.payload)
            else:
                with rejected.skip_on_error(sample.key):
                    models.install(decode(sample.message().file))
        except (BadRequest, UnknownRobot, BadModel):
            return

    return Party((DECIDE, MODEL), take, lambda: models.filters, rejected)


def asker(robot: RobotWithTask, fuzzer: MessageFuzzer) -> Party:
    """Read the replies to one request."""
    request = request_message(BackupPlan(robot), [0.0] * robot.state_dim, [0.0] * robot.action_dim, known_free=True)

    def take(sample: Sample) -> None:
        message = pb.Reply(robot=robot.name)
        fuzzer.fill(message, fuzzer.random.choice(message.DESCRIPTOR.fields))
        try:
            read_reply(message, request, robot)
        except BusError:
            return

    return Party((DECIDE,), take, lambda: None)


def parties(folder: Path, fuzzer: MessageFuzzer) -> dict[str, Party]:
    robot = robot_with_task("ground")
    return {
        "launcher": launcher(folder),
        "recorder": recorder(folder),
        "watch": watch(),
        "learner": learning(robot, folder),
        "actor": actor(robot),
        "safety": safety(),
        "asker": asker(robot, fuzzer),
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """Switch off the log: a line about each skipped message would be most of the work."""
    log = logging.getLogger("brakeline")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


def fuzz(messages: int, seed: int = 0) -> Figures:
    """Draw messages, and give each to all listeners of its topic; then read a log of the last ones."""
    fuzzer, begun = MessageFuzzer(seed), time.monotonic()
    with tempfile.TemporaryDirectory() as name, _quiet():
        folder = Path(name)
        everybody = parties(folder, fuzzer)
        settled, later, process = 0, 0, psutil.Process()
        look = min(LOOK, max(messages // 50, 1))
        for number in range(messages):
            sample = fuzzer.sample(fuzzer.random.choice(TOPICS))
            for party in everybody.values():
                if sample.topic in party.topics:
                    party.messages += 1
                    party.try_(partial(party.take, sample))
            if number % look == look - 1 or number == messages - 1:
                for party in everybody.values():
                    party.try_(party.look)
            if number == int(SETTLED * messages):
                settled = process.memory_info().rss
            if number == int(LATER * messages):
                later = process.memory_info().rss
        grown = process.memory_info().rss - settled
        grown_last = grown - (later - settled)
        for party in everybody.values():
            party.try_(party.close)
        everybody["analyse"] = reader(folder)
    rows: Figures = {
        name: {"messages": party.messages, "passed over": party.rejected.count, "crashes": party.crashes.total()}
        for name, party in everybody.items()
    }
    rows["all"] = {
        "messages": messages,
        "crashes": sum(party.crashes.total() for party in everybody.values()),
        "RSS grown MiB": grown / 2**20,
        "of that in the last third MiB": grown_last / 2**20,
        "RSS settled MiB": settled / 2**20,
        "seconds": time.monotonic() - begun,
    }
    for name, party in everybody.items():
        for crash, count in party.crashes.items():
            rows[f"{name}: {crash}"] = {"crashes": count}
    return rows


def reader(folder: Path) -> Party:
    """Make a report of the recorder's log."""
    party = Party(RECORDED, lambda sample: None, lambda: None)

    def look() -> None:
        log = Log((folder / "fuzz.mcap",))
        analysis = RunAnalysis("fuzz", log, AnalysisOptions(pictures=True), "")
        render(analysis.figures(), {"fuzz": (analysis.figures(), analysis.pictures())})
        party.messages = sum(segment.messages for segment in log.segments)
        party.rejected.count = log.malformed

    party.try_(look)
    return party
