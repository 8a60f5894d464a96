"""Quadrotors behind MAVLink, in real time, at one end of a link."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.messaging.byte_links import open_link
from brakeline.messaging.process_clock import WallClock
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.messaging.task import robot_with_task
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT
from brakeline.sim.autopilot.autopilot_server import ServerStats, TruthSender, serve
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.parameters import AT_ONCE
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.lidar import Lidar
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.wind import Wind

FIELD = 1000.0  # m to the walls of the open field
PAD = 0.02  # m, height of the plane to stand on above an arena's own floor, which is an obstacle


@dataclass(frozen=True)
class AutopilotSettings:
    url: str
    rules: str = "px4"  # whose modes, refusals and parameters: px4 or ardupilot
    vehicles: int = 1  # by system id 1, 2, ...; they pass through each other
    arena: str = ""  # of the quadrotor, drawn with the seed; without one: an open field
    seed: int = 0
    airborne: bool = False  # start hovering at the arena's start, armed, instead of on the ground below it
    setpoint_timeout: float | None = None  # s without a setpoint until it brakes; None: as the rules' parameter has it
    wind: Wind = field(default_factory=Wind)
    truth: str = "127.0.0.1:14600"  # where states and collisions go, as JSON in UDP datagrams; empty: nowhere
    seconds: float = 0.0  # until it ends; 0: on SIGINT or SIGTERM
    at_once: bool = False  # it follows setpoints at once, as the vehicle that was recorded; else as it is delivered


def fly(settings: AutopilotSettings, begun: Callable[[Arena], Any] = lambda arena: None) -> ServerStats:
    """Serve the vehicles until asked to end; `begun` is called when the link is open."""
    arena = flight_arena(settings.arena, settings.seed) if settings.arena else open_field()
    link = open_link(settings.url)
    truth = None
    if settings.truth:
        host, _, port = settings.truth.rpartition(":")
        truth = TruthSender(host or "127.0.0.1", int(port))
    autopilots = [vehicle(settings, arena, system) for system in range(1, settings.vehicles + 1)]
    clock = WallClock()
    begun(arena)
    try:
        with stop_on_signals(threading.Event(), patient=True) as stop:
            return serve(autopilots, link, clock, lambda: stop.is_set() or 0.0 < settings.seconds <= clock.now(), truth)
    finally:
        link.close()


def vehicle(settings: AutopilotSettings, arena: Arena, system: int) -> Autopilot:
    """The endpoint of one vehicle."""
    rng = np.random.default_rng((settings.seed, system))
    noise = QuadrotorNoise()
    quadrotor = Quadrotor(arena, rng, noise, settings.wind, floor=None if settings.airborne else PAD)
    lidar = Lidar(arena, robot_with_task("quadrotor").task.rays, noise.scale * noise.lidar, rng)
    timeout = settings.setpoint_timeout
    parameters = dict(AT_ONCE[settings.rules]) if settings.at_once else {}
    if timeout is not None:
        parameters[SETPOINT_TIMEOUT[settings.rules]] = timeout
    return Autopilot(quadrotor, settings.rules, system, parameters, lidar)


def open_field() -> Arena:
    """Nothing but walls far away; the origin is where to start."""
    return Arena(
        "open field",
        room_boundary(FIELD, FIELD),
        (0.0, 0.0, 5.0),
        (10.0, 0.0, 5.0),
        1.0,
        10**9,
        room_bounds(FIELD, FIELD),
    )
