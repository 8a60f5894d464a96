"""PROCESS: keeps one vehicle flying for its actor, and outlives it.

It has the link and the clock, and carries out what the actor commits: a process with nothing else to do, which no
policy and no bus holds up. An actor that dies leaves a plan that was verified to its end: it is
flown to its end, and then the vehicle hovers until the next actor comes and goes on. If none does, it is let go of.

The actor's side is `actors.vehicle_client`. They meet at a socket that only this user's processes reach.
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
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue

import numpy as np

from actors.frames import Frame
from actors.ground_truth import MavlinkGroundTruth, UdpGroundTruth
from actors.mavlink import MavlinkError
from actors.mavlink_vehicle import ControlPeriod, MavlinkVehicle
from actors.takeoff import REST, STOPPING
from actors.vehicle_client import Answer, Failure, FlightRequest, HandoverRefused, Raw, VehicleUpdate, address, ours
from messaging.links import open_link
from messaging.robots import robot_named
from messaging.shapes import Shapes
from messaging.signals import heeded
from messaging.tolerant import Tolerance

log = logging.getLogger("brakeline.flight")

LOOK = 0.1  # s between two looks at whether to end
FIGURES = 5  # periods from one telling of figures to the next: percentiles of all that was late take a while
LAST_WORDS = 1.0  # s for an actor to take them
CLOSES = 15.0  # s for an actor to brake and close, once this process is told to end
SUCCESSOR = 30.0  # s that one may take to come
GONE = 3.0  # s without a word of the vehicle after which nobody waits for a successor any more
MOST_FRAMES = 100_000  # kept for an actor that does not take them: some minutes'
UNSAID = 20  # words at which it is not told more for now


class Outbox:
    """Says things to the actor of the moment in a thread of its own: nobody waits for one that does not listen."""

    def __init__(self) -> None:
        self.actor: Connection | None = None
        self.lost: deque[Raw] = deque(maxlen=MOST_FRAMES)  # frames that it could not be told any more
        self._queue: SimpleQueue[tuple[Connection | None, object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, said: object) -> None:
        """Never waits. Without an actor what is logged goes to stderr, and all else nowhere."""
        self._queue.put((self.actor, said))

    put_nowait = put  # what a QueueHandler calls

    def tell(self, actor: Connection, said: object) -> None:
        """To one that is not the actor of the moment."""
        self._queue.put((actor, said))

    @property
    def full(self) -> bool:
        return self._queue.qsize() > UNSAID

    def close(self) -> None:
        self._queue.put(None)
        self._thread.join(LAST_WORDS)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            actor, said = item
            try:
                if actor is None:
                    raise BrokenPipeError
                actor.send(said)
            except Exception:  # whatever it is: the next actor must be told again
                self._keep(said)

    def _keep(self, said: object) -> None:
        if isinstance(said, VehicleUpdate):
            self.lost.extend(said.frames)
        elif isinstance(said, logging.LogRecord):
            with contextlib.suppress(OSError, ValueError):  # a terminal that is gone
                print(said.getMessage(), file=sys.stderr, flush=True)


class VehicleServer:
    """Of one vehicle, which flies once this is made."""

    def __init__(self, request: FlightRequest, actor: Connection, outbox: Outbox, stop: threading.Event) -> None:
        """Raises MavlinkError, BadLink, OSError; MavlinkError also when told to stop, or left alone, before it flew."""
        self.request, self._outbox, self._stop = request, outbox, stop
        self._robot, flight = robot_named(request.robot), request.flight
        self._frames: deque[Raw] = deque(maxlen=MOST_FRAMES)
        self._telling = threading.Lock()
        self._tolerance = Tolerance()
        footprint, shapes = self._robot.footprint, Shapes.of(request.obstacles, self._robot.position_dim)
        self._vehicle = MavlinkVehicle(
            open_link(flight.url),
            self._robot,
            flight.system,
            flight.height,
            flight.origin,
            UdpGroundTruth(flight.truth, flight.system, self._tolerance) if flight.truth else None,
            self._keep,
            self._tolerance,
            lambda: stop.is_set() or actor.poll(),  # whatever is said before it flies is: stop
            flight.raise_limits,
            MavlinkGroundTruth(lambda position: float(shapes.distance(position).min()) - footprint),
            flight.lead,
        )
        threading.Thread(target=self._tell, name="news", daemon=True).start()

    def serve(self, actor: Connection) -> bool:
        """Do as the actor says until it says `close` (True) or is gone (False).

        Told to stop, the process waits for that word, but not for ever. Raises MavlinkError: nobody flies it any more,
        or nobody said the word.
        """
        told_at: float | None = None
        while not self._vehicle.failed:
            if told_at is None and self._stop.is_set():
                told_at = time.monotonic()
            if told_at is not None and time.monotonic() - told_at > CLOSES:
                raise MavlinkError("the process that keeps the vehicle was told to end")
            try:
                if not actor.poll(LOOK):
                    continue
                number, what, *words = actor.recv()
            except (EOFError, OSError):
                return False
            if what == "close":
                return True
            try:
                self._outbox.put(Answer(number, self._vehicle.commit(*words)))
            except ValueError as error:
                self._outbox.put(Answer(number, error))
        raise MavlinkError("nobody flies it any more")

    def brake(self) -> None:
        """Along the committed plan to its end, and then until it hovers. Raises MavlinkError: nobody flies it."""
        log.warning("without an actor: braking along the committed plan")
        vehicle, end = self._vehicle, time.monotonic() + STOPPING
        period = vehicle.wait(vehicle.current_period.number + self._robot.horizon)
        while _speed(period) > REST and time.monotonic() < end and not self.gone:
            period = vehicle.wait(period.number + 1)
        what = "it hovers" if _speed(period) <= REST else "it does not come to rest"
        log.warning("%s at (%.2f, %.2f, %.2f) m", what, *period.report.measured[:3])

    @property
    def gone(self) -> bool:
        """Does nobody fly it any more, or was nothing heard of it for a while?"""
        return self._vehicle.failed or self._vehicle.silence > GONE

    def parted(self, request: FlightRequest) -> str:
        """Why another actor can't go on with it, but has to take control anew; empty: it can."""
        if request != self.request:
            return "it was flown with other settings until now"
        return self._vehicle.current_period.lost

    def close(self) -> None:
        """Let go of the vehicle, which is first braked unless it hovers; what it said last goes to the actor."""
        try:
            if not (self._vehicle.idle or self.gone):
                self.brake()
        finally:
            self._vehicle.close()
            self._outbox.put(
                self._news(self._vehicle.current_period, self._vehicle.timing.figures() | self._vehicle.judged())
            )

    def _keep(self, frame: Frame) -> None:
        self._frames.append((time.time_ns(), frame.outgoing, frame.raw))

    def _tell(self) -> None:
        """Each period as it begins; what comes while there is no actor is for the next one."""
        vehicle, period = self._vehicle, self._vehicle.current_period
        while not vehicle.failed:
            if self._outbox.actor is not None and not self._outbox.full:
                told = period.number % FIGURES == 0
                self._outbox.put(self._news(period, vehicle.timing.figures() | vehicle.judged() if told else None))
            try:
                period = vehicle.wait(period.number + 1)
            except MavlinkError:  # it failed, or this machine stood still for seconds
                period = vehicle.current_period

    def _news(self, period: ControlPeriod, figures: dict[str, float] | None) -> VehicleUpdate:
        frames: list[Raw] = []
        with self._telling:
            for kept in (self._outbox.lost, self._frames):
                frames += [kept.popleft() for _ in range(len(kept))]
        return VehicleUpdate(period, frames, self._tolerance.count, figures)


