"""Malformed messages never stop the recorder, `watch` or an analysis."""

import json
import math
import struct
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from brakeline.deploy.commands.watch_command import show_received
from brakeline.logs import segment
from brakeline.logs.foxglove import MOST_ACTORS, FoxgloveConverter
from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
from brakeline.logs.log_recovery import recover
from brakeline.logs.reader import open_log
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.logs.segment import MOST_CHANNELS, Entry
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.foxglove_server import FoxgloveServer
from brakeline.logs.watch.live_page_server import encode
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import EPISODE, EXCHANGE, FRAMES, HEALTH, LOG, RECORDED, STEP, Topic
from tests.fuzz.message_fuzzer import MessageFuzzer
from tests.logs.conftest import Say


def sample(topic: Topic, message: Any, source: str = "a") -> Sample:
    return Sample(topic, topic.at(robot="ground", source=source), message.SerializeToString(), 10**9)


HOSTILE = [
    sample(STEP, pb.Step(header=pb.Header(time=math.inf))),
    sample(STEP, pb.Step(header=pb.Header(time=1e300))),
    sample(LOG, pb.LogLine(header=pb.Header(wall_time=-1))),
    sample(FRAMES, pb.MavlinkFrames(frames=[pb.MavlinkFrame(wall_time=-1, raw=bytes(12))])),
    sample(EPISODE, pb.Episode(robot="ground", actor="a", obstacles=[pb.Obstacle(kind="box")])),
    Sample(STEP, "step/ground/a", b"\xff\xff", 10**9),
]


def record(path: Path, samples: list[Sample]) -> Recording:
    inbox = Inbox()
    recording = Recording(LogSettings(path, derive=FoxgloveConverter().from_sample), inbox)
    for one in samples:
        inbox.put(one)
    recording.finish()
    return recording


