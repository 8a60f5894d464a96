"""Run autopilots in real time on a link, and send the ground truth of their vehicles over a separate channel.

The ground truth goes out as UDP datagrams, one JSON object each, at `TRUTH_RATE` for each vehicle and at once on a
collision:

    {"system": 1, "time": 12.34, "state": [p, v, a: nine numbers, ENU, m, m/s, m/s²],
     "collisions": 0, "clearance": 1.25}

`collisions` counts the contacts with an obstacle that began since the start. `clearance` [m] is the distance from the
sphere of the footprint to the nearest obstacle, null without obstacles. `system` is the vehicle's system id.
"""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from brakeline.messaging.byte_links import Link
from brakeline.sim.autopilot.endpoint import TICK, Autopilot
from brakeline.sim.quadrotor import Quadrotor

TRUTH_RATE = 25.0  # Hz
PATIENCE = 0.25  # s behind the clock, from which the server stops catching up


class WallClock:
    """Real time in seconds since the clock was created, independent of changes to the system's date."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic() - self._start

    def sleep_until(self, moment: float) -> None:
        """Return when `now()` has reached `moment` [s]; at once if it has passed."""
        time.sleep(max(0.0, moment - self.now()))


class TruthSender:
    """Sends the ground truth of vehicles to one UDP address."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = (host, port)

    def send(self, system: int, time: float, vehicle: Quadrotor, collisions: int) -> None:
        """Send one datagram; without a listener it is lost. time: s; collisions: contacts that began so far."""
        state = vehicle.state()
        clearance = float(vehicle.clearance(state))
        message = {
            "system": system,
            "time": round(time, 3),
            "state": state.tolist(),
            "collisions": collisions,
            "clearance": clearance if math.isfinite(clearance) else None,
        }
        with suppress(OSError):
            self._socket.sendto(json.dumps(message).encode(), self._address)

    def close(self) -> None:
        self._socket.close()


@dataclass
class ServerStats:
    """Statistics of a server."""

    ticks: int = 0
    late: int = 0  # ticks begun more than one tick late
    slips: int = 0  # times that it stopped catching up
    collisions: int = 0


def serve(
    autopilots: Sequence[Autopilot],
    link: Link,
    clock: WallClock,
    stop: Callable[[], bool],
    truth: TruthSender | None = None,
) -> ServerStats:
    """Run autopilots in the clock's time until `stop()`. Every autopilot receives all data of the link."""
    stats = ServerStats()
    touches = [0] * len(autopilots)
    every = round(1.0 / TRUTH_RATE / TICK)
    due = clock.now()
    while not stop():
        clock.sleep_until(due)
        behind = clock.now() - due
        stats.late += behind > TICK
        if behind > PATIENCE:
            stats.slips += 1
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
            stats.collisions += begun
            if out := autopilot.take():
                link.send(out)
            if truth is not None and (begun or stats.ticks % every == 0):
                truth.send(autopilot.system, autopilot.flight.time, autopilot.vehicle, touches[i])
        stats.ticks += 1
    return stats
