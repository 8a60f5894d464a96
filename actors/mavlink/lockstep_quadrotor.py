"""A quadrotor behind MAVLink in memory, in lockstep with a simulated autopilot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, message_id
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.telemetry import ATTITUDE, FORCE, MOTION, SOURCES, Array
from brakeline.errors import CommandRefused
from brakeline.messaging.robot import Robot
from brakeline.sim.quadrotor import SAMPLES, Quadrotor
from brakeline.sim.vehicle import Period

if TYPE_CHECKING:
    from brakeline.sim.autopilot.endpoint import Autopilot


class LockstepVehicle(ABC):
    """A simulated quadrotor that an autopilot flies over MAVLink: time passes only in `step`.

    The measured state comes from the autopilot; the true state and the contacts come from the simulator.
    """

    def __init__(self, robot: Robot, vehicle: Quadrotor) -> None:
        self._robot, self._vehicle = robot, vehicle
        self.input = np.zeros(robot.action_dim)  # in force
        self.true = self.measured = vehicle.state()

    @abstractmethod
    def _fly(self) -> Array:
        """Fly one period at `input`, update `measured`, and return the positions (S, 3) [m] at even times."""

    def step(self, input: Array) -> Period:
        """Fly one period at a velocity setpoint (3,) [m/s], clipped to bounds and slew.

        Raises:
            BadInput: the input is not three finite numbers.
            AutopilotGone: the autopilot does not answer.
        """
        self.input, start = self._robot.clip_input(input, self.input), self.measured[:3]
        self._vehicle.begin_period()
        path = self._fly()
        period = self._vehicle.end_period(self.measured, path - start)
        self.true = period.true
        return period

    def initial_period(self) -> Period:
        """Return the report before the first step: the current state, as of a period without motion."""
        clearance = float(self._vehicle.clearance(self.true[:3]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 3)), 0.0)

    def alter(self, **changes: float) -> None:
        """Change the simulated vehicle, see `Quadrotor.alter`."""
        self._vehicle.alter(**changes)


class LockstepQuadrotor(LockstepVehicle):
    """A quadrotor behind a simulated autopilot in this process, which starts in the air.

    The autopilot changes its mode before time begins.
    """

    def __init__(self, endpoint: Autopilot, robot: Robot, tap: FrameTap | None = None) -> None:
        """tap: called with every MAVLink frame. Raises MavlinkError: the autopilot refuses something."""
        super().__init__(robot, endpoint.vehicle)
        self._endpoint, self._client = endpoint, AutopilotClient(endpoint.receive, tap=tap)
        for what, interval in ((MOTION, robot.period / SAMPLES), (ATTITUDE, robot.period), (FORCE, robot.period)):
            self._request(what, interval)
        self._client.follow_setpoints(self._wait)
        self.measured = self._client.state()

    def _fly(self) -> Array:
        client, endpoint = self._client, self._endpoint
        client.path.clear()
        client.setpoint(self.input)
        endpoint.advance(self._robot.period)
        client.feed(endpoint.take())
        self.measured = client.state()
        return np.array([position for _, position in client.path])

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
