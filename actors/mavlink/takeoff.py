"""Bring a vehicle from any state to hovering under our setpoints: estimate, telemetry, limits, mode, takeoff."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable

import numpy as np

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, Wait, message_id
from brakeline.actors.mavlink.autopilot_limits import AUTOPILOT_LIMITS, limits_below_demand, limits_beyond_top
from brakeline.actors.mavlink.telemetry import ATTITUDE, FORCE, LANDED, MOTION, Array, unknown_quantities
from brakeline.errors import MavlinkError, TelemetryMissing
from brakeline.messaging.robot import Robot

log = logging.getLogger("brakeline.flight")

TELEMETRY = 0.02  # s between two messages, as requested
MOST_READINGS = 10  # of the accelerometer that are averaged: those of one period
STATUS = {"px4": {"SYS_STATUS": 2.0}, "ardupilot": {"SYS_STATUS": 2.0, "FENCE_STATUS": 0.5}}  # s
ESTIMATE_TIMEOUT = 300.0  # s for the estimator to find its position
PROGRESS_INTERVAL = 5.0  # s between two log lines meanwhile
ESTIMATOR_SILENCE = 30.0  # s without the estimator's state, after which the takeoff goes on without it
REST = 0.2  # m/s: a slower vehicle hovers; the estimate may be wrong by half of that for good
STOPPING = 20.0  # s until the vehicle hovers: it may have been flying at full speed
LONGEST_PAUSE = 3.0  # s that a vehicle waits in its takeoff for newer telemetry
MOST_PAUSES = 20  # of a takeoff
CLIMB = np.array([0.0, 0.0, 1.0])  # m/s
TIMEOUTS = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}  # s without a setpoint until it brakes by itself
FIXED_TIMEOUT = {"ardupilot": 3.0}  # s, in versions without that parameter
SHORTEST_TIMEOUT = 0.5  # s: a busy machine's setpoints do not trip a timeout of this length


class Takeoff:
    """One takeoff, from the first heartbeat on."""

    def __init__(
        self,
        client: AutopilotClient,
        robot: Robot,
        flight: FlightSettings,
        wait: Wait,
        hold: Callable[[Array | None], None],
        stale: Callable[[], str],
        from_ground: bool = False,
    ) -> None:
        """Prepare the takeoff of one vehicle.

        Args:
            wait: exchanges messages until a condition holds, or a time [s] is over.
            hold: called with a setpoint (3,) [m/s] to repeat from now on; None: send none.
            stale: returns why the measured state is too old to count; empty if it counts.
            from_ground: refuse a vehicle that flies already.
        """
        self._client, self._robot, self._flight, self._wait, self._hold = client, robot, flight, wait, hold
        self._stale = stale
        self._from_ground, self.armed_it = from_ground, False  # armed_it: whether this takeoff armed the vehicle
        self.notes: list[str] = []  # about the messages that are used, and the parameters that are too low

    def fly(self) -> None:
        """Climb to the height above the ground unless the vehicle flies already, and come to rest.

        Raises:
            MavlinkError: the autopilot refuses something, or the vehicle does not hover in the end.
        """
        client, wait = self._client, self._wait
        kind = client.identify(wait)
        self.note(f"{kind}, in {client.mode}")
        self._await_estimate()
        for what, interval in ((LANDED, 0.2), (ATTITUDE, TELEMETRY), (FORCE, TELEMETRY), (MOTION, TELEMETRY)):
            self.note(client.choose(what, interval, wait))
        if not wait(lambda: client.position is not None and client.airborne is not None, 3.0):
            raise TelemetryMissing("the autopilot does not send its position, or whether it flies")
        self._choose_smoothing()
        for message, interval in STATUS[kind].items():
            with contextlib.suppress(MavlinkError):
                client.stream(message_id(message), interval, wait)
        self._compare_limits(kind)
        if self._flight.lead:
            client.lead(wait)
            self.note("it gets positions: if setpoints stop, it stops at the last one")
        if client.second_source:
            raise MavlinkError(client.two_sources)
        if self._from_ground and client.airborne:
            raise MavlinkError("the vehicle flies already: land it, for this flight begins on the ground")
        self._hold(np.zeros(3))
        client.follow_setpoints(wait)
        if not client.armed:
            self.armed_it = True  # also if the answer to the command is lost
            client.arm(wait)
        if not client.airborne:
            self._climb(kind, self._flight.height)
        self._hold(np.zeros(3))
        if not self._wait_in_flight(lambda: float(np.linalg.norm(client.velocity)) < REST, STOPPING, np.zeros(3)):
            raise MavlinkError("the vehicle does not come to rest")
        if not wait(lambda: client.offboard and client.armed, 3.0):
            raise MavlinkError(
                "the autopilot accepted our setpoints, but its heartbeat says that it does not follow them"
            )

    def _await_estimate(self) -> None:
        """Wait until the estimator knows its position, if it sends its state, and log the progress."""
        client, wait = self._client, self._wait
        if not client.watch_estimator(wait):
            return
        began = logged_at = time.monotonic()
        ready = lambda: client.estimator is not None and not unknown_quantities(client.estimator)  # noqa: E731
        while not wait(ready, max(0.0, logged_at + PROGRESS_INTERVAL - time.monotonic())):
            logged_at, unknown = time.monotonic(), ", ".join(unknown_quantities(client.estimator or 0))
            if client.estimator is None and logged_at - began > ESTIMATOR_SILENCE:
                return
            if logged_at - began > ESTIMATE_TIMEOUT:
                raise MavlinkError(f"after {ESTIMATE_TIMEOUT:.0f} s its estimator does not know: {unknown}")
            log.info("waiting for the position estimate for %.0f s; unknown: %s", logged_at - began, unknown)

    def _choose_smoothing(self) -> None:
        """Average as many accelerometer readings as keep the noise within the description's measurement error."""
        client = self._client
        readings: list[Array] = []

        def enough() -> bool:
            if client.message_counts[FORCE] != len(readings) + before:
                readings.append(client.acceleration)
            return len(readings) >= 2 * MOST_READINGS

        before = client.message_counts[FORCE]
        self._wait(enough, 1.0)
        noise = 2.0 * float(np.std(readings, axis=0).max()) if readings else 0.0
        bound = float(np.min(np.asarray(self._robot.measurement_bound)[-self._robot.position_dim :]))
        count = min(max(1, math.ceil((noise / bound) ** 2)), MOST_READINGS)
        client.average_accelerometer(count)
        if count > 1:
            self.note(f"its accelerometer has {noise:.1f} m/s² of noise: {count} readings are averaged")

    def _compare_limits(self, kind: str) -> None:
        """Compare its parameters with the robot's bounds, and set or note those that are too low."""
        client, wait = self._client, self._wait
        names = (limit.parameter for limit in AUTOPILOT_LIMITS[kind])
        values = {name: value for name in names if (value := client.parameter(name, wait)) is not None}
        for limit, value, needed in limits_below_demand(kind, values, self._robot):
            if self._flight.raise_limits:
                done = client.set_parameter(limit.parameter, needed, wait)
                self.note(f"{limit.parameter}: {value:g} -> {needed:g}" + ("" if done else ", which it refuses"))
            else:
                self.note(
                    f"{limit.parameter} is {value:g} ({limit.what}), and the filter may need {needed:g}: raise it "
                    "(--raise-limits), or the vehicle cannot follow the filter's plans"
                )
        for limit, needed in limits_beyond_top(kind, values, self._robot):
            self.note(
                f"{limit.parameter} takes at most {limit.top:g} ({limit.what}), and the filter may need {needed:g}: "
                "lower the slew or the bounds in the description, or the vehicle follows the hardest stops late"
            )
        if self._flight.lead:
            return
        name = TIMEOUTS[kind]
        timeout = client.parameter(name, wait)
        if timeout is None and kind in FIXED_TIMEOUT:
            self.note(f"it has no {name}: if setpoints stop, it flies on for {FIXED_TIMEOUT[kind]:g} s")
        elif timeout is not None and timeout > SHORTEST_TIMEOUT:
            self.note(f"{name} is {timeout:g}: if setpoints stop, it flies on for so many seconds")

    def _wait_in_flight(self, condition: Callable[[], bool], seconds: float, velocity: Array | None) -> bool:
        """Wait as `wait` does, but stop the vehicle while the measured state is too old, and then go on.

        velocity: the setpoint to repeat, (3,) [m/s]; None: the autopilot flies by itself, and stops by itself.

        Raises:
            TelemetryMissing: the state stays too old, or is too old again and again.
        """
        why = ""
        for _ in range(MOST_PAUSES):
            holds = self._wait(lambda: bool(self._stale()) or condition(), seconds)
            if not (why := self._stale()):
                return holds
            if velocity is not None:
                self._hold(np.zeros(3))
            if not self._wait(lambda: not self._stale(), LONGEST_PAUSE):
                why = self._stale() or why  # as it is by now
                break
            if velocity is not None:
                self._hold(velocity)
        raise TelemetryMissing(f"{why}: the vehicle stops its takeoff")

    def _climb(self, kind: str, height: float) -> None:
        client, wait = self._client, self._wait
        assert client.position is not None
        top = client.position[2] + height
        velocity = None if kind == "ardupilot" else CLIMB
        self._hold(velocity)
        if velocity is None:  # a setpoint would end the takeoff
            client.take_off(height, wait)
        climbed = lambda: client.position is not None and client.position[2] > top - 0.3  # noqa: E731
        if not self._wait_in_flight(climbed, 10.0 + 3.0 * height, velocity):
            why = "" if client.offboard else f": it changed to {client.mode}, as after setpoints that came too late"
            raise MavlinkError(f"the vehicle does not climb{why}")

    def note(self, line: str) -> None:
        """Add a line to the notes, and log it."""
        self.notes.append(line)
        log.info("%s", line)
