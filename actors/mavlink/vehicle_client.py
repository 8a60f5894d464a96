"""The actor's side of a vehicle that a second process flies (`brakeline.actors.mavlink.vehicle_server`)."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue

import numpy as np

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod, PeriodicVehicle
from brakeline.actors.mavlink.telemetry import Array
from brakeline.actors.mavlink.vehicle_messages import FlightRequest, error_of, period_of, request_message
from brakeline.actors.mavlink.vehicle_socket import MessageSocket, connect
from brakeline.errors import BadInput, BadMessage, HandoverRefused, MavlinkError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.rejected_messages import RejectedMessages

log = logging.getLogger("brakeline.flight")

REPLY_TIMEOUT = 1.0  # s: the server does nothing else
START_TIMEOUT = 30.0  # s
CLOSE_TIMEOUT = 30.0  # s, braking included
ATTEMPTS = 3  # to take over or to take off
HANDOVER_TIMEOUT = 45.0  # s for a server whose actor died to bring the vehicle to rest
POLL = 0.1  # s between two checks whether to go on waiting
ENDED = "the vehicle server has ended"
SERVER = "brakeline.actors.mavlink.vehicle_server"


class VehicleClient(PeriodicVehicle):
    """A vehicle in flight, used like a `MavlinkVehicle`. It flies its plan to the end even if this process dies."""

    def __init__(
        self,
        request: FlightRequest,
        tap: Callable[[pb.MavlinkFrame], None],
        rejected: RejectedMessages,
        stop: Callable[[], bool],
    ) -> None:
        """Connect to the vehicle's server, or start one, and wait until the vehicle flies.

        Args:
            tap: called with each MAVLink frame.
            rejected: counts messages that cannot be handled, the server's too.
            stop: once it returns true, the client does not wait any more.

        Raises:
            MavlinkError, BadLink, OSError: the server does not fly the vehicle; MavlinkError also if another actor
                flies it, or if `stop` returned true.
            BadMessage: the request is not valid, or too large.
        """
        super().__init__(request.robot)
        self._tap, self._rejected, self._passed_over = tap, rejected, 0
        self._lines: SimpleQueue[pb.LogLine] = SimpleQueue()
        threading.Thread(target=self._log, name="vehicle server's log", daemon=True).start()
        self._process: subprocess.Popen[bytes] | None = None
        self._commands = 0
        for attempts_left in reversed(range(ATTEMPTS)):
            self._connect(request, stop)
            try:
                self._await_flight(stop)
                return
            except BaseException as error:
                self.leave()
                if not (attempts_left and isinstance(error, HandoverRefused)):
                    raise
                log.info("taking control of it anew: %s", error)

    def commit(self, plan: Array, number: int) -> bool:
        """Carry out a plan, see `MavlinkVehicle.commit`. Return False also if the server does not reply in time.

        Raises:
            BadInput, BadMessage: the plan is not valid.
            MavlinkError: nobody flies the vehicle any more.
        """
        rows = np.asarray(plan, float)
        if rows.ndim != 2 or rows.shape[1] != self._robot.action_dim:
            raise BadInput(f"a plan is (periods, {self._robot.action_dim}), not {rows.shape}")
        reply = self._ask(pb.VehicleCommand(commit=pb.PlanCommit(period=number, plan=rows.ravel().tolist())))
        if reply is None:
            return False
        if reply.HasField("error"):
            raise error_of(reply.error)
        return reply.in_time

    def close(self) -> None:
        """Give up the vehicle: its server brakes unless the vehicle hovers, and ends."""
        with contextlib.suppress(OSError):
            self._socket.send(pb.VehicleCommand(close=True))
        self._listener.join(CLOSE_TIMEOUT)  # until the server's last message
        self.leave()

    def leave(self) -> None:
        """End the connection as if this process had died: the server brakes, and waits for another actor."""
        with contextlib.suppress(OSError):
            self._socket.hang_up()
        self._listener.join(CLOSE_TIMEOUT)
        self._socket.close()
        if self._process is not None and self._process.poll() is not None:
            self._process = None

    def _connect(self, request: FlightRequest, stop: Callable[[], bool]) -> None:
        """Connect to the vehicle's server, start one if there is none, and send the flight request."""
        self._current: ControlPeriod | None = None
        self._last_lost: ControlPeriod | None = None  # another server counts its periods anew
        self.failure: Exception | None = None
        self.figures: dict[str, float] = {}  # for Health: lateness, and the ground truth of a simulated flight
        self._replies: SimpleQueue[pb.CommitReply | None] = SimpleQueue()
        self._received, self._received_at = False, time.monotonic()
        command = pb.VehicleCommand(fly=request_message(request))
        self._socket = self._reach(request.flight, stop)
        try:
            self._socket.send(command)
        except BadMessage:
            self._socket.close()
            raise
        except OSError:  # the server has ended meanwhile; the listener reports it
            pass
        self._listener = threading.Thread(target=self._listen, name="vehicle server", daemon=True)
        self._listener.start()

    def _reach(self, flight: FlightSettings, stop: Callable[[], bool]) -> MessageSocket:
        """Raises MavlinkError: no server starts, or `stop` returned true."""
        deadline, process = time.monotonic() + START_TIMEOUT, None
        while (connection := connect(flight.url, flight.system)) is None:
            if process is None:
                words = [sys.executable, "-P", "-m", SERVER, flight.url, str(flight.system)]
                # A session of its own: ^C is for the actor, which then brakes and closes the flight.
                process = self._process = subprocess.Popen(words, start_new_session=True)
            if process.poll() is not None or time.monotonic() > deadline or stop():
                raise MavlinkError(f"the vehicle server does not start (status {process.poll()})")
            time.sleep(0.2 * POLL)
        return connection

    def _await_flight(self, stop: Callable[[], bool]) -> None:
        with self._changed:
            while self._current is None:
                self.check()
                if stop():
                    raise MavlinkError("asked to stop before the vehicle flew")
                if time.monotonic() - self._received_at > HANDOVER_TIMEOUT:
                    why = "the vehicle server fell silent" if self._received else "another process here flies it"
                    raise MavlinkError(why)
                self._changed.wait(POLL)

    def _ask(self, command: pb.VehicleCommand) -> pb.CommitReply | None:
        """Send a command and return its reply; None: no reply in time. Raises MavlinkError: the server is gone."""
        self._commands += 1
        command.number = self._commands
        try:
            self._socket.send(command)
            while True:
                reply = self._replies.get(timeout=REPLY_TIMEOUT)
                self.check()
                if reply is not None and reply.number == command.number:  # not a late reply to an older command
                    return reply
        except OSError as error:
            raise self.failure or MavlinkError(ENDED) from error
        except Empty:
            return None  # `wait` finds out whether the vehicle still flies

    def _listen(self) -> None:
        """Handle the server's messages, in a thread, until the last one."""
        try:
            while True:
                self._socket.poll(None)
                try:
                    message = self._socket.receive(pb.VehicleMessage)
                except BadMessage as error:
                    self._rejected.reject("vehicle server", error)
                    continue
                self._received, self._received_at = True, time.monotonic()
                with self._rejected.skip_on_error("vehicle server"):
                    self._handle(message)
        except (EOFError, OSError):
            self._fail(MavlinkError(ENDED) if self._received else HandoverRefused(ENDED))
        except Exception as error:  # any error: a server that nobody listens to does not fly for us
            self._fail(error)

    def _handle(self, message: pb.VehicleMessage) -> None:
        """Raises BadMessage: it is not valid."""
        match message.WhichOneof("message"):
            case "update":
                self._take(message.update)
            case "reply":
                self._replies.put(message.reply)
            case "failure":
                self._fail(error_of(message.failure))
            case "log":
                self._lines.put(message.log)
            case _:
                raise BadMessage("a message without content")

    def _log(self) -> None:
        """Log the server's lines, in a thread: each of them goes over the bus, which may wait."""
        levels = logging.getLevelNamesMapping()
        while True:
            line = self._lines.get()
            log.log(levels.get(line.level, logging.INFO), "%s", line.text)

    def _take(self, update: pb.VehicleUpdate) -> None:
        for frame in update.frames:
            self._tap(frame)
        self._rejected.count += max(0, update.passed_over - self._passed_over)
        self._passed_over = update.passed_over
        self.figures = dict(update.figures) or self.figures
        self._begin(period_of(update.period, self._robot))

    def _fail(self, error: Exception) -> None:
        super()._fail(error)
        self._replies.put(None)  # wake the thread that waits for a reply
