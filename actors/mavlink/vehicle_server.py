"""PROCESS: fly one vehicle for an actor, and outlive the actor.

The process has the link and the clock, and flies the plans that the actor commits. It does nothing else, so that no
policy and no bus can delay it. If the actor dies, the process flies the committed plan, which was verified, to its
end. The vehicle then hovers until the next actor takes over. If none comes, the process gives up the vehicle.

The actor's side is `vehicle_client`; their socket is in `vehicle_socket`, their messages are in `vehicle_messages`. The
process skips an invalid message, logs it, and flies on: without a valid plan the vehicle brakes.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import sys
import threading
import time
from collections import deque
from queue import SimpleQueue

import numpy as np

from brakeline.actors.mavlink.frame_recorder import frame_message
from brakeline.actors.mavlink.ground_truth import MavlinkGroundTruth
from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.actors.mavlink.takeoff import REST, STOPPING
from brakeline.actors.mavlink.vehicle_messages import (
    FlightRequest,
    error_message,
    period_message,
    plan_of,
    request_of,
    text_of,
)
from brakeline.actors.mavlink.vehicle_socket import MessageSocket, listening, same_user
from brakeline.errors import BadInput, BadMessage, CommandLost, HandoverRefused, MavlinkError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.stop_signals import stop_on_signals

log = logging.getLogger("brakeline.flight")

POLL = 0.1  # s between two checks whether to end
FIGURES_EVERY = 5  # periods: the percentiles in the figures take a while
REQUEST_TIMEOUT = 1.0  # s from an actor's connection to its flight request
DRAIN_TIMEOUT = 1.0  # s for the last messages to the actor
CLOSE_TIMEOUT = 15.0  # s for the actor to brake and close once this process has to end
HANDOVER_TIMEOUT = 30.0  # s for the next actor to connect
SILENCE = 3.0  # s without a message of the vehicle, after which the process does not wait for the next actor
MOST_FRAMES = 100_000  # stored while no actor takes them: some minutes
FRAMES_PER_UPDATE = 300  # of up to 280 bytes: they fit into one message
MOST_QUEUED = 20  # messages, from which on the actor gets no new updates


class ActorOutbox:
    """Sends messages to the current actor in its own thread, so that an actor that does not read delays nobody."""

    def __init__(self) -> None:
        self.actor: MessageSocket | None = None  # the current one
        self.unsent: deque[pb.MavlinkFrame] = deque(maxlen=MOST_FRAMES)  # the next update contains them
        self._queue: SimpleQueue[tuple[MessageSocket | None, pb.VehicleMessage | None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: pb.VehicleMessage) -> None:
        """Queue a message to the current actor. Without an actor, a log line goes to stderr."""
        self._queue.put((self.actor, message))

    def dismiss(self, actor: MessageSocket, error: Exception | None = None) -> None:
        """Queue an error, if there is one, to this actor, and then the end of its connection."""
        if error is not None:
            self._queue.put((actor, pb.VehicleMessage(failure=error_message(error))))
        self._queue.put((actor, None))

    @property
    def full(self) -> bool:
        """Whether the actor reads too slowly for another update."""
        return self._queue.qsize() > MOST_QUEUED

    def close(self) -> None:
        """Wait until all messages are sent, for `DRAIN_TIMEOUT` at most."""
        self._queue.put(None)
        self._thread.join(DRAIN_TIMEOUT)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            actor, message = item
            if message is None:
                if actor is not None:
                    actor.close()
                continue
            try:
                if actor is None:
                    raise BrokenPipeError
                actor.send(message)
            except Exception:  # any error: the next actor must get the frames
                self._store(message)

    def _store(self, message: pb.VehicleMessage) -> None:
        if message.HasField("update"):
            self.unsent.extend(message.update.frames)
        elif message.HasField("log"):
            with contextlib.suppress(OSError, ValueError):  # the terminal is gone
                print(message.log.text, file=sys.stderr, flush=True)


class ActorLog(logging.Handler):
    """Sends each line of the log to the actor, which publishes it."""

    def __init__(self, outbox: ActorOutbox) -> None:
        super().__init__()
        self._outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record with its traceback, if it has one."""
        try:
            line = pb.LogLine(level=record.levelname, text=text_of(self.format(record)))
            self._outbox.put(pb.VehicleMessage(log=line))
        except Exception:
            self.handleError(record)


