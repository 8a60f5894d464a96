"""Hostile frames at the edges of the bus, ROS 2 messages (CDR) and MAVLink, are handled, or dropped."""

import json
import math
import struct
from contextlib import suppress
from random import Random

import numpy as np
import pytest
from pymavlink.generator.mavcrc import x25crc

from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.frame_log import decode_frame
from brakeline.actors.mavlink.mavlink_decoder import AUTOPILOT, MOST_PARAMETERS, MOST_TEXTS, SENDERS, MavlinkDecoder
from brakeline.deploy.run.log_contents import frames_as_json
from brakeline.errors import Malformed
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.ros2 import cdr_messages as cdr
from brakeline.messaging.topics import FRAMES
from tests.fuzz.mutations import WORDS, mutated

OWN = ("COMMAND_ACK", "STATUSTEXT", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "SYS_STATUS", "FENCE_STATUS", "TIMESYNC")


def examples() -> dict[str, object]:
    """Return a message of each type that the bridge and the gate read or write."""
    header, zero = cdr.header(1.5, "odom"), cdr.Vector3(x=0.0, y=0.0, z=0.0)
    twist = cdr.Twist(linear=zero, angular=zero)
    pose = cdr.Pose(position=cdr.Point(x=1.0, y=2.0, z=0.0), orientation=cdr.quaternion(0.3))
    status = cdr.DiagnosticStatus(
        level=1, name="gate", message="stands", hardware_id="x", values=[cdr.KeyValue(key="a", value="b")]
    )
    bounds = dict.fromkeys(("time_increment", "scan_time", "range_min", "angle_min"), 0.0)
    scan = {"ranges": np.ones(60, np.float32), "intensities": np.zeros(0, np.float32)}
    moved = cdr.Transform(translation=zero, rotation=cdr.quaternion(0.1))
    return {
        "odometry": cdr.Odometry(
            header=header,
            child_frame_id="base",
            pose=cdr.PoseWithCovariance(pose=pose, covariance=np.zeros(36)),
            twist=cdr.TwistWithCovariance(twist=twist, covariance=np.zeros(36)),
        ),
        "scan": cdr.LaserScan(header=header, angle_max=6.0, angle_increment=0.1, range_max=4.0, **bounds, **scan),
        "twist": twist,
        "stamped": cdr.TwistStamped(header=header, twist=twist),
        "frames": cdr.TFMessage(
            transforms=[cdr.TransformStamped(header=header, child_frame_id="base", transform=moved)]
        ),
        "diagnostics": cdr.DiagnosticArray(header=header, status=[status]),
        "clock": cdr.Clock(clock=cdr.time_of(3.5)),
    }


@pytest.mark.parametrize("name", examples())
def test_a_ros_message_is_read_or_malformed(name: str) -> None:
    random, message = Random(name), examples()[name]
    whole, read = cdr.encode(message), 0
    for _ in range(300):
        payload = random.choice((mutated(whole, random), random.randbytes(random.randrange(200))))
        with suppress(Malformed):
            read += isinstance(cdr.decode(type(message), payload), type(message))
    assert read > 0, "some are another message of this type"


def frame(random: Random, number: int, payload: bytes) -> bytes:
    """Return a MAVLink 2 frame with the right checksum."""
    system = struct.pack("<BBBBBBB", len(payload), 0, 0, random.randrange(256), 1, AUTOPILOT, number & 0xFF)
    body = system + struct.pack("<H", number >> 8) + payload
    crc = x25crc(body)
    crc.accumulate(bytes([mavlink.mavlink_map[number].crc_extra]))
    return b"\xfd" + body + struct.pack("<H", crc.crc)


def test_whatever_an_autopilot_sends_the_decoder_goes_on() -> None:
    """Every kind of message that the decoder reads, with any bytes as its content and a right checksum."""
    random, texts, received = Random(0), list[str](), list[str]()
    tap = lambda captured: received.append(json.dumps(captured.described))  # noqa: E731
    decoder = MavlinkDecoder(lambda data: None, tap=tap, say=texts.append)
    numbers = {m.msgname: number for number, m in mavlink.mavlink_map.items()}
    names = sorted({"HEARTBEAT", "PARAM_VALUE", *OWN, *SENDERS} & numbers.keys())
    frames = []
    for _ in range(40):
        for name in names:
            size = mavlink.mavlink_map[numbers[name]].unpacker.size
            payload = random.choice((random.randbytes(size), random.choice(WORDS) * (size // 4 + 1)))[:size]
            raw = frame(random, numbers[name], payload)
            frames += [raw, mutated(raw, random)]
    for raw in frames:
        decoder.feed(raw)
        captured = decode_frame(raw, outgoing=False)
        assert captured is None or json.dumps(captured.described, allow_nan=False)
    assert len(received) > len(frames) / 4
    heartbeat = mavlink.MAVLink(None, srcSystem=1, srcComponent=AUTOPILOT).heartbeat_encode(2, 12, 0, 6 << 16, 4)
    sound = heartbeat.pack(mavlink.MAVLink(None, 1, AUTOPILOT))
    decoder.feed(bytes(40) + sound * 40)  # the junk may end in the head of a long frame
    assert decoder.kind == "px4", "and it still reads what is right"
    for value in (decoder.position, decoder.velocity):
        assert value is None or np.isfinite(value).all(), "no position or velocity is NaN or infinite"
    assert math.isfinite(decoder.time)


def test_a_talkative_autopilot_fills_no_memory() -> None:
    """Texts, parameters and time stamps without end: the decoder has the latest ones, among them the one asked for."""
    decoder, sender = MavlinkDecoder(lambda data: None), mavlink.MAVLink(None, srcSystem=1, srcComponent=AUTOPILOT)
    for number in range(MOST_PARAMETERS + 200):
        for message in (
            sender.statustext_encode(6, f"text {number}".encode()),
            sender.param_value_encode(f"P{number}".encode(), float(number), 9, 1, 0),
            sender.timesync_encode(number + 1, number),
        ):
            decoder.feed(message.pack(sender))
    assert decoder.texts[-1] == f"text {MOST_PARAMETERS + 199}" and len(decoder.texts) == MOST_TEXTS
    assert len(decoder._parameters) == len(decoder._types) == MOST_PARAMETERS
    assert len(decoder.clock_answers) <= MOST_TEXTS
    assert decoder._parameters[f"P{MOST_PARAMETERS + 199}"] == MOST_PARAMETERS + 199 and "P0" not in decoder._parameters


def test_hostile_frames_in_a_message_cost_the_log_nothing() -> None:
    random = Random(1)
    for number in range(200):
        message = pb.MavlinkFrames(frames=[pb.MavlinkFrame(raw=random.randbytes(random.randrange(300)), wall_time=1)])
        raw = frame(random, 0, random.randbytes(9))
        message.frames.add(raw=raw, wall_time=1)
        message.header.sequence = number + 1
        entries = frames_as_json(Sample(FRAMES, "frames/ground/actor-0", message.SerializeToString(), 1))
        assert [entry.key for entry in entries] == [f"mavlink/1/{AUTOPILOT}/HEARTBEAT"]
