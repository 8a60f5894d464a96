"""Test that a killed process is started again, that no robot collides meanwhile, and that losses are reported."""

import json
import re
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import EXPERIMENTS, encode
from brakeline.learner.checkpoint import exists
from brakeline.logs.figure_tables import analyse
from brakeline.logs.reader import open_log
from tests.robots import GROUND
from tests.system.runs import Run, alive, brakeline
from tests.waiting import PATIENCE, until


def test_each_process_is_killed_in_turn_and_the_run_goes_on_to_its_end(data_folder, tmp_path):
    with Run(tmp_path / "run", "--steps", 1000, "--learner.checkpoint-every", 350) as run:
        run.until_steps(80)
        assert not exists(run.folder / "learner" / "checkpoint"), "the learner dies before its first checkpoint"
        run.kill("learner")
        run.until_steps(80)
        run.kill("safety-0")
        run.until_steps(80)
        run.kill("actor-1")
        run.until_steps(80)
        run.kill("recorder")
        until(lambda: exists(run.folder / "learner" / "checkpoint"), "a checkpoint")
        run.until_steps(50)
        run.kill("learner")
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    assert figures["finished"] and figures["collisions"] == 0
    assert figures["learners"]["ground"]["steps"] == 1000
    assert figures["restarts"] == {"learner": 2, "safety-0": 1, "actor-1": 1, "recorder": 1}
    starts = {name: process["starts"] for name, process in figures["processes"].items()}
    assert starts == {"launcher": 1, "recorder": 2, "safety-0": 2, "learner": 3, "actor-0": 1, "actor-1": 2}
    log = open_log(run.folder)
    records = list(log)
    assert len(log.paths) == 2 and len(log.cuts) == 1 and "run.mcap" in str(log.cuts[0])
    analysed = analyse(run.folder)
    assert analysed["collisions"] == 0 and analysed["cuts"] == [str(log.cuts[0])]
    lost = {key: topic["missing"] for key, topic in analysed["topics"].items() if topic["missing"]}
    assert lost, "what nobody recorded shows as gaps"
    assert analysed["steps"] + sum(n for key, n in lost.items() if key.startswith("step/")) >= figures["steps"]
    texts = [record.message.text for record in records if record.key == "log/launcher"]
    for name in ("learner", "safety-0", "actor-1"):
        assert any(f"{name} was killed by SIGKILL" in text for text in texts), texts
    _braked_as_committed(records)


def _braked_as_committed(records):
    """Each step without a decision executed the next input of the plan of the step before."""
    plans, fallbacks = {}, 0
    for record in records:
        if record.topic == "exchange" and not record.message.failure:
            request = record.message.request
            plan = np.reshape(record.message.reply.decision.plan, (-1, GROUND.action_dim))
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


def test_two_replicas_and_then_no_launcher(data_folder, tmp_path):
    with Run(tmp_path / "run", "--steps", 100_000, "--replicas", 2) as run:
        run.until_steps(200)
        _is_asked(run.there, tmp_path)
        victims = run.children()
        assert {"safety-0", "safety-1", "recorder", "learner", "actor-0", "actor-1"} == victims.keys()
        _imports_what_it_needs(victims)
        victims["safety-0"].kill()
        run.until_steps(200)  # some are taken before it is back
        assert not [e for e in run.metrics.figures()["no_decision"] if e not in ("NoReply", "Late")]
        until(lambda: run.children().get("safety-0", victims["safety-0"]).pid != victims["safety-0"].pid, "a new one")
        children = run.children()
        run.popen.kill()
        run.popen.wait()
        until(lambda: run.children() == {}, "no process is left without its launcher")
        assert len(children) == 6
    log = open_log(run.folder)
    steps = [record.message for record in log if record.topic == "step"]
    assert log.cuts == [], "the recorder ended in order"
    assert len(steps) > 350 and not any(step.collision for step in steps)
    assert exists(run.folder / "learner" / "checkpoint"), "and so did the learner"


