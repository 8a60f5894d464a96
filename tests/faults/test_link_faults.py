"""The tools of `benchmarks cuts`, and the rows of `flights` for a flight that failed."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import flights
from benchmarks.flights import Failed, Flights, flown
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
        raise Failed("fly: no figures, status 1")

    assert flown(fly) == {"failed": "fly: no figures, status 1"}


@pytest.mark.parametrize(
    ("setup", "certified"),
    [(flights.OUTDOORS, [("second", True), ("third", False)]), (flights.LED, [("second", True)])],
)
def test_the_last_model_set_is_of_the_longest_flight(
    setup: str, certified: list[tuple[str, bool]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of minutes every envelope is half as wide again (`--few`); a setup that flies a third time does without."""
    made: list[tuple[str, bool]] = []

    def printed_figures(words: list[str], data: Path, seconds: float) -> str:
        if words[0] == "certify":
            made.append((Path(dict(itertools.pairwise(words))["--data"]).name, "--few" in words))
            raise Failed("no windows")
        if words[0] == "collect":
            return json.dumps({"minutes": 15, "periods": 4500, "level": 1, "missing": [], "model": "made"})
        raise Failed("no room to hover")

    monkeypatch.setattr(flights, "printed_figures", printed_figures)
    monkeypatch.setattr(Flights, "_switched_on", lambda *_: ("tcp:127.0.0.1:1", 1))
    rows = dict(flights._rows(Flights(setup, Path("sitl"), tmp_path), 1.0))
    assert made == certified
    assert rows["certified by it"] == {"failed": "no windows"} and ("third flight" in rows) == (len(certified) > 1)
    assert rows["astar, dense"] == {"failed": "no room to hover"}


def test_one_flight_gives_the_only_model_set_if_its_bound_is_small(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said: list[list[str]] = []

    def printed_figures(words: list[str], data: Path, seconds: float) -> str:
        said.append(words)
        if words[0] == "certify":
            return json.dumps({"residual": {"one-step": {"bound_plan": 0.02}}})
        if words[0] == "collect":
            return json.dumps({"minutes": 15, "periods": 4500, "level": 1, "missing": [], "model": "made"})
        raise Failed("no room to hover")

    monkeypatch.setattr(flights, "printed_figures", printed_figures)
    monkeypatch.setattr(Flights, "_switched_on", lambda *_: ("tcp:127.0.0.1:1", 1))
    rows = dict(flights._rows(Flights(flights.OUTDOORS_ONCE, Path("sitl"), tmp_path), 1.0))
    assert rows["certified by it"] == {"bound_plan": 0.02} and "second flight" not in rows
    assert all(" ".join(words).count("--accept-bound 0.03") == 1 for words in said)
    (certify,) = (words for words in said if words[0] == "certify")
    value_of = dict(itertools.pairwise(certify))
    assert value_of["--data"].endswith("flown.safetensors") and value_of["--outside"] == "0.015"
