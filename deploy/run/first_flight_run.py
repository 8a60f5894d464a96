"""Fly a vehicle for the first time, from the link to the landing, to record its first data set."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from brakeline.errors import CommandLost, MavlinkError
from brakeline.messaging.acceleration_age import about_age
from brakeline.messaging.robot import Robot
from brakeline.messaging.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
    from brakeline.deploy.data.first_flight import FirstFlightResult
    from brakeline.safety.model.dataset import Dataset

log = logging.getLogger("brakeline.collect")

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
    acceleration_age: float | None = None
    """Record the horizontal acceleration of this long ago instead of the present one [s], at most 1. By default a
    control period (0.2) behind ArduPilot, which plans its acceleration ahead, and 0 behind other autopilots. `fly`
    then uses the same age."""


def fly(robot: Robot, url: str, seed: int, settings: FirstFlightSettings, path: Path) -> FirstFlightResult:
    """Take off, fly, land, store the recorded data, and return them with their model set.

    SIGINT or SIGTERM land the vehicle at once, and so does any error; the data until then count. During the flight,
    the data until then are in a partial data set beside `path` (`partial_path`). It is deleted once `path` is stored.

    Args:
        robot: the description in real time.
        url: the MAVLink link.
        path: the file for the data.

    Raises:
        BadLink, MavlinkError: the vehicle can't be flown; the message says what to do.
        BadData: nothing was recorded.
    """
    from brakeline.actors.actor_settings import FlightSettings
    from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
    from brakeline.actors.mavlink.vehicle_socket import listening
    from brakeline.deploy.data.build_lock import folder_lock
    from brakeline.deploy.data.first_flight import Box, FirstFlight
    from brakeline.deploy.data.partial_save import PartialSave, partial_path
    from brakeline.deploy.data.patient_save import save_patiently

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    flight_settings = FlightSettings(
        url,
        settings.system,
        height=settings.height,
        raise_limits=settings.raise_limits,
        lead=settings.lead,
    )
    partial = PartialSave(partial_path(path))
    # A second signal must not leave the vehicle in the air. No actor of this machine may take the vehicle.
    with stop_on_signals(threading.Event(), patient=True) as stop, listening(url, settings.system):
        vehicle = MavlinkVehicle(robot, flight_settings, stop=stop.is_set, from_ground=True)
        age = settings.acceleration_age
        if age is None:
            age = robot.period if vehicle.autopilot == "ardupilot" else 0.0
        vehicle.acceleration_age = age
        try:
            middle = vehicle.current_period.report.measured[:3]
            box = Box(middle, np.array([0.5 * settings.room, 0.5 * settings.room, settings.height * 2.0 / 3.0]))
            metadata = {"autopilot": "; ".join(vehicle.notes), "url": url} | about_age([age])
            flight = FirstFlight(vehicle, robot, box, seed, metadata, stop.is_set, partial.offer)
            try:
                flight.fly(settings.minutes)
            finally:
                land(vehicle, robot.horizon)
                partial.finish()
        finally:
            vehicle.close()

    def store(data: Dataset) -> None:
        with folder_lock(path.parent):
            save_patiently(data, path)
        partial.remove()
        log.info("the flight is stored in %s", path)

    return flight.result(store)


def land(vehicle: MavlinkVehicle, periods: int) -> None:
    """Brake, land the vehicle and wait until it disarms, unless somebody else has it. Log what a person has to do.

    Our command may have ended, or the vehicle may be in a mode that a pilot or a failsafe chose: it is not ours to land
    then.

    periods: control periods to brake for.
    """
    with contextlib.suppress(MavlinkError):  # the vehicle's thread may have died
        vehicle.wait(vehicle.current_period.number + periods)
    if isinstance(vehicle.failure, CommandLost):
        return
    if not vehicle.offboard:
        log.error("not landing: the vehicle does not follow our setpoints (%s): land it", vehicle.mode)
        return
    try:
        vehicle.land()
        deadline = time.monotonic() + LANDING_TIMEOUT
        while vehicle.armed and time.monotonic() < deadline:
            vehicle.listen(1.0)
    except MavlinkError as error:
        log.error("the vehicle does not land, so land it yourself: %s", error)
        return
    if vehicle.armed:
        log.error("the vehicle is still armed after %.0f s: land and disarm it yourself", LANDING_TIMEOUT)
