"""PROCESS: keeps one vehicle flying for an actor, and outlives it.

It has the link and the clock, and carries out what the actor commits: a process with nothing else to do, which no
policy, no bus and no garbage collector holds up. An actor that dies leaves a plan that was verified to its end: it is
flown to its end, then the vehicle hovers, and only then the link is given up. Who flies it next waits for that.

The actor's side is `actors.kept`; between them is a pair of sockets that nobody else has.
"""

from __future__ import annotations

import logging
import os
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
from typing import Any

import numpy as np

from actors.frames import Frame
from actors.kept import Answer, Charge, Failure, News, Raw
from actors.live import LiveVehicle
from actors.mavlink import MavlinkError
from actors.settings import FlightSettings
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
PREDECESSOR = 45.0  # s that one may take to bring the vehicle to rest and let go of it

Outbox = SimpleQueue[Any]  # News | Answer | Failure | logging.LogRecord


class Keeper:
    """Of one vehicle, which flies once this is made."""

    def __init__(self, charge: Charge, pipe: Connection, outbox: Outbox) -> None:
        """Raises MavlinkError, BadLink, OSError; MavlinkError also when told to stop, or left alone, before it flew."""
        self._pipe, self._outbox = pipe, outbox
        self._robot, flight = robot_named(charge.robot), charge.flight
        self._frames: deque[Raw] = deque()
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
            pipe.poll,  # whatever is said before it flies is: stop
            flight.raise_limits,
            Witness(lambda position: float(shapes.distance(position).min()) - footprint),
        )
        threading.Thread(target=self._tell, name="news", daemon=True).start()

    def serve(self, stop: threading.Event) -> bool:
        """Do as the actor says until it says `close` (True), or it is gone, or `stop` is set."""
        vehicle = self._vehicle
        while not stop.is_set():
            if not self._pipe.poll(LOOK):
                continue
            try:
                what, *words = self._pipe.recv()
            except (EOFError, OSError):
                return False
            if what == "close":
                return True
            try:
                self._outbox.put(Answer(vehicle.commit(*words)))
            except ValueError as error:
                self._outbox.put(Answer(error))
        return False

    def brake(self) -> None:
        """Along the committed plan to its end, and then until it hovers."""
        log.warning("nobody flies any more: braking along the committed plan")
        vehicle, end = self._vehicle, time.monotonic() + STOPPING
        turn = vehicle.wait(vehicle.turn.number + self._robot.horizon)
        while np.linalg.norm(turn.report.measured[3:6]) > REST and time.monotonic() < end:
            turn = vehicle.wait(turn.number + 1)
        log.warning("it hovers at (%.2f, %.2f, %.2f) m: letting go of it", *turn.report.measured[:3])

    def close(self) -> None:
        """Let go of the vehicle."""
        self._vehicle.close()

    def _keep(self, frame: Frame) -> None:
        self._frames.append((time.time_ns(), frame.outgoing, frame.raw))

    def _tell(self) -> None:
        """Each period as it begins."""
        vehicle, turn = self._vehicle, self._vehicle.turn
        while True:
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
def alone(flight: FlightSettings) -> Iterator[None]:
    """Within the block nobody else on this machine keeps that vehicle.

    The name of a socket that nobody listens at: it is gone with its process, however that ends. Raises MavlinkError:
    somebody else flies it, and goes on flying.
    """
    name = f"\0brakeline/{os.getuid()}/{flight.url}/{flight.system}"
    deadline, said = time.monotonic() + PREDECESSOR, False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as mark:
        while True:
            try:
                mark.bind(name)
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise MavlinkError(f"another process here flies vehicle {flight.system} at {flight.url}") from None
            if not said:
                log.info("waiting until whoever flew it has brought it to rest")
                said = True
            time.sleep(LOOK)
        yield


def main() -> int:
    """Keep the vehicle that the first word over the inherited socket names. 0: told to end; 1: it failed; 2: left."""
    pipe, outbox, stop = Connection(int(sys.argv[1])), Outbox(), threading.Event()
    writer = threading.Thread(target=_write, args=(outbox, pipe), name="writer", daemon=True)
    writer.start()
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(QueueHandler(outbox))
    with heeded(stop):
        try:
            status = _keep(pipe.recv(), pipe, outbox, stop)
            outbox.put(Answer(None))
        except Exception as error:
            status = 1
            outbox.put(Failure(error))
    outbox.put(None)
    writer.join(LAST_WORDS)
    return status


def _keep(charge: Charge, pipe: Connection, outbox: Outbox, stop: threading.Event) -> int:
    with alone(charge.flight):
        keeper = Keeper(charge, pipe, outbox)
        try:
            if keeper.serve(stop):
                return 0
            keeper.brake()
            return 2
        finally:
            keeper.close()


def _write(outbox: Outbox, pipe: Connection) -> None:
    """What is said goes to the actor; once there is none, to stderr."""
    while (said := outbox.get()) is not None:
        try:
            pipe.send(said)
        except OSError:
            if isinstance(said, logging.LogRecord):
                print(said.getMessage(), file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
