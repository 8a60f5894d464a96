"""What comes to a flight's ports from whoever likes to send."""

import json
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.ground_truth import MOST_DATAGRAMS, UdpGroundTruth
from brakeline.messaging.free_ports import free_udp_port
from brakeline.messaging.rejected_messages import RejectedMessages

STATE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
TOLD = {"system": 1, "time": 1.0, "state": STATE, "collisions": 2, "clearance": 0.5}


class Said:
    """A truth channel and who sends to it."""

    def __init__(self) -> None:
        self.rejected, self.port = RejectedMessages(), free_udp_port()
        self.truth = UdpGroundTruth(self.port, 1, self.rejected)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __call__(self, data: object) -> None:
        payload = data if isinstance(data, bytes) else json.dumps(data).encode()
        self.socket.sendto(payload, ("127.0.0.1", self.port))


@pytest.fixture
def say() -> Iterator[Said]:
    said = Said()
    yield said
    said.truth.close()
    said.socket.close()


@pytest.mark.parametrize(
    "data",
    [
        *(b"\0", b"", b"\xff\xfe", b"[" * 4000, b"null", b"7", b"[]", b"{}", b'"system"'),
        *(TOLD | {"state": state} for state in (None, [], [0.0] * 8, ["x"] * 9, [1e400] * 9, [float("nan")] * 9, {})),
        *(TOLD | {"collisions": count} for count in (None, "many", 1.5, [1])),
        *(TOLD | {"clearance": clearance} for clearance in ("far", [1], float("nan"))),
    ],
)
def test_what_no_simulator_tells_is_passed_over(say: Said, data: object) -> None:
    say(data)
    say(TOLD)
    say.truth.poll()
    assert say.rejected.count == 1
    assert say.truth.state is not None and say.truth.state.tolist() == STATE
    assert (say.truth.collisions, say.truth.clearance) == (2, 0.5)


def test_truth_is_told_on_this_machine_alone(say: Said) -> None:
    assert say.truth._socket.getsockname()[0] == "127.0.0.1"


def test_who_sends_without_end_does_not_hold_up_the_flight(say: Said) -> None:
    read = []

    class Endless:
        def recv(self, size: int) -> bytes:
            read.append(size)
            return b"\0"

        def close(self) -> None: ...

    before, say.truth._socket = say.truth._socket, Endless()  # type: ignore[assignment]
    say.truth.poll()
    say.truth._socket = before
    assert len(read) == MOST_DATAGRAMS


def test_noise_on_a_link_is_passed_over() -> None:
    random, client = np.random.default_rng(0), AutopilotClient(lambda data: None, 1)
    for _ in range(2000):
        start = b"\xfd" if random.random() < 0.5 else b""
        client.feed(start + random.integers(0, 256, int(random.integers(0, 300)), np.uint8).tobytes())
