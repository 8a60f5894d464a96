"""Test each process when it is started alone by its command and with its keys, as on a machine of its own."""

import json
import signal

from brakeline.deploy.commands.ros2_command import Ros2Command
from brakeline.deploy.data.data_paths import method_path
from brakeline.logs.figure_tables import analyse
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.robot import robot_named
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND
from tests.system.runs import brakeline, refused, succeeded
from tests.waiting import until

LEARNING = ("--learner.td3.hidden", 16, "--learner.td3.batch", 16, "--learner.td3.warmup", 100)
NAMES = ("safety", "client", "viewer", "actor-7", "learner", "recorder", "certify")


def test_safety_learner_actor_and_recorder_alone_with_the_keys_that_were_handed_out_to_them(
    start, data_folder, tmp_path, monkeypatch
):
    keys, parts, endpoint = tmp_path / "keys", tmp_path / "parts", free_endpoint("tls")
    there = ("--connect", endpoint)
    succeeded("keys", keys, *NAMES, "--hand-out", parts)
    names = {"ca.pem", "safety.pem", "safety.key", "names", "vouchers.key", "signers"}
    assert {path.name for path in (parts / "safety").iterdir()} == names
    assert {path.name for path in (parts / "actor-7").iterdir()} == {"ca.pem", "actor-7.pem", "actor-7.key"}
    assert not list(parts.rglob("ca.key")) and (parts / "certify" / "signer.key").exists()

    def launch(name, *words):
        return start(name.partition("-")[0], *words, "--keys", parts / name)

    model = method_path(GROUND, "ddpc", ModelConfig())
    assert "no seal" in refused("safety", "ground", "--listen", endpoint, "--keys", parts / "safety")
    succeeded("keys", parts / "certify", "--sign", model)
    try:
        safety = launch("safety", "ground", "--listen", endpoint)
        # Before anybody else is there: the processes may be started in any order.
        actor = launch("actor-7", "ground", *there, "--name", "actor-7", "--number", 7, "--robots", 2)
        recorder = launch("recorder", tmp_path / "run.mcap", *there)
        until((tmp_path / "run.mcap").exists, "the recorder records")
        learner = launch("learner", "ground", *there, "--out", tmp_path / "learner", "--steps", 250, *LEARNING)
        with Bus(BusSettings(connect=(endpoint,), keys=parts / "viewer", patience=60.0), "viewer") as bus:
            until(lambda: {"safety", "actor-7", "recorder", "learner"} <= bus.living(), "all live")
    finally:
        model.with_suffix(".seal").unlink()

    monkeypatch.setenv("BRAKELINE_KEYS", str(parts / "client"))
    query = ("query", "ground", *there, "--timeout", 10, "--json")
    answer = json.loads(brakeline(*query, "--known-free").stdout)
    assert answer["kind"] == "allowed"
    near = json.loads(brakeline(*query, "--obstacle", "cylinder 0.3 0 0.1", "--action", 0.25, 0).stdout)
    assert near["kind"] in ("allowed", "adjusted")
    stranger = refused("query", "ground", "--known-free", *there, "--keys", parts / "actor-7")
    assert "no keys of client" in stranger
    with Ros2Command(connect=(endpoint,), keys=parts / "client")._asker(robot_named("ground"), lead=30.0) as question:
        (reply,) = question([pb.Request(robot="ground")])
    assert reply.error.field == "plan", "a ROS robot's questions are heard, and this one was empty"
    status = succeeded("status", *there, "--keys", parts / "viewer")
    assert "safety" in status and "recorder" in status

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

    monkeypatch.delenv("BRAKELINE_KEYS")
    again = ("learner", "ground", "--listen", free_endpoint(), "--out", tmp_path / "learner", *LEARNING)
    assert "holds a checkpoint already" in refused(*again)
