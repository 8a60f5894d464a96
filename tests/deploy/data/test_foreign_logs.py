"""Other people's logs: tools take over from each other, damaged logs are read, parsers are confined."""

import math
import os
import shutil
import struct
import subprocess
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin

from brakeline.actors.mavlink.ardupilot_dialect import mavlink as dialect
from brakeline.deploy.cli import main
from brakeline.deploy.data.importer import OWN, reader_of, tables_of
from brakeline.deploy.data.sources import isolated_reader
from brakeline.deploy.data.sources.isolated_reader import ReadLimits, read_here, read_isolated
from brakeline.deploy.data.sources.source_table import notes_of
from brakeline.deploy.data.sources.tlog_file import KINDS, SENT
from brakeline.deploy.interpreter import PYTHON
from brakeline.errors import LogError, NoSource
from brakeline.logs.log_recovery import recover
from brakeline.logs.reader import open_log
from tests.deploy.data.bags import write_bag, write_bin, write_ros1_bag, write_text_log
from tests.deploy.data.porter import FILE, drive
from tests.logs.sample_log import Writer

BAG = "ros_bag:read"


@pytest.fixture(scope="module")
def driven():
    return drive(seconds=20.0)


@pytest.fixture(scope="module")
def bags(driven, tmp_path_factory):
    """The same drive as bags of every kind."""
    folder = tmp_path_factory.mktemp("bags")
    write_bag(folder / "mcap", *driven, storage=StoragePlugin.MCAP)
    write_bag(folder / "sqlite", *driven)
    write_ros1_bag(folder / "ros1.bag", *driven)
    for compression in Writer1.CompressionFormat:
        write_ros1_bag(folder / f"{compression.name}.bag", *driven, compression=compression)
    return folder


def seconds(tables) -> float:
    return max(float(table.time[-1]) for table in tables)


def odometry(tables):
    return next(table for table in tables if table.name == "/odom")


# --- tools take over from each other -----------------------------------------------------------------------------


def test_a_recovered_bag_is_still_a_bag(bags, tmp_path):
    cut = tmp_path / "cut.mcap"
    data = (bags / "mcap" / "mcap.mcap").read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    recover(cut)
    with cut.open("rb") as file:
        assert make_reader(file).get_header().profile == "ros2"
    assert reader_of(cut) == BAG and 5.0 < seconds(tables_of(cut)) < 19.0


def test_a_bag_is_recognised_by_its_messages_and_a_run_by_its_own(bags, tmp_path):
    nameless = tmp_path / "nameless.mcap"
    named, profile = (bags / "mcap" / "mcap.mcap").read_bytes(), b"\x04\x00\x00\x00ros2"
    nameless.write_bytes(named.replace(profile, profile.replace(b"ros2", b"    ")))
    assert reader_of(nameless) == BAG
    writer = Writer(losses=0.0)
    writer.episode("actor-0", 0)
    assert reader_of(writer.write(tmp_path / "run.mcap")) == OWN


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_a_bag_without_its_metadata_is_read(bags, tmp_path, kind):
    folder = shutil.copytree(bags / kind, tmp_path / kind)
    whole = odometry(tables_of(folder))
    (folder / "metadata.yaml").unlink()
    table = odometry(read_here(reader_of(folder), folder))
    assert np.array_equal(table.time, whole.time) and notes_of([table]) == ()


def test_commands_for_logs_of_runs_name_the_one_for_bags(bags, capsys):
    path = bags / "mcap" / "mcap.mcap"
    with pytest.raises(LogError, match=r"is a ROS bag.* `brakeline import"):
        list(open_log(path))
    for command in (["analyse", str(path)], ["export", str(path), "--csv", "/dev/null"]):
        assert main(command) == 1
        assert "read it with `brakeline import" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(LogError, match=r"brakeline import. reads damaged logs of other formats"):
        recover(bags / "ros1.bag")


