"""What really happened, by the simulator inside a real autopilot: the judge of a flight, and nothing that it flies by.

It tells latitude and longitude over MAVLink beside the estimate. Where the flight begins, the map is laid so that truth
and estimate agree; from then on what the estimate drifts by counts against the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from actors.telemetry import Array, Place


@dataclass
class Witness:
    """One flight's. clearance: of a position (3,) from the nearest obstacle, m, below 0: touched."""

    clearance_of: Callable[[Array], float]
    state: Array | None = None  # (9,), its acceleration unknown: zeros
    collisions: int = 0  # times that a touch began
    clearance: float = math.inf  # m, now
    least: float = math.inf  # m, of all clearances
    worst: float = 0.0  # m, the farthest the estimate was off the truth since the beginning, across the ground
    _start: tuple[Place, Array] | None = None
    _touching: bool = False

    def take(self, place: Place, estimate: Array, velocity: Array) -> None:
        """The truth, and the estimate (3,) [m] and (3,) [m/s] of about that moment. A height it does not tell is the
        estimate's."""
        if self._start is None:
            self._start = place, estimate.copy()
        first, origin = self._start
        position = origin + place.since(first)
        if place.altitude is None:
            position[2] = estimate[2]
        self.worst = max(self.worst, math.hypot(*(position - estimate)[:2]))
        self.state = np.concatenate((position, velocity, np.zeros(3)))
        self.clearance = now = self.clearance_of(position)
        self.least = min(self.least, now)
        self.collisions += now < 0.0 and not self._touching
        self._touching = now < 0.0
