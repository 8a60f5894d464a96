"""What our own simulator tells about a vehicle beside MAVLink."""

from __future__ import annotations

import json
import math
import socket
from typing import Any

import numpy as np
from numpy.typing import NDArray

from messaging.tolerant import Tolerance
from sim.quadrotor import QUADROTOR

Array = NDArray[np.float64]

FARTHEST = 1e5  # m, m/s, ...: no vehicle is farther off, or as fast
MOST_TOLD = 100  # datagrams read at one look


class Truth:
    """What a simulator on this machine tells about a vehicle beside MAVLink (sim.autopilot.server): its last word."""

    def __init__(self, port: int, system: int, tolerance: Tolerance | None = None) -> None:
        """Listen on a UDP port for this machine alone. Raises OSError when it is taken."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._system, self._tolerance = system, tolerance or Tolerance()
        self.state: Array | None = None
        self.collisions = 0
        self.clearance = math.inf

    def poll(self) -> None:
        """Take what has come, but not for ever: whoever sends without end must not hold up the flight."""
        for _ in range(MOST_TOLD):
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                return
            with self._tolerance.over("truth"):
                self._take(json.loads(data))

    def _take(self, told: Any) -> None:
        """Raises ValueError, TypeError, KeyError: it is not what a simulator tells."""
        if told["system"] != self._system:
            return
        state, clearance = np.array(told["state"], float), told["clearance"]
        clearance = math.inf if clearance is None else float(clearance)
        if state.shape != (QUADROTOR.state_dim,) or not (np.abs(state) < FARTHEST).all() or math.isnan(clearance):
            raise ValueError(f"state {told['state']}, clearance {clearance}")
        if type(told["collisions"]) is not int:
            raise ValueError(f"collisions {told['collisions']!r}")
        self.state, self.collisions, self.clearance = state, told["collisions"], clearance

    def close(self) -> None:
        self._socket.close()
