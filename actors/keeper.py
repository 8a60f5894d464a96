"""PROCESS: keeps one vehicle flying for its actor, and outlives it.

It has the link and the clock, and carries out what the actor commits: a process with nothing else to do, which no
policy, no bus and no garbage collector holds up. An actor that dies leaves a plan that was verified to its end: it is
flown to its end, and then the vehicle hovers until the next actor comes and goes on. If none does, it is let go of.

The actor's side is `actors.kept`. They meet at a socket that only processes of this user on this machine reach.
"""

from __future__ import annotations

import copy
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
from queue import SimpleQueue

import numpy as np

from actors.frames import Frame
from actors.kept import Answer, Charge, Failure, News, Raw, address, ours
from actors.live import LiveVehicle
from actors.mavlink import MavlinkError
from actors.takeoff import REST, STOPPING
from actors.truth import Truth
from actors.witness import Witness
from messaging.links import open_link
from messaging.robots import robot_named
from messaging.signals import heeded
from messaging.tolerant import Tolerance

log = logging.getLogger("brakeline.flight")

LOOK = 0.1  # s between two looks at whether to end
FIGURES = 5  # periods from one telling of figures to the next: percentiles of all that was late take a while
LAST_WORDS = 1.0  # s for an actor to take them
SUCCESSOR = 30.0  # s that one may take to come
GONE = 3.0  # s without a word of the vehicle after which nobody waits for a successor any more
MOST_FRAMES = 100_000  # kept for an actor that does not take them: some minutes'
UNSAID = 20  # words at which it is not told more for now


class Outbox:
    """Says things to the actor of the moment in a thread of its own: nobody waits for one that does not listen."""

    def __init__(self) -> None:
        self.actor: Connection | None = None
        self._queue: SimpleQueue[tuple[Connection | None, object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, said: object) -> None:
        """Never waits. Without an actor what is logged goes to stderr, and all else nowhere."""
        self._queue.put((self.actor, said))

    put_nowait = put  # what a QueueHandler calls

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
            except OSError:
                if isinstance(said, logging.LogRecord):
                    print(said.getMessage(), file=sys.stderr, flush=True)


class Keeper:
    """Of one vehicle, which flies once this is made."""

    def __init__(self, charge: Charge, actor: Connection, outbox: Outbox) -> None:
        """Raises MavlinkError, BadLink, OSError; MavlinkError also when told to stop, or left alone, before it flew."""
        self.charge, self._outbox = charge, outbox
        self._robot, flight = robot_named(charge.robot), charge.flight
        self._frames: deque[Raw] = deque(maxlen=MOST_FRAMES)
        self._tolerance = Tolerance()
        footprint, shapes = self._robot.footprint, charge.arena.shapes
        self._vehicle = LiveVehicle(
            open_link(flight.url),
            self._robot,
            flight.system,
            flight.height,
            flight.origin,
            Truth(flight.truth, flight.system, self._tolerance) if flight.truth else None,
            self._keep,
            self._tolerance,
            actor.poll,  # whatever is said before it flies is: stop
            flight.raise_limits,
            Witness(lambda position: float(shapes.distance(position).min()) - footprint),
        )
        threading.Thread(target=self._tell, name="news", daemon=True).start()

    def serve(self, actor: Connection, stop: threading.Event) -> bool:
        """Do as the actor says until it says `close` (True), or it is gone, or `stop` is set."""
        while not stop.is_set():
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
        return False

    def brake(self) -> None:
        """Along the committed plan to its end, and then until it hovers. Raises MavlinkError: nobody flies it."""
        log.warning("without an actor: braking along the committed plan")
        vehicle, end = self._vehicle, time.monotonic() + STOPPING
        turn = vehicle.wait(vehicle.turn.number + self._robot.horizon)
        while np.linalg.norm(turn.report.measured[3:6]) > REST and time.monotonic() < end and not self.gone:
            turn = vehicle.wait(turn.number + 1)
        log.warning("it hovers at (%.2f, %.2f, %.2f) m", *turn.report.measured[:3])

    @property
    def gone(self) -> bool:
        """Has nothing been heard of the vehicle for a while?"""
        return self._vehicle.silence > GONE

    def close(self) -> None:
        """Let go of the vehicle."""
        self._vehicle.close()

    def _keep(self, frame: Frame) -> None:
        self._frames.append((time.time_ns(), frame.outgoing, frame.raw))

    def _tell(self) -> None:
        """Each period as it begins; what comes while there is no actor is for the next one."""
        vehicle, turn = self._vehicle, self._vehicle.turn
        while True:
            if self._outbox.actor is not None and not self._outbox.full:
                frames = [self._frames.popleft() for _ in range(len(self._frames))]
                figures = None
                if turn.number % FIGURES == 0:
                    figures = vehicle.timing.figures() | vehicle.judged()
                self._outbox.put(News(turn, frames, self._tolerance.count, figures))
            try:
                turn = vehicle.wait(turn.number + 1)
            except MavlinkError as error:
                self._outbox.put(Failure(error))
                return


@contextmanager
def listening(url: str, system: int) -> Iterator[socket.socket]:
    """A socket at which actors of that vehicle knock. Raises OSError: somebody else keeps it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(address(url, system))
        server.listen()
        yield server


def next_actor(server: socket.socket, stop: threading.Event, keeper: Keeper | None) -> Connection | None:
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
        with heeded(stop), listening(url, system) as server:
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
    keeper: Keeper | None = None
    try:
        while (actor := next_actor(server, stop, keeper)) is not None:
            if (charge := _charge(actor)) is None:
                continue
            outbox.actor = actor
            if keeper is None:
                keeper = Keeper(charge, actor, outbox)
            elif charge.differs(keeper.charge):
                raise MavlinkError("it was flown with other settings until now, and is let go of: try again")
            else:
                log.info("it hovers, and goes on")
            if keeper.serve(actor, stop):
                return 0
            outbox.actor = None
            keeper.brake()
        return 2
    finally:
        if keeper is not None:
            keeper.close()


def _charge(actor: Connection) -> Charge | None:
    """An actor's first word; None: it is gone, or has nothing to say."""
    try:
        said = actor.recv() if actor.poll(LAST_WORDS) else None
    except (EOFError, OSError):
        return None
    return said if isinstance(said, Charge) else None


def _portable(error: Exception) -> Exception:
    """An exception that can be read at the other end."""
    try:
        copy.copy(error)  # made anew of its arguments, as there
    except Exception:
        return MavlinkError(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    sys.exit(main())
