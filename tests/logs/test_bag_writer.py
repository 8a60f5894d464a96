"""Bags read back by other readers: complete ones, incomplete ones, and ones of a full disk."""

from types import SimpleNamespace

import pytest
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from brakeline.logs import bag_writer as bags
from brakeline.logs.bag_writer import BagWriter
from brakeline.messaging.ros2 import SENSOR, Qos
from brakeline.messaging.ros2.cdr_messages import Clock, Twist, encode, time_of, twist


def test_a_bag_holds_every_message_with_its_type_and_qos(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(20):
            bag("/cmd_vel", Twist, encode(twist(float(i), 0.0)), 1000 + i, Qos())
        bag("/clock", Clock, encode(Clock(clock=time_of(3.0))), 2000, SENSOR)
    with AnyReader([tmp_path / "bag"]) as reader:  # by the definitions in the bag alone
        qos = {c.topic: (c.ext.offered_qos_profiles[0].depth, c.msgcount) for c in reader.connections}
        assert qos == {"/cmd_vel": (10, 20), "/clock": (5, 1)}
        read = [(stamp, reader.deserialize(raw, c.msgtype)) for c, stamp, raw in reader.messages()]
    assert [(stamp, message.linear.x) for stamp, message in read[:20]] == [(1000 + i, float(i)) for i in range(20)]
    assert bag.count == 21


def test_a_message_from_a_second_before_a_kill_is_in_the_file(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(bags, "time", SimpleNamespace(monotonic=lambda: now[0]))
    bag = BagWriter(tmp_path / "bag")
    for i in range(31):
        bag("/cmd_vel", Twist, encode(twist(float(i), 0.0)), i, Qos())
        now[0] += 0.1 * bags.PERIOD if i < 29 else 2 * bags.PERIOD  # the last message is the flush of all before
    found: list[int] = []
    with (tmp_path / "bag" / "bag.mcap").open("rb") as file, pytest.raises((McapError, EOFError)):
        records = StreamReader(file, emit_chunks=False).records
        found.extend(record.log_time for record in records if isinstance(record, Message))
    assert found == list(range(31))
    with bag:
        pass


def test_a_folder_that_is_there_is_left_alone(tmp_path):
    with pytest.raises(FileExistsError, match="exists already"):
        BagWriter(tmp_path)


def test_a_full_disk_is_reported_once_and_the_node_goes_on(tmp_path, monkeypatch, caplog):
    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr(bags, "PERIOD", 0.0)
    bag = BagWriter(tmp_path / "bag")
    flush = bag._flush
    monkeypatch.setattr(bag, "_flush", full)
    for i in range(5):
        bag("/cmd_vel", Twist, encode(twist(0.0, 0.0)), i, Qos())
    assert caplog.text.count("RECORDING STOPPED") == 1 and bag.count == 1
    monkeypatch.setattr(bag, "_flush", flush)
    with bag:
        pass
