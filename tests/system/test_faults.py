"""Test that a killed process is started again, that no robot collides meanwhile, and that losses are reported."""

import json
import re
import signal
import socket
import subprocess
import time

import numpy as np
import psutil
import pytest

from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import EXPERIMENTS, encode
from brakeline.learner.checkpoint import exists
from brakeline.logs.figure_tables import analyse
from brakeline.logs.reader import open_log
from tests.accepting import WORDS
from tests.robots import ROBOTS
from tests.system.runs import Run
from tests.waiting import PATIENCE, until

KINDS = ("ground", "quadrotor")
MIXED = ("train", *KINDS, "--experiment", "debug")
STEPS = 1500  # of each kind: a fast machine must not be through before the last process is killed


def test_each_process_is_killed_in_turn_and_robots_of_two_kinds_learn_to_the_end(flight_folder, tmp_path):
    words = ("--steps", STEPS, "--learner.checkpoint-every", 300, "--actors", 2, "--mavlink", *WORDS)
    with Run(tmp_path / "run", *words, command=MIXED) as run:
        checkpoint = run.folder / "learner-ground" / "checkpoint"
        run.until_steps(80)
        run.kill("safety-0")
        run.until_steps(40, "actor-ground")  # the quadrotors may soon be through
        assert not exists(checkpoint), "the learner dies before its first checkpoint"
        run.kill("learner-ground")
        run.until_steps(80, "actor-ground")
        run.kill("actor-ground-1")
        run.until_steps(50, "actor-ground")
        until(lambda: _launcher_said("actor-ground-1 was killed", run.folder), "the recorder has flushed")
        run.kill("recorder")
        until(lambda: exists(checkpoint), "a checkpoint")
        run.until_steps(50, "actor-ground")
        run.kill("learner-ground")
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    assert json.loads((run.folder / "figures.json").read_text()) == figures
    assert figures["finished"] and figures["collisions"] == 0
    assert {name: learner["steps"] for name, learner in figures["learners"].items()} == dict.fromkeys(KINDS, STEPS)
    assert all(learner["weights_version"] > 1 for learner in figures["learners"].values()), "both learned something"
    assert figures["restarts"] == {"learner-ground": 2, "safety-0": 1, "actor-ground-1": 1, "recorder": 1}
    actors = {f"actor-{kind}-{i}" for kind in KINDS for i in (0, 1)}
    assert set(figures["actors"]) == actors
    starts = {name: process["starts"] for name, process in figures["processes"].items()}
    once = dict.fromkeys(("launcher", "learner-quadrotor", *actors), 1)
    assert starts == once | {"recorder": 2, "safety-0": 2, "learner-ground": 3, "actor-ground-1": 2}
    log = open_log(run.folder)
    records = list(log)
    assert len(log.paths) == 2 and len(log.cuts) == 1 and "run.mcap" in str(log.cuts[0])
    analysed = analyse(run.folder)
    cut, *unrecorded = analysed["cuts"]
    assert analysed["collisions"] == 0 and cut == str(log.cuts[0])
    said = re.compile(r"\d+ (of the \d+ steps that the learner of \w+ had|messages that the run published) are not in")
    assert all(said.match(line) for line in unrecorded), unrecorded
    lost = {key: topic["missing"] for key, topic in analysed["topics"].items() if topic["missing"]}
    assert any(key.startswith("step/") for key in lost), "what nobody recorded shows as gaps"
    for key in ("step/ground/actor-ground-0", "step/ground/actor-ground-1"):
        assert analysed["topics"][key]["messages"] + lost.get(key, 0) >= figures["topics"][key]["messages"]
    for name in ("learner-ground", "safety-0", "actor-ground-1"):
        assert _launcher_said(f"{name} was killed by SIGKILL", run.folder)
    failed = {r.message.request.actor for r in records if r.topic == "exchange" and r.message.failure}
    waited = {r.message.process for r in records if r.topic == "log" and "waiting for the safety" in r.message.text}
    felt = failed | waited - {"launcher"}  # which repeats the last words of what was killed
    assert felt == actors, "each of them felt that the service had died"
    taped = {r.message.actor for r in records if r.topic == "frames"}
    assert taped == {"actor-quadrotor-0", "actor-quadrotor-1"}
    _braked_as_committed(records)


