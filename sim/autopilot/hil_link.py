"""Physics for a real autopilot, from outside: our vehicle's sensors go to it, its rotors' commands come back.

In lockstep, as PX4's `simulator_mavlink` has it: its clock is the one in HIL_SENSOR, it computes, it answers with
HIL_ACTUATOR_CONTROLS, and time stands still until it has. So flight code that runs in real time on a vehicle runs here
as fast as both can, and nothing is ever late.
"""

from __future__ import annotations

import socket
import time

from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.hil_sensors import HilSensors
from brakeline.sim.flight_controller import Vector
from brakeline.sim.quadrotor import Quadrotor

LOCKSTEP, ARMED = 0x1, int(mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
ROTORS = 4
PATIENCE = 2.0  # s of real time for an answer
UNANSWERED = 5  # of those in a row, and it is gone
BOOTING = 0.004  # s that an answer is waited for as long as none has come


class AutopilotGone(RuntimeError):
    """The autopilot does not answer any more, or cannot be run in lockstep."""


class HilLink:
    """The simulator's end of one autopilot. vehicle: may be exchanged for another one between two ticks.

    shift: m, ENU: where the autopilot believes to be when the vehicle is at its arena's origin. An arena that is
    exchanged for the next one is, for the autopilot, another corner of one large field.
    """

    def __init__(self, connection: socket.socket, vehicle: Quadrotor, sensors: HilSensors) -> None:
        self.vehicle, self.shift = vehicle, (0.0, 0.0, 0.0)
        self.armed = False  # it lets the rotors turn
        self.unanswered = 0  # steps on which no answer came in time
        self.answering = False  # it has started up: lockstep has begun
        self._sensors, self._connection = sensors, connection
        self._step = round(1e6 * vehicle.timestep)  # µs
        self._now = 0  # µs
        self._most = float(vehicle.controller.body.most_thrust)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._silent = 0
        self._heard = 0  # µs, time of the newest command

    @property
    def time(self) -> float:
        """s since the autopilot was switched on."""
        return 1e-6 * self._now

    def tick(self) -> None:
        """One physics step: what is sensed now goes out, what the autopilot makes of it moves the vehicle.

        Raises:
            AutopilotGone.
        """
        vehicle = self.vehicle
        self._now += self._step
        truth, (dx, dy, dz) = vehicle.true_reading(), self.shift
        x, y, z = truth.position
        where: Vector = (x + dx, y + dy, z + dz)
        packets = [message.pack(self._packer) for message in self._sensors.read(truth, where, self._now)]
        try:
            self._connection.sendall(b"".join(packets))
        except OSError as error:
            raise AutopilotGone("the autopilot closed the connection") from error
        self._wait()
        vehicle.fly(1)

    def _wait(self) -> None:
        """For the command that belongs to the newest sensors; before the first one ever, not for long."""
        end = time.monotonic() + (PATIENCE if self.answering else BOOTING)
        while self._heard < self._now - self._step // 2:
            left = end - time.monotonic()
            if left <= 0.0:
                return self._miss()
            self._connection.settimeout(left)
            try:
                data = self._connection.recv(65536)
            except TimeoutError:
                return self._miss()
            except OSError as error:
                raise AutopilotGone("the autopilot closed the connection") from error
            if not data:
                raise AutopilotGone("the autopilot closed the connection")
            for message in self._parser.parse_buffer(data) or ():
                if message.get_msgId() == mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS:
                    self._obey(message)
        self._silent = 0
        return None

    def _obey(self, message: mavlink.MAVLink_hil_actuator_controls_message) -> None:
        if not message.flags & LOCKSTEP:
            raise AutopilotGone(
                "this autopilot was built without lockstep: it cannot be given physics from outside here"
            )
        self.answering = True
        self._heard = message.time_usec
        self.armed = bool(message.mode & ARMED)
        self.vehicle.set_thrusts(tuple(self._most * min(max(c, 0.0), 1.0) for c in message.controls[:ROTORS]))

    def _miss(self) -> None:
        if not self.answering:
            return
        self.unanswered += 1
        self._silent += 1
        if self._silent >= UNANSWERED:
            raise AutopilotGone(f"the autopilot has not answered for {UNANSWERED * PATIENCE:g} s")
