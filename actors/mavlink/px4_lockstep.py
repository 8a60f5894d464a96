"""A quadrotor behind the real PX4, in lockstep. It stays in the air between episodes, while the arenas change."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.frame_log import CapturedFrame, FrameTap
from brakeline.actors.mavlink.lockstep_quadrotor import LockstepVehicle
from brakeline.actors.mavlink.telemetry import Array, resampled
from brakeline.errors import AutopilotGone, MavlinkError
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.hil_link import HilLink
from brakeline.sim.autopilot.hil_sensors import HilSensors
from brakeline.sim.autopilot.px4_process import Px4Process
from brakeline.sim.flight_estimator import QuadrotorNoise
from brakeline.sim.quadrotor import SAMPLES, Quadrotor
from brakeline.sim.sim_conditions import SensorNoise
from brakeline.sim.vehicle import Period

RECEIVE_EVERY, SETPOINT_EVERY = 4, 20  # physics steps
INTERVALS = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0.01,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0.005,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 0.005,
}  # s between two messages, at the rate at which PX4 makes them
FRESH = 0.0125  # s of simulated time: `settle` waits for newer messages than that
SETTLE_TIMEOUT = 0.25  # s of real time
OLDEST = 0.05  # s of simulated time: a state from older messages does not count
POSITION_TIMEOUT, CLIMB_TIMEOUT, STOP_TIMEOUT = 90.0, 20.0, 10.0  # s
SETTLING_TIME = 15.0  # s of hovering, after which the takeoff does not disturb the estimate any more
HEIGHT, CLIMB = 3.0, 1.5  # m, m/s, of the takeoff
STANDING, LEVEL = 0.1, 0.1  # m/s, rad: below both, the vehicle hovers
FAR = 500.0  # m to the walls of the field
QUIET = QuadrotorNoise(scale=0.0)  # PX4 has its own estimator
FIELD = Arena(
    "field",
    room_boundary(FAR, 2.0 * FAR),
    (0.0, 0.0, FAR),
    (0.5 * FAR, 0.0, FAR),
    1.0,
    10**9,
    room_bounds(FAR, 2.0 * FAR),
)


class Px4Flight:
    """One PX4 process, which starts when it is needed first, and again when it cannot go on, as after a crash.

    `enter` puts another simulated vehicle in the place of the one that flies. For PX4 all arenas lie in one large
    field.
    """

    def __init__(self, folder: Path, noise: SensorNoise, tap: FrameTap | None = None) -> None:
        """folder: see `Px4Process`; tap: called with every MAVLink frame between PX4 and this process."""
        self._folder, self._noise, self._tap = folder, noise, tap
        self._px4: Px4Process | None = None
        self._count = 0
        self._times = dict.fromkeys(INTERVALS, 0.0)  # s, of the newest message of each kind
        self.setpoint = np.zeros(3)  # m/s
        self.starts = 0  # of PX4
        # why PX4 has not followed our setpoints since `enter`, or its state does not count; empty: all is well
        self.lost = ""

    @property
    def flies(self) -> bool:
        """Whether PX4 runs and follows setpoints."""
        return self._px4 is not None and self._px4.alive and self.hil.armed and self.client.offboard

    def enter(self, vehicle: Quadrotor) -> None:
        """Take this vehicle's place, hovering at the start of its arena.

        Raises:
            LaunchError, MavlinkError: PX4 does not start, or does not take off; AutopilotGone: PX4 does not answer.
        """
        try:
            hovers = self.flies and self._stop()
        except AutopilotGone:
            hovers = False
        if not hovers:
            self._begin()
        self._replace(vehicle)
        self.lost = self.client.interruption = ""

    def send_setpoint(self, velocity: Array) -> None:
        """Send this setpoint (3,) [m/s] from now on."""
        self.setpoint, self._count = velocity, 0

    def advance(self, seconds: float) -> None:
        """Simulate some seconds. Raises AutopilotGone."""
        for _ in range(round(seconds / self.hil.vehicle.timestep)):
            if self._count % SETPOINT_EVERY == 0:
                self.client.setpoint(self.setpoint)
                self.client.heartbeat()
            self._count += 1
            self.hil.tick()
            if self._count % RECEIVE_EVERY == 0:
                self._receive()

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Simulate until a condition holds, for some seconds at most. Return whether it holds."""
        end = self.hil.time + seconds
        while not condition():
            if self.hil.time >= end:
                return False
            self.advance(0.05)
        return True

    def settle(self) -> None:
        """Wait for the newest messages while simulated time stands still: PX4's threads may be behind.

        If they do not come, the state of the vehicle is `lost`.
        """
        end = time.monotonic() + SETTLE_TIMEOUT
        self._receive()
        while min(self._times.values()) < self.hil.time - FRESH and (left := end - time.monotonic()) > 0.0:
            select.select([self._link], [], [], left)
            self._receive()
        if (age := self.hil.time - min(self._times.values())) > OLDEST:
            self.lost = self.lost or f"PX4 sends no newer telemetry: the latest is {age:.2f} s old"

    def close(self) -> None:
        """End PX4. This also happens when the object is collected, and at the end of the program."""
        if self._px4 is not None:
            self._shut()
            self._px4 = None

    def _begin(self) -> None:
        """Start PX4 and take off."""
        self.close()
        self._link = link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        try:
            self._px4 = px4 = Px4Process(self._folder, link.getsockname()[1])
        except BaseException:
            link.close()
            raise
        self._shut = weakref.finalize(self, _shut, px4, link)
        self.starts += 1
        rng = np.random.default_rng(self.starts)
        vehicle = Quadrotor(FIELD, rng, QUIET, floor=FAR)
        self.hil = HilLink(px4.connection, vehicle, HilSensors(self._noise, rng, vehicle.timestep))
        self.client = AutopilotClient(lambda data: link.sendto(data, ("127.0.0.1", px4.local)), tap=self._on_frame)
        self._times = dict.fromkeys(INTERVALS, 0.0)
        self.send_setpoint(np.zeros(3))
        while not self.hil.answering:
            self.hil.tick()
        if not self.wait(lambda: self.client.position is not None, POSITION_TIMEOUT):
            raise MavlinkError(f"PX4 does not know its position; its last output:\n{px4.last_output()}")
        for kind, interval in INTERVALS.items():
            self.client.stream(kind, interval, self.wait)
        self.client.follow_setpoints(self.wait)
        self.client.arm(self.wait)
        self.send_setpoint(np.array([0.0, 0.0, CLIMB]))
        if not self.wait(lambda: vehicle.state()[2] > FAR + HEIGHT, CLIMB_TIMEOUT) or not self._stop():
            raise MavlinkError(f"PX4 does not take off; its last output:\n{px4.last_output()}")
        self.advance(SETTLING_TIME)

    def _stop(self) -> bool:
        """Come to a stop in the empty field. Return whether the vehicle hovers."""
        self._replace(Quadrotor(FIELD, np.random.default_rng(0), QUIET))
        self.send_setpoint(np.zeros(3))
        return self.wait(self._hovers, STOP_TIMEOUT)

    def _hovers(self) -> bool:
        truth = self.hil.vehicle.true_reading()
        tilt = 2.0 * math.hypot(truth.attitude[1], truth.attitude[2])
        return math.hypot(*truth.velocity) < STANDING and tilt < LEVEL

    def _replace(self, vehicle: Quadrotor) -> None:
        """Replace the simulated vehicle; shift its position so that nothing changes for PX4."""
        hil = self.hil
        before, after = hil.vehicle.true_reading().position, vehicle.true_reading().position
        x, y, z = (shift + old - new for shift, old, new in zip(hil.shift, before, after, strict=True))
        vehicle.copy_motion(hil.vehicle)
        hil.vehicle, hil.shift = vehicle, (x, y, z)

    def _on_frame(self, frame: CapturedFrame) -> None:
        message = frame.message
        if not frame.outgoing and message.get_msgId() in self._times:
            micro = getattr(message, "time_usec", None)
            self._times[message.get_msgId()] = 1e-3 * message.time_boot_ms if micro is None else 1e-6 * micro
        if self._tap is not None:
            self._tap(frame)

    def _receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.client.feed(self._link.recv(65536))
        client, left = self.client, ""
        if not (client.offboard and self.hil.armed):
            left = f"PX4 does not follow our setpoints ({client.mode if self.hil.armed else 'it is disarmed'})"
        self.lost = self.lost or client.interruption or left


