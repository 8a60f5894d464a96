"""Test the keys that the command makes and divides, in processes that are started alone."""

import os

from brakeline.actors.ros2.ros2_process import Ros2Settings
from brakeline.deploy.commands.ros2_command import Ros2Command
from brakeline.deploy.data.data_paths import method_path
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND
from tests.system.runs import brakeline
from tests.waiting import until


def test_a_service_with_the_keys_that_were_handed_out_to_it(start, data_folder, tmp_path, monkeypatch):
    keys, parts, endpoint = tmp_path / "keys", tmp_path / "parts", free_endpoint("tls")
    done = brakeline("keys", keys, "safety", "client", "viewer", "actor-0", "certify", "--hand-out", parts)
    assert done.returncode == 0, done.stderr
    names = {"ca.pem", "safety.pem", "safety.key", "names", "vouchers.key", "signers"}
    assert {path.name for path in (parts / "safety").iterdir()} == names
    assert {path.name for path in (parts / "actor-0").iterdir()} == {"ca.pem", "actor-0.pem", "actor-0.key"}
    assert not list(parts.rglob("ca.key")) and (parts / "certify" / "signer.key").exists()

    model = method_path(GROUND, "ddpc", ModelConfig())
    unsigned = brakeline("safety", "ground", "--listen", endpoint, "--keys", parts / "safety")
    assert unsigned.returncode == 1 and "no seal" in unsigned.stderr and "Traceback" not in unsigned.stderr
    signed = brakeline("keys", parts / "certify", "--sign", model)
    assert signed.returncode == 0, signed.stderr
    try:
        start("safety", "ground", "--listen", endpoint, "--keys", parts / "safety")
        with Bus(BusSettings(connect=(endpoint,), keys=parts / "viewer", patience=60.0), "viewer") as bus:
            until(lambda: "safety" in bus.living(), "the service lives")
        monkeypatch.setitem(os.environ, "BRAKELINE_KEYS", str(parts / "client"))
        answer = brakeline("query", "ground", "--connect", endpoint, "--known-free", "--timeout", 10, "--json")
        assert answer.returncode == 0 and '"kind": "allowed"' in answer.stdout, answer.stderr
        stranger = brakeline("query", "ground", "--known-free", "--connect", endpoint, "--keys", parts / "actor-0")
        assert stranger.returncode == 1 and "no keys of client" in stranger.stderr
        node = Ros2Command(connect=(endpoint,), keys=parts / "client")
        with node._asker(Ros2Settings("ground", lead=30.0)) as question:
            (reply,) = question([pb.Request(robot="ground")])
        assert reply.error.field == "plan", "a ROS robot's questions are heard, and this one was empty"
    finally:
        model.with_suffix(".seal").unlink()
