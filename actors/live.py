"""A quadrotor in real time behind a link: a thread of its own keeps time, and carries out the plan it was given."""

from __future__ import annotations

import json
import logging
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from actors.mavlink import ATTITUDE, IMU, POSITION, STATE, Array, Client, MavlinkError, Tap
from messaging.links import Link
from messaging.robots import Robot
from messaging.tolerant import Tolerance
from sim.quadrotor import QUADROTOR, SAMPLES, slewed
from sim.vehicle import Period

log = logging.getLogger("brakeline.flight")

POLL = 0.005  # s between two looks at a link
RESEND = 0.05  # s after which a setpoint is sent again
STALE = 0.2  # s without a position after which telemetry counts as lost
LATE = 0.02  # s after its time at which a period's beginning counts as late
REST = 0.1  # m/s: slower is hovering
CLIMB = np.array([0.0, 0.0, 1.0])  # m/s
FARTHEST = 1e5  # m, m/s, ...: no vehicle is farther off, or as fast
MOST_TOLD = 100  # datagrams read at one look
KEPT = 10_000  # latest beginnings whose lateness is remembered


@dataclass
class Timing:
    """How real time was kept."""

    periods: int = 0
    late: int = 0  # begun more than `LATE` after their time
    slips: int = 0  # begun so late that the clock was set anew: the one before lasted two periods or more
    worst_gap: float = 0.0  # s between two setpoints
    lateness: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))  # s, of the beginnings of periods

    def figures(self) -> dict[str, float]:
        """For Health, in ms where it says so."""
        lateness = 1e3 * np.array([*self.lateness] or [0.0])
        return {
            "periods": self.periods,
            "periods late": self.late,
            "periods slipped": self.slips,
            "lateness p50 ms": float(np.percentile(lateness, 50)),
            "lateness p99 ms": float(np.percentile(lateness, 99)),
            "lateness worst ms": float(lateness.max()),
            "worst setpoint gap ms": 1e3 * self.worst_gap,
        }


@dataclass(frozen=True)
class Turn:
    """The moment at which a period begins: its number, and how the one before ended.

    lost: no telemetry came lately, or the autopilot does not follow our setpoints: why; empty: neither.
    """

    number: int
    input: Array  # (3,) m/s, in force from now on
    report: Period
    lost: str = ""


class Offset:
    """Our clock less the autopilot's [s], by the messages that came soonest.

    It falls at once and rises with the clocks' drift: milliseconds on a busy machine must not move it, for at 7 m/s
    each is 7 mm. Only when every message of a second is `JUMP` late the other clock has jumped: a simulator slips.
    """

    DRIFT = 1e-4  # s a second, at most, between two clocks
    JUMP = 0.05  # s

    def __init__(self) -> None:
        self.value = math.inf  # before the first message
        self._noted = self._second = -math.inf  # when the last message came, and when this second began
        self._soonest = math.inf  # in this second

    def note(self, now: float, theirs: float) -> None:
        """A message of their time `theirs` has come."""
        if now - self._second > 1.0:
            if self._soonest > self.value + self.JUMP:
                self.value = self._soonest
            self._second, self._soonest = now, math.inf
        late = now - theirs
        drifted = self.value + self.DRIFT * (now - self._noted) if math.isfinite(self.value) else math.inf
        self.value, self._noted, self._soonest = min(drifted, late), now, min(self._soonest, late)


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


