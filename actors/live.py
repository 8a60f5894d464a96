"""A quadrotor in real time behind a link: a thread of its own keeps time, and carries out the plan it was given."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from actors.frames import Tap
from actors.mavlink import Client, MavlinkError, NotTold
from actors.takeoff import TELEMETRY, Takeoff
from actors.telemetry import IN_FLIGHT, TRUTH, Array
from actors.timing import Offset, Timing
from actors.truth import Truth
from actors.witness import Witness
from messaging.links import Link
from messaging.robots import Robot
from messaging.tolerant import Tolerance
from sim.quadrotor import SAMPLES
from sim.vehicle import Period, executed

log = logging.getLogger("brakeline.flight")

POLL = 0.005  # s between two looks at a link
RESEND = 0.05  # s after which a setpoint is sent again
STALE = 0.2  # s without a position, an attitude or an acceleration after which telemetry counts as lost
SILENT = 3.0  # s without a heartbeat after which nobody knows its mode
HURRY = 1.0  # s between two questions about the autopilot's clock
LOW = 20.0  # % of the battery from which it is spoken of
LATE = 0.02  # s after its time at which a period's beginning counts as late


@dataclass(frozen=True)
class Turn:
    """The moment at which a period begins: its number, and how the one before ended.

    lost: no telemetry came lately, or the autopilot does not follow our setpoints: why; empty: neither.
    """

    number: int
    input: Array  # (3,) m/s, in force from now on
    report: Period
    lost: str = ""


class LiveVehicle:
    """A quadrotor in real time on a link: any autopilot that speaks MAVLink, simulated or not.

    Periods follow each other by the clock, whoever decides. `commit` hands over a plan: one input for each period from
    one on that has not begun. Its thread sends each at its time, again every `RESEND` seconds, and reads telemetry. So
    a plan that nobody replaces is carried out to its end, and then zero: hover. If the process dies, the autopilot's
    own timeout brakes; an actor has another process do this, which does not die with it (`actors.kept`). A vehicle that
    leaves offboard or guided mode, for a pilot, a failsafe, its battery or its fence, is not fought for: the periods
    until it comes back by itself are `lost`.

    Collisions and clearance are what the simulator's truth channel says, where there is one.
    """

    def __init__(
        self,
        link: Link,
        robot: Robot,
        system: int = 1,
        height: float = 3.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        truth: Truth | None = None,
        tap: Tap | None = None,
        tolerance: Tolerance | None = None,
        stop: Callable[[], bool] = lambda: False,
        raise_limits: bool = False,
        witness: Witness | None = None,
        lead: bool = False,
    ) -> None:
        """Take control, climb to that height [m] above the ground unless it flies already, and begin the first period.

        origin: where the autopilot's local frame begins, in ours, m; stop: told to, it waits for nothing any more;
        raise_limits: set those parameters that hold it below what the robot's description asks for; witness: the judge
        of the flight, if there is no truth channel and the autopilot has a simulator inside that tells; lead: tell it
        places to go to in place of velocities (`actors.leading`).

        Raises:
            MavlinkError: nobody there, or it refuses, or told to stop.
        """
        self._robot, self._told_to_stop = robot, stop
        self._link, self._truth = link, truth
        self._witness = witness if truth is None else None
        self._client = Client(link.send, system, tap, lambda text: log.info("it says: %s", text))
        self._origin, self._tolerance = np.asarray(origin), tolerance or Tolerance()
        self.timing = Timing()
        self._plan: list[Array] = []  # the inputs after the one in force
        self._sent_at = self._beaten_at = self._asked_at = -math.inf
        self._counted: dict[str, int] = {}  # messages, by what they tell
        self._heard_at: dict[str, float] = {}  # s, when the latest of them came
        self._said_lost, self._said_low = "", False
        self._takeoff = Takeoff(self._client, robot, self._wait, self._hold, raise_limits, lead)
        self.notes = self._takeoff.notes
        self._velocity: Array | None = None  # the setpoint to be repeated
        self._offsets = Offset()
        self._turned, self._ended, self._failure = threading.Condition(), threading.Event(), ""
        try:
            self._takeoff.fly(height)
        except BaseException:
            link.close()
            raise
        self._collisions = 0 if truth is None else truth.collisions
        if self._witness is not None:
            self._call_witness()
        state = self._state(time.monotonic())
        standing = Period(state, state, False, math.inf, math.inf, np.zeros((SAMPLES, 3)), 0.0)
        self.turn = Turn(0, np.zeros(self._robot.action_dim), standing)
        self._due = time.monotonic() + self._robot.period  # s: when the next period begins
        self._pump = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._pump.start()

    def commit(self, plan: Array, number: int) -> bool:
        """Carry out inputs (K, 3) [m/s], clipped to bounds and slew, from the period of that number on, then zero.

        False: that period has begun already, with what was committed before.

        Raises:
            BadInput: when one is not three finite numbers.
        """
        rows = [executed(self._robot, row, row) for row in np.asarray(plan, float)]
        with self._turned:
            in_time = self.turn.number < number
            if in_time:
                before = number - self.turn.number - 1
                kept = [*self._plan, *[np.zeros(self._robot.action_dim)] * before][:before]
                self._plan = kept + rows
        return in_time

    def wait(self, number: int) -> Turn:
        """The latest turn, once the period of that number has begun.

        Raises:
            MavlinkError: its thread has died.
        """
        with self._turned:
            patience = 2.0 + self._robot.period * max(0, number - self.turn.number)
            if not self._turned.wait_for(lambda: self.turn.number >= number or bool(self._failure), patience):
                raise MavlinkError(f"period {number} does not begin")
            if self._failure:
                raise MavlinkError(f"nobody flies any more: {self._failure}")
            return self.turn

    def step(self, input: Array) -> Period:
        """The running period to its end; then an input is in force that nothing follows: a brake. Raises BadInput."""
        number = self.turn.number + 1
        self.commit(np.asarray(input)[None], number)
        return self.wait(number).report

    def land(self) -> None:
        """Give up control: land and disarm. Raises MavlinkError."""
        self._stop()
        self._velocity, self._told_to_stop = None, lambda: False
        self._client.land(self._wait)

    @property
    def armed(self) -> bool:
        """By its last heartbeat."""
        return self._client.armed

    @property
    def idle(self) -> bool:
        """Does it hover, as far as it was told to, with no input to come?"""
        return not self._plan and not self.turn.input.any()

    @property
    def failed(self) -> bool:
        """Has its thread died?"""
        return bool(self._failure)

    @property
    def silence(self) -> float:
        """s since anything was heard of it."""
        return time.monotonic() - max(self._heard_at.values(), default=-math.inf)

    def judged(self) -> dict[str, float]:
        """For Health, once a witness told something."""
        witness = self._witness
        if witness is None or witness.state is None:
            return {}
        return {
            "true collisions": witness.collisions,
            "true clearance least m": witness.least,
            "estimate off truth at most m": witness.worst,
        }

    def listen(self, seconds: float) -> None:
        """Once it was told to land: hear what it says."""
        self._wait(lambda: False, seconds)

    def close(self) -> None:
        """Send nothing any more: unless it has landed, the autopilot's timeout brakes it."""
        self._stop()
        self._link.close()
        if self._truth is not None:
            self._truth.close()

    def _call_witness(self) -> None:
        try:
            self._takeoff.note(self._client.choose(TRUTH, TELEMETRY, self._wait))
        except NotTold:
            self._witness = None

    # --- in the thread, once it runs --------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._ended.wait(min(POLL, max(0.0, self._due - time.monotonic()))):
                with self._turned:
                    now = time.monotonic()
                    if now >= self._due:
                        self._begin(now)
                    self._exchange(now)
        except Exception as error:  # whatever it is: without setpoints the autopilot brakes
            log.exception("no setpoint is sent any more")
            with self._turned:
                self._failure = f"{type(error).__name__}: {error}"
                self._turned.notify_all()

    def _begin(self, now: float) -> None:
        """A period begins: send its input first, then see what the one before has come to."""
        following = self._plan.pop(0) if self._plan else np.zeros(self._robot.action_dim)
        self._velocity = executed(self._robot, following, self.turn.input)
        self._send_setpoint(now)
        self._keep_time(now - self._due)
        start, state = self.turn.report.measured[:3], self._state(now)
        report = self._report(state, self._path(now, state) - start)
        self.turn = Turn(self.turn.number + 1, self._velocity, report, self._lost(now))
        self._say_lost(self.turn.lost)
        self._client.path = self._client.path[-1:]
        self._turned.notify_all()

    def _keep_time(self, lateness: float) -> None:
        timing = self.timing
        timing.periods += 1
        timing.late += lateness > LATE
        timing.lateness.append(lateness)
        slipped = lateness > self._robot.period
        timing.slips += slipped
        self._due += self._robot.period + (lateness if slipped else 0.0)

    def _lost(self, now: float) -> str:
        """Why what is measured, or asked of the autopilot, does not count."""
        client = self._client
        for what in IN_FLIGHT:
            silent = now - self._heard_at.get(what, -math.inf)
            if silent > STALE:
                return f"no telemetry of {what} for {silent:.2f} s"
        if now - self._heard_at.get("mode", -math.inf) > SILENT:
            return f"no heartbeat for more than {SILENT:.0f} s"
        if not (client.offboard and client.armed):
            state = client.mode if client.armed else "it is disarmed"
            return f"the autopilot does not follow our setpoints ({state})"
        if client.outside:
            return f"the autopilot says that it is outside of its geofence ({client.outside})"
        return "the autopilot says that it is in an emergency" if client.emergency else ""

    def _say_lost(self, why: str) -> None:
        """Once, when it begins or has another reason, and when it ends."""
        self.timing.lost += bool(why)
        kind, said = why.split(" for ")[0], self._said_lost
        if kind != said:
            self._said_lost = kind
            texts = "; ".join(self._client.texts[-2:])
            if why:
                log.warning("braking: %s%s", why, f"; it says: {texts}" if texts else "")
            else:
                log.warning("flying again, after: %s", said)
        battery = self._client.battery
        if battery is not None and battery < LOW and not self._said_low:
            self._said_low = True
            log.warning("its battery is at %.0f %%", battery)

    @property
    def _offset(self) -> float:
        """s, our clock less the autopilot's: by the messages that came soonest, less their way, which is half of what
        TIMESYNC takes at the least; what is within our own polling is not counted."""
        way = 0.5 * self.timing.round_trip - POLL
        return self._offsets.value - (way if 0.0 < way < STALE else 0.0)

    def _state(self, now: float) -> Array:
        """The state (9,) at a moment of ours: the latest telemetry, carried on by its own velocity and acceleration."""
        client = self._client
        assert client.position is not None
        ahead = min(max(now - self._offset - client.time, 0.0), STALE)
        v, a = client.velocity, client.acceleration
        position = client.position + self._origin + ahead * v + 0.5 * ahead**2 * a
        return np.concatenate((position, v + ahead * a, a))

    def _path(self, now: float, state: Array) -> Array:
        """Positions (S, 3) at even times of the period that ends now, in that state."""
        heard = self._client.path
        times = [t + self._offset for t, _ in heard] + [now]
        places = np.array([p + self._origin for _, p in heard] + [state[:3]])
        at = now - self._robot.period + self._robot.period / SAMPLES * np.arange(1, SAMPLES + 1)
        return np.stack([np.interp(at, times, places[:, axis]) for axis in range(3)], axis=1)

    def _report(self, state: Array, path: Array) -> Period:
        truth = self._truth or self._witness
        if truth is None or truth.state is None:
            return Period(state, state, False, math.inf, math.inf, path, 0.0)
        collision, self._collisions = truth.collisions > self._collisions, truth.collisions
        return Period(state, truth.state, collision, truth.clearance, truth.clearance, path, 0.0)

    def _exchange(self, now: float) -> None:
        """Read what has come, and send what is due."""
        client = self._client
        before = len(client.path), client.time
        with self._tolerance.over("mavlink"):
            client.feed(self._link.receive())
        for what, count in client.heard.items():
            if self._counted.get(what) != count:
                self._counted[what], self._heard_at[what] = count, now
        if self._witness is not None and client.truth is not None and client.position is not None:
            self._witness.take(client.truth, client.position + self._origin, client.velocity)
            client.truth = None
        if (len(client.path), client.time) != before:
            self._offsets.note(now, client.time)
        for asked, _ in client.answers:
            self.timing.round_trip = min(self.timing.round_trip, 1e-9 * (time.monotonic_ns() - asked))
        client.answers.clear()
        if now - self._asked_at >= HURRY:
            self._asked_at = now
            client.ask_time(time.monotonic_ns())
        if self._truth is not None:
            self._truth.poll()
        if now - self._beaten_at >= 1.0:
            self._beaten_at = now
            client.heartbeat()
        if self._velocity is not None and now - self._sent_at >= RESEND:
            self._send_setpoint(now)

    def _hold(self, velocity: Array | None) -> None:
        """Repeat that setpoint from now on; None: send none."""
        if self._velocity is None:  # while none was to be sent there was no gap between two
            self._sent_at = -math.inf
        self._velocity = velocity

    def _send_setpoint(self, now: float) -> None:
        assert self._velocity is not None
        if math.isfinite(self._sent_at):
            self.timing.worst_gap = max(self.timing.worst_gap, now - self._sent_at)
        self._sent_at = now
        self._client.setpoint(self._velocity)

    def _wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """While no thread does: exchange until it holds. A stall of ours is no silence of the autopilot's."""
        left, looked = seconds, time.monotonic()
        while not condition():
            if self._told_to_stop():
                raise MavlinkError("told to stop before it flew")
            if left < 0.0:
                return False
            self._exchange(time.monotonic())
            time.sleep(POLL)
            now = time.monotonic()
            left, looked = left - min(now - looked, 10.0 * POLL), now
        return True

    def _stop(self) -> None:
        self._ended.set()
        if self._pump.is_alive():
            self._pump.join(2.0)
