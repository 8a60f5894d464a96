"""The tools of `benchmarks cuts`, and the rows of `flights` for a flight that failed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.flights import NoFigures, flight_row
from brakeline.messaging.byte_links import Tcp, Udp, open_link
from brakeline.messaging.free_ports import free_udp_port
from tests.faults.link_faults import Outcomes, Relay, Steps
from tests.waiting import until


@pytest.fixture
def ends() -> Iterator[tuple[Relay, Udp, Tcp]]:
    """A relay, the autopilot behind it, and who flies it."""
    port = free_udp_port()
    relay = Relay(open_link(f"udpin:127.0.0.1:{port}"))
    autopilot, companion = open_link(f"udpout:127.0.0.1:{port}"), open_link(relay.url)
    assert isinstance(autopilot, Udp) and isinstance(companion, Tcp)
    yield relay, autopilot, companion
    for end in (relay, autopilot, companion):
        end.close()


def heard(relay: Relay, end: Udp | Tcp) -> bytes:
    relay.pump()
    return end.receive()


def test_a_relay_carries_bytes_both_ways_until_it_is_cut(ends: tuple[Relay, Udp, Tcp]) -> None:
    relay, autopilot, companion = ends
    relay.pump()  # lets the companion in
    autopilot.send(b"telemetry")
    until(lambda: heard(relay, companion) == b"telemetry")
    companion.send(b"setpoint")
    until(lambda: heard(relay, autopilot) == b"setpoint")
    relay.cut(0.3)
    for _ in range(20):
        autopilot.send(b"lost")
        assert heard(relay, companion) == b""
    until(lambda: relay.pump() is None and not relay.dead)
    autopilot.send(b"again")
    until(lambda: heard(relay, companion).endswith(b"again"))


def test_steps_are_read_from_what_a_flight_prints() -> None:
    steps = Steps(iter(["driving\n", "steps 55  episodes 1  goals 1\n", "it says: steps 3\n"]))
    until(lambda: steps.taken == 55)
    assert steps.beyond(54) and not steps.beyond(55)


def test_of_cut_links_the_longest_way_is_told() -> None:
    outcomes = Outcomes(count=3, nearest=0.5)
    assert "way most m" not in outcomes.row(), "what was killed has none"
    for way, speed in ((2.0, 4.0), (3.04, 3.0), (0.1, 0.0)):
        outcomes.take_way(way, speed)
    assert outcomes.row() | {"way most m": 3.0, "from m/s": 3.0} == outcomes.row()


def test_a_flight_that_did_not_take_off_is_a_row() -> None:
    def fly() -> dict[str, object]:
        raise NoFigures("fly: no figures, status 1")

    assert flight_row(fly) == {"failed": "fly: no figures, status 1"}
