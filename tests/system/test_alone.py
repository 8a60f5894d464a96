"""Test each process when it is started alone by its command, as on a machine of its own."""

import signal

from brakeline.logs.figure_tables import analyse
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.service.client import SafetyClient
from tests.system.runs import brakeline
from tests.waiting import until

LEARNING = ("--learner.td3.hidden", 16, "--learner.td3.batch", 16, "--learner.td3.warmup", 100)


def test_safety_learner_actor_and_recorder_alone(start, data_folder, tmp_path):
    endpoint = free_endpoint()
    there = ("--connect", endpoint)
    safety = start("safety", "ground", "--listen", endpoint)
    # Before anybody else is there: the processes may be started in any order.
    actor = start("actor", "ground", *there, "--name", "actor-7", "--number", 7, "--robots", 2)
    recorder = start("recorder", tmp_path / "run.mcap", *there)
    until((tmp_path / "run.mcap").exists, "the recorder records")
    learner = start("learner", "ground", *there, "--out", tmp_path / "learner", "--steps", 250, *LEARNING)

    with Bus(BusSettings(connect=(endpoint,), patience=60.0), "test") as bus:
        until(lambda: {"safety", "actor-7", "recorder", "learner"} <= bus.living(), "all live")
        near = [Obstacle("cylinder", (0.3, 0.0), (0.1,))]
        answer = SafetyClient(bus, "ground", 5.0).decide([0.0] * 5, [0.25, 0.0], near)
        assert answer.kind in ("allowed", "adjusted")
    status = brakeline("status", *there)
    assert status.returncode == 0, status.stderr
    assert "safety" in status.stdout and "recorder" in status.stdout

    assert learner.wait(120.0) == 0, "the last step is learned from"
    assert (tmp_path / "learner" / "policy.safetensors").exists()
    assert actor.wait(30.0) == 0, "and the actor knows"
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(30.0) == 0
    safety.send_signal(signal.SIGTERM)
    assert safety.wait(30.0) == 0
    figures = analyse(tmp_path / "run.mcap")
    assert sorted(figures["actors"]) == ["actor-7.0", "actor-7.1"]
    assert figures["steps"] >= 250 and figures["collisions"] == 0 and figures["cuts"] == []
    assert figures["topics"]["step/ground/actor-7.0"]["missing"] == 0

    again = brakeline("learner", "ground", "--listen", endpoint, "--out", tmp_path / "learner", *LEARNING)
    assert again.returncode == 1 and "holds a checkpoint already" in again.stderr and "Traceback" not in again.stderr
