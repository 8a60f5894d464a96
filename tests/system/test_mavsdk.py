"""Clients that we did not write, unmodified, fly the autopilot over UDP: MAVSDK, and pymavlink's mavutil."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.offboard import Offboard, OffboardError, VelocityBodyYawspeed, VelocityNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, Telemetry

from tests.system.flights import autopilot
from tests.system.runs import until

os.environ.setdefault("MAVLINK20", "1")


@pytest.fixture
def system() -> Iterator[Any]:
    """MAVSDK's view of a vehicle with PX4's rules."""
    with autopilot("--rules", "px4") as port:
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        with Mavsdk(configuration) as sdk:
            sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            found = sdk.first_autopilot(60.0)
            assert found is not None
            yield found
        configuration.destroy()


def test_mavsdk_flies(system: Any) -> None:
    telemetry, action, offboard = Telemetry(system), Action(system), Offboard(system)
    until(telemetry.health_all_ok, "healthy", 30.0)
    assert not telemetry.armed() and not telemetry.in_air()

    with pytest.raises(ActionError):
        action.takeoff()  # not armed
    action.arm()
    until(telemetry.armed, "armed", 10.0)
    action.takeoff()
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
