"""`brakeline autopilot`: quadrotors behind MAVLink, in real time, for any ground station or companion."""

from __future__ import annotations

import signal
import threading
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from deploy.commands.common import errors, say_json
from deploy.vehicles import flight_arena
from messaging.clock import WallClock
from messaging.links import open_link
from messaging.rays import rays_of
from messaging.robots import QUADROTOR
from sim.autopilot.endpoint import Autopilot as Endpoint
from sim.autopilot.rules import SETPOINT_TIMEOUT
from sim.autopilot.server import Truth, serve
from sim.flight_estimator import QuadrotorNoise
from sim.lidar import Lidar
from sim.quadrotor import Quadrotor
from sim.wind import Wind
from sim.world import Arena, closing, room_bounds

FIELD = 1000.0  # m to the walls of the open field
PAD = 0.02  # m, height of the plane to stand on above an arena's own floor, which is an obstacle


@dataclass(frozen=True)
class Autopilot:
    url: str = "udpout:127.0.0.1:14540"
    """udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT. PX4's simulator sends to UDP 14540, ArduPilot's listens on
    TCP 5760."""
    rules: Literal["px4", "ardupilot"] = "px4"
    """Whose modes, refusals and parameters."""
    vehicles: int = 1
    """By system id 1, 2, …; they pass through each other."""
    arena: str = ""
    """Of the quadrotor, drawn with the seed; without one: an open field."""
    seed: int = 0
    airborne: bool = False
    """Start hovering at the arena's start, armed, instead of on the ground below it."""
    setpoint_timeout: float | None = None
    """s without a setpoint until it brakes; without it: as the rules' parameter has it (1 s, 3 s)."""
    wind: float = 0.0
    """m/s, mean; its direction is drawn."""
    gust: float = 0.0
    """m/s, standard deviation on each axis."""
    truth: str = "127.0.0.1:14600"
    """Where states and collisions go, as JSON in UDP datagrams; empty: nowhere."""
    seconds: float = 0.0
    """Until it ends; 0: on ^C."""
    json: bool = False

    def run(self) -> int:
        arena = flight_arena(self.arena, self.seed) if self.arena else open_field()
        link = open_link(self.url)
        truth = None
        if self.truth:
            host, _, port = self.truth.rpartition(":")
            truth = Truth(host or "127.0.0.1", int(port))
        autopilots = [self.autopilot(arena, system) for system in range(1, self.vehicles + 1)]
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        clock = WallClock()
        if not self.json:
            errors.print(f"{self.rules} on {self.url}, {self.vehicles} vehicle(s), {arena.name}; ^C ends it")
        try:
            tally = serve(autopilots, link, clock, lambda: stop.is_set() or 0.0 < self.seconds <= clock.now(), truth)
        finally:
            link.close()
        if self.json:
            say_json(asdict(tally))
        else:
            errors.print(f"{tally.ticks} ticks, {tally.late} late, {tally.slips} slips, {tally.collisions} collisions")
        return 0

    def autopilot(self, arena: Arena, system: int) -> Endpoint:
        """The endpoint of one vehicle."""
        rng = np.random.default_rng((self.seed, system))
        noise = QuadrotorNoise()
        wind = Wind(speed=self.wind, gust=self.gust)
        vehicle = Quadrotor(arena, rng, noise, wind, floor=None if self.airborne else PAD)
        lidar = Lidar(arena, rays_of(QUADROTOR), noise.scale * noise.lidar, rng)
        timeout = {} if self.setpoint_timeout is None else {SETPOINT_TIMEOUT[self.rules]: self.setpoint_timeout}
        return Endpoint(vehicle, self.rules, system, timeout, lidar)


def open_field() -> Arena:
    """Nothing but walls far away; the origin is where to start."""
    return Arena(
        "open field", closing(FIELD, FIELD), (0.0, 0.0, 5.0), (10.0, 0.0, 5.0), 1.0, 10**9, room_bounds(FIELD, FIELD)
    )
