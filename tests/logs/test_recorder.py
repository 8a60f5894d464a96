"""The recorder over a real bus, killed, and on a disk that fills up."""

import errno
import itertools
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from mcap.reader import make_reader

from brakeline.logs import recorder
from brakeline.logs.metrics import Metrics
from brakeline.logs.reader import open_log, read
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.logs.segment import BufferedFile, Entry
from brakeline.logs.segment_rotation import Rotation
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.topics import EPISODE, EXCHANGE, LEARNER, LOG, STEP
from tests.faults.failing_calls import Died, failing, full
from tests.logs.conftest import Say, Start


def test_the_log_holds_as_many_messages_per_topic_as_were_published(router: Bus, start: Start, tmp_path: Path) -> None:
    recorder = start(tmp_path / "run.mcap")
    settings = BusSettings(connect=router.settings.listen)
    messages: list[tuple[Any, Any]] = [(STEP, pb.Step()), (EPISODE, pb.Episode()), (EXCHANGE, pb.Exchange())]
    with Bus(settings, "actor-0") as one, Bus(settings, "actor-1") as two, Bus(settings, "learner") as learner:
        for number in range(300):
            for actor in (one, two):
                for topic, message in messages[: 3 if number % 10 == 0 else 1]:
                    actor.publisher(topic, robot="ground").put(message)
            learner.publisher(LEARNER, robot="ground").put(pb.LearnerMetrics(updates=number))
            learner.publisher(LOG).put(pb.LogLine(text="a line"))
        published = one.published() | two.published() | learner.published()
    recorder.send_signal(signal.SIGTERM)
    assert recorder.wait(10.0) == 0
    log = open_log(tmp_path)
    records = list(log)
    recorded = Counter(record.key for record in records if not record.key.endswith("/recorder"))
    assert recorded == published
    assert published["step/ground/actor-0"] == 300 and published["exchange/ground/actor-1"] == 30
    assert log.cuts == []
    assert log.metadata["run"] == {"method": "none"}
    metrics = Metrics()
    for record in records:
        metrics.add(record.key, record.message)
    topics = metrics.topics()
    assert not any(counts["missing"] or counts["duplicates"] for counts in topics.values())