def test_the_recorder_stores_malformed_messages_and_goes_on(say: Say, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    good = say("log/a", pb.LogLine(text="after it"))
    recording = record(path, [*HOSTILE, good])
    assert recording.recorded.total() == len(HOSTILE) + 1
    log = open_log(path)
    payloads = {payload for _, _, _, payload in log.rows()}
    assert {one.payload for one in (*HOSTILE, good)} <= payloads and not log.cuts
    decoded = open_log(path)
    assert [record.message.text for record in decoded if record.topic == "log"][-1] == "after it"
    assert decoded.malformed >= 1


def test_more_keys_than_a_file_can_number_do_not_end_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MOST_CHANNELS < 2**16
    monkeypatch.setattr(segment, "MOST_CHANNELS", 50)
    rejected, inbox = RejectedMessages(), Inbox()
    for number in range(70):
        inbox.put(sample(LOG, pb.LogLine(text="x"), f"a{number}"))
    Recording(LogSettings(tmp_path / "run.mcap"), inbox, rejected).finish()
    assert sum(1 for _ in open_log(tmp_path).rows()) == 50 and rejected.count > 0


@pytest.mark.parametrize(("received", "published"), [(-1, 0), (0, -1), (2**64, 0), (0, 2**64)])
def test_an_entry_has_times_that_a_file_can_hold(received: int, published: int) -> None:
    with pytest.raises(ValueError, match="log/a"):
        Entry("log/a", pb.LogLine, b"", received, published, 0)


MALFORMED = [
    sample(EPISODE, pb.Episode(robot="ground", actor="a", obstacles=[pb.Obstacle(kind="box", position=[0.0, 0.0])])),
    sample(EPISODE, pb.Episode(robot="ground", actor="a", goal=[0.0, 0.0])),
    sample(STEP, pb.Step(robot="ground", actor="a")),
    sample(STEP, pb.Step(robot="ground", actor="a", state=[math.nan] * 5)),
    sample(STEP, pb.Step(robot="quadrotor", actor="q", state=[0.0])),
    sample(
        EXCHANGE, pb.Exchange(request=pb.Request(actor="b"), reply=pb.Reply(decision=pb.Decision(tube_center=[1.0])))
    ),
    sample(LOG, pb.LogLine(level="ERROR", text="\n")),
]


def test_watch_and_foxglove_go_on_after_hostile_messages(say: Say) -> None:
    fuzzer, board, rejected, inbox = MessageFuzzer(0), Dashboard(), RejectedMessages(), Inbox()
    drawn = [fuzzer.sample(topic) for _ in range(60) for topic in RECORDED]
    good = say("step/ground/b", pb.Step(robot="ground", actor="b", state=[1.0, 0.0, 0.0, 0.0, 0.0], index=1))
    with FoxgloveServer() as live:
        for frame in (b"\xff" * 1000, "[" * 50_000, '{"op": "subscribe", "subscriptions": [{"id": -1}]}', ""):
            with suppress(ConnectionClosed), connect(live.url, subprotocols=["foxglove.sdk.v1"]) as visit:  # type: ignore
                visit.send(frame)
                visit.recv(timeout=10.0)
        for one in (*HOSTILE, *MALFORMED, *drawn, good):
            inbox.put(one)
            show_received(inbox, board, live, rejected)
        with connect(live.url, subprotocols=["foxglove.sdk.v1"]) as visit:  # type: ignore
            assert json.loads(visit.recv(timeout=10.0))["op"] == "serverInfo"
            channels = json.loads(visit.recv(timeout=10.0))["channels"]
    assert good.key in {channel["topic"] for channel in channels}
    shown = {robot["actor"]: robot for robot in json.loads(encode(board.view()))["robots"]}
    assert shown["b"]["pose"] == [1.0, 0.0, 0.0] and rejected.count > 0


def test_a_crowd_of_actors_is_drawn_up_to_a_bound() -> None:
    converter = FoxgloveConverter()
    names = [f"a{number}" for number in range(MOST_ACTORS + 50)]
    episodes = [
        sample(EPISODE, pb.Episode(robot="ground", actor=name, goal=[1.0] * 2, start=[0.0] * 5), name) for name in names
    ]
    drawn = [bool(converter.from_sample(episode)) for episode in (*episodes, episodes[0])]
    assert drawn == [True] * MOST_ACTORS + [False] * 50 + [True] and converter.failures == 50


def test_an_analysis_counts_malformed_messages_and_goes_on(say: Say, tmp_path: Path) -> None:
    step = pb.Step(robot="ground", actor="b", state=[1.0, 0.0, 0.0, 0.0, 0.0], truncated=True)
    infinite = pb.Step(robot="ground", actor="a", state=[math.inf] * 5)
    record(tmp_path / "run.mcap", [*HOSTILE, *MALFORMED, sample(STEP, infinite), say("step/ground/b", step)])
    analysed = analyse_runs(tmp_path, AnalysisOptions(pictures=True))
    figures = analysed.figures()
    assert figures["actors"]["b"]["episodes"] == 1 and figures["malformed"] >= 5
    analysed.by_label()


def test_a_message_that_names_another_process_than_its_key_counts_for_nobody(say: Say, tmp_path: Path) -> None:
    """The recorder stores the bytes that it receives, also those that every other process refuses."""
    step = pb.Step(robot="ground", actor="b", state=[0.0] * 5)
    forged = pb.Step(robot="ground", actor="b", state=[0.0] * 5, step=1, collision=True, truncated=True)
    life = pb.Health(process="b", last=True)
    others = [sample(STEP, forged), sample(STEP, pb.Step(robot="quadrotor", actor="a")), sample(HEALTH, life)]
    record(tmp_path / "run.mcap", [say("step/ground/b", step), *others])
    figures = analyse_runs(tmp_path, AnalysisOptions()).figures()
    assert (figures["steps"], figures["collisions"], figures["malformed"]) == (1, 0, 3)
    assert list(figures["actors"]) == ["b"] and not figures["processes"]


def chunk_of(size: int, compression: str, frame: bytes) -> bytes:
    """Return the record of a chunk that declares `size` bytes."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(frame)) + frame
    return struct.pack("<BQ", 6, len(body)) + body


def packed(compression: str, said: bool) -> bytes:
    """Compress 64 MiB of zeros to a few kB; `said`: the frame declares its size."""
    zeros = bytes(2**26)
    if compression == "lz4":
        return bytes(lz4.frame.compress(zeros, store_size=said))
    return zstandard.ZstdCompressor(write_content_size=said).compress(zeros)


@pytest.mark.parametrize("said", [True, False])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("size", [0, 1000, 2**40])
def test_a_chunk_that_lies_about_its_size_is_damage_and_not_unpacked(
    compression: str, said: bool, size: int, tmp_path: Path, say: Say
) -> None:
    path = tmp_path / "run.mcap"
    record(path, [say("log/a", pb.LogLine(text="before"))])
    whole = path.read_bytes()
    bomb = chunk_of(size, compression, packed(compression, said))
    path.write_bytes(whole[:8] + bomb + whole[8:])
    tracemalloc.start()
    log = open_log(path)
    assert [record.message.text for record in log if record.topic == "log"] == ["before"]
    recovery = recover(path, tmp_path / "whole.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**23, f"{peak} bytes"
    assert [cut.lost for cut in log.cuts] == [len(bomb)] and recovery.lost == len(bomb)
