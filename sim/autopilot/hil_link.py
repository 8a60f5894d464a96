"""Simulate the physics of a real autopilot: send it our vehicle's sensors, and apply its commands to the rotors.

Both run in lockstep, as PX4's `simulator_mavlink` does: the autopilot takes its time from HIL_SENSOR, answers with
HIL_ACTUATOR_CONTROLS, and the simulator waits for the answer. So flight code made for real time runs as fast as both
can, and nothing is ever late.
"""

from __future__ import annotations

import math
import socket
import time

from brakeline.errors import AutopilotGone
from brakeline.sim.autopilot.common_dialect import mavlink
from brakeline.sim.autopilot.hil_sensors import HilSensors
from brakeline.sim.quadrotor import Quadrotor

LOCKSTEP, ARMED = 0x1, int(mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
ROTORS = 4
ANSWER_TIMEOUT = 2.0  # s of real time
MOST_UNANSWERED = 5  # timeouts in a row after which the autopilot counts as gone
BOOT_TIMEOUT = 0.004  # s, the timeout before the first answer
BOOT_LIMIT = 120.0  # s of real time without a first answer, after which the autopilot counts as gone


class HilLink:
    """The simulator's end of the connection to one autopilot.

    Attributes:
        vehicle: may be exchanged for another one between two ticks.
        shift: (x, y, z) m, ENU: the autopilot's position when the vehicle is at the origin of its arena. Another arena
            is, for the autopilot, another corner of one large field.
        armed: whether the autopilot lets the rotors turn.
        unanswered: number of steps without an answer in time.
        answering: whether the autopilot has started up, so that lockstep has begun.
    """

    def __init__(self, connection: socket.socket, vehicle: Quadrotor, sensors: HilSensors) -> None:
        self.vehicle, self.shift = vehicle, (0.0, 0.0, 0.0)
        self.armed = False
        self.unanswered = 0
        self.answering = False
        self._sensors, self._connection = sensors, connection
        self._step = round(1e6 * vehicle.timestep)  # µs
        self._now = 0  # µs
        self._most_thrust = float(vehicle.controller.body.most_thrust)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._unanswered_in_a_row = 0
        self._last_command = 0  # µs
        self._started = time.monotonic()  # s

    @property
    def time(self) -> float:
        """Time since the autopilot was switched on [s]."""
        return 1e-6 * self._now

    def tick(self) -> None:
        """Advance by one physics step: send the sensors, wait for the commands, move the vehicle.

        Raises:
            AutopilotGone: the autopilot closed the connection, no longer answers, has no lockstep, or its command is
                not finite.
        """
        vehicle = self.vehicle
        self._now += self._step
        truth, (dx, dy, dz) = vehicle.true_reading(), self.shift
        x, y, z = truth.position
        position = (x + dx, y + dy, z + dz)
        packets = [message.pack(self._packer) for message in self._sensors.read(truth, position, self._now)]
        try:
            self._connection.sendall(b"".join(packets))
        except OSError as error:
            raise AutopilotGone("the autopilot closed the connection") from error
        self._wait()
        vehicle.advance(1)

    def _wait(self) -> None:
        """Wait for the command that answers the newest sensors."""
        end = time.monotonic() + (ANSWER_TIMEOUT if self.answering else BOOT_TIMEOUT)
        while self._last_command < self._now - self._step // 2:
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
                    self._apply(message)
        self._unanswered_in_a_row = 0
        return None

    def _apply(self, message: mavlink.MAVLink_hil_actuator_controls_message) -> None:
        """Set the thrusts that a command asks for. Raises AutopilotGone: the command cannot be from a lockstep."""
        if not message.flags & LOCKSTEP:
            raise AutopilotGone(
                "the autopilot was built without lockstep; build PX4 for SITL with lockstep, its default"
            )
        if message.time_usec > self._now:
            raise AutopilotGone("the autopilot does not take its time from the simulator: its command is ahead of it")
        controls = message.controls[:ROTORS]
        if not all(map(math.isfinite, controls)):
            raise AutopilotGone(f"the autopilot commands its motors with {list(controls)}")
        self.answering = True
        self._last_command = message.time_usec
        self.armed = bool(message.mode & ARMED)
        self.vehicle.set_thrusts(tuple(self._most_thrust * min(max(c, 0.0), 1.0) for c in controls))

    def _miss(self) -> None:
        if not self.answering:
            if time.monotonic() - self._started > BOOT_LIMIT:
                raise AutopilotGone(f"the autopilot has connected, and does not start within {BOOT_LIMIT:g} s")
            return
        self.unanswered += 1
        self._unanswered_in_a_row += 1
        if self._unanswered_in_a_row >= MOST_UNANSWERED:
            raise AutopilotGone(f"the autopilot has not answered for {MOST_UNANSWERED * ANSWER_TIMEOUT:g} s")
