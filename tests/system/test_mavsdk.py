"""Test the autopilot with unmodified clients of other authors over UDP: MAVSDK, and pymavlink's mavutil."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.offboard import Offboard, OffboardError, VelocityBodyYawspeed, VelocityNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, Telemetry

from tests.system.flights import autopilot
from tests.waiting import PATIENCE, until

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink import mavutil

ARMED = mavutil.mavlink.MAV_MODE_FLAG_SAFETY_ARMED


@pytest.fixture(scope="module")
def system() -> Iterator[Any]:
    """Return MAVSDK's view of a vehicle with PX4's rules, which is on the ground before and after each test."""
    with autopilot("--rules", "px4") as port:
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        with Mavsdk(configuration) as sdk:
            sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            vehicle = sdk.first_autopilot(60.0)
            assert vehicle is not None
            yield vehicle
        configuration.destroy()


def test_mavsdk_flies(system: Any) -> None:
    telemetry, action, offboard = Telemetry(system), Action(system), Offboard(system)
    until(telemetry.health_all_ok, "healthy", 30.0)
    assert not telemetry.armed() and not telemetry.in_air()

    action.takeoff()  # begins when it is armed, as PX4's does
    assert not telemetry.in_air()
    action.arm()
    until(telemetry.armed, "armed", 10.0)
    until(lambda: telemetry.position().relative_altitude_m > 2.2, "taken off", 20.0)
    until(lambda: telemetry.flight_mode() == FlightMode.HOLD, "holding", 10.0)
    with pytest.raises(ActionError):
        action.disarm()  # in the air

    with pytest.raises(OffboardError):
        offboard.start()  # no setpoint yet
    offboard.set_velocity_ned(VelocityNedYaw(0.0, 2.0, -0.5, 90.0))
    offboard.start()
    until(lambda: abs(telemetry.velocity_ned().east_m_s - 2.0) < 0.2, "two metres a second to the east", 15.0)
    until(lambda: telemetry.flight_mode() == FlightMode.OFFBOARD, "offboard", 5.0)
    offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 1.5, 0.0, 0.0))  # right of east is south
    until(lambda: abs(telemetry.velocity_ned().north_m_s + 1.5) < 0.2, "to the south", 15.0)

    action.hold()
    until(lambda: speed(telemetry) < 0.15, "standing", 10.0)
    until(lambda: telemetry.flight_mode() == FlightMode.HOLD, "holding again", 5.0)
    action.land()
    until(lambda: not telemetry.in_air(), "landed", 60.0)
    until(lambda: not telemetry.armed(), "disarmed by itself", 20.0)


def test_mavsdk_reads_and_sets_parameters(system: Any) -> None:
    parameters = Param(system)
    assert parameters.get_param_float("COM_OF_LOSS_T") == pytest.approx(1.0)
    assert parameters.get_param_int("SYS_AUTOSTART") == 4001
    parameters.set_param_float("COM_OF_LOSS_T", 0.5)
    assert parameters.get_param_float("COM_OF_LOSS_T") == pytest.approx(0.5)


def speed(telemetry: Any) -> float:
    v = telemetry.velocity_ned()
    return float((v.north_m_s**2 + v.east_m_s**2 + v.down_m_s**2) ** 0.5)


def test_mavutil_flies_the_second_of_two_vehicles_on_one_port(stalled: Callable[[], float]) -> None:
    """By ArduPilot's rules; MAVSDK flies by PX4's."""
    with autopilot("--rules", "ardupilot", "--vehicles", 2) as port:
        vehicle = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=200)
        try:
            vehicle.wait_heartbeat(timeout=60)
            assert vehicle.mavlink20()
            heartbeat(vehicle, 1)
            vehicle.target_system, vehicle.target_component = 2, 1
            heartbeat(vehicle, 2)
            start = time.monotonic()
            heartbeat(vehicle, 2)
            assert time.monotonic() - start < 3.0 + stalled()
            ask(vehicle, mavutil.mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 50_000)
            vehicle.set_mode("GUIDED")
            until(lambda: heartbeat(vehicle, 2).custom_mode == 4, "guided", 10.0)
            ask(vehicle, mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            ask(vehicle, mavutil.mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3)
            until(lambda: received(vehicle, "LOCAL_POSITION_NED").z < -2.5, "taken off", 20.0)
            position = stream(vehicle, 1.0, 0.0, 0.0, seconds=3.0)
            assert position.vx == pytest.approx(1.0, abs=0.2) and position.z < -1.5
            assert heartbeat(vehicle, 2).base_mode & ARMED and not heartbeat(vehicle, 1).base_mode & ARMED
            vehicle.param_fetch_one("GUID_TIMEOUT")
            assert received(vehicle, "PARAM_VALUE").param_id == "GUID_TIMEOUT"
            ask(vehicle, mavutil.mavlink.MAV_CMD_NAV_LAND)
            until(lambda: not heartbeat(vehicle, 2).base_mode & ARMED, "landed and disarmed", 30.0)
        finally:
            vehicle.close()


def received(vehicle: Any, kind: str, system: int = 2, more: str = "", timeout: float = PATIENCE) -> Any:
    """Wait for a message of a kind from one of the vehicles. Returns None if there is none in time."""
    condition = f"{kind}.get_srcSystem()=={system}{more}"
    return vehicle.recv_match(type=kind, condition=condition, blocking=True, timeout=timeout)


def heartbeat(vehicle: Any, system: int) -> Any:
    return received(vehicle, "HEARTBEAT", system)


def ask(vehicle: Any, command: int, *params: float) -> None:
    """Send a command to the second vehicle until it accepts it."""
    for _ in range(5):
        vehicle.mav.command_long_send(2, 1, command, 0, *params, *[0] * (7 - len(params)))
        ack = received(vehicle, "COMMAND_ACK", more=f" and COMMAND_ACK.command=={command}", timeout=3.0)
        if ack is not None and ack.result == 0:
            return
        time.sleep(0.5)
    raise AssertionError(f"command {command}: {ack}")


def stream(vehicle: Any, vx: float, vy: float, vz: float, seconds: float) -> Any:
    """Stream setpoints (NED) to the second vehicle at 10 Hz. Returns its last LOCAL_POSITION_NED."""
    position = None
    for _ in range(round(seconds / 0.1)):
        vehicle.mav.set_position_target_local_ned_send(0, 2, 1, 1, 0x0DC7, 0, 0, 0, vx, vy, vz, 0, 0, 0, 0, 0)
        end = time.monotonic() + 0.1
        while (left := end - time.monotonic()) > 0.0:
            position = received(vehicle, "LOCAL_POSITION_NED", timeout=left) or position
    return position