class VehicleServer:
    """One vehicle, which flies once this object exists."""

    def __init__(
        self, request: FlightRequest, actor: MessageSocket, outbox: ActorOutbox, stop: threading.Event
    ) -> None:
        """Take control of the vehicle and take off.

        Raises:
            MavlinkError, BadLink, OSError: the vehicle does not fly, `stop` is set before it flies, or the actor hangs
                up or sends anything.
        """
        self.request, self._robot, self._outbox, self._stop = request, request.robot, outbox, stop
        self._frames: deque[pb.MavlinkFrame] = deque(maxlen=MOST_FRAMES)
        self._updating = threading.Lock()
        self._rejected = RejectedMessages()
        shapes = Shapes.of(request.obstacles, self._robot.position_dim)
        self._vehicle = MavlinkVehicle(
            request.robot,
            request.flight,
            tap=lambda frame: self._frames.append(frame_message(frame)),
            rejected=self._rejected,
            stop=lambda: stop.is_set() or actor.poll(),
            mavlink_truth=MavlinkGroundTruth(shapes, self._robot.footprint),
        )
        threading.Thread(target=self._send_updates, name="updates", daemon=True).start()

    def serve(self, actor: MessageSocket) -> bool:
        """Carry out the actor's commands until it closes the flight (True) or is gone (False).

        Once the process has to end, the actor has `CLOSE_TIMEOUT` to close the flight.

        Raises:
            MavlinkError: nobody flies the vehicle any more, or the actor did not close the flight in time.
        """
        stopped_at: float | None = None
        while True:
            self._vehicle.check()
            if stopped_at is None and self._stop.is_set():
                stopped_at = time.monotonic()
            if stopped_at is not None and time.monotonic() - stopped_at > CLOSE_TIMEOUT:
                raise MavlinkError("the vehicle server had to end")
            try:
                if not actor.poll(POLL):
                    continue
                command = actor.receive(pb.VehicleCommand)
            except BadMessage as error:
                self._rejected.reject("vehicle command", error)
                continue
            except (EOFError, OSError):
                return False
            if command.WhichOneof("command") == "close":
                return True
            self._outbox.put(pb.VehicleMessage(reply=self._reply(command)))

    def brake(self) -> None:
        """Fly the committed plan to its end, and wait until the vehicle hovers. Raises MavlinkError."""
        log.warning("without an actor: braking along the committed plan")
        vehicle, end = self._vehicle, time.monotonic() + STOPPING
        period = vehicle.wait(vehicle.current_period.number + self._robot.horizon)
        while _speed(period) > REST and time.monotonic() < end and not self.gone:
            period = vehicle.wait(period.number + 1)
        outcome = "it hovers" if _speed(period) <= REST else "it does not come to rest"
        log.warning("%s at (%.2f, %.2f, %.2f) m", outcome, *period.report.measured[:3])

    @property
    def gone(self) -> bool:
        """Whether the vehicle's thread has died, or the vehicle is silent."""
        return self._vehicle.failed or self._vehicle.silence > SILENCE

    @property
    def command_lost(self) -> CommandLost | None:
        """Why our command of the vehicle has ended, if it has; the next actor must not take the vehicle over anew."""
        failure = self._vehicle.failure
        return failure if isinstance(failure, CommandLost) else None

    def refusal(self, request: FlightRequest) -> Exception | None:
        """Return why the vehicle can't be handed over for this request; None: it can.

        A vehicle that a pilot has is handed over as it is: the next actor waits until the pilot gives it back.
        """
        if self.command_lost is not None:
            return self.command_lost
        if request != self.request:
            return HandoverRefused("it was flown with other settings until now")
        return None

    def close(self) -> None:
        """Brake unless the vehicle hovers, give it up, and send the last update."""
        vehicle = self._vehicle
        try:
            if not (vehicle.idle or self.gone):
                self.brake()
        finally:
            vehicle.close()
            self._send_update(vehicle.current_period, figures=True)

    def _reply(self, command: pb.VehicleCommand) -> pb.CommitReply:
        """Commit a plan; a command that is not valid changes nothing."""
        try:
            if command.WhichOneof("command") != "commit":
                raise BadMessage("in flight a command is `commit` or `close`")
            plan = plan_of(command.commit, self._robot, self._vehicle.current_period.number)
            in_time = self._vehicle.commit(plan, command.commit.period)
        except (BadMessage, BadInput) as error:
            self._rejected.reject("vehicle command", error)
            return pb.CommitReply(number=command.number, error=error_message(error))
        return pb.CommitReply(number=command.number, in_time=in_time)

    def _send_updates(self) -> None:
        """Send each period as it begins. What arrives while there is no actor goes to the next one."""
        vehicle, period = self._vehicle, self._vehicle.current_period
        while not vehicle.failed:
            if self._outbox.actor is not None and not self._outbox.full:
                self._send_update(period, figures=period.number % FIGURES_EVERY == 0)
            try:
                period = vehicle.wait(period.number + 1)
            except MavlinkError:  # the thread died, or this machine stood still for seconds
                period = vehicle.current_period

    def _send_update(self, period: ControlPeriod, figures: bool) -> None:
        vehicle, frames = self._vehicle, list[pb.MavlinkFrame]()
        with self._updating:
            for source in (self._outbox.unsent, self._frames):
                frames += [source.popleft() for _ in range(len(source))]
        for start in range(0, max(len(frames), 1), FRAMES_PER_UPDATE):
            update = pb.VehicleUpdate(
                period=period_message(period),
                frames=frames[start : start + FRAMES_PER_UPDATE],
                passed_over=self._rejected.count,
                figures=vehicle.timing.figures() | vehicle.truth_figures() if figures else {},
            )
            self._outbox.put(pb.VehicleMessage(update=update))


