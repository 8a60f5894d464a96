"""Quadrotors behind MAVLink: in lockstep with a simulated autopilot in memory, or in real time on a link."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from actors.mavlink import ATTITUDE, IMU, POSITION, STATE, Array, Client, MavlinkError, Tap
from messaging.links import Link
from messaging.robots import QUADROTOR
from sim.quadrotor import SAMPLES, Quadrotor, slewed
from sim.vehicle import Period

SAMPLE_TIME = QUADROTOR.period / SAMPLES  # s
POLL = 0.005  # s between two looks at a link
RESEND = 0.1  # s after which a setpoint is sent again
LAPSE = 0.3  # s after which an input that no other follows gives way to braking
STALE = 0.3  # s without a position after which telemetry counts as lost
LATE = 0.02  # s after its time at which a period's beginning counts as late
CLIMB = np.array([0.0, 0.0, 1.0])  # m/s


class Endpoint(Protocol):
    """A simulated autopilot in memory: sim.autopilot.endpoint.Autopilot."""

    vehicle: Quadrotor

    def receive(self, data: bytes) -> None: ...

    def take(self) -> bytes: ...

    def advance(self, seconds: float) -> None: ...


class MavlinkVehicle:
    """A quadrotor flown over the bytes of an embedded autopilot, in lockstep: time passes only in `step`.

    What is measured comes from telemetry, what is true and what was touched from the simulator. The autopilot starts in
    the air; setpoints and mode are exchanged before time begins.
    """

    def __init__(self, endpoint: Endpoint, tap: Tap | None = None) -> None:
        """tap: is called with every MAVLink frame. Raises MavlinkError when the autopilot refuses something."""
        self._endpoint, self._client = endpoint, Client(endpoint.receive, tap=tap)
        self.input = np.zeros(QUADROTOR.action_dim)
        wait = self._wait
        for message, interval in ((POSITION, SAMPLE_TIME), (ATTITUDE, QUADROTOR.period), (IMU, QUADROTOR.period)):
            self._client.stream(message, interval, wait)
            self._client.request(message, wait)
        self._client.follow_setpoints(wait)
        self.true, self.measured = endpoint.vehicle.state(), self._measured()

    def step(self, input: Array) -> Period:
        """Fly one period at a velocity setpoint (3,) [m/s], clipped to bounds and slew.

        Raises:
            BadInput: when the input is not three finite numbers.
        """
        self.input = slewed(input, self.input)
        client, endpoint, start = self._client, self._endpoint, self.measured[:3]
        client.path.clear()
        client.setpoint(self.input)
        endpoint.vehicle.watch()
        endpoint.advance(QUADROTOR.period)
        client.feed(endpoint.take())
        self.measured = self._measured()
        path = np.array([position for _, position in client.path]) - start
        period = endpoint.vehicle.watched(self.measured, path)
        self.true = period.true
        return period

    def standing(self) -> Period:
        """The present state as a period in which nothing happened: what there is to say before the first step."""
        clearance = float(self._endpoint.vehicle.clearance(self.true[:3]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 3)), 0.0)

    def alter(self, **changes: float) -> None:
        """Of the simulated vehicle: see Quadrotor.alter."""
        self._endpoint.vehicle.alter(**changes)

    def _measured(self) -> Array:
        """The state (9,) by the latest telemetry."""
        client = self._client
        assert client.position is not None
        return np.concatenate((client.position, client.velocity, client.acceleration))

    def _wait(self, condition: Callable[[], bool], _: float) -> bool:
        """Answers come at once or not at all."""
        self._client.feed(self._endpoint.take())
        return condition()


@dataclass
class Timing:
    """How real time was kept."""

    periods: int = 0
    late: int = 0  # begun more than `LATE` after their time
    worst_late: float = 0.0  # s
    missed: int = 0  # whole periods that nobody began
    lapses: int = 0  # inputs that gave way to braking because no other followed
    worst_gap: float = 0.0  # s between two setpoints


class Truth:
    """What a simulator tells about a vehicle beside MAVLink (sim.autopilot.server): its last word."""

    def __init__(self, port: int, system: int) -> None:
        """Listen on a UDP port of this machine. Raises OSError when it is taken."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("0.0.0.0", port))
        self._socket.setblocking(False)
        self._system = system
        self.state: Array | None = None
        self.collisions = 0
        self.clearance = math.inf

    def poll(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                told = json.loads(self._socket.recv(4096))
                if told["system"] == self._system:
                    self.state, self.collisions = np.array(told["state"]), told["collisions"]
                    self.clearance = math.inf if told["clearance"] is None else told["clearance"]

    def close(self) -> None:
        self._socket.close()


class LiveVehicle:
    """A quadrotor in real time on a link: any autopilot that speaks MAVLink, simulated or not.

    A period begins with `begin(input)` and ends with `finish()`, which waits for the period's time: in between there
    is time to decide about the next. A thread of its own reads telemetry and sends the setpoint again every `RESEND`
    seconds; an input other than zero that no other follows within `LAPSE` gives way to zero: brake and hold. If the
    process dies, the autopilot's own timeout does the same.

    true is what the simulator's truth channel says, as of its last word; without one it is what was measured.
    """

    def __init__(
        self,
        link: Link,
        system: int = 1,
        height: float = 3.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        truth: Truth | None = None,
        tap: Tap | None = None,
    ) -> None:
        """Take control, and climb to that height [m] above the ground unless it flies already.

        origin: where the autopilot's local frame begins, in ours, m.

        Raises:
            MavlinkError: nobody there, or it refuses.
        """
        self._link, self._client, self._truth = link, Client(link.send, system, tap), truth
        self._origin = np.asarray(origin)
        self.timing = Timing()
        self.input = np.zeros(QUADROTOR.action_dim)
        self._sent_at = self._beaten_at = self._heard_at = self._begun_at = -math.inf
        self._velocity: Array | None = None  # the setpoint to be repeated
        self._offset = math.inf  # s, our clock less the autopilot's, by the message that came soonest
        self._due: float | None = None  # s, our clock: when the period ends
        self._collisions = 0
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._take_off(height)
        self.measured = self.true = self._state(time.monotonic())
        self._pump = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._pump.start()

    @property
    def age(self) -> float:
        """s since the last position was heard."""
        return time.monotonic() - self._heard_at

    @property
    def lost(self) -> bool:
        """Telemetry does not come any more: what is measured is of the past."""
        return self.age > STALE

    def begin(self, input: Array) -> None:
        """Send a setpoint (3,) [m/s], clipped to bounds and slew, for the period that begins now.

        Raises:
            BadInput: when the input is not three finite numbers.
        """
        now = time.monotonic()
        with self._lock:
            self.input = slewed(input, self.input)
            self._velocity, self._begun_at = self.input, now
            self._send_setpoint(now)
            self._client.path = self._client.path[-1:]
        timing = self.timing
        timing.periods += 1
        late = 0.0 if self._due is None else now - self._due
        timing.late += late > LATE
        timing.worst_late = max(timing.worst_late, late)
        skipped = max(0, int(late / QUADROTOR.period))
        timing.missed += skipped
        self._due = now + QUADROTOR.period if self._due is None else self._due + (skipped + 1) * QUADROTOR.period

    def finish(self) -> Period:
        """Wait for the period's end. To be called once after each `begin`."""
        assert self._due is not None, "finish() follows begin()"
        time.sleep(max(0.0, self._due - time.monotonic()))
        start, now = self.measured[:3], time.monotonic()
        with self._lock:
            self.measured = self._state(now)
            path = self._path(now)
        return self._period(path - start)

    def step(self, input: Array) -> Period:
        """A whole period. Raises BadInput."""
        self.begin(input)
        return self.finish()

    def standing(self) -> Period:
        """The present state as a period in which nothing happened."""
        return self._period(np.zeros((SAMPLES, 3)))

    def alter(self, **changes: float) -> None:
        """Raises ValueError: nobody can, from here."""
        raise ValueError(f"a vehicle behind a link cannot be altered: {', '.join(changes)}")

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
        if client.airborne:
            return
        assert client.position is not None
        top = client.position[2] + height
        if kind == "ardupilot":
            self._velocity = None  # a setpoint would end the takeoff
            client.take_off(height, wait)
        else:
            self._velocity = CLIMB
        if not wait(lambda: client.position is not None and client.position[2] > top - 0.3, 10.0 + 3.0 * height):
            raise MavlinkError("it does not climb")
        self._velocity, self._sent_at = np.zeros(3), -math.inf
        wait(lambda: float(np.linalg.norm(client.velocity)) < 0.1, 5.0)

    def _state(self, now: float) -> Array:
        """The state (9,) at a moment of ours: the latest telemetry, carried on by its own velocity and acceleration."""
        client = self._client
        assert client.position is not None
        ahead = min(max(now - self._offset - client.time, 0.0), STALE)
        v, a = client.velocity, client.acceleration
        position = client.position + self._origin + ahead * v + 0.5 * ahead**2 * a
        return np.concatenate((position, v + ahead * a, a))

    def _path(self, now: float) -> Array:
        """Positions (S, 3) at even times of the period that ends now."""
        heard = self._client.path
        times = [t + self._offset for t, _ in heard] + [now]
        places = np.array([p + self._origin for _, p in heard] + [self.measured[:3]])
        at = now - QUADROTOR.period + SAMPLE_TIME * np.arange(1, SAMPLES + 1)
        return np.stack([np.interp(at, times, places[:, axis]) for axis in range(3)], axis=1)

    def _period(self, path: Array) -> Period:
        truth = self._truth
        if truth is None or truth.state is None:
            self.true = self.measured
            return Period(self.measured, self.true, False, math.inf, math.inf, path, 0.0)
        with self._lock:
            self.true, clearance = truth.state, truth.clearance
            collision, self._collisions = truth.collisions > self._collisions, truth.collisions
        return Period(self.measured, self.true, collision, clearance, clearance, path, 0.0)

    def _run(self) -> None:
        while not self._ended.wait(POLL):
            with self._lock:
                self._exchange(time.monotonic())

    def _exchange(self, now: float) -> None:
        """Read what has come, and send what is due."""
        client = self._client
        before = len(client.path), client.time
        client.feed(self._link.receive())
        if (len(client.path), client.time) != before:
            self._heard_at = now
            self._offset = min(self._offset, now - client.time)
        if self._truth is not None:
            self._truth.poll()
        if now - self._beaten_at >= 1.0:
            self._beaten_at = now
            client.heartbeat()
        if self.input.any() and now - self._begun_at > LAPSE:
            self.timing.lapses += 1
            self._velocity = self.input = np.zeros(QUADROTOR.action_dim)
            self._send_setpoint(now)
        elif self._velocity is not None and now - self._sent_at >= RESEND:
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
