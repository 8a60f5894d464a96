"""Test a log that is replayed, that a learner learns from without a robot, and that replaces a lost checkpoint."""

import json
import shutil
from pathlib import Path

import pytest

from brakeline.deploy.run.run_config import EXPERIMENTS
from brakeline.logs.reader import read
from brakeline.messaging.policy_weights import MLP
from tests.robots import GROUND
from tests.system.runs import brakeline

STEPS = EXPERIMENTS["debug"].steps


@pytest.fixture(scope="module")
def logged(logged_run: Path) -> dict[str, int]:
    """Return the numbers of steps and exchanges in the log."""
    topics = [record.topic for record in read(logged_run)]
    return {name: topics.count(name) for name in ("step", "exchange")}


def test_replay_of_a_whole_run_decides_the_same(logged_run: Path, logged: dict[str, int]) -> None:
    done = brakeline("replay", logged_run, "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    figures = json.loads(done.stdout)
    assert figures["requests"] == logged["exchange"] > 0 and figures["different"] == 0
    assert figures["requests"] - figures["unanswered"] > 0.95 * figures["requests"]
    other = json.loads(brakeline("replay", logged_run, "--margin", "0.05", "--json").stdout)
    assert other["different"] > 0 and other["examples"][0]["differences"]


def test_offline_a_policy_comes_from_the_log_alone(logged_run: Path, logged: dict[str, int], tmp_path: Path) -> None:
    words = ("train", "ground", "--experiment", "debug", "--from-logs", logged_run, "--actors", "0")
    done = brakeline(*words, "--out", tmp_path / "offline", "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    learner = figures["learners"]["ground"]
    assert figures["finished"] and figures["steps"] == 0, "nobody drove"
    assert figures["from_logs"]["published"] == learner["steps"] == logged["step"]
    assert (learner["missing"], learner["duplicates"], learner["done"]) == (0, 0, True)
    assert learner["updates"] == logged["step"] - EXPERIMENTS["debug"].learner.td3.warmup
    assert set(figures["processes"]) == {"launcher", "recorder", "learner", "feeder"}
    assert not any(record.topic in ("step", "logged") for record in read(tmp_path / "offline"))
    (path,) = figures["policies"]
    assert MLP.load(Path(path), GROUND).sizes[0] == GROUND.task.observation_dim


def test_a_lost_checkpoint_comes_back_from_the_log(logged_run: Path, logged: dict[str, int], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(logged_run, folder)
    shutil.rmtree(folder / "learner")
    more = 60
    words = ("train", "--resume", folder, "--from-logs", folder, "--steps", logged["step"] + more)
    done = brakeline(*words, "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    learner = figures["learners"]["ground"]
    assert figures["from_logs"]["published"] == logged["step"], "the figures say how many steps came back"
    assert (learner["steps"], learner["duplicates"]) == (logged["step"] + more, 0)
    assert more <= figures["steps"] <= more + 2 * EXPERIMENTS["debug"].learner.window, "then robots went on"
    first = min(record.message.episode for record in read(folder / "run_0001.mcap") if record.topic == "step")
    assert first > 0, "with episodes that were not there before"
    # Once more: now the learner knows all that is in the log, but for episodes that began after its last step.
    recorded = logged["step"] + figures["steps"]
    late = recorded - learner["steps"]
    done = brakeline("train", "--resume", folder, "--from-logs", folder, "--steps", logged["step"] + 2 * more, "--json")
    figures = json.loads(done.stdout)
    assert figures["from_logs"]["published"] + figures["from_logs"]["known"] == recorded
    assert figures["from_logs"]["published"] <= late
    assert figures["finished"] and figures["learners"]["ground"]["duplicates"] == 0
