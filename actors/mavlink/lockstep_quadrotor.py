"""A quadrotor behind MAVLink in memory, in lockstep with a simulated autopilot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, message_id
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.telemetry import ATTITUDE, FORCE, MOTION, SOURCES, Array
from brakeline.errors import CommandRefused
from brakeline.messaging.robot import Robot
from brakeline.sim.quadrotor import SAMPLES, Quadrotor
from brakeline.sim.vehicle import Period, clip_input


class Endpoint(Protocol):
    """A simulated autopilot in memory, such as `brakeline.sim.autopilot.endpoint.Autopilot`."""

    vehicle: Quadrotor

    def receive(self, data: bytes) -> None: ...

    def take(self) -> bytes: ...

    def advance(self, seconds: float) -> None: ...


class LockstepQuadrotor:
    """A quadrotor flown by a simulated autopilot in this process: time passes only in `step`.

    The measured state comes from telemetry; the true state and the contacts come from the simulator. The autopilot
    starts in the air, and changes its mode before time begins.

    Attributes:
        input: the input in force (3,) [m/s].
        measured, true: the state (9,).
    """

    def __init__(self, endpoint: Endpoint, robot: Robot, tap: FrameTap | None = None) -> None:
        """tap: called with every MAVLink frame. Raises MavlinkError: the autopilot refuses something."""
        self._endpoint, self._client = endpoint, AutopilotClient(endpoint.receive, tap=tap)
        self._robot, period = robot, robot.period
        self.input = np.zeros(robot.action_dim)
        wait = self._wait
        for what, interval in ((MOTION, period / SAMPLES), (ATTITUDE, period), (FORCE, period)):
            self._request(what, interval)
        self._client.follow_setpoints(wait)
        self.true, self.measured = endpoint.vehicle.state(), self._measured()

    def step(self, input: Array) -> Period:
        """Fly one period at a velocity setpoint (3,) [m/s], clipped to bounds and slew.

        Raises:
            BadInput: the input is not three finite numbers.
        """
        self.input = clip_input(self._robot, input, self.input)
        client, endpoint, start = self._client, self._endpoint, self.measured[:3]
        client.path.clear()
        client.setpoint(self.input)
        endpoint.vehicle.begin_period()
        endpoint.advance(self._robot.period)
        client.feed(endpoint.take())
        self.measured = self._measured()
        path = np.array([position for _, position in client.path]) - start
        period = endpoint.vehicle.end_period(self.measured, path)
        self.true = period.true
        return period

    def initial_period(self) -> Period:
        """Return the report before the first step: the current state, as of a period without motion."""
        clearance = float(self._endpoint.vehicle.clearance(self.true[:3]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 3)), 0.0)

    def alter(self, **changes: float) -> None:
        """Change the simulated vehicle, see `Quadrotor.alter`."""
        self._endpoint.vehicle.alter(**changes)

    def _measured(self) -> Array:
        """Return the state (9,) of the latest telemetry."""
        client = self._client
        assert client.position is not None
        return np.concatenate((client.position, client.velocity, client.acceleration))

    def _request(self, what: str, interval: float) -> None:
        """Request the best message that the autopilot grants, at an interval [s] and now. Raises CommandRefused."""
        names = [source.message for source in SOURCES[what]]
        for name in names:
            try:
                self._client.stream(message_id(name), interval, self._wait)
                self._client.request(message_id(name), self._wait)
                return
            except CommandRefused:
                if name == names[-1]:
                    raise

    def _wait(self, condition: Callable[[], bool], _: float) -> bool:
        """Read the replies, which are there at once or never."""
        self._client.feed(self._endpoint.take())
        return condition()
