"""Damaged files are repaired, and a recorder that is killed at any moment loses at most the last second."""

import json
import os
import random
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.decoder import DecoderFactory

from brakeline.deploy.cli import main
from brakeline.errors import LogError
from brakeline.logs.log_recovery import recover
from brakeline.logs.reader import Log, open_log
from brakeline.logs.recorder import LogSettings, Recording
from brakeline.logs.segment import being_written, open_segment
from brakeline.logs.segment_rotation import Rotation
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.topics import STEP
from tests.logs.conftest import Say, Start
from tests.logs.sample_log import ABOUT, Writer


def whole(path: Path) -> list[int]:
    """Return the sequence numbers of a file that the `mcap` package's seeking reader can read."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=["step/ground/actor-0", "step/ground/launcher"])
        numbers = [item.decoded_message.header.sequence for item in decoded]
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in reader.iter_messages())
        about = len(list(reader.iter_metadata()))
        assert about >= 2 or not numbers, "but for a file killed at its first moment"
    return numbers


def test_a_truncated_file_is_repaired_and_the_damage_is_reported(tmp_path: Path) -> None:
    writer = Writer(losses=0.0)
    for number in range(6):
        writer.episode("actor-0", number)
    source = writer.write(tmp_path / "source.mcap", portion=30)
    data, every = source.read_bytes(), whole(source)
    for place in (0.3, 0.5, 0.77, 0.9, 0.999):
        folder = tmp_path / str(place)
        folder.mkdir()
        path = folder / "run.mcap"
        path.write_bytes(data[: int(place * len(data))])
        expected = sum(1 for _ in open_log(path))
        recovered = recover(path)
        assert recovered.messages == expected == sum(1 for _ in open_log(path)) and open_log(path).cuts == []
        assert whole(path) == every[: len(whole(path))]
        assert recovered.kept is not None and recovered.kept.read_bytes() == data[: int(place * len(data))]
        assert "damaged file is" in str(recovered) and (recovered.lost > 0 or "summary" in recovered.cuts[0])
        again = recover(path)
        assert again.kept is None and "nothing to do" in str(again)
        assert sorted(item.name for item in folder.iterdir()) == ["run.mcap", "run.mcap.damaged"]


def test_everything_in_the_file_is_taken_over_that_of_others_too(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=200, compression=CompressionType.LZ4, index_types=IndexType.NONE)
        writer.start()
        schema = writer.register_schema("a.Type", "jsonschema", b"{}")
        channel = writer.register_channel("/theirs", "json", schema, {"unit": "m"})
        bare = writer.register_channel("/bare", "json", 0)
        writer.add_attachment(1, 2, "note.txt", "text/plain", b"hello")
        writer.add_metadata("about", {"x": "y"})
        for number in range(40):
            writer.add_message(channel, 10 + number, b'{"n": %d}' % number, 20 + number, number)
            writer.add_message(bare, 10 + number, b"{}", 0, number)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-30])
    recover(path)
    with path.open("rb") as file:
        reader = make_reader(file)
        stored = list(reader.iter_messages(topics=["/theirs"]))
        times = [(10 + number, 20 + number, number) for number in range(40)]
        assert [(m.log_time, m.publish_time, m.sequence) for _, _, m in stored] == times
        assert stored[0][0].name == "a.Type" and stored[0][1].metadata == {"unit": "m"}
        assert [a.data for a in reader.iter_attachments()] == [b"hello"]
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("about", {"x": "y"})]
        assert len(list(reader.iter_messages(topics=["/bare"]))) == 40


def test_a_file_that_is_being_recorded_or_is_no_log_is_not_changed(tmp_path: Path) -> None:
    segment = open_segment(tmp_path / "run.mcap", {})
    assert being_written(segment.path)
    with pytest.raises(LogError, match="is being recorded"):
        recover(segment.path)
    log = open_log(segment.path)
    assert list(log) == [] and "the file is being recorded" in str(log.cuts[0]) and log.segments[0].recording
    segment.finish()
    assert not being_written(segment.path)
    (tmp_path / "text.mcap").write_text("a long story, but not a log")
    with pytest.raises(LogError, match="not an MCAP file"):
        recover(tmp_path / "text.mcap")
    with pytest.raises(FileExistsError, match="exists already"):
        recover(segment.path, tmp_path / "text.mcap")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["run.mcap", "text.mcap"]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = Writer(losses=0.0)
    for _ in range(2):
        writer.episode("actor-0", 0)
        writer.write(tmp_path / "run.mcap")
    path = tmp_path / "run_0001.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    assert main(["recover", str(path), "--out", str(tmp_path / "out.mcap")]) == 0
    assert open_log(path).cuts == [] and list(open_log(path)) and open_log(tmp_path / "out.mcap")
    assert main(["recover", str(tmp_path / "run.mcap"), "--out", str(tmp_path / "first.mcap")]) == 0, "this file alone"
    said = capsys.readouterr().out
    assert "a copy of" in said and "run.mcap, which is intact" in said and "damaged file is" in said.splitlines()[0]
    assert len(list(open_log(tmp_path / "first.mcap"))) == len(list(Log((tmp_path / "run.mcap",))))
    (tmp_path / "first.mcap").unlink()
    assert main(["recover", str(tmp_path / "run.mcap"), "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    files = json.loads(lines[-1])["files"]
    assert [(item["kept"] is None, item["lost"] >= 0) for item in files] == [(True, True), (False, True)]
    assert main(["recover", str(tmp_path), "--out", "x"]) == 1


def test_files_rotate_by_size_and_by_time_and_each_is_whole(
    tmp_path: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("brakeline.logs.recorder.time.monotonic", lambda: now[0])
    inbox = Inbox()
    recording = Recording(LogSettings(tmp_path / "run.mcap", ABOUT, rotation=Rotation(0.02, 60.0)), inbox)
    for _ in range(12):
        inbox.put(say("log/a", pb.LogLine(text=os.urandom(2000).hex())))
        recording.save()
    by_size = len(list(tmp_path.glob("*.mcap")))
    assert 2 <= by_size <= 4
    now[0] += 61.0
    recording.save()
    assert len(list(tmp_path.glob("*.mcap"))) == by_size + 1, "by time"
    now[0] += 61.0
    recording.save()
    assert len(list(tmp_path.glob("*.mcap"))) == by_size + 1, "but none without a message"
    inbox.put(say("log/a", pb.LogLine(text="x")))
    recording.finish()
    paths = sorted(tmp_path.glob("*.mcap"))
    log = open_log(tmp_path)
    assert [record.message.header.sequence for record in log] == list(range(1, 14)) and log.cuts == []
    assert log.paths == tuple(paths), "the names sort"
    for number, path in enumerate(paths):
        alone = Log((path,))
        list(alone)
        assert alone.metadata["run"] == ABOUT["run"] and alone.metadata["brakeline"]["segment"] == str(number)
    with pytest.raises(ValueError, match="above 0"):
        Rotation(mib=0.0)


def test_killed_at_five_random_moments_nothing_older_than_a_second_is_missing(
    router: Bus, start: Start, tmp_path: Path
) -> None:
    """Files rotate all the time, so that some kills happen between the end of a file and the start of the next."""
    chance, publisher = random.Random(os.urandom(8)), router.publisher(STEP, robot="ground")
    folders = [tmp_path / str(number) for number in range(5)]  # of recorders of the same messages
    children = {folder: start(folder / "run.mcap", 0.02, 1.5) for folder in folders}
    dated, killed, begin = list[float](), dict[Path, float](), time.monotonic()
    for folder, after in sorted(((f, chance.uniform(0.2, 2.2)) for f in folders), key=lambda item: item[1]):
        while time.monotonic() < begin + after:
            publisher.put(pb.Step(observation=[chance.random() for _ in range(26)]))
            dated.append(time.monotonic())
            time.sleep(0.002)
        children[folder].kill()
        killed[folder] = time.monotonic()
    for folder, child in children.items():
        child.wait()
        found: list[int] = []
        for path in sorted(folder.glob("*.mcap")):
            recover(path)
            found += whole(path)
        assert found == list(range(1, 1 + len(found))), "none is missing in between, or twice"
        old = sum(at < killed[folder] - 1.0 for at in dated)
        assert len(found) >= old, f"{folder}: {old - len(found)} older than a second are missing"
