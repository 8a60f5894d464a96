"""A vehicle's first flight, from the link to the landing."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass

import numpy as np

from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.actors.mavlink.vehicle_socket import listening
from brakeline.deploy.data.first_flight import Box, Found, Maiden
from brakeline.messaging.byte_links import open_link
from brakeline.messaging.robot import Robot
from brakeline.messaging.stop_signals import stop_on_signals

LANDING = 120.0  # s that a landing may take


@dataclass(frozen=True)
class MaidenSettings:
    url: str
    system: int = 1
    minutes: float = 15.0
    height: float = 30.0  # m
    room: float = 80.0  # m, the side of the square
    seed: int = 0
    raise_limits: bool = False
    lead: bool = False


def fly(robot: Robot, settings: MaidenSettings) -> Found:
    """Take off, fly, land. SIGINT or SIGTERM: land at once; what was flown counts.

    Raises:
        BadLink, MavlinkError: with what to do; BadData: nothing was flown.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    with (
        stop_on_signals(threading.Event(), patient=True) as stop,  # a second one must not leave it in the air
        listening(settings.url, settings.system),  # so that no actor of this machine takes it
    ):
        return _flown(robot, settings, stop)


def _flown(robot: Robot, settings: MaidenSettings, stop: threading.Event) -> Found:
    vehicle = MavlinkVehicle(
        open_link(settings.url),
        robot,
        settings.system,
        settings.height,
        stop=stop.is_set,
        raise_limits=settings.raise_limits,
        lead=settings.lead,
    )
    try:
        middle = vehicle.current_period.report.measured[:3]
        box = Box(middle, np.array([0.5 * settings.room, 0.5 * settings.room, settings.height * 2.0 / 3.0]))
        about = {"autopilot": "; ".join(vehicle.notes), "url": settings.url}
        found = Maiden(vehicle, robot, box, settings.seed, stop.is_set).fly(settings.minutes, about)
        vehicle.wait(vehicle.current_period.number + robot.horizon)
        vehicle.land()
        _await_landing(vehicle)
    finally:
        vehicle.close()
    return found


def _await_landing(vehicle: MavlinkVehicle) -> None:
    deadline = time.monotonic() + LANDING
    while vehicle.armed and time.monotonic() < deadline:
        vehicle.listen(1.0)
