"""Decide whether the measurement of a flight counts, and whether the autopilot still follows our setpoints."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from brakeline.actors.mavlink.flight_timing import ClockOffset, FlightTiming
from brakeline.actors.mavlink.mavlink_decoder import JUMP, MavlinkDecoder
from brakeline.actors.mavlink.telemetry import IN_FLIGHT, MOTION, Array, unknown_quantities

POLL = 0.005  # s between two reads of the link
STALE = 0.2  # s without a position, an attitude or an acceleration after which telemetry counts as lost
SILENT = 3.0  # s without a heartbeat after which the mode counts as unknown
# s, for which a vehicle may fly on at its last velocity: until its autopilot's timeout, and while it brakes
COAST = 2.0
DRIFT = 0.1  # m/s, of a vehicle that hovers
MOST_REQUESTS = 10  # for the autopilot's clock, to which a reply still counts


class FlightWatch:
    """When the latest messages of an autopilot arrived, and how old they were then."""

    def __init__(self, client: MavlinkDecoder, timing: FlightTiming) -> None:
        self._client, self._timing = client, timing
        self._counted: dict[str, int] = {}  # messages by their quantity
        self._received_at: dict[str, float] = {}  # s, arrival of the latest of them
        # ns, our clock at our requests for the autopilot's
        self._clock_requests: deque[int] = deque(maxlen=MOST_REQUESTS)
        self._offsets = ClockOffset()
        self._noted_at = math.inf  # s, time of the last call of `note`
        self._before: Array | None = None  # (3,) m, the latest position
        self._reach = 0.0  # m, the way that the vehicle can have flown since then

    def note(self, now: float, setpoint: float = 0.0) -> None:
        """Take in what the client has received up to `now` [s]. setpoint: the speed that we command [m/s]."""
        client, timing = self._client, self._timing
        self._reach += setpoint * max(now - self._noted_at, 0.0)
        self._noted_at = now
        for what, count in client.message_counts.items():
            if self._counted.get(what) != count:
                if what == MOTION:
                    self._offsets.note(now, client.time)
                    self._note_position(now - self._received_at.get(what, now))
                self._counted[what], self._received_at[what] = count, now
        for asked, theirs in client.clock_answers:
            if asked in self._clock_requests:  # other stations ask, too
                timing.round_trip = min(timing.round_trip, now - 1e-9 * asked)
                self._offsets.answer(1e-9 * asked, 1e-9 * theirs, timing.round_trip)
        client.clock_answers.clear()

    def _note_position(self, silent: float) -> None:
        """Take in the latest position. End our command if the vehicle cannot have flown there.

        Without positions the vehicle brakes along the committed plan, and then hovers. So the setpoints and its last
        velocity limit its way, however long a gap is: a position farther away is in another frame.

        silent: s since the position before arrived.
        """
        client = self._client
        if silent > STALE and self._before is not None and client.position is not None:
            moved = float(np.linalg.norm(client.position - self._before))
            if not moved <= JUMP + DRIFT * silent + self._reach:
                why = f"its position jumped by {moved:.2f} m in a gap of {silent:.2f} s, farther than it can have flown"
                client.interruption = client.interruption or why
        self._before, self._reach = client.position, COAST * float(np.linalg.norm(client.velocity))

    def clock_requested(self, nanoseconds: int) -> None:
        """Note a request for the autopilot's clock at this time of ours [ns]."""
        self._clock_requests.append(nanoseconds)

    @property
    def offset(self) -> float:
        """Our clock minus the autopilot's, s.

        The estimate comes from the messages with the least delay, minus half of the fastest TIMESYNC round trip. The
        part of a round trip that our own polling explains does not count.
        """
        one_way = 0.5 * self._timing.round_trip - POLL
        return self._offsets.value - (one_way if 0.0 < one_way < math.inf else 0.0)

    def age(self, now: float) -> float:
        """Return the age of the latest position at `now`, s."""
        return now - self.offset - self._client.time

    def silence(self, now: float) -> float:
        """Return the seconds since the last message of the autopilot."""
        return now - max(self._received_at.values(), default=-math.inf)

    def stale(self, now: float) -> str:
        """Return why the measured state is too old to count; empty if it counts."""
        for what in IN_FLIGHT:
            silent = now - self._received_at.get(what, -math.inf)
            if silent > STALE:
                return f"no telemetry of {what} for {silent:.2f} s"
        if (age := self.age(now)) > STALE:
            return f"telemetry arrives too late: no newer position for {age:.2f} s"
        return ""

    def lost(self, now: float) -> str:
        """Return why the measurement or our control does not count; empty if both count."""
        client = self._client
        if client.interruption:
            return f"our command of the vehicle has ended: {client.interruption}"
        if why := self.stale(now):
            return why
        if now - self._received_at.get("mode", -math.inf) > SILENT:
            return f"no heartbeat for more than {SILENT:.0f} s"
        if not (client.offboard and client.armed):
            state = client.mode if client.armed else "it is disarmed"
            return f"the autopilot does not follow our setpoints ({state})"
        if client.estimator is not None and (unknown := unknown_quantities(client.estimator)):
            return f"its estimator does not know {', '.join(unknown)}"
        if client.breached_side:
            return f"the autopilot says that it is outside of its geofence ({client.breached_side})"
        return "the autopilot says that it is in an emergency" if client.emergency else ""