def _launcher_said(words, folder):
    """Return whether a line of the launcher with these words is in the log."""
    return any(words in record.message.text for record in open_log(folder) if record.key == "log/launcher")


def _braked_as_committed(records):
    """Each step without a decision executed the next input of the plan of the step before."""
    plans, fallbacks = {}, 0
    for record in records:
        if record.topic == "exchange" and not record.message.failure:
            request = record.message.request
            plan = np.reshape(record.message.reply.decision.plan, (-1, ROBOTS[request.robot].action_dim))
            plans[request.actor, request.episode, request.step] = plan[1:]
        elif record.topic == "step" and record.message.fallback:
            step = record.message
            fallbacks += 1
            before = plans.get((step.actor, step.episode, step.step - 1))
            if before is not None:
                assert np.allclose(step.action, before[0], atol=1e-6)
                plans[step.actor, step.episode, step.step] = before[1:]
    failures = [r for r in records if r.topic == "exchange" and r.message.failure]
    assert len(failures) == fallbacks, "who stands and waits takes no step"


def test_what_fails_again_and_again_ends_the_run_and_says_why(data_folder, tmp_path):
    folder = tmp_path / "run"
    (folder / "learner" / "checkpoint").mkdir(parents=True)
    (folder / "learner" / "checkpoint" / "latest").write_text("000042\n")  # it is not there: never a fresh start
    with Run(folder, "--actors", 1, "--no-record") as run:
        run.popen.wait(3.0 * PATIENCE)  # five starts of a process that imports torch
        errors = run.errors.read_text()
        assert run.popen.returncode == 1
        assert "learner ended with 1" in errors and "5th time in a row" in errors and "'latest' is missing" in errors
        assert "Traceback" not in errors and run.children() == {}
    words = (folder / "logs" / "learner.log").read_text()
    assert len(re.findall(r"deploy/run/run_process.py\", line \d+, in <module>", words)) == 5, (
        "one traceback for each start"
    )
    assert json.loads((folder / "figures.json").read_text())["restarts"]["learner"] == 4


def test_a_second_interrupt_ends_the_launcher_at_once_and_leaves_nothing_either(data_folder, tmp_path):
    """Of a run without a recorder (`tests/deploy/run/test_launcher.py` has its figures)."""
    with Run(tmp_path / "run", "--no-record", "--actors", 1) as run:
        run.until_steps(20)
        actor = run.children()["actor-0"]
        actor.suspend()  # the launcher waits for it for ten seconds
        run.popen.send_signal(signal.SIGINT)
        time.sleep(1.5)  # else both would count as one
        assert run.popen.poll() is None
        run.popen.send_signal(signal.SIGINT)
        assert run.popen.wait(5.0) == 130
        actor.resume()
        until(lambda: run.children() == {}, "no process is left")
    assert list(run.folder.glob("*.mcap")) == []


def test_a_child_whose_launcher_is_gone_ends_without_a_word_to_the_bus(tmp_path):
    (tmp_path / CONFIG).write_text(encode(EXPERIMENTS["debug"]))
    nobody = next(pid for pid in range(2**15, 2**22) if not psutil.pid_exists(pid))
    with socket.create_server(("127.0.0.1", 0)) as bus:
        endpoint = f"tcp/127.0.0.1:{bus.getsockname()[1]}"
        (tmp_path / "endpoint").write_text(json.dumps({"endpoint": endpoint, "pid": nobody}))
        child = [*PYTHON, "-m", "brakeline.deploy.run.run_process", str(tmp_path), "actor-0"]
        assert subprocess.run(child, check=False, timeout=PATIENCE).returncode != 0
        bus.setblocking(False)
        with pytest.raises(BlockingIOError):
            bus.accept()
