"""No bit of a finished log can be flipped without a word: chunks, metadata, attachments and summary have checksums."""

from pathlib import Path
from random import Random

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from brakeline.errors import LogError
from brakeline.logs.log_recovery import recover
from brakeline.logs.mcap_container import MAGIC
from brakeline.logs.reader import count_by_key, open_log
from brakeline.logs.segment import Entry, Segment, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from tests.fuzz.mutations import flipped
from tests.logs.sample_log import written

KEY = "step/ground/a"
KINDS = {KEY: pb.Step, "log/b": pb.LogLine}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    steps = ((KEY, pb.Step(actor="a", step=number), 10**18 + number) for number in range(30))
    return written(tmp_path / "run.mcap", steps, {"run": {"seed": "7"}}, {"model/ground/x": bytes(100)})


def test_each_flipped_bit_is_named(path: Path) -> None:
    log = open_log(path)
    assert len(list(log)) == 30 and log.cuts == [], "whole, there is no damage"
    whole, random = path.read_bytes(), Random(0)
    chunk = [at for at in range(len(whole)) if whole.startswith(b"zstd", at)][5]
    path.write_bytes(flipped(whole, chunk + 40, 3))
    log = open_log(path)
    assert len(list(log)) == log.segments[0].messages == 29 and log.cuts[0].lost > 0, "only that chunk is lost"
    index = whole.index(bytes([Opcode.MESSAGE_INDEX]) + (22).to_bytes(8, "little"))  # of a chunk with one message
    assert Opcode.MESSAGE_INDEX ^ Opcode.MESSAGE == 1 << 1, "one bit makes it a message"
    places = [*(random.randrange(len(whole)) for _ in range(150)), whole.index(b"seed"), len(whole) - 1]
    for place, bit in [(index, 1), *((place, random.randrange(8)) for place in places)]:
        path.write_bytes(flipped(whole, place, bit))
        log = open_log(path)
        try:
            read = len(list(log))
        except LogError as error:
            assert place < len(MAGIC) and "run.mcap" in str(error)
            continue
        assert log.cuts and all("run.mcap" in str(cut) for cut in log.cuts), place
        assert read <= 30


def test_a_damaged_first_chunk_costs_only_its_own_messages(path: Path) -> None:
    """It declares the channels. The summary repeats them, and the metadata do if the recorder was killed."""
    other = ((f"log/{'bcd'[number]}", pb.LogLine(text=str(number)), 10**18 + 30 + number) for number in range(3))
    steps = ((KEY, pb.Step(actor="a", step=number), 10**18 + number) for number in range(30))
    written(path.with_name("two.mcap"), (*steps, *other))
    whole = path.with_name("two.mcap").read_bytes()
    changed = flipped(whole, whole.index(b"zstd") + 40, 3)
    path.write_bytes(changed)
    log = open_log(path)
    assert [record.message.step for record in log if record.topic == "step"] == list(range(1, 30))
    assert len(log.cuts) == 1 and log.cuts[0].lost > 100
    repaired = recover(path)
    assert repaired.messages == sum(1 for _ in open_log(path)) == 32 and open_log(path).cuts == []
    path.write_bytes(changed[: changed.rindex(b"zstd")])  # in the summary
    log = open_log(path)
    keys = ["log/b", "log/c", "log/d"]
    assert [record.message.step for record in log if record.topic == "step"] == list(range(1, 30))
    assert len(log.cuts) == 2 and "no summary" not in str(log.cuts[0])
    path.with_name("run.mcap.damaged").unlink()
    assert recover(path).messages == 32 and [record.key for record in open_log(path)] == [KEY] * 29 + keys
    with path.open("rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [item.decoded_message.step for item in decoded if item.channel.topic == KEY] == list(range(1, 30))


@pytest.mark.parametrize("finished", [True, False])
def test_a_channel_whose_schema_was_in_a_damaged_chunk_is_read(path: Path, finished: bool) -> None:
    segment = open_segment(path.with_name("lines.mcap"), {})
    for key in ("log/a", "log/b"):
        segment.save([Entry(key, pb.LogLine, pb.LogLine(text=key).SerializeToString(), 1, 1, 1)])
    segment.finish() if finished else segment.abandon()
    whole = segment.path.read_bytes()
    segment.path.write_bytes(flipped(whole, whole.index(b"zstd") + 40, 3))
    assert [record.message.text for record in open_log(segment.path)] == ["log/b"]


def test_messages_of_an_undeclared_channel_do_not_hide_the_rest_of_their_chunk(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Logs of earlier versions have no topics in their metadata."""
    monkeypatch.setattr(Segment, "_declare", lambda self, entries: None)
    segment = open_segment(path.with_name("mixed.mcap"), {})
    for portion in ((KEY,), ("log/b", KEY), (KEY, "log/b")):
        segment.save(Entry(key, KINDS[key], KINDS[key]().SerializeToString(), 1, 1, 1) for key in portion)
    segment.abandon()
    whole = segment.path.read_bytes()
    segment.path.write_bytes(flipped(whole, whole.index(b"zstd") + 40, 3))
    log = open_log(segment.path)
    assert [record.key for record in log] == ["log/b", "log/b"]
    assert sum("undeclared channel 1" in str(cut) for cut in log.cuts) == 2


def test_counts_by_the_summary_are_right_or_by_the_messages(path: Path) -> None:
    assert count_by_key(path) == {KEY: 30}
    whole, random = path.read_bytes(), Random(1)
    summary = whole.rindex(b"seed")
    for _ in range(40):
        path.write_bytes(flipped(whole, random.randrange(summary, len(whole)), random.randrange(8)))
        assert count_by_key(path)[KEY] <= 30
    path.write_bytes(whole[:-1])
    assert count_by_key(path) == {KEY: 30}


def test_a_chunk_with_an_absurd_length_is_damage(path: Path) -> None:
    whole = path.read_bytes()
    name = whole.index(b"zstd")  # the chunk's compression, before the length of its records
    path.write_bytes(whole[: name + 4] + b"\xff" * 8 + whole[name + 12 :])
    log = open_log(path)
    assert [record.message.step for record in log] == list(range(1, 30)) and log.cuts
