"""Fly a quadrotor in real time over a MAVLink link: a thread keeps time and carries out the committed plan."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.flight_timing import ClockOffset, FlightTiming
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.ground_truth import MavlinkGroundTruth, UdpGroundTruth
from brakeline.actors.mavlink.takeoff import TELEMETRY, Takeoff
from brakeline.actors.mavlink.telemetry import IN_FLIGHT, TRUTH, Array
from brakeline.errors import MavlinkError, TelemetryMissing
from brakeline.messaging.byte_links import Link
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.robot import Robot
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.vehicle import Period, clip_input

log = logging.getLogger("brakeline.flight")

POLL = 0.005  # s between two reads of the link
RESEND = 0.05  # s between two transmissions of the same setpoint
STALE = 0.2  # s without a position, an attitude or an acceleration after which telemetry counts as lost
SILENT = 3.0  # s without a heartbeat after which the mode counts as unknown
SYNC_INTERVAL = 1.0  # s between two requests for the autopilot's clock
LOW_BATTERY = 20.0  # %, below which the log says so
LATE = 0.02  # s after its time at which a period's start counts as late


@dataclass(frozen=True)
class ControlPeriod:
    """One control period, at the moment when it begins.

    Attributes:
        number: its number; the first is 0.
        input: (3,) m/s, in force from this moment on.
        report: the outcome of the period before.
        lost: why the measurement or our control does not count: no recent telemetry, or the autopilot does not follow
            our setpoints. Empty if both count.
    """

    number: int
    input: Array
    report: Period
    lost: str = ""


class MavlinkVehicle:
    """A quadrotor in real time on a link, with any autopilot that speaks MAVLink, simulated or not.

    Periods follow each other by the clock. `commit` takes a plan: one input for each period that has not begun. The
    vehicle's thread sends each input at its time, sends it again every `RESEND` seconds, and reads telemetry. It flies
    a plan to its end unless another plan replaces it, and then sends zero: the vehicle hovers.

    If the process dies, the autopilot's own timeout brakes the vehicle. An actor therefore runs the vehicle in a second
    process, which outlives the actor (`brakeline.actors.mavlink.vehicle_client`). If the vehicle leaves offboard or
    guided mode (pilot, failsafe, battery, fence), we do not take it back; periods are `lost` until it returns.

    Collisions and clearance come from the ground truth of a simulator, if there is one.
    """

    def __init__(
        self,
        link: Link,
        robot: Robot,
        *,
        system: int = 1,
        height: float = 3.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        truth: UdpGroundTruth | None = None,
        tap: FrameTap | None = None,
        rejected: RejectedMessages | None = None,
        stop: Callable[[], bool] = lambda: False,
        raise_limits: bool = False,
        mavlink_truth: MavlinkGroundTruth | None = None,
        lead: bool = False,
    ) -> None:
        """Take control, climb to `height` [m] above the ground unless the vehicle flies already, begin period 0.

        Args:
            link: to the autopilot; this object closes it.
            robot: the robot's description: its bounds, slew and period.
            system: the autopilot's MAVLink system id.
            height: m above the ground.
            origin: the start of the autopilot's local frame in our world frame, m.
            truth: the ground truth that our own simulator sends over UDP.
            tap: called with each MAVLink frame.
            rejected: counts messages that cannot be handled.
            stop: once it returns true, nothing here waits any more.
            raise_limits: set each autopilot parameter that is below the robot's bounds.
            mavlink_truth: the ground truth of the autopilot's own simulator; without effect if `truth` is given.
            lead: send positions ahead of the vehicle instead of velocities (`position_lookahead`).

        Raises:
            MavlinkError: no autopilot answers, it refuses something, or `stop` returned true.
        """
        self._robot, self._stop_requested = robot, stop
        self._link, self._truth = link, truth
        self._mavlink_truth = mavlink_truth if truth is None else None
        self._client = AutopilotClient(link.send, system, tap, lambda text: log.info("it says: %s", text))
        self._origin, self._rejected = np.asarray(origin), rejected or RejectedMessages()
        self.timing = FlightTiming()
        self._plan: list[Array] = []  # the inputs after the one in force
        self._sent_at = self._heartbeat_at = self._synced_at = -math.inf
        self._counted: dict[str, int] = {}  # messages by their quantity
        self._received_at: dict[str, float] = {}  # s, arrival of the latest of them
        self._logged_loss, self._logged_battery = "", False
        self._takeoff = Takeoff(self._client, robot, self._wait, self._hold, raise_limits, lead)
        self.notes = self._takeoff.notes
        self._velocity: Array | None = None  # the setpoint that is repeated
        self._offsets = ClockOffset()
        self._changed, self._ended, self._failure = threading.Condition(), threading.Event(), ""
        try:
            self._takeoff.fly(height)
        except BaseException:
            link.close()
            raise
        self._collisions = 0 if truth is None else truth.collisions
        if self._mavlink_truth is not None:
            self._request_truth()
        state = self._state(time.monotonic())
        standing = Period(state, state, False, math.inf, math.inf, np.zeros((SAMPLES, 3)), 0.0)
        self.current_period = ControlPeriod(0, np.zeros(self._robot.action_dim), standing)
        self._due = time.monotonic() + self._robot.period  # s, start of the next period
        self._pump = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._pump.start()

    def commit(self, plan: Array, number: int) -> bool:
        """Carry out a plan (K, 3) [m/s], clipped to bounds and slew, from period `number` on, and then zero.

        Returns:
            False if that period has begun already; the plan committed before stays in force.

        Raises:
            BadInput: an input is not three finite numbers.
        """
        rows = [clip_input(self._robot, row, row) for row in np.asarray(plan, float)]
        with self._changed:
            in_time = self.current_period.number < number
            if in_time:
                before = number - self.current_period.number - 1
                unchanged = [*self._plan, *[np.zeros(self._robot.action_dim)] * before][:before]
                self._plan = unchanged + rows
        return in_time

    def wait(self, number: int) -> ControlPeriod:
        """Wait until period `number` has begun, and return the current period.

        Raises:
            MavlinkError: the period does not begin in time, or the vehicle's thread has died.
        """
        with self._changed:
            patience = 2.0 + self._robot.period * max(0, number - self.current_period.number)
            if not self._changed.wait_for(
                lambda: self.current_period.number >= number or bool(self._failure), patience
            ):
                raise MavlinkError(f"period {number} does not begin")
            if self._failure:
                raise MavlinkError(f"nobody flies any more: {self._failure}")
            return self.current_period

    def step(self, input: Array) -> Period:
        """Wait for the current period to end, then brake after one period with `input` (3,) [m/s]. Raises BadInput."""
        number = self.current_period.number + 1
        self.commit(np.asarray(input)[None], number)
        return self.wait(number).report

    def land(self) -> None:
        """Land, disarm and give up control. Raises MavlinkError."""
        self._stop()
        self._velocity, self._stop_requested = None, lambda: False
        self._client.land(self._wait)

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed, by its last heartbeat."""
        return self._client.armed

    @property
    def idle(self) -> bool:
        """Whether the input in force is zero and no other input follows."""
        return not self._plan and not self.current_period.input.any()

    @property
    def failed(self) -> bool:
        """Whether the vehicle's thread has died."""
        return bool(self._failure)

    @property
    def silence(self) -> float:
        """Seconds since the last message of the autopilot."""
        return time.monotonic() - max(self._received_at.values(), default=-math.inf)

    def judged(self) -> dict[str, float]:
        """Figures for Health from the ground truth of the autopilot's simulator; empty without one."""
        truth = self._mavlink_truth
        if truth is None or truth.state is None:
            return {}
        return {
            "true collisions": truth.collisions,
            "true clearance least m": truth.least,
            "estimate off truth at most m": truth.worst,
        }

    def listen(self, seconds: float) -> None:
        """Read messages for some seconds after `land`."""
        self._wait(lambda: False, seconds)

    def close(self) -> None:
        """Stop sending. Unless the vehicle has landed, the autopilot's timeout brakes it."""
        self._stop()
        self._link.close()
        if self._truth is not None:
            self._truth.close()

    def _request_truth(self) -> None:
        try:
            self._takeoff.note(self._client.choose(TRUTH, TELEMETRY, self._wait))
        except TelemetryMissing:
            self._mavlink_truth = None

    # --- in the thread, once it runs --------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._ended.wait(min(POLL, max(0.0, self._due - time.monotonic()))):
                with self._changed:
                    now = time.monotonic()
                    if now >= self._due:
                        self._begin(now)
                    self._exchange(now)
        except Exception as error:  # any error: without setpoints the autopilot brakes
            log.exception("no more setpoints are sent")
            with self._changed:
                self._failure = f"{type(error).__name__}: {error}"
                self._changed.notify_all()

    def _begin(self, now: float) -> None:
        """Begin a period: send its input first, then report on the period before."""
        following = self._plan.pop(0) if self._plan else np.zeros(self._robot.action_dim)
        self._velocity = clip_input(self._robot, following, self.current_period.input)
        self._send_setpoint(now)
        self._keep_time(now - self._due)
        start, state = self.current_period.report.measured[:3], self._state(now)
        report = self._report(state, self._path(now, state) - start)
        self.current_period = ControlPeriod(self.current_period.number + 1, self._velocity, report, self._lost(now))
        self._log_loss(self.current_period.lost)
        self._client.path = self._client.path[-1:]
        self._changed.notify_all()

    def _keep_time(self, lateness: float) -> None:
        timing = self.timing
        timing.periods += 1
        timing.late += lateness > LATE
        timing.lateness.append(lateness)
        slipped = lateness > self._robot.period
        timing.slips += slipped
        self._due += self._robot.period + (lateness if slipped else 0.0)

    def _lost(self, now: float) -> str:
        """Return why the measurement or our control does not count; empty if both count."""
        client = self._client
        for what in IN_FLIGHT:
            silent = now - self._received_at.get(what, -math.inf)
            if silent > STALE:
                return f"no telemetry of {what} for {silent:.2f} s"
        if now - self._received_at.get("mode", -math.inf) > SILENT:
            return f"no heartbeat for more than {SILENT:.0f} s"
        if not (client.offboard and client.armed):
            state = client.mode if client.armed else "it is disarmed"
            return f"the autopilot does not follow our setpoints ({state})"
        if client.outside:
            return f"the autopilot says that it is outside of its geofence ({client.outside})"
        return "the autopilot says that it is in an emergency" if client.emergency else ""

    def _log_loss(self, why: str) -> None:
        """Log a loss when it begins, when its reason changes, and when it ends."""
        self.timing.lost += bool(why)
        kind, before = why.split(" for ")[0], self._logged_loss
        if kind != before:
            self._logged_loss = kind
            texts = "; ".join(self._client.texts[-2:])
            if why:
                log.warning("braking: %s%s", why, f"; it says: {texts}" if texts else "")
            else:
                log.warning("flying again, after: %s", before)
        battery = self._client.battery
        if battery is not None and battery < LOW_BATTERY and not self._logged_battery:
            self._logged_battery = True
            log.warning("its battery is at %.0f %%", battery)

    @property
    def _offset(self) -> float:
        """Our clock minus the autopilot's, s.

        The estimate comes from the messages with the least delay, minus half of the fastest TIMESYNC round trip. The
        part of a round trip that our own polling explains does not count.
        """
        way = 0.5 * self.timing.round_trip - POLL
        return self._offsets.value - (way if 0.0 < way < STALE else 0.0)

    def _state(self, now: float) -> Array:
        """Return the state (9,) at time `now`: the latest telemetry, extrapolated by its velocity and acceleration."""
        client = self._client
        assert client.position is not None
        ahead = min(max(now - self._offset - client.time, 0.0), STALE)
        v, a = client.velocity, client.acceleration
        position = client.position + self._origin + ahead * v + 0.5 * ahead**2 * a
        return np.concatenate((position, v + ahead * a, a))

    def _path(self, now: float, state: Array) -> Array:
        """Return S positions (S, 3) [m] at even times of the period that ends now in `state` (9,)."""
        path = self._client.path
        times = [t + self._offset for t, _ in path] + [now]
        positions = np.array([p + self._origin for _, p in path] + [state[:3]])
        at = now - self._robot.period + self._robot.period / SAMPLES * np.arange(1, SAMPLES + 1)
        return np.stack([np.interp(at, times, positions[:, axis]) for axis in range(3)], axis=1)

    def _report(self, state: Array, path: Array) -> Period:
        truth = self._truth or self._mavlink_truth
        if truth is None or truth.state is None:
            return Period(state, state, False, math.inf, math.inf, path, 0.0)
        collision, self._collisions = truth.collisions > self._collisions, truth.collisions
        return Period(state, truth.state, collision, truth.clearance, truth.clearance, path, 0.0)

    def _exchange(self, now: float) -> None:
        """Read all messages that have arrived, and send all that is due."""
        client = self._client
        before = len(client.path), client.time
        with self._rejected.skip_on_error("mavlink"):
            client.feed(self._link.receive())
        for what, count in client.message_counts.items():
            if self._counted.get(what) != count:
                self._counted[what], self._received_at[what] = count, now
        if self._mavlink_truth is not None and client.truth is not None and client.position is not None:
            self._mavlink_truth.take(client.truth, client.position + self._origin, client.velocity)
            client.truth = None
        if (len(client.path), client.time) != before:
            self._offsets.note(now, client.time)
        for asked, _ in client.answers:
            self.timing.round_trip = min(self.timing.round_trip, 1e-9 * (time.monotonic_ns() - asked))
        client.answers.clear()
        if now - self._synced_at >= SYNC_INTERVAL:
            self._synced_at = now
            client.ask_time(time.monotonic_ns())
        if self._truth is not None:
            self._truth.poll()
        if now - self._heartbeat_at >= 1.0:
            self._heartbeat_at = now
            client.heartbeat()
        if self._velocity is not None and now - self._sent_at >= RESEND:
            self._send_setpoint(now)

    def _hold(self, velocity: Array | None) -> None:
        """Repeat this setpoint (3,) [m/s] from now on; None: send none."""
        if self._velocity is None:  # a pause without setpoints is no gap between two of them
            self._sent_at = -math.inf
        self._velocity = velocity

    def _send_setpoint(self, now: float) -> None:
        assert self._velocity is not None
        if math.isfinite(self._sent_at):
            self.timing.worst_gap = max(self.timing.worst_gap, now - self._sent_at)
        self._sent_at = now
        self._client.setpoint(self._velocity)

    def _wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Exchange messages until the condition holds, before the thread runs. Our own stalls do not count as time."""
        left, before = seconds, time.monotonic()
        while not condition():
            if self._stop_requested():
                raise MavlinkError("asked to stop before the vehicle flew")
            if left < 0.0:
                return False
            self._exchange(time.monotonic())
            time.sleep(POLL)
            now = time.monotonic()
            left, before = left - min(now - before, 10.0 * POLL), now
        return True

    def _stop(self) -> None:
        self._ended.set()
        if self._pump.is_alive():
            self._pump.join(2.0)
