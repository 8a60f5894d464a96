"""Fly a quadrotor in real time over a MAVLink link: a thread keeps time and carries out the committed plan."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.autopilot_commands import HEARTBEAT_INTERVAL, AutopilotClient
from brakeline.actors.mavlink.flight_timing import FlightTiming
from brakeline.actors.mavlink.flight_watch import POLL, STALE, FlightWatch
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.ground_truth import MavlinkGroundTruth, UdpGroundTruth
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod, PeriodicVehicle
from brakeline.actors.mavlink.takeoff import TELEMETRY, Takeoff
from brakeline.actors.mavlink.telemetry import TRUTH, Array, resampled
from brakeline.errors import CommandLost, MavlinkError, TelemetryMissing
from brakeline.messaging.acceleration_age import OLDEST
from brakeline.messaging.byte_links import open_link
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.robot import Robot
from brakeline.sim.quadrotor import SAMPLES
from brakeline.sim.vehicle import Period

log = logging.getLogger("brakeline.flight")

RESEND = 0.05  # s between two transmissions of the same setpoint
SYNC_INTERVAL = 0.2  # s between two requests for the autopilot's clock
LOW_BATTERY = 20.0  # %, below which the log says so
LATE = 0.02  # s: a period that begins later than this after its time is late


class MavlinkVehicle(PeriodicVehicle):
    """A quadrotor in real time on a link, with any autopilot that speaks MAVLink, simulated or not.

    Periods follow each other by the clock. `commit` takes a plan: one input for each period that has not begun. The
    vehicle's thread sends each input at its time, sends it again every `RESEND` seconds, and reads telemetry. It flies
    a plan to its end unless another plan replaces it, and then sends zero: the vehicle hovers.

    If the process dies, the autopilot's own timeout brakes the vehicle. An actor therefore runs the vehicle in a second
    process, which outlives the actor (`brakeline.actors.mavlink.vehicle_client`). If the vehicle leaves offboard or
    guided mode (pilot, failsafe, battery, fence), we do not take it back; periods are `lost` until it returns. If the
    vehicle disarms or restarts, or its estimate jumps, our command of it has ended: the vehicle brakes along the
    committed plan (a disarmed one does not), and then nobody flies it. After such an event, we do not know whether the
    vehicle is where our map says, or whether a person holds it.

    Collisions and clearance come from the ground truth of a simulator, if there is one.

    Attributes:
        acceleration_age: the states hold the horizontal acceleration of this long ago [s]. What counts is the age in
            the data of the model set (`brakeline.messaging.acceleration_age`).
    """

    def __init__(
        self,
        robot: Robot,
        flight: FlightSettings,
        *,
        tap: FrameTap | None = None,
        rejected: RejectedMessages | None = None,
        stop: Callable[[], bool] = lambda: False,
        mavlink_truth: MavlinkGroundTruth | None = None,
        from_ground: bool = False,
    ) -> None:
        """Take control, climb to `flight.height` unless the vehicle flies already, and begin period 0.

        Args:
            tap: called with each MAVLink frame.
            rejected: counts messages that cannot be handled.
            stop: once it returns true, nothing here waits any more.
            mavlink_truth: the ground truth of the autopilot's own simulator; without effect if `flight.truth` is set.
            from_ground: refuse a vehicle that flies already.

        Raises:
            BadLink, OSError: the link cannot be opened.
            MavlinkError: no autopilot answers, it refuses something, or `stop` returned true.
        """
        super().__init__(robot)
        self.acceleration_age = flight.acceleration_age
        self._accelerations: deque[tuple[float, Array]] = deque()  # times [s] and (3,), as old as `OLDEST` and older
        self._stop_requested, self._rejected = stop, rejected or RejectedMessages()
        self._origin = np.asarray(flight.origin)
        self.timing = FlightTiming()
        self._plan: list[Array] = []  # the inputs after the one in force
        self._sent_at = self._heartbeat_at = self._synced_at = -math.inf
        self._logged_loss, self._logged_battery = "", False
        self._velocity: Array | None = None  # the setpoint that is repeated
        self._ended = threading.Event()
        self._link = open_link(flight.url)
        self._truth: UdpGroundTruth | None = None
        self._mavlink_truth = None if flight.truth else mavlink_truth
        self._client = AutopilotClient(
            self._send, flight.system, tap, lambda text: log.info("the autopilot says: %s", text)
        )
        self._watch = FlightWatch(self._client, self.timing)
        stale = lambda: self._watch.stale(time.monotonic())  # noqa: E731
        self._takeoff = Takeoff(self._client, robot, flight, self._wait, self._hold, stale, from_ground)
        self.notes = self._takeoff.notes
        try:
            if flight.truth:
                self._truth = UdpGroundTruth(flight.truth, flight.system, self._rejected)
            self._takeoff.fly()
        except BaseException:
            self._land_after_failure()
            self._disconnect()
            raise
        self._client.interruption = ""  # the map and our command hold from here on
        self._collisions = 0 if self._truth is None else self._truth.collisions
        if self._mavlink_truth is not None:
            self._request_truth()
        state = self._state(time.monotonic())
        standing = Period(state, state, False, math.inf, math.inf, np.zeros((SAMPLES, 3)), 0.0)
        self._begin(ControlPeriod(0, np.zeros(robot.action_dim), standing))
        self._due = time.monotonic() + robot.period  # s, start of the next period
        self._pump = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._pump.start()

    @property
    def autopilot(self) -> str:
        """The kind of autopilot, as its heartbeat says: "ardupilot" or "px4"."""
        assert self._client.kind is not None, "it has taken off"
        return self._client.kind

    def commit(self, plan: Array, number: int) -> bool:
        """Carry out a plan (K, 3) [m/s], clipped to bounds and slew, from period `number` on, and then zero.

        Returns:
            False if that period has begun already, or our command has ended; the plan committed before stays in force.

        Raises:
            BadInput: an input is not three finite numbers.
        """
        rows = [self._robot.clip_input(row, row) for row in np.asarray(plan, float)]
        with self._changed:
            in_time = self.current_period.number < number and not self._client.interruption
            if in_time:
                before = number - self.current_period.number - 1
                unchanged = [*self._plan, *[np.zeros(self._robot.action_dim)] * before][:before]
                self._plan = unchanged + rows
        return in_time

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
    def offboard(self) -> bool:
        """Whether the vehicle is in the mode that follows our setpoints, by its last heartbeat."""
        return self._client.offboard

    @property
    def mode(self) -> str:
        """The name of its mode, by its last heartbeat."""
        return self._client.mode

    @property
    def idle(self) -> bool:
        """Whether the input in force is zero and no other input follows."""
        return not self._plan and not self.current_period.input.any()

    @property
    def silence(self) -> float:
        """Seconds since the last message of the autopilot."""
        return self._watch.silence(time.monotonic())

    def truth_figures(self) -> dict[str, float]:
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
        self._disconnect()

    def _send(self, data: bytes) -> None:
        """Send to the autopilot's address; to all peers of the link until it is known."""
        self._link.send(data, self._client.source or "")

    def _disconnect(self) -> None:
        self._link.close()
        if self._truth is not None:
            self._truth.close()

    def _land_after_failure(self) -> None:
        """Land a vehicle whose takeoff failed after we had armed it, unless somebody else has it."""
        self._velocity, self._stop_requested = None, lambda: False
        if self._takeoff.armed_it and self._client.armed and self._client.offboard:
            log.error("the takeoff failed: landing")
            try:
                self._client.land(self._wait)
            except MavlinkError as error:
                log.error("the vehicle does not land, so land it yourself: %s", error)

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
                        self._begin_next(now)
                    self._exchange(now)
                    self._end_command()
        except CommandLost as error:
            log.error("no more setpoints are sent: %s", error)
            self._fail(error)
        except Exception as error:  # any error: without setpoints the autopilot brakes
            log.exception("no more setpoints are sent")
            self._fail(MavlinkError(f"nobody flies any more: {type(error).__name__}: {error}"))

    def _end_command(self) -> None:
        """Raise CommandLost once our command has ended and the vehicle has braked along its plan, or has disarmed."""
        if self._client.interruption and (self.idle or not self._client.armed):
            raise CommandLost(
                f"our command of the vehicle has ended: {self._client.interruption}. Check where it is, and start again"
            )

    def _begin_next(self, now: float) -> None:
        """Begin a period: send its input first, then report on the period before. Missed periods leave out numbers."""
        missed = int((now - self._due) / self._robot.period)
        # Without setpoints the autopilot has braked: the inputs of missed periods would set it in motion again.
        del self._plan[:missed]
        following = self._plan.pop(0) if self._plan else np.zeros(self._robot.action_dim)
        self._velocity = self._robot.clip_input(following, self.current_period.input)
        self._send_setpoint(now)
        self._keep_time(now - self._due)
        start, state = self.current_period.report.measured[:3], self._state(now)
        report, lost = self._report(state, self._path(now, state) - start), self._watch.lost(now)
        self._begin(ControlPeriod(self.current_period.number + 1 + missed, self._velocity, report, lost))
        self._log_loss(lost)
        self._client.path = self._client.path[-1:]

    def _keep_time(self, lateness: float) -> None:
        """Count a period, and set the time of the next one: also a late period lasts a whole period."""
        timing, late = self.timing, lateness > LATE
        timing.periods += 1
        timing.late += late
        timing.lateness.append(lateness)
        timing.slips += lateness > self._robot.period
        self._due += self._robot.period + (lateness if late else 0.0)

    def _log_loss(self, why: str) -> None:
        """Log a loss when it begins, when its reason changes, and when it ends."""
        self.timing.lost += bool(why)
        kind, before = why.split(" for ")[0], self._logged_loss
        if kind != before:
            self._logged_loss = kind
            texts = "; ".join(self._client.texts[-2:])
            if why:
                log.warning("braking: %s%s", why, f"; the autopilot says: {texts}" if texts else "")
            else:
                log.warning("flying again, after: %s", before)
        battery = self._client.battery
        if battery is not None and battery < LOW_BATTERY and not self._logged_battery:
            self._logged_battery = True
            log.warning("the battery is at %.0f %%", battery)

    def _state(self, now: float) -> Array:
        """Return the state (9,) at time `now`: the latest telemetry, extrapolated by its velocity and acceleration.

        Its horizontal acceleration is the one of `acceleration_age` ago.
        """
        ahead = min(max(self._watch.age(now), 0.0), STALE)
        state = self._client.state(self._origin, ahead)
        if self.acceleration_age and self._accelerations:
            times, values = zip(*self._accelerations, strict=True)
            state[6:8] = resampled(times, np.array(values), np.array([now - self.acceleration_age]))[0, :2]
        return state

    def _remember_acceleration(self, now: float) -> None:
        self._accelerations.append((now, self._client.acceleration))
        while len(self._accelerations) > 1 and self._accelerations[1][0] <= now - OLDEST:
            self._accelerations.popleft()

    def _path(self, now: float, state: Array) -> Array:
        """Return S positions (S, 3) [m] at even times of the period that ends now in `state` (9,)."""
        path, period = self._client.path, self._robot.period
        times = [t + self._watch.offset for t, _ in path] + [now]
        positions = np.array([p + self._origin for _, p in path] + [state[:3]])
        return resampled(times, positions, now - period + period / SAMPLES * np.arange(1, SAMPLES + 1))

    def _report(self, state: Array, path: Array) -> Period:
        truth = self._truth or self._mavlink_truth
        if truth is None or truth.state is None:
            return Period(state, state, False, math.inf, math.inf, path, 0.0)
        collision, self._collisions = truth.collisions > self._collisions, truth.collisions
        return Period(state, truth.state, collision, truth.clearance, truth.clearance, path, 0.0)

    def _exchange(self, now: float) -> None:
        """Read all messages that have arrived, and send all that is due."""
        client = self._client
        for peer, data in self._link.receive_by_peer():
            with self._rejected.skip_on_error("mavlink"):
                client.feed(data, peer)
        self._watch.note(now, 0.0 if self._velocity is None else float(np.linalg.norm(self._velocity)))
        self._remember_acceleration(now)
        if self._mavlink_truth is not None and client.truth is not None and client.position is not None:
            self._mavlink_truth.take(client.truth, client.position + self._origin, client.velocity)
            client.truth = None
        if now - self._synced_at >= SYNC_INTERVAL:
            self._synced_at = now
            self._watch.clock_requested(asked := time.monotonic_ns())
            client.ask_time(asked)
        if self._truth is not None:
            self._truth.poll()
        if now - self._heartbeat_at >= HEARTBEAT_INTERVAL:
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