def _speed(period: ControlPeriod) -> float:
    return float(np.linalg.norm(period.report.measured[3:6]))


def next_actor(listener: socket.socket, stop: threading.Event, server: VehicleServer | None) -> MessageSocket | None:
    """Wait for the next actor of this user; None: `stop` is set, none came, or the vehicle is gone."""
    deadline = time.monotonic() + HANDOVER_TIMEOUT
    while not stop.is_set() and time.monotonic() < deadline:
        if server is not None and server.gone and server.command_lost is None:
            return None
        if not select.select([listener], [], [], POLL)[0]:
            continue
        connection, _ = listener.accept()
        if same_user(connection):
            return MessageSocket(connection)
        connection.close()
    return None


def receive_request(actor: MessageSocket, url: str, system: int) -> FlightRequest:
    """Return the flight request, which is an actor's first message.

    Raises:
        BadMessage: there is none, it is not valid, or it is for another vehicle.
        EOFError, OSError: the actor is gone.
    """
    if not actor.poll(REQUEST_TIMEOUT):
        raise BadMessage(f"no flight request within {REQUEST_TIMEOUT:g} s")
    command = actor.receive(pb.VehicleCommand)
    if command.WhichOneof("command") != "fly":
        raise BadMessage("an actor's first message is a flight request")
    request = request_of(command.fly)
    if (request.flight.url, request.flight.system) != (url, system):
        raise BadMessage(f"the flight request is for vehicle {request.flight.system} at {request.flight.url}")
    return request


def main() -> int:
    """Fly the vehicle of the command line: URL SYSTEM.

    Returns:
        0: an actor closed the flight; 1: the flight failed; 2: no actor took over.
    """
    url, system = sys.argv[1], int(sys.argv[2])
    outbox, stop = ActorOutbox(), threading.Event()
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(ActorLog(outbox))
    try:
        with stop_on_signals(stop, patient=True), listening(url, system) as listener:
            return _serve_actors(listener, url, system, outbox, stop)
    except Exception as error:
        if outbox.actor is None:
            log.error("the vehicle server gives up the vehicle: %s", error)
        outbox.put(pb.VehicleMessage(failure=error_message(error)))
        return 1
    finally:
        outbox.close()


def _serve_actors(listener: socket.socket, url: str, system: int, outbox: ActorOutbox, stop: threading.Event) -> int:
    """Serve one actor after the other. Raises what `VehicleServer` raises."""
    server: VehicleServer | None = None
    try:
        while (actor := next_actor(listener, stop, server)) is not None:
            try:
                request = receive_request(actor, url, system)
            except BadMessage as error:
                log.warning("an actor is refused: %s", error)
                outbox.dismiss(actor, error)
                continue
            except (EOFError, OSError):  # it is gone
                outbox.dismiss(actor)
                continue
            if server is not None and (refusal := server.refusal(request)):
                outbox.dismiss(actor, refusal)
                return 2
            outbox.actor = actor
            if server is None:
                server = VehicleServer(request, actor, outbox, stop)
            else:
                log.info("it hovers, and goes on")
            if server.serve(actor):
                return 0
            outbox.actor = None
            outbox.dismiss(actor)
            with contextlib.suppress(CommandLost):  # the next actor hears why
                server.brake()
        return 2
    finally:
        if server is not None:
            server.close()


if __name__ == "__main__":
    sys.exit(main())
