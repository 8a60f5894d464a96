"""Simulate quadrotors behind MAVLink in real time, at one end of a link."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.messaging.byte_links import open_link
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT
from brakeline.sim.autopilot.autopilot_server import ServerStats, TruthSender, WallClock, serve
from brakeline.sim.autopilot.endpoint import Autopilot
from brakeline.sim.autopilot.parameters import AT_ONCE
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.wind import Wind

FIELD_SIZE = 1000.0  # m from the origin to the walls of the open field
PAD = 0.02  # m, height of the ground above the arena's own floor, which is an obstacle


@dataclass(frozen=True)
class AutopilotSettings:
    """Settings of the simulated vehicles and their autopilots."""

    url: str
    rules: str = "px4"  # modes, refusals and parameters: px4 or ardupilot
    vehicles: int = 1  # with system ids 1, 2, ...; they pass through each other
    arena: str = ""  # of the quadrotor, drawn with the seed; empty: an open field
    seed: int = 0
    airborne: bool = False  # start armed and hovering at the arena's start, instead of on the ground below it
    setpoint_timeout: float | None = None  # s without a setpoint after which it brakes; None: the rules' parameter
    noise: QuadrotorNoise = field(default_factory=QuadrotorNoise)
    wind: Wind = field(default_factory=Wind)
    changes: dict[str, float] = field(default_factory=dict)  # of the vehicles' physics, as `Quadrotor.alter` takes them
    truth: str = "127.0.0.1:14600"  # HOST:PORT that gets states and collisions, as JSON in UDP; empty: none
    seconds: float = 0.0  # duration; 0: until SIGINT or SIGTERM
    at_once: bool = False  # follow setpoints at once, as the recorded vehicle does; else with the delivered limits


def fly(settings: AutopilotSettings, on_start: Callable[[Arena], Any] = lambda arena: None) -> ServerStats:
    """Serve the vehicles until the duration ends, SIGINT or SIGTERM. Calls `on_start` when the link is open."""
    arena = arena_or_field(settings.arena, settings.seed)
    link = open_link(settings.url)
    truth = open_truth(settings.truth)
    autopilots = [vehicle(settings, arena, system) for system in range(1, settings.vehicles + 1)]
    clock = WallClock()
    on_start(arena)
    try:
        with stop_on_signals(threading.Event(), patient=True) as stop:
            return serve(autopilots, link, clock, lambda: stop.is_set() or 0.0 < settings.seconds <= clock.now(), truth)
    finally:
        link.close()
        if truth is not None:
            truth.close()


def vehicle(settings: AutopilotSettings, arena: Arena, system: int) -> Autopilot:
    """Return the MAVLink endpoint of one vehicle."""
    rng = np.random.default_rng((settings.seed, system))
    floor = None if settings.airborne else PAD
    quadrotor = Quadrotor(arena, rng, settings.noise, settings.wind, floor, settings.changes)
    timeout = settings.setpoint_timeout
    parameters = dict(AT_ONCE[settings.rules]) if settings.at_once else {}
    if timeout is not None:
        parameters[SETPOINT_TIMEOUT[settings.rules]] = timeout
    return Autopilot(quadrotor, settings.rules, system, parameters)


def arena_or_field(name: str, seed: int) -> Arena:
    """Return the arena with this name, drawn with the seed; an open field for an empty name."""
    return flight_arena(name, seed) if name else open_field()


def open_field() -> Arena:
    """Return an arena with nothing in it but walls far away, and the start at its middle."""
    walls, bounds = room_boundary(FIELD_SIZE, FIELD_SIZE), room_bounds(FIELD_SIZE, FIELD_SIZE)
    return Arena("open field", walls, (0.0, 0.0, 5.0), (10.0, 0.0, 5.0), 1.0, 10**9, bounds)


def open_truth(address: str) -> TruthSender | None:
    """Return the sender of true states to HOST:PORT; None for an empty address."""
    host, _, port = address.rpartition(":")
    return TruthSender(host or "127.0.0.1", int(port)) if address else None
