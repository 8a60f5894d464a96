"""Ground truth judges a flight: over MAVLink it starts where the estimate starts; over UDP invalid datagrams are
skipped."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from brakeline.actors.mavlink.ground_truth import MOST_DATAGRAMS, MavlinkGroundTruth, UdpGroundTruth
from brakeline.actors.mavlink.telemetry import GeoPosition
from brakeline.messaging.free_ports import free_udp_port
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.rejected_messages import RejectedMessages

METRES = 0.0111195  # of latitude, a ten millionth of a degree


def at(north: float, altitude: float | None = 10.0) -> GeoPosition:
    return GeoPosition(round(north / METRES), 0, altitude, METRES)


def test_a_collision_is_judged_by_the_truth_and_counted_once() -> None:
    """A wall is 5 m north of the body of 1 m; the drifting estimate stays in front of it."""
    wall = Obstacle("wall", (0.0, 6.0, 0.0), yaw=-0.5 * math.pi)
    truth = MavlinkGroundTruth(Shapes.of([wall], 3), footprint=1.0)
    for north in (0.0, 3.0, 4.9, 5.2, 5.4, 4.0, 5.1):
        estimate = np.array([1.0, 0.5 * north, 3.0])
        truth.take(at(north), estimate, np.zeros(3))
    assert truth.collisions == 2 and truth.least == pytest.approx(-0.4, abs=0.01)
    assert truth.clearance == pytest.approx(-0.1, abs=0.01)
    assert truth.worst == pytest.approx(2.7, abs=0.01)
    assert truth.state is not None and truth.state[:3] == pytest.approx([1.0, 5.1, 3.0], abs=0.02)


def test_without_an_altitude_the_height_is_the_estimates() -> None:
    floor = Obstacle("box", (0.0, 0.0, -1.0), (9.0, 9.0, 2.0))
    truth = MavlinkGroundTruth(Shapes.of([floor], 3), footprint=0.5)
    for height in (3.0, 2.0):
        truth.take(at(0.0, None), np.array([0.0, 0.0, height]), np.zeros(3))
    assert truth.clearance == pytest.approx(1.5)


def test_a_flight_without_obstacles_is_judged_too() -> None:
    truth = MavlinkGroundTruth(Shapes.of((), 3), footprint=0.5)
    truth.take(at(0.0), np.zeros(3), np.zeros(3))
    assert truth.collisions == 0 and truth.clearance == truth.least == math.inf
    assert truth.state is not None


STATE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
DATAGRAM = {"system": 1, "time": 1.0, "state": STATE, "collisions": 2, "clearance": 0.5}


class TruthChannel:
    """A ground truth that listens, and a socket that sends to it."""

    def __init__(self) -> None:
        self.rejected, self.port = RejectedMessages(), free_udp_port()
        self.truth = UdpGroundTruth(self.port, 1, self.rejected)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, data: object) -> None:
        payload = data if isinstance(data, bytes) else json.dumps(data).encode()
        self.socket.sendto(payload, ("127.0.0.1", self.port))


@pytest.fixture
def channel() -> Iterator[TruthChannel]:
    channel = TruthChannel()
    yield channel
    channel.truth.close()
    channel.socket.close()


def test_an_invalid_datagram_is_skipped(channel: TruthChannel) -> None:
    invalid: list[object] = [b"\0", b"", b"\xff\xfe", b"[" * 4000, b"null", b"7", b"[]", b"{}", b'"system"']
    states = (None, [], [0.0] * 8, ["x"] * 9, [1e400] * 9, [float("nan")] * 9, {})
    invalid += [DATAGRAM | {"state": state} for state in states]
    invalid += [DATAGRAM | {"collisions": count} for count in (None, "many", 1.5, [1])]
    invalid += [DATAGRAM | {"clearance": clearance} for clearance in ("far", [1], float("nan"))]
    for number, data in enumerate(invalid, 1):
        channel.truth.state = None
        channel.send(data)
        channel.send(DATAGRAM)
        channel.truth.poll()
        assert channel.rejected.count == number, data
        assert channel.truth.state is not None and channel.truth.state.tolist() == STATE
        assert (channel.truth.collisions, channel.truth.clearance) == (2, 0.5)


def test_ground_truth_listens_on_this_machine_only(channel: TruthChannel) -> None:
    assert channel.truth._socket.getsockname()[0] == "127.0.0.1"


def test_a_flood_of_datagrams_does_not_delay_the_flight(channel: TruthChannel) -> None:
    read = []

    class Endless:
        def recv(self, size: int) -> bytes:
            read.append(size)
            return b"\0"

        def close(self) -> None: ...

    before, channel.truth._socket = channel.truth._socket, Endless()  # type: ignore[assignment]
    channel.truth.poll()
    channel.truth._socket = before
    assert len(read) == MOST_DATAGRAMS