def _speed(period: ControlPeriod) -> float:
    return float(np.linalg.norm(period.report.measured[3:6]))


@contextmanager
def listening(url: str, system: int) -> Iterator[socket.socket]:
    """A socket at which actors of that vehicle knock. Raises MavlinkError: somebody else keeps it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        try:
            server.bind(address(url, system))
        except OSError as error:
            raise MavlinkError(f"another process here flies vehicle {system} at {url}") from error
        server.listen()
        yield server


def next_actor(server: socket.socket, stop: threading.Event, keeper: VehicleServer | None) -> Connection | None:
    """The next one of this user that knocks; None: told to stop, or none comes."""
    deadline = time.monotonic() + SUCCESSOR
    while not stop.is_set() and time.monotonic() < deadline and not (keeper and keeper.gone):
        if not select.select([server], [], [], LOOK)[0]:
            continue
        knocking, _ = server.accept()
        if ours(knocking):
            return Connection(knocking.detach())
        knocking.close()
    return None


def main() -> int:
    """Keep vehicle SYSTEM at URL: both on the command line. 0: told to end; 1: it failed; 2: left alone."""
    url, system = sys.argv[1], int(sys.argv[2])
    outbox, stop = Outbox(), threading.Event()
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(QueueHandler(outbox))  # type: ignore[arg-type]
    try:
        with heeded(stop, patient=True), listening(url, system) as server:
            return _keep(server, outbox, stop)
    except Exception as error:
        if outbox.actor is None:
            log.error("the vehicle is let go of: %s", error)
        outbox.put(Failure(_portable(error)))
        return 1
    finally:
        outbox.close()


def _keep(server: socket.socket, outbox: Outbox, stop: threading.Event) -> int:
    """For one actor after the other. Raises what making a keeper does, and MavlinkError."""
    keeper: VehicleServer | None = None
    try:
        while (actor := next_actor(server, stop, keeper)) is not None:
            if (request := _charge(actor)) is None:
                continue
            if keeper is not None and (why := keeper.parted(request)):
                outbox.tell(actor, Failure(HandoverRefused(why)))
                return 2
            outbox.actor = actor
            if keeper is None:
                keeper = VehicleServer(request, actor, outbox, stop)
            else:
                log.info("it hovers, and goes on")
            if keeper.serve(actor):
                return 0
            outbox.actor = None
            keeper.brake()
        return 2
    finally:
        if keeper is not None:
            keeper.close()


def _charge(actor: Connection) -> FlightRequest | None:
    """An actor's first word; None: it is gone, or has nothing to say."""
    try:
        said = actor.recv() if actor.poll(LAST_WORDS) else None
    except (EOFError, OSError):
        return None
    return said if isinstance(said, FlightRequest) else None


def _portable(error: Exception) -> Exception:
    """An exception that can be read at the other end."""
    try:
        ForkingPickler.loads(ForkingPickler.dumps(error))
    except Exception:
        return MavlinkError(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    sys.exit(main())
