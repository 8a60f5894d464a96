"""Test `--deterministic`: the weights depend on the seed alone, however fast the run is and however often it stops.

The run that stops is also the test of how a run ends and is resumed.
"""

import signal
from pathlib import Path

import pytest

from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import load
from brakeline.learner.checkpoint import exists
from brakeline.logs.figure_tables import analyse
from brakeline.logs.reader import read
from tests.system.runs import Run
from tests.waiting import until

# An untrained robot hardly ever reaches a goal, and from this seed it does not: its episodes have 300 steps, so the run
# ends at 600.
SEED = 4
SHORT = ("--deterministic", "--steps", 400, "--learner.td3.warmup", 100, "--learner.checkpoint-every", 100)


@pytest.fixture(scope="module")
def uninterrupted(data_folder, tmp_path_factory) -> tuple[Path, bytes]:
    with Run(tmp_path_factory.mktemp("runs") / "one", *SHORT, "--seed", SEED) as run:
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    assert figures["finished"] and figures["collisions"] == 0 and list(figures["actors"]) == ["actor-0"]
    assert figures["learners"]["ground"]["updates"] == 600 - 100, "one for each step after the warm-up"
    return run.folder, (run.folder / "learner" / "policy.safetensors").read_bytes()


def first_goal(folder: Path) -> list[float]:
    records = read(folder)
    return next(list(r.message.goal) for r in records if r.topic == "episode" and r.message.actor == "actor-0")


def test_the_seed_decides_where_robots_go_and_what_the_learner_draws(uninterrupted, logged_run):
    """That the learner's weights are others then: `tests/learner/test_core.py`."""
    folder, _ = uninterrupted
    assert load(folder / CONFIG).learning().seed == SEED != load(logged_run / CONFIG).learning().seed
    assert first_goal(folder) != first_goal(logged_run)


def test_interrupted_it_ends_in_order_and_resumed_it_gives_the_same_weights(uninterrupted, tmp_path):
    with Run(tmp_path / "run", *SHORT, "--seed", SEED) as run:
        run.watch()
        until(lambda: exists(run.folder / "learner" / "checkpoint"), "a checkpoint")
        run.until_steps(30)  # within the second episode
        figures = run.end(signal.SIGINT)
        assert run.popen.returncode == 130, run.errors.read_text()
    assert not figures["finished"] and figures["steps"] < 600 and figures["policies"]
    before = analyse(run.folder)
    assert (before["cuts"], before["steps"], before["seconds"] > 0) == ([], figures["steps"], True)
    assert not any(topic["missing"] for topic in before["topics"].values())
    assert not [name for name, process in before["processes"].items() if process["alive"] and "actor" in name]
    last = max(record.message.episode for record in read(run.folder) if record.topic == "episode")

    with Run(run.folder, fresh=False) as resumed:
        figures = resumed.end()
        assert resumed.popen.returncode == 0, resumed.errors.read_text()
    assert (run.folder / "learner" / "policy.safetensors").read_bytes() == uninterrupted[1]
    assert first_goal(run.folder) == first_goal(uninterrupted[0])
    assert figures["finished"] and figures["learners"]["ground"]["steps"] == 600, "whole episodes"
    after = analyse(run.folder)
    assert [path.rsplit("/", 1)[1] for path in after["log"]] == ["run.mcap", "run_0001.mcap"]
    assert after["steps"] == before["steps"] + figures["steps"]
    assert not any(topic["missing"] for topic in after["topics"].values())
    assert after["processes"]["learner"]["starts"] == 2
    episodes = [record.message.episode for record in read(run.folder / "run_0001.mcap") if record.topic == "episode"]
    assert episodes and min(episodes) <= last + 1 and max(episodes) >= last, "episodes go on"