def test_a_log_of_a_run_without_the_robot_says_what_it_holds_and_what_is_lost(tmp_path, capsys):
    writer = Writer(losses=0.0)
    writer.episode("actor-0", 0)
    path = writer.write(tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes()[:-60])
    assert main(["import", str(path), "--robot", str(FILE)]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "no trajectory of porter" in said and "of step/ground/actor-0" in said and "brakeline analyse" in said
    assert "summary" in said or "cannot be read" in said
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert main(["robot", "new", str(tmp_path / "a.toml"), "--from", str(empty)]) == 1
    assert "brakeline robot new" in " ".join(capsys.readouterr().err.split())


# --- damaged logs, as far as they go ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mcap/mcap.mcap", "sqlite/sqlite.db3", "ros1.bag", "BZ2.bag", "LZ4.bag"])
def test_a_cut_bag_is_read_up_to_the_cut_and_says_so(bags, tmp_path, name):
    whole = odometry(read_here(BAG, bags / name))
    assert not whole.notes and len(whole.time) == 1000
    data = (bags / name).read_bytes()
    cut = tmp_path / Path(name).name
    cut.write_bytes(data[: int(0.6 * len(data))])
    tables = read_here(BAG, cut)
    table = odometry(tables)
    assert 100 < len(table.time) < 900
    assert np.array_equal(table.columns["position.x"], whole.columns["position.x"][: len(table.time)])
    notes = notes_of(tables)
    assert notes and all(str(cut) in note for note in notes)
    assert any("lost" in note or "cannot be read" in note for note in notes), notes


@pytest.mark.parametrize("write", [write_bin, write_text_log])
def test_a_cut_log_of_an_autopilot_is_read(driven, tmp_path, write):
    path = write(tmp_path / ("a.bin" if write is write_bin else "a.log"), *driven)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 - 5])
    assert 8.0 < seconds(read_here("ardupilot_log:read", path)) < 12.0


def test_damaged_bytes_cost_the_messages_around_them(bags, tmp_path, driven):
    data = bytearray((bags / "ros1.bag").read_bytes())
    at = data.index(b"nav_msgs/Odometry")
    place = data.index(b"odom", at + 20_000)
    data[place - 4 : place] = b"\xff\xff\xff\x7f"  # the length of a frame's name
    path = tmp_path / "a.bag"
    path.write_bytes(data)
    tables = read_here(BAG, path)
    assert len(odometry(tables).time) == 999
    assert "1 messages are left out: /odom cannot be decoded" in tables[0].notes[0]