class LiveVehicle:
    """A quadrotor in real time on a link: any autopilot that speaks MAVLink, simulated or not.

    Periods follow each other by the clock, whoever decides. `commit` hands over a plan: one input for each period from
    one on that has not begun. Its thread sends each at its time, again every `RESEND` seconds, and reads telemetry. So
    a plan that nobody replaces is carried out to its end, and then zero: hover. If the process dies, the autopilot's
    own timeout brakes.

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
    ) -> None:
        """Take control, climb to that height [m] above the ground unless it flies already, and begin the first period.

        origin: where the autopilot's local frame begins, in ours, m.

        Raises:
            MavlinkError: nobody there, or it refuses.
        """
        self._robot = robot
        self._link, self._client, self._truth = link, Client(link.send, system, tap), truth
        self._origin, self._tolerance = np.asarray(origin), tolerance or Tolerance()
        self.timing = Timing()
        self._plan: list[Array] = []  # the inputs after the one in force
        self._sent_at = self._beaten_at = self._heard_at = -math.inf
        self._velocity: Array | None = None  # the setpoint to be repeated
        self._offsets = Offset()
        self._turned, self._ended, self._failure = threading.Condition(), threading.Event(), ""
        self._take_off(height)
        self._collisions = 0 if truth is None else truth.collisions
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
        rows = [slewed(row, row) for row in np.asarray(plan, float)]
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
        self._velocity = None
        self._client.land(self._wait)

    def close(self) -> None:
        """Send nothing any more: unless it has landed, the autopilot's timeout brakes it."""
        self._stop()
        self._link.close()
        if self._truth is not None:
            self._truth.close()

    def _take_off(self, height: float) -> None:
        client, wait = self._client, self._wait
        kind = client.identify(wait)
        for message, interval in ((POSITION, POLL * 4), (ATTITUDE, POLL * 4), (IMU, POLL * 4), (STATE, 0.2)):
            client.stream(message, interval, wait)
        if not wait(lambda: client.position is not None and client.airborne is not None, 10.0):
            raise MavlinkError("it does not tell its position, or whether it flies")
        self._velocity = np.zeros(3)
        client.follow_setpoints(wait)
        if not client.armed:
            client.arm(wait)
        if not client.airborne:
            self._climb(kind, height)
        self._velocity = np.zeros(3)
        if not wait(lambda: float(np.linalg.norm(client.velocity)) < REST, 8.0):  # it may have flown when we came
            raise MavlinkError("it does not come to rest")
        if not wait(lambda: client.offboard and client.armed, 3.0):
            raise MavlinkError("it says that it follows setpoints, and its heartbeat that it does not")

    def _climb(self, kind: str, height: float) -> None:
        client, wait = self._client, self._wait
        assert client.position is not None
        top = client.position[2] + height
        if kind == "ardupilot":
            self._velocity = None  # a setpoint would end the takeoff
            client.take_off(height, wait)
        else:
            self._velocity = CLIMB
        if not wait(lambda: client.position is not None and client.position[2] > top - 0.3, 10.0 + 3.0 * height):
            raise MavlinkError("it does not climb")
        self._sent_at = -math.inf

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
        self._velocity = slewed(following, self.turn.input)
        self._send_setpoint(now)
        self._keep_time(now - self._due)
        start, state = self.turn.report.measured[:3], self._state(now)
        report = self._report(state, self._path(now, state) - start)
        self.turn = Turn(self.turn.number + 1, self._velocity, report, self._lost(now))
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
        if now - self._heard_at > STALE:
            return f"no telemetry for {now - self._heard_at:.2f} s"
        if not (self._client.offboard and self._client.armed):
            return "the autopilot does not follow our setpoints"
        return ""

    def _state(self, now: float) -> Array:
        """The state (9,) at a moment of ours: the latest telemetry, carried on by its own velocity and acceleration."""
        client = self._client
        assert client.position is not None
        ahead = min(max(now - self._offsets.value - client.time, 0.0), STALE)
        v, a = client.velocity, client.acceleration
        position = client.position + self._origin + ahead * v + 0.5 * ahead**2 * a
        return np.concatenate((position, v + ahead * a, a))

    def _path(self, now: float, state: Array) -> Array:
        """Positions (S, 3) at even times of the period that ends now, in that state."""
        heard = self._client.path
        times = [t + self._offsets.value for t, _ in heard] + [now]
        places = np.array([p + self._origin for _, p in heard] + [state[:3]])
        at = now - self._robot.period + self._robot.period / SAMPLES * np.arange(1, SAMPLES + 1)
        return np.stack([np.interp(at, times, places[:, axis]) for axis in range(3)], axis=1)

    def _report(self, state: Array, path: Array) -> Period:
        truth = self._truth
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
        if (len(client.path), client.time) != before:
            self._heard_at = now
            self._offsets.note(now, client.time)
        if self._truth is not None:
            self._truth.poll()
        if now - self._beaten_at >= 1.0:
            self._beaten_at = now
            client.heartbeat()
        if self._velocity is not None and now - self._sent_at >= RESEND:
            self._send_setpoint(now)

    def _send_setpoint(self, now: float) -> None:
        assert self._velocity is not None
        if math.isfinite(self._sent_at):
            self.timing.worst_gap = max(self.timing.worst_gap, now - self._sent_at)
        self._sent_at = now
        self._client.setpoint(self._velocity)

    def _wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """While no thread does: exchange until it holds."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._exchange(time.monotonic())
            time.sleep(POLL)
        return True

    def _stop(self) -> None:
        self._ended.set()
        if self._pump.is_alive():
            self._pump.join(2.0)
