"""The process on a real bus, with an actor that makes its steps up."""

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.errors import Late, NoReply, Refused, UnknownRobot
from brakeline.learner import checkpoint
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.learner.learner_output import POLICY
from brakeline.learner.learner_process import LearnerLoop, LearnerSettings, main
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.topics import FLOW, JOIN, LEARNER, STEP, WEIGHTS
from tests.robots import GROUND
from tests.waiting import until

CONFIG = LearnerConfig(
    td3=TD3Config(hidden=(32, 32), batch=32, warmup=50),
    steps=300,
    capacity=1000,
    publish_every=20,
    checkpoint_every=100,
)


@pytest.fixture
def bus() -> Iterator[Bus]:
    """The router, and the actor's place on it."""
    endpoint = free_endpoint()
    with Bus(BusSettings(listen=(endpoint,)), "actor-0") as bus:
        yield bus


class Actor:
    """Publishes steps as far as the flow allows."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.index, self.episode = bus, 0, 0
        self.limit, self.done = 0, False
        self.versions: list[int] = []
        self.metrics: list[pb.LearnerMetrics] = []
        self._steps = bus.publisher(STEP, robot="ground")
        bus.subscribe(FLOW, lambda sample: self._heed(sample.message()), robot="ground")
        bus.subscribe(WEIGHTS, lambda sample: self.versions.append(sample.message().version), robot="ground")
        bus.subscribe(LEARNER, lambda sample: self.metrics.append(sample.message()), robot="ground")

    def _heed(self, flow: pb.Flow) -> None:
        self.limit, self.done = max(self.limit, flow.limit["actor-0"]), flow.done

    def join(self, **fields: object) -> pb.JoinReply:
        values = {"robot": "ground", "actor": "actor-0", "layout": GROUND.learning_layout(), "index": self.index}
        join = pb.Join(**(values | {"episode": self.episode} | fields)).SerializeToString()

        def asked() -> pb.JoinReply | None:
            with suppress(NoReply, Late):
                return pb.JoinReply.FromString(self.bus.ask(JOIN, join, 5.0, robot="ground"))
            return None

        reply = until(asked, "the learner has started")
        if not reply.HasField("error"):
            self._heed(reply.flow)
            self.episode = reply.episode
        return reply

    def drive(self, steps: int) -> None:
        """Publish up to `steps` more in episodes of 20 steps, or up to the end of the run."""
        last, step, seen, action = self.index + steps, 0, [0.1] * 26, GROUND.low()
        while self.index < last and not self.done:
            if self.index >= self.limit:
                until(lambda: self.index < self.limit or self.done, "the flow goes on")
                continue
            self.index += 1
            place = {"robot": "ground", "actor": "actor-0", "episode": self.episode, "step": step, "index": self.index}
            moved = {"observation": seen, "next_observation": seen, "action": action, "proposed": action}
            self._steps.put(pb.Step(**place, **moved, truncated=step == 19))
            self.episode, step = (self.episode + 1, 0) if step == 19 else (self.episode, step + 1)


def start(bus: Bus, out: Path, learner: LearnerConfig = CONFIG, resume: bool = False) -> threading.Thread:
    settings = LearnerSettings(BusSettings(connect=bus.settings.listen), out=out, learner=learner, resume=resume)
    thread = threading.Thread(target=main, args=(settings,), daemon=True)
    thread.start()
    return thread


def test_a_run_from_the_first_step_to_the_last(bus, tmp_path):
    thread, actor = start(bus, tmp_path), Actor(bus)
    assert actor.join(layout="0").error.field == "layout"
    with pytest.raises(Refused):
        bus.ask(JOIN, b"\xff\xff\xff", 5.0, robot="ground")
    reply = actor.join()
    assert (reply.episode, reply.weights.version) == (0, 1)
    actor._steps.put(pb.Step(robot="ground", actor="actor-0", index=1))  # no observation: refused, and on it goes
    actor.drive(10**6)
    thread.join(20.0)
    assert not thread.is_alive() and actor.done
    assert actor.versions == sorted(set(actor.versions)) and len(actor.versions) > 5
    last = actor.metrics[-1]
    assert last.done and (last.steps, last.updates, last.missing, last.duplicates) == (300, 250, 0, 0)
    assert MLP.load(tmp_path / POLICY).version == last.weights_version
    assert checkpoint.exists(tmp_path / checkpoint.CHECKPOINT)


@pytest.fixture
def loops(monkeypatch) -> list[LearnerLoop]:
    """Those that were started, to be stopped as SIGTERM does."""
    started: list[LearnerLoop] = []
    original = LearnerLoop.run
    monkeypatch.setattr(LearnerLoop, "run", lambda loop: (started.append(loop), original(loop))[1])
    return started


def test_stopped_and_resumed(bus, tmp_path, loops):
    first, actor = start(bus, tmp_path), Actor(bus)
    before = actor.join().flow.incarnation
    actor.drive(130)
    until(lambda: loops[0]._learner.steps >= 130)  # what is still on its way would be lost, and counted as missing
    loops[0]._process.stop.set()
    first.join(20.0)
    second = start(bus, tmp_path, resume=True)
    reply = actor.join()
    assert reply.flow.incarnation != before and reply.episode == 7
    actor.drive(10**6)
    second.join(20.0)
    assert actor.metrics[-1].done and actor.metrics[-1].steps == 300
    assert actor.metrics[-1].missing == 0


def test_what_cannot_start_is_an_error(bus, tmp_path):
    """There is nothing to resume; there is no such robot; a fresh start would overwrite a checkpoint."""
    settings = LearnerSettings(BusSettings(connect=bus.settings.listen), out=tmp_path, learner=CONFIG)
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint"):
        main(replace(settings, resume=True))
    with pytest.raises(UnknownRobot, match="submarine"):
        main(replace(settings, robot="submarine"))
    Learner(GROUND, CONFIG).save(tmp_path / checkpoint.CHECKPOINT)
    with pytest.raises(checkpoint.CheckpointError, match="resume"):
        main(settings)


def test_unwritable_checkpoints_do_not_end_the_run(bus, tmp_path):
    (tmp_path / checkpoint.CHECKPOINT).write_text("a file where a folder belongs")
    thread, actor = start(bus, tmp_path, replace(CONFIG, steps=120, checkpoint_every=40)), Actor(bus)
    actor.join()
    actor.drive(10**6)
    thread.join(20.0)
    assert actor.metrics[-1].steps == 120
    assert MLP.load(tmp_path / POLICY).version == actor.metrics[-1].weights_version
