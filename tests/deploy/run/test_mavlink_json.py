"""Test MAVLink frames in the log: the received bytes, and JSON that other programs can read."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from brakeline.actors.mavlink.frame_recorder import FrameRecorder
from brakeline.actors.mavlink.lockstep_quadrotor import LockstepQuadrotor
from brakeline.deploy.run.log_contents import ENCODING, frames_as_json
from brakeline.errors import ExportError, Malformed
from brakeline.logs.log_export import to_tlog
from brakeline.logs.reader import open_log, read
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.topics import FRAMES, LOG
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.quadrotor import Quadrotor
from tests.arenas import staged_arena
from tests.robots import QUADROTOR


class Bus:
    """Puts what is published into a recorder's inbox."""

    def __init__(self) -> None:
        self.inbox, self.messages = Inbox(), list[pb.MavlinkFrames]()

    def put(self, message: pb.MavlinkFrames) -> None:
        self.messages.append(message)
        payload = message.SerializeToString()
        self.inbox.put(Sample(FRAMES, "frames/quadrotor/actor-0", payload, 10**18 + len(self.messages)))


def taped(periods: int) -> Bus:
    """What a vehicle in memory says in its first periods."""
    arena = staged_arena(start=(0.0, 0.0, 50.0), goal=(9.0, 9.0, 50.0), half_width=100.0, height=100.0)
    bus = Bus()
    tape = FrameRecorder(bus, "quadrotor", "actor-0")
    vehicle = LockstepQuadrotor(
        Autopilot(Quadrotor(arena, np.random.default_rng(0)), quiet=True), QUADROTOR, tape.record
    )
    for _ in range(periods):
        vehicle.step(np.array([0.5, 0.25, 0.0]))
        tape.publish()
    return bus


def test_a_recorder_stores_bytes_and_json(tmp_path: Path) -> None:
    bus = taped(3)
    recording = Recording(LogSettings(tmp_path / "run.mcap", derive=frames_as_json), bus.inbox)
    recording.save()
    recording.finish()

    stored = [record.message for record in read(tmp_path)]
    assert stored == bus.messages, "what describes itself is no message of ours"
    frames = [frame for message in stored for frame in message.frames]
    with (tmp_path / "run.mcap").open("rb") as file:
        rows = [(channel, message) for _, channel, message in make_reader(file).iter_messages()]
    entries = [(c.topic, json.loads(m.data), m.publish_time) for c, m in rows if c.message_encoding == ENCODING]
    assert len(entries) == len(frames) and {c.schema_id for c, _ in rows if c.message_encoding == ENCODING} == {0}
    for frame in frames:  # MAVLink 2: sequence, system, component are bytes 4 to 6
        assert any(
            content["header"] == {"sequence": frame.raw[4], "system_id": frame.raw[5], "component_id": frame.raw[6]}
            and time == frame.wall_time
            for _, content, time in entries
        )
    setpoint = next(content for key, content, _ in entries if key == "mavlink/245/191/SET_POSITION_TARGET_LOCAL_NED")
    assert setpoint["message"]["type"] == "SET_POSITION_TARGET_LOCAL_NED"
    assert any(content["message"]["vy"] == 0.5 for key, content, _ in entries if key.endswith("TARGET_LOCAL_NED"))

    with (tmp_path / "a.tlog").open("wb") as file:
        assert to_tlog(open_log(tmp_path), file) == len(frames)
    expected = b"".join((f.wall_time // 1000).to_bytes(8, "big") + f.raw for f in frames)
    assert (tmp_path / "a.tlog").read_bytes() == expected


def test_a_tlog_of_a_log_without_frames_fails_with_what_to_do(log: Path, tmp_path: Path) -> None:
    with (tmp_path / "a.tlog").open("wb") as file, pytest.raises(ExportError, match="--mavlink"):
        to_tlog(open_log(log), file)


def test_bytes_that_are_no_frame_are_left_out() -> None:
    line = Sample(LOG, "log/a", pb.LogLine(text="x").SerializeToString(), 1)
    assert frames_as_json(line) == []
    garbage = pb.MavlinkFrames(frames=[pb.MavlinkFrame(wall_time=1, raw=b"\xfd\x00no frame")])
    assert frames_as_json(Sample(FRAMES, "frames/a/b", garbage.SerializeToString(), 1)) == []
    with pytest.raises(Malformed):
        frames_as_json(Sample(FRAMES, "frames/a/b", b"\xff\xff", 1))