def test_impossible_stamps_are_left_out(driven, tmp_path):
    path = write_bin(tmp_path / "a.bin", *driven)
    data = bytearray(path.read_bytes())
    at = data.index(b"\xa3\x95\x0a", 3 * len(data) // 4)
    data[at + 3 : at + 11] = b"\xff" * 8
    path.write_bytes(data)
    tables = read_here("ardupilot_log:read", path)
    assert seconds(tables) < 21.0 and "1 messages with impossible time stamps are left out" in tables[0].notes[0]


def test_velocities_of_setpoints_are_of_the_frame_that_they_name():
    """North 1 m/s, or ahead 1 m/s; of any other frame nothing is known."""
    world, body = ("LOCAL_NED", "LOCAL_OFFSET_NED"), ("BODY_NED", "BODY_OFFSET_NED", "BODY_FRD")
    frames = [getattr(dialect, f"MAV_FRAME_{name}") for name in (*world, *body, "LOCAL_FLU", "GLOBAL")]
    columns = {name: np.zeros(len(frames)) for name in ("type_mask", "vy", "vz", "yaw_rate")}
    setpoints = KINDS[SENT].quantities(columns | {"vx": np.ones(len(frames)), "coordinate_frame": np.array(frames)})
    nan = [math.nan]
    np.testing.assert_array_equal(setpoints["command.velocity.y"], [*[1.0] * 2, *nan * 5])
    np.testing.assert_array_equal(setpoints["command.body.x"], [*nan * 2, *[1.0] * 3, *nan * 2])


def test_a_vehicle_that_restarts_its_clock_is_dated_in_parts(tmp_path):
    vehicle, out = dialect.MAVLink(None, srcSystem=1, srcComponent=1), bytearray()
    for k in range(200):
        stamp = 20 * (k if k < 100 else k - 80)
        message = dialect.MAVLink_local_position_ned_message(stamp, 0.0, 0.1 * k, *[0.0] * 4)
        out += struct.pack(">Q", 10**15 + 20_000 * k) + message.pack(vehicle)
    path = tmp_path / "a.tlog"
    path.write_bytes(out)
    (table,) = read_here("tlog_file:read", path)
    assert np.allclose(table.time, 0.02 * np.arange(200))
    assert np.allclose(table.columns["position.x"], 0.1 * np.arange(200))
    assert "step back 1 times" in table.notes[0]


# --- parsers are confined -----------------------------------------------------------------------------------------


@pytest.fixture
def parser(tmp_path, monkeypatch):
    """Plant a parser for the process that reads: its source is run in the place of a real reader."""

    def plant(source: str) -> str:
        (tmp_path / "sitecustomize.py").write_text(
            "import sys, types\n"
            f"module = types.ModuleType('{isolated_reader.__package__}.planted')\n"
            f"exec({source!r}, module.__dict__)\n"
            f"sys.modules[module.__name__] = module\n"
        )
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        return "planted:read"

    return plant


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("def read(path):\n while True: pass", "takes more than .* s.*--read-seconds"),
        ("import time\ndef read(path): time.sleep(60)", "takes more than .* s.*--read-seconds"),
        ("def read(path): return [bytearray(2**30)]", r"takes more than 0.5 GiB of memory.*--read-gib"),
        ("def read(path): return {}[path.name]", "its reader stopped with KeyError: 'a.log'"),
        ("def read(path): return read(path)", "its reader stopped with RecursionError"),
        ("def read(path): raise PermissionError(13, 'Permission denied', str(path))", "you may not read it .*copy it"),
        ("import os, signal\ndef read(path): os.kill(os.getpid(), signal.SIGSEGV)", r"crashed \(SIGSEGV\)"),
        ("import os\ndef read(path): os._exit(3)", r"crashed \(status 3\)"),
    ],
)
def test_a_parser_that_hangs_fills_the_memory_or_crashes_ends_with_one_error(
    tmp_path, parser, source, said, monkeypatch
):
    monkeypatch.setattr(isolated_reader, "WAITING", 0.0 if "sleep" in source else 600.0)
    path = tmp_path / "a.log"
    path.write_bytes(b"")
    limits = ReadLimits(0.4 if "seconds" in said else 2.0, 0.5)
    with pytest.raises(NoSource, match=f"a.log: .*{said}"):
        read_isolated(parser(source), path, limits)


def test_a_missing_package_stays_a_missing_package(tmp_path, parser):
    with pytest.raises(ModuleNotFoundError) as caught:
        read_isolated(parser("def read(path): import pyulog.none"), tmp_path, ReadLimits(1.0, 0.5))
    assert caught.value.name == "pyulog.none"


def test_tables_come_back_as_they_were_read(bags):
    here, back = read_here(BAG, bags / "ros1.bag"), read_isolated(BAG, bags / "ros1.bag", ReadLimits())
    for one, other in zip(here, back, strict=True):
        assert one.columns.keys() == other.columns.keys()
        assert all(np.array_equal(one.columns[name], other.columns[name], equal_nan=True) for name in one.columns)
        for name in {field.name for field in fields(one)} - {"columns"}:
            value, same = getattr(one, name), getattr(other, name)
            assert np.array_equal(value, same) if isinstance(value, np.ndarray) else value == same, name


def test_a_lower_limit_of_the_user_holds():
    program = (
        "import resource, sys\nfrom pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30,) * 2)\n"
        "from brakeline.deploy.data.sources.isolated_reader import USUAL_LIMITS, read_isolated\n"
        "print(len(read_isolated('tlog_file:read', Path(sys.argv[1]), USUAL_LIMITS)))"
    )
    log = Path(__file__).parent / "flown" / "copter.tlog"
    assert int(subprocess.check_output([*PYTHON, "-c", program, str(log)])) > 2


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(NoSource, match="neither a file nor a folder"):
        tables_of(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="--read-gib above 0"):
        ReadLimits(gib=0.0)
