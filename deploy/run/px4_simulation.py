"""Simulate the physics for a real PX4, in real time or as fast as both can.

Flight code, estimator and failsafes are PX4's own. This program simulates vehicle, sensors and arena.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.run.autopilot_run import PAD, arena_or_field, open_truth
from brakeline.errors import AutopilotGone
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.sim.arena import Arena
from brakeline.sim.autopilot.autopilot_server import PATIENCE, TRUTH_RATE, TruthSender, WallClock
from brakeline.sim.autopilot.hil_link import HilLink
from brakeline.sim.autopilot.hil_sensors import HilSensors
from brakeline.sim.autopilot.px4_process import Px4Process
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.sim_conditions import SensorNoise
from brakeline.sim.wind import Wind


@dataclass(frozen=True)
class HilSettings:
    """Settings of PX4 and of the simulated physics (hardware in the loop)."""

    folder: Path  # of a PX4 that was built for SITL
    url: str = "udpout:127.0.0.1:14540"  # where PX4 sends MAVLink
    arena: str = ""  # of the quadrotor, drawn with the seed; empty: an open field
    seed: int = 0
    noise: SensorNoise = field(default_factory=SensorNoise)
    wind: Wind = field(default_factory=Wind)
    parameters: dict[str, float] = field(default_factory=dict)  # of PX4
    truth: str = "127.0.0.1:14600"  # HOST:PORT that gets states and collisions, as JSON in UDP; empty: none
    speed: float = 1.0  # multiple of real time; 0: as fast as possible
    seconds: float = 0.0  # simulated duration; 0: until SIGINT or SIGTERM


@dataclass
class FlightResult:
    """Figures of a flight, from PX4's first answer on."""

    simulated: float = 0.0  # s
    real: float = 0.0  # s
    speed: float = 0.0  # simulated seconds in a real one
    unanswered: int = 0  # physics steps at which PX4 did not answer in time
    slips: int = 0  # times that the simulation gave up catching up with real time
    collisions: int = 0  # touches of an obstacle


def fly(settings: HilSettings, on_start: Callable[[Quadrotor], Any] = lambda vehicle: None) -> FlightResult:
    """Start PX4 and let it fly until the duration ends, SIGINT or SIGTERM.

    Args:
        on_start: is called when PX4 has answered for the first time.

    Raises:
        LaunchError: PX4 is not in the folder or does not start, or a signal ended its start.
        AutopilotGone: PX4 fell silent.
        ValueError: the URL is not on this machine.
    """
    port = _port(settings.url)
    arena = arena_or_field(settings.arena, settings.seed)
    with contextlib.ExitStack() as stack:
        # From here on, so that a signal during PX4's start also ends PX4 and deletes its files.
        stop = stack.enter_context(stop_on_signals(threading.Event(), patient=True))
        if (truth := open_truth(settings.truth)) is not None:
            stack.callback(truth.close)
        px4 = Px4Process(settings.folder, port, settings.parameters, stop.is_set)
        stack.callback(px4.close)
        try:
            hil = HilLink(px4.connection, *_vehicle(settings, arena))
            while not hil.answering and not stop.is_set():
                hil.tick()
            on_start(hil.vehicle)
            end = settings.seconds or float("inf")
            return serve(hil, WallClock(), settings.speed, lambda: stop.is_set() or hil.time >= end, truth)
        except AutopilotGone as error:
            raise AutopilotGone(f"{error}; PX4's last output:\n{px4.last_output()}") from error


def serve(
    hil: HilLink, clock: WallClock, speed: float, stop: Callable[[], bool], truth: TruthSender | None = None
) -> FlightResult:
    """Simulate step by step until `stop` returns True.

    Args:
        speed: highest multiple of the clock's time; 0: as fast as possible.
    """
    result, step = FlightResult(), hil.vehicle.timestep
    start, simulated_start = clock.now(), hil.time
    due, steps_per_report, count, touching = start, round(1.0 / TRUTH_RATE / step), 0, False
    while not stop():
        hil.vehicle.collided = False
        hil.tick()
        touched = hil.vehicle.collided and not touching
        touching = hil.vehicle.collided
        result.collisions += touched
        if truth is not None and (touched or count % steps_per_report == 0):
            truth.send(1, hil.time, hil.vehicle, result.collisions)
        count += 1
        if speed:
            due += step / speed
            clock.sleep_until(due)
            if clock.now() - due > PATIENCE:
                result.slips += 1
                due = clock.now()
    result.simulated, result.real = hil.time - simulated_start, clock.now() - start
    result.speed, result.unanswered = result.simulated / max(result.real, 1e-9), hil.unanswered
    return result


def _vehicle(settings: HilSettings, arena: Arena) -> tuple[Quadrotor, HilSensors]:
    """Return the vehicle on the floor below the arena's start, and its sensors.

    The vehicle's own estimator has no errors, for PX4 estimates.
    """
    rng = np.random.default_rng((settings.seed, 1))
    vehicle = Quadrotor(arena, rng, QuadrotorNoise(scale=0.0), settings.wind, floor=PAD)
    return vehicle, HilSensors(settings.noise, rng, vehicle.timestep)


def _port(url: str) -> int:
    kind, host, port = [*url.split(":"), "", ""][:3]
    if kind != "udpout" or host not in ("127.0.0.1", "localhost") or not port.isdigit():
        raise ValueError(f"PX4 sends to a port of this machine: udpout:127.0.0.1:PORT, not {url!r}")
    return int(port)
