"""Test two robots of each kind in one run: all learn, and none collides when the only safety service dies."""

from __future__ import annotations

from pathlib import Path

from brakeline.logs.reader import read
from tests.accepting import WORDS
from tests.system.runs import Run

MIXED = ("train", "ground", "quadrotor", "--experiment", "debug")
KINDS = ("ground", "quadrotor")


def test_two_of_each_learn_and_all_stop_when_the_service_dies(flight_folder: Path, tmp_path: Path) -> None:
    with Run(tmp_path / "run", "--steps", 250, "--actors", 2, "--mavlink", *WORDS, command=MIXED) as run:
        run.until_steps(150)
        run.kill("safety-0")
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    assert figures["finished"] and figures["collisions"] == 0
    assert figures["restarts"] == {"safety-0": 1}
    assert {name: learner["steps"] for name, learner in figures["learners"].items()} == dict.fromkeys(KINDS, 250)
    assert all(learner["weights_version"] > 1 for learner in figures["learners"].values()), "both learned something"
    assert set(figures["actors"]) == {f"actor-{kind}-{i}" for kind in KINDS for i in (0, 1)}

    records = list(read(run.folder))
    failed = {r.message.request.actor for r in records if r.topic == "exchange" and r.message.failure}
    waited = {r.message.process for r in records if r.topic == "log" and "waiting for the safety" in r.message.text}
    assert failed | waited == set(figures["actors"]), "each of them felt it"
    taped = {r.message.actor for r in records if r.topic == "frames"}
    assert taped == {"actor-quadrotor-0", "actor-quadrotor-1"}
