"""A segment has the received bytes, and every MCAP tool can read it."""

import json
from pathlib import Path

import pytest
from mcap.exceptions import DecoderNotFoundError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from brakeline.errors import LogError
from brakeline.logs.reader import by_run, find, open_log, read
from brakeline.logs.recorder import entry
from brakeline.logs.segment import BufferedFile, Entry, Segment, name_of, number_of, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from tests.full_disk import full_disk
from tests.logs.conftest import Say


def write(run: Path, *portions: list[Sample], finish: bool = True) -> Segment:
    segment = open_segment(run, {"run": {"method": "ddpc", "seed": "3"}, "configuration": {"json": "{}"}})
    for portion in portions:
        segment.save([entry(sample) for sample in portion])
    if finish:
        segment.finish()
    else:
        segment.abandon()
    return segment


def test_the_plain_reader_gives_the_same_bytes_and_its_decoder_the_same_values(tmp_path: Path, say: Say) -> None:
    step = say("step/ground/a", pb.Step(robot="ground", index=1, observation=[0.5, 0.25], decision=pb.ADJUSTED), 0.2)
    health = say("health/a", pb.Health(process="a", figures={"rate": 2.5}))
    write(tmp_path / "run.mcap", [step], [health])
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        stored = list(reader.iter_decoded_messages())
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 2
    assert [item.channel.topic for item in stored] == ["step/ground/a", "health/a"]
    assert [item.message.data for item in stored] == [step.payload, health.payload]
    assert [item.message.log_time for item in stored] == [step.received, health.received]
    assert stored[0].message.publish_time == 200_000_000, "simulated time where there is one"
    assert stored[1].message.publish_time == health.message().header.wall_time
    assert stored[0].schema is not None and stored[0].schema.name == "brakeline.Step"
    assert list(stored[0].decoded_message.observation) == [0.5, 0.25]
    assert stored[1].decoded_message.figures["rate"] == 2.5
    assert metadata["run"] == {"method": "ddpc", "seed": "3"}
    assert "simulated" in metadata["brakeline"]["publish_time"]


def test_our_reader_gives_the_messages_of_every_segment_in_order(tmp_path: Path, say: Say) -> None:
    run = tmp_path / "demo" / "run.mcap"
    lines = [say("log/a", pb.LogLine(text=str(number))) for number in range(30)]
    written = [write(run, [line]).path.name for line in lines[:12]]
    assert written[:3] == ["run.mcap", "run_0001.mcap", "run_0002.mcap"]
    for place in (run, run.parent, [run], str(run)):
        assert [record.message.text for record in read(place)] == [str(number) for number in range(12)]
    later = run.with_name("run_0011.mcap")
    record = next(read(later))
    assert (record.topic, record.key, record.message) == ("log", "log/a", lines[11].message())
    assert (record.log_time, record.publish_time) == (lines[11].received, lines[11].message().header.wall_time)


def test_names_of_segments() -> None:
    names = ("run.mcap", "run_0002.mcap", "run.2.mcap", "a.b.mcap", "a_12.mcap")
    numbers = [("run", 0), ("run", 2), ("run", 2), ("a.b", 0), ("a_12", 0)]
    assert [number_of(Path(name)) for name in names] == numbers
    first = [name_of("run.mcap", number) for number in range(200)]
    assert first == sorted(first)


def test_logs_named_by_date_are_runs_of_their_own(tmp_path: Path, say: Say) -> None:
    """The number in the file decides, not one in its name; many missing numbers are one line."""
    for name in ("log_20260101", "log_20260101", "flight_2025", "flight_2026", *["run"] * 9):
        write(tmp_path / f"{name}.mcap", [say("log/a", pb.LogLine(text=name))])
    found = {label: [path.name for path in paths] for label, paths in by_run(find(tmp_path)).items()}
    place = tmp_path.name
    assert found[f"{place}/log_20260101"] == ["log_20260101.mcap", "log_20260101_0001.mcap"]
    assert found[f"{place}/flight_2025"] == ["flight_2025.mcap"] and len(found) == 4
    assert [path.name for path in find(tmp_path / "log_20260101.mcap")] == found[f"{place}/log_20260101"]
    for number in (0, 1, 2, 5):
        (tmp_path / name_of("run.mcap", number)).unlink()
    log = open_log(tmp_path)
    assert len(list(log)) == 9
    missing = ["run.mcap to run_0002.mcap: these 3 segments are missing", "run_0005.mcap: this segment is missing"]
    assert [str(cut).removeprefix(f"{tmp_path}/") for cut in log.cuts] == missing


