"""Test a learner that learns from a log without a robot, and a log that replaces a lost checkpoint."""

import json
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from brakeline.deploy.run import log_feed
from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import EXPERIMENTS, load
from brakeline.logs.reader import read
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.policy_weights import MLP
from tests.robots import GROUND
from tests.system.runs import succeeded


@pytest.fixture(scope="module")
def steps(logged_run: Path) -> list[pb.Step]:
    return [record.message for record in read(logged_run) if record.topic == "step"]


def test_offline_a_policy_comes_from_the_log_alone(logged_run: Path, steps: list[pb.Step], tmp_path: Path) -> None:
    words = ("train", "ground", "--experiment", "debug", "--from-logs", logged_run, "--actors", "0")
    figures = json.loads(succeeded(*words, "--out", tmp_path / "offline", "--json"))
    learner = figures["learners"]["ground"]
    assert figures["finished"] and figures["steps"] == 0, "nobody drove"
    assert figures["from_logs"]["published"] == learner["steps"] == len(steps)
    assert (learner["missing"], learner["duplicates"], learner["done"]) == (0, 0, True)
    assert learner["updates"] == len(steps) - EXPERIMENTS["debug"].learner.td3.warmup
    assert set(figures["processes"]) == {"launcher", "recorder", "learner", "feeder"}
    assert not any(record.topic in ("step", "logged") for record in read(tmp_path / "offline"))
    (path,) = figures["policies"]
    assert MLP.load(Path(path), GROUND).sizes[0] == GROUND.task.observation_dim


def test_a_lost_checkpoint_comes_back_from_the_log(logged_run: Path, steps: list[pb.Step], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(logged_run, folder)
    shutil.rmtree(folder / "learner")
    more = 60
    words = ("train", "--resume", folder, "--from-logs", folder, "--steps", len(steps) + more)
    figures = json.loads(succeeded(*words, "--json"))
    learner = figures["learners"]["ground"]
    assert figures["from_logs"]["published"] == len(steps), "the figures say how many steps came back"
    assert (learner["steps"], learner["duplicates"]) == (len(steps) + more, 0)
    assert more <= figures["steps"] <= more + 2 * load(folder / CONFIG).learner.window, "then robots went on"
    first = min(record.message.episode for record in read(folder / "run_0001.mcap") if record.topic == "step")
    assert first > 0, "with episodes that were not there before"


def test_steps_that_the_learner_knows_are_not_fed_again(
    logged_run: Path, steps: list[pb.Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A learner with a checkpoint knows all but the episodes that began after its last step."""

    class Client:
        policy, done = None, True

        def __init__(self, bus: object, robot: object, actor: str) -> None: ...

        def join(self, index: int, episode: int, stop: object) -> int:
            return 1

        def wait(self, index: int, episode: int, stop: object) -> bool:
            return True

    fed: list[pb.Step] = []
    bus = SimpleNamespace(publisher=lambda topic, **names: SimpleNamespace(put=fed.append))
    process: Any = SimpleNamespace(bus=bus, stop=threading.Event(), figures={}, announce=lambda: None)
    monkeypatch.setattr(log_feed, "LearnerClient", Client)
    assert log_feed._feed(process, log_feed.FeederSettings(BusSettings(), (str(logged_run),)))
    process.refresh()
    late = [step for step in steps if step.episode >= 1]
    assert [(step.actor, step.episode, step.step) for step in fed] == [
        (step.actor, step.episode, step.step) for step in late
    ]
    assert 0 < len(late) < len(steps)
    assert (process.figures["published"], process.figures["known"]) == (len(late), len(steps) - len(late))
    assert process.figures["damaged"] == 0