class SmallDisk:
    """Files that share `free` bytes, like a full disk: a write takes what fits and then fails."""

    def __init__(self, free: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free = free
        monkeypatch.setattr("brakeline.logs.segment.BufferedFile", lambda file: BufferedFile(Quota(self, file)))


class Quota:
    def __init__(self, disk: SmallDisk, file: BinaryIO) -> None:
        self.disk, self.file, self.size = disk, file, 0

    def write(self, data: memoryview) -> int:
        if self.disk.free == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken = min(len(data), self.disk.free)
        self.file.write(data[:taken])
        self.disk.free -= taken
        self.size += taken
        return taken

    def seek(self, place: int) -> int:
        return self.file.seek(place)

    def truncate(self, size: int) -> None:
        self.file.truncate(size)
        self.disk.free += self.size - size
        self.size = size


def test_recording_survives_a_full_disk_and_resumes(
    tmp_path: Path, say: Say, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr("brakeline.logs.recorder.RETRY", 0.0)
    disk = SmallDisk(30_000, monkeypatch)
    inbox = Inbox(limit=100_000)
    recording = Recording(LogSettings(tmp_path / "run.mcap"), inbox)
    lines = [say("log/a", pb.LogLine(text=os.urandom(500).hex())) for _ in range(300)]
    for number, line in enumerate(lines):
        if number == 290:
            disk.free = 10_000_000
        inbox.put(line)
        recording.save()
        saved = recording.recorded["log/a"]
        assert saved * 1000 + inbox.bytes + inbox.dropped["log/a"] * 1000 >= number * 1000, "none is lost silently"
    assert recording.failure == ""
    recording.finish()
    recorded = [record.message for record in read(tmp_path)]
    assert len(recorded) == recording.recorded.total() == 300 - inbox.dropped.total()
    assert 0 < inbox.dropped.total() < 250
    sequences = [message.header.sequence for message in recorded]
    assert sequences == sorted(set(sequences))
    assert sequences[-9:] == list(range(292, 301))
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == ["run.mcap", "run_0001.mcap"]
    assert "NOT RECORDING" in caplog.text and "No space left" in caplog.text
    assert "messages were dropped" in caplog.text
    levels = [line.levelname for line in caplog.records if "recording to" in line.message]
    assert levels[0] == "INFO" and set(levels[1:]) == {"WARNING"}  # more than one where only a header still fitted


@pytest.mark.parametrize("error", [full, Died])
def test_a_full_disk_or_a_kill_at_any_call_loses_nothing_without_a_word(
    tmp_path: Path, say: Say, monkeypatch: pytest.MonkeyPatch, error: Callable[[], BaseException]
) -> None:
    monkeypatch.setattr("brakeline.logs.recorder.RETRY", 0.0)
    lines = [say("log/a", pb.LogLine(text=f"line {number}")) for number in range(12)]
    failed = set()
    for at in itertools.count():
        folder = tmp_path / str(at)
        inbox = Inbox()
        settings = LogSettings(folder / "run.mcap", rotation=Rotation(mib=1e-4))
        recording = Recording(settings, inbox)
        with failing(folder, at, error) as disk, suppress(Died):
            for line in lines[:3]:
                inbox.put(line)
                recording.save()
        if len(disk.seen) <= at:
            if error is full:
                recording.finish()
            break
        failed.add(disk.seen[at])
        recorded = recording.recorded.total()
        if error is Died:  # another recorder goes on, with what it hears
            inbox = Inbox()
            recording = Recording(settings, inbox)
        for line in lines[8:]:
            inbox.put(line)
        recording.finish()
        log = open_log(folder)
        numbers = [record.message.header.sequence for record in log]
        if error is full:
            assert numbers[-4:] == [9, 10, 11, 12] and set(numbers) >= {1, 2, 3}, (at, disk.seen)
        assert numbers == sorted(set(numbers)) and set(range(1, recorded + 1)) <= set(numbers)
        assert numbers[-4:] == [9, 10, 11, 12]
    assert {"mkdir", "open", "write"} <= failed


def test_a_disk_that_stays_full_is_reported_at_the_end(
    tmp_path: Path, say: Say, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    SmallDisk(0, monkeypatch)
    inbox = Inbox()
    recording = Recording(LogSettings(tmp_path / "run.mcap"), inbox)
    inbox.put(say("log/a", pb.LogLine(text="x")))
    recording.finish()
    assert "could not be recorded" in caplog.text
    assert inbox.dropped == {"log/a": 1} and not inbox.bytes, "Health says how many"
    assert list(tmp_path.glob("*.mcap")) == []
    assert "No space left" in recording.failure


def test_pictures_that_take_too_long_cost_no_message(
    tmp_path: Path, say: Say, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder fell behind because of its drawing; at the end of the run it was killed with all waiting messages."""
    monkeypatch.setattr(recorder, "MOST_DRAWING", 0.1)

    def drawn(sample: Sample) -> list[Entry]:
        time.sleep(0.03)
        return [Entry(f"picture/{sample.key}", pb.LogLine, sample.payload, sample.received, sample.received, 0)]

    inbox = Inbox()
    recording = Recording(LogSettings(tmp_path / "run.mcap", derive=drawn), inbox)
    for number in range(100):
        inbox.put(say("log/a", pb.LogLine(text=f"{number}")))
    recording.finish()
    with (tmp_path / "run.mcap").open("rb") as file:
        topics = Counter(channel.topic.partition("/")[0] for _, channel, _ in make_reader(file).iter_messages())
    assert topics["log"] == 100 and topics["picture"] == 100 - recording.undrawn > 0
    assert recording.undrawn > 80 and caplog.text.count("without scenes") == 1


def test_a_folder_that_cannot_be_written_is_a_failure_too(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    recording = Recording(LogSettings(tmp_path / "file" / "run.mcap"), Inbox())
    recording.save()
    assert "Not a directory" in recording.failure or "File exists" in recording.failure
