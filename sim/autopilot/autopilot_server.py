"""Autopilots in real time on a link, and what a simulator knows beside them: the truth, on a channel of its own.

The truth goes out as UDP datagrams, one JSON object each, at `TRUTH_RATE` for each vehicle and at once on a collision:

    {"system": 1, "time": 12.34, "state": [p, v, a: nine numbers, ENU, m, m/s, m/s²],
     "collisions": 0, "clearance": 1.25}

`collisions` counts touches of an obstacle since the start, at every physics step; `clearance` [m] is from the
footprint's sphere to the nearest obstacle, null where there are none; `system` is the vehicle's system id.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from brakeline.messaging.byte_links import Link
from brakeline.messaging.process_clock import Clock
from brakeline.sim.autopilot.endpoint import TICK, Autopilot
from brakeline.sim.quadrotor import Quadrotor

TRUTH_RATE = 25.0  # Hz
PATIENCE = 0.25  # s that it may be late before it gives up catching up


class TruthSender:
    """Sends what the vehicles really do to one UDP address."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = (host, port)

    def send(self, system: int, time: float, vehicle: Quadrotor, collisions: int) -> None:
        """time: s since the autopilot was switched on; collisions: touches of an obstacle since then."""
        state = vehicle.state()
        clearance = float(vehicle.clearance(state[:3]))
        told = {
            "system": system,
            "time": round(time, 3),
            "state": state.tolist(),
            "collisions": collisions,
            "clearance": clearance if math.isfinite(clearance) else None,
        }
        try:
            self._socket.sendto(json.dumps(told).encode(), self._address)
        except OSError:
            return  # nobody listens

    def close(self) -> None:
        self._socket.close()


@dataclass
class ServerStats:
    """How a server has fared."""

    ticks: int = 0
    late: int = 0  # ticks begun more than one tick late
    slips: int = 0  # times it gave up catching up
    collisions: int = 0

    def __str__(self) -> str:
        return f"{self.ticks} ticks, {self.late} late, {self.slips} slips, {self.collisions} collisions"


def serve(
    autopilots: Sequence[Autopilot],
    link: Link,
    clock: Clock,
    stop: Callable[[], bool],
    truth: TruthSender | None = None,
) -> ServerStats:
    """Run autopilots in the clock's time until told to stop; all hear all that comes over the link."""
    tally = ServerStats()
    touches = [0] * len(autopilots)
    every = round(1.0 / TRUTH_RATE / TICK)
    due = clock.now()
    while not stop():
        clock.sleep_until(due)
        behind = clock.now() - due
        tally.late += behind > TICK
        if behind > PATIENCE:
            tally.slips += 1
            due = clock.now()
        due += TICK
        data = link.receive()
        for i, autopilot in enumerate(autopilots):
            if data:
                autopilot.receive(data)
            touching = autopilot.vehicle.collided
            autopilot.vehicle.collided = False
            autopilot.advance(TICK)
            begun = autopilot.vehicle.collided and not touching
            touches[i] += begun
            tally.collisions += begun
            if out := autopilot.take():
                link.send(out)
            if truth is not None and (begun or tally.ticks % every == 0):
                truth.send(autopilot.system, autopilot.pilot.time, autopilot.vehicle, touches[i])
        tally.ticks += 1
    return tally
