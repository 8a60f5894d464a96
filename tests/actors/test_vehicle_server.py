"""A vehicle that a process of its own keeps: what an actor sees of it, and what becomes of it when the actor dies."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from actors import vehicle_client
from actors.frames import decoded
from actors.mavlink import MavlinkError
from actors.settings import FlightSettings
from actors.vehicle_client import FlightRequest, Raw, VehicleClient, address, ours
from actors.vehicle_server import listening, next_actor
from messaging.clock import WallClock
from messaging.links import open_link
from messaging.tolerant import Tolerance
from sim.autopilot import server
from sim.autopilot.endpoint import Autopilot
from sim.autopilot.pilot import Mode
from sim.vehicle import BadInput
from sim.world import staged_arena
from tests.actors.test_mavlink import quadrotor
from tests.robots import QUADROTOR
from tests.waiting import until

ARENA = staged_arena(start=(0.0, 0.0, 2.0), half_width=20.0, height=10.0)


@pytest.fixture
def flown() -> Iterator[tuple[str, Autopilot]]:
    """An autopilot on the floor, in a thread, and where it is."""
    link, stop = open_link("udpin:127.0.0.1:0"), threading.Event()
    autopilot = Autopilot(quadrotor(floor=0.02), "px4")
    thread = threading.Thread(target=server.serve, args=([autopilot], link, WallClock(), stop.is_set))
    thread.start()
    try:
        yield f"udpout:127.0.0.1:{link.port}", autopilot  # type: ignore[union-attr]
    finally:
        stop.set()
        thread.join()
        link.close()


@contextmanager
def actor(url: str, frames: list[Raw] | None = None, height: float = 2.0) -> Iterator[VehicleClient]:
    request = FlightRequest(FlightSettings(url, height=height), QUADROTOR.name, ARENA.obstacles)
    tap: Callable[[Raw], None] = (frames if frames is not None else []).append
    vehicle = VehicleClient(request, tap, Tolerance(), lambda: False)
    try:
        yield vehicle
    finally:
        vehicle.close()


def test_what_an_actor_that_dies_committed_is_flown_to_its_end_and_the_next_one_goes_on(
    stalled: Callable[[], float], flown: tuple[str, Autopilot]
) -> None:
    url, autopilot = flown
    first: list[Raw] = []
    second: list[Raw] = []
    with contextlib.ExitStack() as stack:
        vehicle = stack.enter_context(actor(url, first))
        with pytest.raises(BadInput):
            vehicle.commit(np.full((2, 3), np.nan), vehicle.current_period.number + 2)
        number = vehicle.current_period.number + 2
        plan = np.array([[0.8, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 0.0, 0.0], [0.8, 0.0, 0.0]])
        assert vehicle.commit(plan, number) and not vehicle.commit(plan, number - 2), "that one has begun"
        assert vehicle.wait(number + 1).input == pytest.approx(plan[1])
        vehicle.leave()
        with pytest.raises(MavlinkError, match="ended"):
            vehicle.wait(number + 5)

        heir = stack.enter_context(actor(url, second))
        period = heir.current_period
        assert period.number >= number + QUADROTOR.horizon, "the periods went on"
        assert np.linalg.norm(period.report.measured[3:6]) < 0.3 and not period.lost, "it hovers"
        assert period.report.measured[0] > 0.5 and autopilot.pilot.mode is Mode.OFFBOARD, "where the plan ended"
        heir.wait(heir.current_period.number + 6)
        assert heir.figures()["periods"] >= number
    times = np.array([at for at, _, _ in first + second]) * 1e-9
    assert np.diff(times).max() < 0.3 + stalled(), "what it said in between was kept for the next actor"
    sent = [found.message for _, out, raw in first + second if out and (found := decoded(raw, out)) is not None]
    speeds = [m.vy for m in sent if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    assert set(np.round(speeds, 3)) == {0.0, 0.8, 1.5}, "nothing else was ever asked of it"


def test_one_vehicle_has_one_actor_and_a_keeper_that_ends_with_it(
    monkeypatch: pytest.MonkeyPatch, flown: tuple[str, Autopilot]
) -> None:
    url, autopilot = flown
    with actor(url) as vehicle:
        monkeypatch.setattr(vehicle_client, "PREDECESSOR", 0.5)
        with pytest.raises(MavlinkError, match="another process here flies it"), actor(url):
            pass
        monkeypatch.undo()
        vehicle.wait(vehicle.current_period.number + 2)
        vehicle.leave()
        with actor(url, height=3.0) as other:
            assert other.current_period.number < vehicle.current_period.number, "other settings: taken anew"
    with socket.socket(socket.AF_UNIX) as knocking, pytest.raises(ConnectionRefusedError):
        knocking.connect(address(url, 1))
    until(lambda: autopilot.pilot.mode is not Mode.OFFBOARD, "the autopilot goes by its own timeout")


def test_an_actor_that_closes_in_full_flight_leaves_it_braked(flown: tuple[str, Autopilot]) -> None:
    url, autopilot = flown
    frames: list[Raw] = []
    with actor(url, frames) as vehicle:
        number = vehicle.current_period.number + 2
        vehicle.commit(np.array([[0.8, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 0.0, 0.0], [0.7, 0.0, 0.0]]), number)
        vehicle.wait(number + 2)
        assert np.linalg.norm(vehicle.current_period.report.measured[3:6]) > 0.5
    assert np.linalg.norm(autopilot.vehicle.state()[3:6]) < 0.3
    sent = [found.message for _, out, raw in frames if out and (found := decoded(raw, out)) is not None]
    assert [m for m in sent if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"][-1].vy == 0.0, "told to its end"


def test_who_is_taken_by_somebody_else_meanwhile_is_taken_control_of_anew(flown: tuple[str, Autopilot]) -> None:
    url, autopilot = flown
    with actor(url) as vehicle:
        vehicle.leave()
        autopilot.pilot.mode = Mode.HOLD
        time.sleep(0.5)
        with actor(url) as heir:
            heir.wait(heir.current_period.number + 5)
            assert not heir.current_period.lost and autopilot.pilot.mode is Mode.OFFBOARD


def test_nobody_elses_processes_are_listened_to(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening("udpin:test", os.getpid()) as door, socket.socket(socket.AF_UNIX) as knocking:
        knocking.connect(address("udpin:test", os.getpid()))
        assert ours(knocking)
        user = os.getuid()
        monkeypatch.setattr("os.getuid", lambda: user + 1)
        stop = threading.Event()
        threading.Timer(0.5, stop.set).start()
        began = time.monotonic()
        assert next_actor(door, stop, None) is None and time.monotonic() - began > 0.3
        assert knocking.recv(1) == b"", "it is hung up on"


def test_what_is_said_of_a_link_that_is_none(flown: tuple[str, Autopilot]) -> None:
    with pytest.raises(ValueError, match="a link is"), actor("nonsense:1"):
        pass
