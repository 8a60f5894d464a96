"""From whatever state an autopilot is in to hovering under our setpoints: what it must know, tell and allow first."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable

import numpy as np

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, MavlinkError, TelemetryMissing, message_id
from brakeline.actors.mavlink.autopilot_limits import (
    AUTOPILOT_LIMITS,
    FIXED_TIMEOUT,
    SHORTEST,
    TIMEOUTS,
    demand,
    limits_below_demand,
)
from brakeline.actors.mavlink.telemetry import ATTITUDE, FORCE, LANDED, MOTION, Array, missing
from brakeline.messaging.robot import Robot

log = logging.getLogger("brakeline.flight")

TELEMETRY = 0.02  # s from one message to the next, as it is asked for
READINGS = 10  # of the accelerometer, at most, the mean of which counts: those of one period
STATUS = {"px4": {"SYS_STATUS": 2.0}, "ardupilot": {"SYS_STATUS": 2.0, "FENCE_STATUS": 0.5}}  # s
ESTIMATING = 300.0  # s that an estimator may take to know where it is
PROGRESS = 5.0  # s between two lines about that
SPEECHLESS = 30.0  # s after which one that grants to tell and does not is no longer waited for
REST = 0.2  # m/s: slower is hovering; what is estimated may be off by half of that, for good
STOPPING = 20.0  # s until it hovers: it may have flown when we came, at full speed
CLIMB = np.array([0.0, 0.0, 1.0])  # m/s

Wait = Callable[[Callable[[], bool], float], bool]  # until it holds, or so many s have gone by: does it hold?


class Takeoff:
    """One takeoff, from the first heartbeat on. notes: which messages are used, which parameters are too low."""

    def __init__(
        self,
        client: AutopilotClient,
        robot: Robot,
        wait: Wait,
        hold: Callable[[Array | None], None],
        raise_limits: bool,
        lead: bool = False,
    ) -> None:
        """hold: have a setpoint (3,) [m/s] repeated from now on, None: none; raise_limits: set those parameters that
        hold it below what the robot's description asks for; lead: send
        positions (`brakeline.actors.mavlink.position_lookahead`)."""
        self._client, self._robot, self._wait, self._hold = client, robot, wait, hold
        self._raise_limits, self._lead = raise_limits, lead
        self.notes: list[str] = []

    def fly(self, height: float) -> None:
        """Climb to that height [m] above the ground unless it flies already, and come to rest.

        Raises:
            MavlinkError: it refuses, or does not come to where it flies as it is told.
        """
        client, wait = self._client, self._wait
        kind = client.identify(wait)
        self.note(f"{kind}, in {client.mode}")
        self._await_estimate()
        for what, interval in ((LANDED, 0.2), (ATTITUDE, TELEMETRY), (FORCE, TELEMETRY), (MOTION, TELEMETRY)):
            self.note(client.choose(what, interval, wait))
        if not wait(lambda: client.position is not None and client.airborne is not None, 3.0):
            raise TelemetryMissing("it does not tell its position, or whether it flies")
        self._smooth()
        for message, interval in STATUS[kind].items():
            with contextlib.suppress(MavlinkError):
                client.stream(message_id(message), interval, wait)
        self._compare_limits(kind)
        if self._lead:
            client.lead(wait)
            self.note("it is told places to go to: when setpoints stop it stays at the last one")
        self._hold(np.zeros(3))
        client.follow_setpoints(wait)
        if not client.armed:
            client.arm(wait)
        if not client.airborne:
            self._climb(kind, height)
        self._hold(np.zeros(3))
        if not wait(lambda: float(np.linalg.norm(client.velocity)) < REST, STOPPING):
            raise MavlinkError("it does not come to rest")
        if not wait(lambda: client.offboard and client.armed, 3.0):
            raise MavlinkError("it says that it follows setpoints, and its heartbeat that it does not")

    def _await_estimate(self) -> None:
        """Wait until the estimator knows where it is, if it says so; with progress."""
        client, wait = self._client, self._wait
        if not client.watch_estimator(wait):
            return
        began = said_at = time.monotonic()
        ready = lambda: client.estimator is not None and not missing(client.estimator)  # noqa: E731
        while not wait(ready, max(0.0, said_at + PROGRESS - time.monotonic())):
            said_at, lacking = time.monotonic(), ", ".join(missing(client.estimator or 0))
            if client.estimator is None and said_at - began > SPEECHLESS:
                return
            if said_at - began > ESTIMATING:
                raise MavlinkError(f"its estimator does not know, after {ESTIMATING:.0f} s: {lacking}")
            log.info("waiting for the position estimate: %.0f s, it does not know: %s", said_at - began, lacking)

    def _smooth(self) -> None:
        """Take the mean of as many readings of the accelerometer as it takes to come within the description's error."""
        client = self._client
        felt: list[Array] = []

        def another() -> bool:
            if client.message_counts[FORCE] != len(felt) + heard:
                felt.append(client.acceleration)
                return len(felt) >= 2 * READINGS
            return False

        heard = client.message_counts[FORCE]
        self._wait(another, 1.0)
        noise = 2.0 * float(np.std(felt, axis=0).max()) if felt else 0.0
        bound = float(np.min(np.asarray(self._robot.measurement_bound)[-self._robot.position_dim :]))
        readings = min(max(1, math.ceil((noise / bound) ** 2)), READINGS)
        client.smooth(readings)
        if readings > 1:
            self.note(f"its accelerometer is off by {noise:.1f} m/s²: the mean of {readings} readings is taken")

    def _compare_limits(self, kind: str) -> None:
        """What its parameters allow, beside what may be asked of it."""
        client, wait = self._client, self._wait
        told = {c.parameter: client.parameter(c.parameter, wait) for c in AUTOPILOT_LIMITS[kind]}
        values = {name: value for name, value in told.items() if value is not None}
        for limit, value in limits_below_demand(kind, values, self._robot):
            wanted = limit.value(demand(self._robot))
            short = f"{limit.parameter} is {value:g} ({limit.what}), and up to {wanted:g} may be asked for"
            if self._raise_limits:
                done = client.set_parameter(limit.parameter, wanted, wait)
                self.note(f"{limit.parameter}: {value:g} -> {wanted:g}" + ("" if done else ", which it refuses"))
            else:
                self.note(f"{short}: raise it (--raise-limits), or it cannot do what is asked of it")
        name = TIMEOUTS[kind]
        timeout = client.parameter(name, wait)
        if self._lead:
            return
        if timeout is None and kind in FIXED_TIMEOUT:
            self.note(f"no {name} here: it flies on for {FIXED_TIMEOUT[kind]:g} s when setpoints stop")
        elif timeout is not None and timeout > SHORTEST[kind]:
            self.note(f"{name} is {timeout:g}: so many seconds it flies on when setpoints stop")

    def _climb(self, kind: str, height: float) -> None:
        client, wait = self._client, self._wait
        assert client.position is not None
        top = client.position[2] + height
        if kind == "ardupilot":
            self._hold(None)  # a setpoint would end the takeoff
            client.take_off(height, wait)
        else:
            self._hold(CLIMB)
        if not wait(lambda: client.position is not None and client.position[2] > top - 0.3, 10.0 + 3.0 * height):
            why = "" if client.offboard else f": it went to {client.mode}, as after setpoints that came too late"
            raise MavlinkError(f"it does not climb{why}")

    def note(self, line: str) -> None:
        """Keep a line, and log it."""
        self.notes.append(line)
        log.info("%s", line)
