"""Fly a vehicle for the first time, from the link to the landing, to record its first data set."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from brakeline.errors import CommandLost
from brakeline.messaging.robot import Robot
from brakeline.messaging.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from brakeline.deploy.data.first_flight import FirstFlightResult

LANDING_TIMEOUT = 120.0  # s


@dataclass(frozen=True)
class FirstFlightSettings:
    """Set the first flight of a vehicle, which `brakeline collect --url` flies."""

    minutes: float = 15.0
    """Fly for this long [min], without takeoff and landing."""
    height: float = 30.0
    """Climb to this height [m]. The vehicle then stays between a third and five thirds of it."""
    room: float = 80.0
    """Stay within a square whose sides have this length [m]."""
    system: int = 1
    """Address the vehicle by this MAVLink system id."""
    raise_limits: bool = False
    """Raise the parameters of the vehicle that limit it below its description: speeds, accelerations, tilt."""
    lead: bool = False
    """Send position targets instead of velocities. If setpoints stop, the vehicle then stays at the last target.
    Without this option, an ArduCopter without GUID_TIMEOUT flies on for 3 s. The option changes how the vehicle flies,
    so use it with both `collect` and `fly`."""


def fly(robot: Robot, url: str, seed: int, settings: FirstFlightSettings) -> FirstFlightResult:
    """Take off, fly, land, and return the recorded data and the model set of it.

    SIGINT or SIGTERM land the vehicle at once; the data until then count.

    Args:
        robot: the description in real time.
        url: the MAVLink link.

    Raises:
        BadLink, MavlinkError: the vehicle can't be flown; the message says what to do.
        BadData: nothing was recorded.
    """
    from brakeline.actors.actor_settings import FlightSettings
    from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
    from brakeline.actors.mavlink.vehicle_socket import listening
    from brakeline.deploy.data.first_flight import Box, FirstFlight

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    flight_settings = FlightSettings(
        url, settings.system, height=settings.height, raise_limits=settings.raise_limits, lead=settings.lead
    )
    # A second signal must not leave the vehicle in the air. No actor of this machine may take the vehicle.
    with stop_on_signals(threading.Event(), patient=True) as stop, listening(url, settings.system):
        vehicle = MavlinkVehicle(robot, flight_settings, stop=stop.is_set)
        try:
            middle = vehicle.current_period.report.measured[:3]
            box = Box(middle, np.array([0.5 * settings.room, 0.5 * settings.room, settings.height * 2.0 / 3.0]))
            metadata = {"autopilot": "; ".join(vehicle.notes), "url": url}
            flight = FirstFlight(vehicle, robot, box, seed, stop.is_set).fly(settings.minutes, metadata)
            with contextlib.suppress(CommandLost):  # it is not ours to land then; the result says so
                vehicle.wait(vehicle.current_period.number + robot.horizon)
                vehicle.land()
                deadline = time.monotonic() + LANDING_TIMEOUT
                while vehicle.armed and time.monotonic() < deadline:
                    vehicle.listen(1.0)
        finally:
            vehicle.close()
    return flight
