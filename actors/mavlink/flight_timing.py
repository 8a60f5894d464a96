"""How well a flight keeps real time, and the offset between the autopilot's clock and ours."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

MOST_LATENESSES = 10_000  # the latest ones count


@dataclass
class FlightTiming:
    """Statistics of the control periods."""

    periods: int = 0
    late: int = 0  # periods that began more than `mavlink_vehicle.LATE` after their time
    slips: int = 0  # periods that began late by a period or more: the one before lasted two or more
    worst_gap: float = 0.0  # s between two setpoints
    round_trip: float = math.inf  # s to the autopilot and back, the fastest
    lost: int = 0  # periods whose telemetry or mode did not count
    lateness: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_LATENESSES))  # s, of each period's start

    def figures(self) -> dict[str, float]:
        lateness_ms = 1e3 * np.array([*self.lateness] or [0.0])
        return {
            "periods": self.periods,
            "periods late": self.late,
            "periods slipped": self.slips,
            "lateness p50 ms": float(np.percentile(lateness_ms, 50)),
            "lateness p99 ms": float(np.percentile(lateness_ms, 99)),
            "lateness worst ms": float(lateness_ms.max()),
            "worst setpoint gap ms": 1e3 * self.worst_gap,
            "periods without telemetry": self.lost,
            **({"link round trip ms": 1e3 * self.round_trip} if math.isfinite(self.round_trip) else {}),
        }


class ClockOffset:
    """Our clock minus the autopilot's [s], from the messages with the least delay.

    The value falls at once, and rises only by the drift between two clocks: on a busy machine messages arrive
    milliseconds late, and at 7 m/s each millisecond is 7 mm. Messages that all arrive later do not tell a clock that
    has jumped, as when a simulator stalls, from a link that has become slower. A TIMESYNC reply does: the autopilot
    read its clock after our request was sent, so no delay makes the offset larger than that.
    """

    DRIFT = 1e-4  # s per second, the largest between two clocks
    JUMP = 0.05  # s, by which the clock must have jumped: autopilots read their clock some milliseconds early

    def __init__(self) -> None:
        self.value = math.inf  # before the first message
        self._noted_at = -math.inf  # s, arrival of the last message

    def note(self, now: float, theirs: float) -> None:
        """Take in a message that arrives at `now` [s, our clock] and was sent at `theirs` [s, the autopilot's]."""
        drifted = self.value + self.DRIFT * (now - self._noted_at) if math.isfinite(self.value) else math.inf
        self.value, self._noted_at = min(drifted, now - theirs), now

    def answer(self, asked: float, theirs: float, round_trip: float) -> None:
        """Take in a TIMESYNC reply: follow the autopilot's clock if it has jumped further than any delay explains.

        asked: s, our clock at the request; theirs: s, the autopilot's at its reply; round_trip: s, the fastest so far.
        A reply to a request that was itself delayed proves less of a jump; the next fast one proves all of it.
        """
        proved = asked - theirs + round_trip
        if proved > self.value + self.JUMP:
            self.value = proved