def test_a_file_counts_once_and_in_its_place_whatever_the_order_and_the_links(tmp_path: Path, say: Say) -> None:
    """`runs/*` also has the newest run as `runs/latest`."""
    for run in ("a", "b"):
        (tmp_path / run).mkdir()
        for _ in range(2):
            write(tmp_path / run / "run.mcap", [say("log/a", pb.LogLine(text=run))])
    (tmp_path / "latest").symlink_to("b")
    files = {"a": ["run.mcap", "run_0001.mcap"], "b": ["run.mcap", "run_0001.mcap"]}
    for given in (
        sorted(tmp_path.iterdir()),
        [tmp_path / "a", tmp_path / "b" / ".." / "b", tmp_path / "b"],
        [tmp_path / "a" / "run_0001.mcap", tmp_path / "latest" / "run_0001.mcap", tmp_path / "b", tmp_path / "a"],
    ):
        runs = by_run(find(given))
        assert {label: [path.name for path in paths] for label, paths in runs.items()} == files, given
        assert len(list(read(given))) == 4


def test_a_truncated_file_yields_its_intact_messages_and_reports_the_damage(tmp_path: Path, say: Say) -> None:
    run = tmp_path / "run.mcap"
    segment, ends = open_segment(run, {}), []
    for _ in range(5):
        segment.save([entry(say("log/a", pb.LogLine(text="x" * 50))) for _ in range(20)])
        ends.append(segment.size)
    segment.finish()
    whole = run.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in (*range(ends[1], ends[3] + 1, 37), *ends, len(whole) - 1):
        cut.write_bytes(whole[:size])
        log = open_log(cut)
        assert len(list(log)) >= 20 * sum(end <= size for end in ends), size
        assert len(log.cuts) == 1 and log.cuts[0].lost < size, size
    assert open_log(run).cuts == []


def test_a_segment_that_was_never_finished_is_read_in_full(tmp_path: Path, say: Say) -> None:
    write(tmp_path / "run.mcap", [say("log/a", pb.LogLine(text="1"))], finish=False)
    write(tmp_path / "run.mcap", [say("log/a", pb.LogLine(text="2"))])
    (tmp_path / "run_0002.mcap").touch()
    log = open_log(tmp_path)
    assert [record.message.text for record in log] == ["1", "2"]
    assert [cut.path.name for cut in log.cuts] == ["run.mcap", "run_0002.mcap"]
    assert "has no summary" in str(log.cuts[0])


def test_a_file_that_is_no_log_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no log at"):
        find(tmp_path)
    with pytest.raises(LogError, match="no log at"):
        list(read(tmp_path / "run.mcap"))
    (tmp_path / "text.mcap").write_text("a long story, but not a log")
    with pytest.raises(LogError, match="not an MCAP file"):
        list(read(tmp_path / "text.mcap"))


def documented(number: int, log: Path) -> str:
    """Return a Python block of the page about logs, which reads this log."""
    page = (Path(__file__).parents[2] / "docs" / "logs.md").read_text()
    return page.split("```python\n")[number + 1].split("```", 1)[0].replace("runs/latest/run.mcap", str(log))


def test_a_figure_of_ones_own_comes_from_the_steps_of_a_log(
    tmp_path: Path, say: Say, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = [
        pb.Step(robot="ground", actor="a", episode=episode, index=i + 1, proposed=[0.25, 0.0], action=[speed, 0.0])
        for i, (episode, speed) in enumerate([(0, 0.25), (0, 0.0), (1, 0.25)])
    ]
    other = say("health/a", pb.Health(process="a"))
    write(tmp_path / "run.mcap", [other, *(say("step/ground/a", step, 0.2) for step in steps)])
    exec(documented(1, tmp_path / "run.mcap"), {})
    assert capsys.readouterr().out.splitlines() == ["ground a 0 0.125", "ground a 1 0.0"]


def test_the_two_lines_of_the_documentation_read_json_channels_too(tmp_path: Path) -> None:
    """A flight's log has JSON channels, at which the strict reader stops."""
    segment = open_segment(tmp_path / "run.mcap", {})
    line, text = pb.LogLine(process="a").SerializeToString(), json.dumps({"type": 2}).encode()
    heartbeat = Entry("mavlink/1/1/HEARTBEAT", "application/json;mavlink", text, 2, 2, 0)
    segment.save([Entry("log/a", pb.LogLine, line, 1, 1, 1), heartbeat])
    segment.finish()
    with (tmp_path / "run.mcap").open("rb") as file, pytest.raises(DecoderNotFoundError):
        list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    code = documented(0, tmp_path / "run.mcap")
    seen: list[tuple[str, object]] = []
    exec(code.replace("print(channel.topic, value)", "seen.append((channel.topic, value))"), {"seen": seen})
    assert [topic for topic, _ in seen] == ["log/a", "mavlink/1/1/HEARTBEAT"] and seen[1][1] == {"type": 2}


def test_the_error_of_a_full_disk_lets_the_file_be_finished(tmp_path):
    """The error's traceback held the waiting bytes, and a log that was closed for the error raised another one."""
    with (tmp_path / "log").open("wb", buffering=0) as file:
        spool = BufferedFile(file)
        spool.write(bytes(5_000))
        with full_disk(1_000), pytest.raises(OSError, match="File too large"):
            try:
                spool.flush()
            finally:
                spool.write(b"the end")
        spool.flush()
    assert (tmp_path / "log").read_bytes() == bytes(5_000) + b"the end"
