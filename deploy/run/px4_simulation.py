"""A real PX4 with our physics, in real time or as fast as both can: flight code, estimator and failsafes are its own;
vehicle, sensors and arena are ours."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.deploy.run.autopilot_run import PAD, open_field
from brakeline.messaging.process_clock import Clock, WallClock
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.sim.arena import Arena
from brakeline.sim.autopilot.autopilot_server import PATIENCE, TRUTH_RATE, TruthSender
from brakeline.sim.autopilot.hil_link import AutopilotGone, HilLink
from brakeline.sim.autopilot.hil_sensors import HilSensors, SensorNoise
from brakeline.sim.autopilot.px4_process import Px4Process
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.wind import Wind

HERE = ("127.0.0.1", "localhost")


@dataclass(frozen=True)
class HilSettings:
    folder: Path  # of PX4
    url: str = "udpout:127.0.0.1:14540"  # where it sends MAVLink
    arena: str = ""  # of the quadrotor, drawn with the seed; without one: an open field
    seed: int = 0
    noise: SensorNoise = field(default_factory=SensorNoise)
    wind: Wind = field(default_factory=Wind)
    parameters: dict[str, float] = field(default_factory=dict)  # of PX4
    truth: str = "127.0.0.1:14600"  # where states and collisions go, as JSON in UDP datagrams; empty: nowhere
    speed: float = 1.0  # times real time; 0: as fast as it goes
    seconds: float = 0.0  # of simulated time until it ends; 0: on SIGINT or SIGTERM


@dataclass
class Flown:
    """How it went. Times in s, from PX4's first answer on."""

    simulated: float = 0.0
    real: float = 0.0
    speed: float = 0.0  # simulated seconds in a real one
    unanswered: int = 0  # physics steps at which PX4 did not answer in time
    slips: int = 0  # times it gave up catching up with real time
    collisions: int = 0  # touches of an obstacle

    def __str__(self) -> str:
        return (
            f"{self.simulated:.1f} s simulated in {self.real:.1f} s: {self.speed:.2f} x real time, "
            f"{self.unanswered} steps without an answer, {self.slips} slips, {self.collisions} collisions"
        )


def fly(settings: HilSettings, begun: Callable[[Quadrotor], Any] = lambda vehicle: None) -> Flown:
    """Start PX4 and let it fly until asked to end; `begun` is called when it has answered for the first time.

    Raises:
        Px4Error: it is not there or does not start; AutopilotGone: it went silent; ValueError: the URL is none of here.
    """
    port = _port(settings.url)
    arena = flight_arena(settings.arena, settings.seed) if settings.arena else open_field()
    px4 = Px4Process(settings.folder, port, settings.parameters)
    truth = _truth(settings.truth)
    try:
        with stop_on_signals(threading.Event(), patient=True) as stop:
            return _served(settings, px4, arena, truth, stop, begun)
    except AutopilotGone as error:
        raise AutopilotGone(f"{error}; PX4's last words:\n{px4.last_words()}") from error
    finally:
        px4.close()
        if truth is not None:
            truth.close()


def _served(
    settings: HilSettings,
    px4: Px4Process,
    arena: Arena,
    truth: TruthSender | None,
    stop: threading.Event,
    begun: Callable[[Quadrotor], Any],
) -> Flown:
    hil = HilLink(px4.connection, *_vehicle(settings, arena))
    while not hil.answering and not stop.is_set():
        hil.tick()
    begun(hil.vehicle)
    over = settings.seconds or float("inf")
    return serve(hil, WallClock(), settings.speed, lambda: stop.is_set() or hil.time >= over, truth)


def serve(
    hil: HilLink, clock: Clock, speed: float, stop: Callable[[], bool], truth: TruthSender | None = None
) -> Flown:
    """Step by step until told to stop, no faster than `speed` times the clock's time; 0: as fast as it goes."""
    flown, step = Flown(), hil.vehicle.timestep
    begin, since = clock.now(), hil.time
    due, every, count, touching = begin, round(1.0 / TRUTH_RATE / step), 0, False
    while not stop():
        hil.vehicle.collided = False
        hil.tick()
        begun = hil.vehicle.collided and not touching
        touching = hil.vehicle.collided
        flown.collisions += begun
        if truth is not None and (begun or count % every == 0):
            truth.send(1, hil.time, hil.vehicle, flown.collisions)
        count += 1
        if speed:
            due += step / speed
            clock.sleep_until(due)
            if clock.now() - due > PATIENCE:
                flown.slips += 1
                due = clock.now()
    flown.simulated, flown.real = hil.time - since, clock.now() - begin
    flown.speed, flown.unanswered = flown.simulated / max(flown.real, 1e-9), hil.unanswered
    return flown


def _vehicle(settings: HilSettings, arena: Arena) -> tuple[Quadrotor, HilSensors]:
    """On the floor below the arena's start; its estimator is PX4's, so ours errs in nothing."""
    rng = np.random.default_rng((settings.seed, 1))
    vehicle = Quadrotor(arena, rng, QuadrotorNoise(scale=0.0), settings.wind, floor=PAD)
    return vehicle, HilSensors(settings.noise, rng, vehicle.timestep)


def _port(url: str) -> int:
    kind, host, port = [*url.split(":"), "", ""][:3]
    if kind != "udpout" or host not in HERE or not port.isdigit():
        raise ValueError(f"PX4 sends to a port of this machine: udpout:127.0.0.1:PORT, not {url!r}")
    return int(port)


def _truth(address: str) -> TruthSender | None:
    if not address:
        return None
    host, _, port = address.rpartition(":")
    return TruthSender(host or HERE[0], int(port))
