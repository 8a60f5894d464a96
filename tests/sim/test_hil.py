"""The simulated sensors are right, and the simulator waits for the autopilot, which is a stand-in here."""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from brakeline.errors import AutopilotGone, LaunchError
from brakeline.sim.autopilot import ned_frames
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.hil_link import HilLink
from brakeline.sim.autopilot.hil_sensors import DECLINATION, INCLINATION, HilSensors
from brakeline.sim.autopilot.px4_process import Px4Process
from brakeline.sim.flight_estimator import Estimate, QuadrotorNoise
from brakeline.sim.kernels.flight_kernels import GRAVITY
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.sim_conditions import SensorNoise
from tests.sim.station import field

HOVER = 1.2 * 9.81 / 4.0 / 8.8  # of a rotor's full thrust


def sensor_messages(truth: Estimate, scale: float = 0.0, readings: int = 1) -> list[Any]:
    sensors = HilSensors(SensorNoise(scale=scale), np.random.default_rng(0), 0.005)
    return [m for i in range(readings) for m in sensors.read(truth, truth.position, 5000 * (i + 1))]


def at_rest(heading: float) -> Estimate:
    """heading: rad from east, counterclockwise."""
    q = (math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading))
    return Estimate((30.0, 40.0, 7.0), (1.0, 2.0, 0.5), q, (0.1, 0.2, 0.3), (0.0, 0.0, GRAVITY))


@pytest.mark.parametrize(("heading", "from_north"), [(0.0, 90.0), (0.5 * math.pi, 0.0), (math.pi, -90.0)])
def test_sensors_without_errors_measure_the_true_state_in_their_frames(heading: float, from_north: float) -> None:
    imu, fix = sensor_messages(at_rest(heading))
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((0.0, 0.0, -GRAVITY))
    assert (imu.xgyro, imu.ygyro, imu.zgyro) == pytest.approx((0.1, -0.2, -0.3))
    compass = math.degrees(math.atan2(-imu.ymag, imu.xmag) + DECLINATION)  # of a level body, from true north
    assert math.remainder(compass - from_north, 360.0) == pytest.approx(0.0, abs=1e-6)
    assert math.atan2(imu.zmag, math.hypot(imu.xmag, imu.ymag)) == pytest.approx(INCLINATION)
    height = (1.0 - (imu.abs_pressure / 1013.25) ** (1.0 / 5.25588)) / 2.25577e-5
    assert height == pytest.approx(ned_frames.ALTITUDE + 7.0) and imu.pressure_alt == pytest.approx(height)

    north = math.radians(1e-7 * fix.lat - ned_frames.LATITUDE) * 6371000.0
    east = math.radians(1e-7 * fix.lon - ned_frames.LONGITUDE) * 6371000.0 * math.cos(math.radians(ned_frames.LATITUDE))
    assert (east, north, 1e-3 * fix.alt) == pytest.approx((30.0, 40.0, ned_frames.ALTITUDE + 7.0), abs=0.02)
    assert (fix.vn, fix.ve, fix.vd) == (200, 100, -50)
    assert fix.cog == round(100.0 * math.degrees(math.atan2(1.0, 2.0)))


def test_sensor_errors_have_their_size_and_follow_from_the_seed() -> None:
    messages = sensor_messages(at_rest(0.0), scale=1.0, readings=4000)
    noise = SensorNoise()
    force = np.array([m.xacc for m in messages if m.get_type() == "HIL_SENSOR"])
    fixes = np.array([m.alt for m in messages if m.get_type() == "HIL_GPS"]) * 1e-3
    assert force.std() == pytest.approx(noise.accelerometer, rel=0.1)
    assert abs(force.mean()) < 4.0 * noise.accelerometer_bias and abs(force.mean()) > 1e-4
    assert len(fixes) == 200 and fixes.std() == pytest.approx(noise.gps_position, rel=0.3)
    again = sensor_messages(at_rest(0.0), scale=1.0, readings=4000)
    assert [m.to_dict() for m in again] == [m.to_dict() for m in messages]


@contextmanager
def stand_in(
    share: float = HOVER, lockstep: int = 1, answers: float = math.inf, ahead: int = 0
) -> Iterator[tuple[HilLink, list[int]]]:
    """Yield the simulator's end of a connection, and the times of the readings that the autopilot received.

    That autopilot answers each of the first `answers` readings with the same share of full thrust.

    ahead: µs from the time of a reading to the time of its answer.
    """
    ours, theirs = socket.socketpair()
    vehicle = Quadrotor(field(), np.random.default_rng(0), QuadrotorNoise(scale=0.0))
    hil = HilLink(ours, vehicle, HilSensors(SensorNoise(), np.random.default_rng(0), vehicle.timestep))
    times: list[int] = []

    def answer() -> None:
        parser, packer = mavlink.MAVLink(None), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        while data := theirs.recv(65536):
            for message in parser.parse_buffer(data) or ():
                if message.get_type() == "HIL_SENSOR" and len(times) < answers:
                    times.append(message.time_usec)
                    controls = [share] * 4 + [0.0] * 12
                    moment = message.time_usec + ahead
                    reply = mavlink.MAVLink_hil_actuator_controls_message(moment, controls, 129, lockstep)
                    theirs.sendall(reply.pack(packer))

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield hil, times
    finally:
        ours.shutdown(socket.SHUT_RDWR)
        thread.join(10.0)
        ours.close()
        theirs.close()


def test_the_simulator_waits_for_every_command_and_applies_it() -> None:
    with stand_in() as (hil, times):
        for _ in range(200):
            hil.tick()
        assert times == [5000 * (i + 1) for i in range(200)] and hil.unanswered == 0 and hil.armed
        assert hil.time == pytest.approx(1.0)
        assert np.abs(hil.vehicle.state()[:6] - [0, 0, 10, 0, 0, 0]).max() < 1e-6  # it hovers
    with stand_in(share=2.0 * HOVER) as (hil, _):
        for _ in range(200):
            hil.tick()
        assert 8.2 < hil.vehicle.state()[5] < 9.0  # a second at twice its weight, less drag


def test_an_autopilot_that_no_longer_answers_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.sim.autopilot.hil_link.ANSWER_TIMEOUT", 0.02)
    with stand_in(answers=3) as (hil, _), pytest.raises(AutopilotGone, match="has not answered"):
        for _ in range(100):
            hil.tick()
    assert hil.unanswered == 5


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"lockstep": 0}, "lockstep"),
        ({"share": math.nan}, "commands its motors with"),
        ({"share": math.inf}, "commands its motors with"),
        ({"ahead": 3_600_000_000}, "its time from the simulator"),  # answers all readings of the next hour
    ],
)
def test_an_autopilot_whose_answers_are_wrong_is_an_error(how: dict[str, Any], words: str) -> None:
    with stand_in(**how) as (hil, _), pytest.raises(AutopilotGone, match=words):
        for _ in range(200):  # it may not wait for the first answer
            hil.tick()


def test_an_autopilot_that_never_starts_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.sim.autopilot.hil_link.BOOT_LIMIT", 0.1, raising=False)
    with stand_in(answers=0) as (hil, _), pytest.raises(AutopilotGone, match="does not start"):
        for _ in range(200):
            hil.tick()


def test_a_folder_without_px4_is_refused(tmp_path: Any) -> None:
    with pytest.raises(LaunchError, match="holds no PX4"):
        Px4Process(tmp_path, 14540)