def _imports_what_it_needs(children: dict[str, psutil.Process]) -> None:
    """Else each costs seconds at its start, and hundreds of megabytes."""
    loaded = {name: " ".join(part.path for part in child.memory_maps()) for name, child in children.items()}
    assert {name for name, paths in loaded.items() if "libtorch" in paths} == {"learner"}
    assert {name for name, paths in loaded.items() if "libmujoco" in paths} == {"actor-0", "actor-1"}
    # Numba brings SciPy's linear algebra; all else of SciPy would come on top.
    assert not {name for name, paths in loaded.items() if "/scipy/sparse/" in paths and name.startswith("actor")}


def _is_asked(there: tuple[object, ...], folder: Path) -> None:
    """`status` and `query` of a run in progress, for people and as JSON."""
    status = brakeline("status", *there)
    assert status.returncode == 0 and "safety-1" in status.stdout and "learning ground" in status.stdout
    shown = json.loads(brakeline("status", *there, "--json").stdout)
    assert {"launcher", "recorder", "safety-0", "safety-1", "learner", "actor-0", "actor-1"} <= set(shown["alive"])
    assert shown["processes"]["safety-0"]["model ground"] and shown["learners"]["ground"]["steps"] > 0
    near = ("query", "ground", *there, "--timeout", 10, "--obstacle", "cylinder 0.25 0 0.1")
    answer = json.loads(brakeline(*near, "--json").stdout)
    assert answer.keys() >= {"kind", "action", "plan", "tube_center", "margin", "time_ms", "model"}
    assert answer["kind"] in ("allowed", "adjusted", "failsafe") and answer["margin"] >= 0.0
    assert len(answer["plan"]) == len(answer["tube_center"]) == len(answer["tube_half_width"]) == GROUND.horizon
    assert answer["kind"] in brakeline(*near).stdout
    for far, said in ((3.5, ("allowed",)), (0.0, ("adjusted", "failsafe"))):  # all free about it; nothing seen
        scan = {"ranges": [far] * 360, "angles": np.radians(range(360)).tolist(), "pose": [0.0, 0.0, 0.0]}
        (folder / "scan.json").write_text(json.dumps(scan))
        query = brakeline("query", "ground", *there, "--timeout", 10, "--scan", folder / "scan.json", "--json")
        assert json.loads(query.stdout)["kind"] in said
    wrong = brakeline("query", "ground", *there, "--known-free", "--state", 1, 2)
    assert wrong.returncode == 1 and "BadRequest" in wrong.stderr and "Traceback" not in wrong.stderr


def test_what_fails_again_and_again_ends_the_run_and_says_why(data_folder, tmp_path):
    folder = tmp_path / "run"
    (folder / "learner" / "checkpoint").mkdir(parents=True)
    (folder / "learner" / "checkpoint" / "latest").write_text("000042\n")  # it is not there: never a fresh start
    with Run(folder) as run:
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


def test_a_second_interrupt_leaves_nothing_either(data_folder, tmp_path):
    """Of a run without a recorder (`tests/deploy/run/test_launcher.py` has its figures)."""
    with Run(tmp_path / "run", "--no-record") as run:
        until(lambda: run.children().keys() == {"safety-0", "learner", "actor-0", "actor-1"}, "all processes")
        run.popen.send_signal(signal.SIGINT)
        time.sleep(1.5)
        run.popen.send_signal(signal.SIGINT)
        run.popen.wait(PATIENCE)
        until(lambda: run.children() == {}, "no process is left")
    assert list(run.folder.glob("*.mcap")) == []


def test_a_child_whose_launcher_is_gone_ends_without_a_word_to_the_bus(tmp_path):
    (tmp_path / CONFIG).write_text(encode(EXPERIMENTS["debug"]))
    nobody = next(pid for pid in range(2**15, 2**22) if not alive(pid))
    with socket.create_server(("127.0.0.1", 0)) as bus:
        endpoint = f"tcp/127.0.0.1:{bus.getsockname()[1]}"
        (tmp_path / "endpoint").write_text(json.dumps({"endpoint": endpoint, "pid": nobody}))
        child = [*PYTHON, "-m", "brakeline.deploy.run.run_process", str(tmp_path), "actor-0"]
        assert subprocess.run(child, check=False, timeout=PATIENCE).returncode != 0
        bus.setblocking(False)
        with pytest.raises(BlockingIOError):
            bus.accept()