def _shut(px4: Px4Process, link: socket.socket) -> None:
    px4.close()
    link.close()


class Px4Vehicle(LockstepVehicle):
    """A quadrotor flown by PX4, for one episode.

    The measured state is PX4's estimate. At the start, where the vehicle hovers, PX4's local frame is aligned with the
    arena's, as if PX4 were switched on at a known place.
    """

    def __init__(self, flight: Px4Flight, vehicle: Quadrotor, robot: Robot) -> None:
        """Raises the errors of `Px4Flight.enter`; AutopilotGone also if PX4 sends no state."""
        flight.enter(vehicle)
        super().__init__(robot, vehicle)
        self._flight = flight
        flight.send_setpoint(self.input)
        flight.settle()
        self._check()
        self._offset = np.zeros(3)
        self._offset = self.true[:3] - self._estimate()[:3]
        self.measured = self._estimate()

    def step(self, input: Array) -> Period:
        """Fly one period, see `LockstepVehicle.step`.

        A collision may disarm PX4: its period is the last one of the episode, and counts.

        Raises:
            AutopilotGone: also if PX4 did not follow the setpoint, or its state does not count. Nothing may be learned
                from such a period.
        """
        period = super().step(input)
        if not period.at_fault:
            self._check()
        return period

    def _check(self) -> None:
        """Raise AutopilotGone: PX4 did not follow the setpoint, or its state does not count."""
        if why := self._flight.lost:
            messages = "; it says: " + "; ".join(texts) if (texts := self._flight.client.texts[-3:]) else ""
            raise AutopilotGone(f"{why}{messages}")

    def _fly(self) -> Array:
        flight, path = self._flight, self._flight.client.path
        start, begin = self.measured[:3], flight.hil.time
        path.clear()
        flight.send_setpoint(self.input)
        flight.advance(self._robot.period)
        flight.settle()
        self.measured = self._estimate()
        times = [begin, *(time for time, _ in path), flight.hil.time]
        positions = np.array([start, *(position + self._offset for _, position in path), self.measured[:3]])
        return resampled(times, positions, begin + self._robot.period * np.arange(1, SAMPLES + 1) / SAMPLES)

    def _estimate(self) -> Array:
        """Return the state (9,) of the latest telemetry, extrapolated to the current time, by `OLDEST` at most."""
        client = self._flight.client
        return client.state(self._offset, min(max(self._flight.hil.time - client.time, 0.0), OLDEST))
