"""Ground truth of a simulated flight: it counts collisions, and no decision uses it.

Two sources exist. Our own simulator sends it over UDP beside MAVLink (`UdpGroundTruth`). A real autopilot that runs in
a simulator sends it over MAVLink beside the estimate (`MavlinkGroundTruth`).
"""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass
from typing import Any

import numpy as np

from brakeline.actors.mavlink.telemetry import Array, GeoPosition
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.structured_text import parse_json
from brakeline.sim.quadrotor import QUADROTOR

FARTHEST = 1e5  # m, m/s, ...: no vehicle is farther away, or faster
MOST_DATAGRAMS = 100  # read in one call of `poll`


class UdpGroundTruth:
    """The latest ground truth that `brakeline.sim.autopilot.autopilot_server` on this machine sends over UDP."""

    def __init__(self, port: int, system: int, rejected: RejectedMessages | None = None) -> None:
        """Listen on a UDP port of the loopback interface. system: the vehicle's. Raises OSError: the port is in use."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._system, self._rejected = system, rejected or RejectedMessages()
        self.state: Array | None = None  # (9,); None before the first datagram
        self.collisions = 0  # number of times that the vehicle began to touch an obstacle
        self.clearance = math.inf  # m from the body to the nearest obstacle; inf if the simulator sends none

    def poll(self) -> None:
        """Read the datagrams that have arrived, `MOST_DATAGRAMS` at most: a flood must not hold up the flight."""
        for _ in range(MOST_DATAGRAMS):
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                return
            with self._rejected.skip_on_error("truth"):
                self._take(parse_json(data))

    def close(self) -> None:
        self._socket.close()

    def _take(self, values: Any) -> None:
        """Take over the values of a datagram. Raises ValueError, TypeError, KeyError: it is not our simulator's."""
        if values["system"] != self._system:
            return
        state, clearance = np.array(values["state"], float), values["clearance"]
        clearance = math.inf if clearance is None else float(clearance)
        if state.shape != (QUADROTOR.state_dim,) or not (np.abs(state) < FARTHEST).all() or math.isnan(clearance):
            raise ValueError(f"state {values['state']}, clearance {clearance}")
        if type(values["collisions"]) is not int:
            raise ValueError(f"collisions {values['collisions']!r}")
        self.state, self.collisions, self.clearance = state, values["collisions"], clearance


@dataclass
class MavlinkGroundTruth:
    """Ground truth of one flight, from the latitude and longitude that an autopilot's simulator sends over MAVLink.

    The first message places the map so that truth and estimate agree. From then on, the drift of the estimate can cause
    collisions that count.
    """

    obstacles: Shapes
    footprint: float  # m, the body's radius
    state: Array | None = None  # (9,), with an unknown acceleration of 0; None before the first message
    collisions: int = 0  # number of times that the vehicle began to touch an obstacle
    clearance: float = math.inf  # m, the latest; below 0 the body touches an obstacle
    least: float = math.inf  # m, the smallest clearance so far
    worst: float = 0.0  # m, the largest horizontal distance so far from the estimate to the truth
    _start: tuple[GeoPosition, Array] | None = None
    _touching: bool = False

    def take(self, place: GeoPosition, estimate: Array, velocity: Array) -> None:
        """Take the true place, and the estimated position (3,) [m] and velocity (3,) [m/s] of about the same moment.

        If `place` has no altitude, the estimate's height stands for it.
        """
        if self._start is None:
            self._start = place, estimate.copy()
        first, origin = self._start
        position = origin + place.since(first)
        if place.altitude is None:
            position[2] = estimate[2]
        self.worst = max(self.worst, math.hypot(*(position - estimate)[:2]))
        self.state = np.concatenate((position, velocity, np.zeros(3)))
        self.clearance = now = float(self.obstacles.distance(position).min(initial=math.inf)) - self.footprint
        self.least = min(self.least, now)
        self.collisions += now < 0.0 and not self._touching
        self._touching = now < 0.0
