"""ArduCopter and PX4 as they are, where there are any (tests/real.py): from switching on to flying and to landing, and
half a minute behind the filter, all at once, in which their actors die."""

from __future__ import annotations

import logging
import math
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.timing import stalls
from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.ardupilot_dialect import mavlink
from brakeline.actors.mavlink.autopilot_commands import message_id
from brakeline.actors.mavlink.frame_log import CapturedFrame
from brakeline.actors.mavlink.mavlink_decoder import OFFBOARD
from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.errors import CommandLost
from tests.accepting import WORDS
from tests.real import KINDS, autopilot, autopilots
from tests.robots import QUADROTOR
from tests.system.runs import Run
from tests.waiting import until

DEGREE = 111_319.5  # m, of latitude
TRUTH = {"ardupilot": "SIMSTATE", "px4": "HIL_STATE_QUATERNION"}  # what its own simulator knows
LAND = {"ardupilot": (9, 0), "px4": (4, 6)}  # DO_SET_MODE
USED = {"ardupilot": {"ATTITUDE", "SCALED_IMU", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE"}}
BEFORE, AFTER = 40, 150  # periods until its actor dies, and from then on: half a minute
OFF = 1.5  # m that an estimate may be off after a few metres: it is made of a simulated GPS


def way(before: Any, after: Any) -> np.ndarray:
    """From one place to another, east and north, m, by the truth."""
    east = after.lng - before.lng if before.get_type() == "SIMSTATE" else after.lon - before.lon
    narrow = math.cos(math.radians(1e-7 * before.lat))
    return 1e-7 * DEGREE * np.array([narrow * east, after.lat - before.lat])


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_found_out_flown_and_given_back(kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    frames: list[CapturedFrame] = []
    with autopilot(kind, tmp_path) as (url, system):
        vehicle = MavlinkVehicle(
            QUADROTOR, FlightSettings(url, system, height=5.0, raise_limits=True), tap=frames.append
        )
        try:
            client = vehicle._client
            assert client.kind == kind and set(client.chosen.values()) >= USED.get(kind, set()), vehicle.notes
            client._mav.command_long_send(
                system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id(TRUTH[kind]), 20_000, *[0] * 5
            )

            def truth() -> Any:
                return next(f.message for f in reversed(frames[-2000:]) if f.name.endswith(TRUTH[kind]))

            hovering = [vehicle.step(np.zeros(3)) for _ in range(8)][-1].measured
            began = truth()
            flown = [vehicle.step(np.array([2.0, -1.0, 0.3])) for _ in range(15)][-1].measured
            there = truth()
            assert flown[:2] - hovering[:2] == pytest.approx(way(began, there), abs=OFF), (
                "in our axes, by its own truth"
            )
            assert flown[0] - hovering[0] > 2.0 and flown[1] - hovering[1] < -0.8 and flown[5] > 0.0
            for _ in range(20):  # a busy machine simulates more slowly
                if np.abs(flown[3:5] - [2.0, -1.0]).max() <= 0.6:
                    break
                flown = vehicle.step(np.array([2.0, -1.0, 0.3])).measured
            assert flown[3:5] == pytest.approx([2.0, -1.0], abs=0.6)
            braked = [vehicle.step(np.zeros(3)) for _ in range(15)][-1].measured
            assert np.linalg.norm(braked[3:6]) < 0.7 and not vehicle.current_period.lost
            assert vehicle.timing.round_trip < 0.2

            main, sub = LAND[kind]  # somebody else takes it
            client._mav.command_long_send(
                system,
                1,
                mavlink.MAV_CMD_DO_SET_MODE,
                0,
                mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                main,
                sub,
                *[0] * 4,
            )
            until(lambda: "LAND" in vehicle.current_period.lost)
            vehicle.wait(vehicle.current_period.number + 10)
            assert client.custom_mode != OFFBOARD[kind][1], "who took it keeps it"
            assert any("braking" in record.message and "LAND" in record.message for record in caplog.records)
            until(lambda: vehicle.failed)
            with pytest.raises(CommandLost, match="it has disarmed"):
                vehicle.check()
        finally:
            vehicle.close()
    waited = any("waiting for the position estimate" in record.message for record in caplog.records)
    assert waited or kind == "px4", "its estimator needs longer than a line takes"


def test_an_ardupilot_that_is_led_stays_where_it_was_led_to_when_nothing_more_comes(tmp_path: Path) -> None:
    """Told velocities, a version without GUID_TIMEOUT flies on for 3 s: 12 m."""
    with autopilot("ardupilot", tmp_path) as (url, system):
        vehicle = MavlinkVehicle(QUADROTOR, FlightSettings(url, system, height=5.0, raise_limits=True, lead=True))
        try:
            flown = [vehicle.step(np.array([3.0, 0.0, 0.0])) for _ in range(20)][-1].measured
            assert flown[3:6] == pytest.approx([3.0, 0.0, 0.0], abs=0.6)
            vehicle._stop()  # nothing more is sent
            client, link = vehicle._client, vehicle._link
            end = time.monotonic() + 6.0
            while time.monotonic() < end:
                for peer, data in link.receive_by_peer():
                    client.feed(data, peer)
                time.sleep(0.01)
            assert client.position is not None
            assert float(np.linalg.norm(client.position - flown[:3])) < 5.0
            assert np.linalg.norm(client.velocity) < 0.4 and client.armed and client.offboard
        finally:
            vehicle.close()


@pytest.mark.usefixtures("flight_folder")
def test_all_fly_behind_one_filter_and_hover_when_their_actors_die(tmp_path: Path) -> None:
    """By the embedded vehicle's model set, which is not theirs: nothing is said of how they get on."""
    with ExitStack() as stack:
        there = [stack.enter_context(vehicle) for vehicle in autopilots(tmp_path)]
        urls, systems = zip(*there, strict=True)
        how = ["--url", *urls, "--systems", *systems, "--minutes", AFTER * QUADROTOR.period / 60.0]
        how += ["--policy", "astar", "--at-start", "--raise-limits", "--pictures", 0, *WORDS]
        with stalls(0.01) as lost, Run(tmp_path / "run", *how, command=("fly", "quadrotor")) as run:
            actors = run.watch().actors
            names = [f"actor-{i}" for i in range(len(there))]
            until(lambda: all(name in actors and actors[name].steps >= BEFORE for name in names))
            for name in names:
                run.kill(name)
            figures = run.end()
            assert figures["finished"], run.errors.read_text()
    flights = figures["flights"] if len(there) > 1 else {"actor-0": figures["flight"]}
    assert figures["restarts"] == dict.fromkeys(flights, 1)
    assert figures["steps"] >= (BEFORE + AFTER) * len(there)
    for name, flight in flights.items():
        assert flight["answers in time share"] >= 0.9 - lost.share, (name, flight, lost)
        assert flight["true clearance least m"] < 20.0, f"{name}: its own simulator tells the truth"
        lines = (run.folder / "logs" / f"{name}.log").read_text()
        assert "braking along the committed plan" in lines and "it hovers at" in lines, name
