"""A vehicle that a process of its own keeps flying (`actors.vehicle_server`), as its actor sees it."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue

import numpy as np

from actors.mavlink import MavlinkError
from actors.mavlink_vehicle import ControlPeriod
from actors.settings import FlightSettings
from actors.telemetry import Array
from messaging.robots import robot_named
from messaging.shapes import Obstacle
from messaging.tolerant import Tolerance

ANSWERS_IN = 1.0  # s, for a process that does nothing else
STARTS_IN = 30.0  # s
ENDS_IN = 30.0  # s, braking included
ATTEMPTS = 3  # at taking over, or taking off
PREDECESSOR = 45.0  # s in which a keeper whose actor died has brought the vehicle to rest
LOOK = 0.1  # s between two looks at whether to go on waiting
ENDED = "the process that keeps the vehicle has ended"

Raw = tuple[int, bool, bytes]  # a MAVLink frame: when [ns], is it outgoing, its bytes


@dataclass(frozen=True)
class FlightRequest:
    """What to fly: an actor's first word."""

    flight: FlightSettings
    robot: str
    obstacles: tuple[Obstacle, ...]  # for the judge of simulated flights


class HandoverRefused(MavlinkError):
    """It was kept until now, but can't be handed over: somebody has to take control of it anew."""


@dataclass(frozen=True)
class VehicleUpdate:
    """Of a period that begins, and what came since the one before."""

    period: ControlPeriod
    frames: list[Raw]
    passed_over: int  # messages, since the beginning
    figures: dict[str, float] | None


@dataclass(frozen=True)
class Answer:
    """To the question of that number."""

    number: int
    value: object


@dataclass(frozen=True)
class Failure:
    """Nobody flies any more."""

    error: Exception


def address(url: str, system: int) -> str:
    """Where a vehicle's keeper is met: a name that is gone with its process, however that ends, and not a file."""
    place = url.replace("//", "").replace("localhost", "127.0.0.1")
    return f"\0brakeline/{os.getuid()}/{place[-80:]}/{system}"


def ours(peer: socket.socket) -> bool:
    """Is it a process of this user? What it says is unpickled."""
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return bool(user == os.getuid())


class VehicleClient:
    """To its actor what a `MavlinkVehicle` is, see there; but it goes on to the end of its plan when the actor dies."""

    def __init__(
        self, request: FlightRequest, tap: Callable[[Raw], None], tolerance: Tolerance, stop: Callable[[], bool]
    ) -> None:
        """Take over from a keeper whose actor died, or start one, and wait until it flies.

        tap: is called with every frame; stop: told to, it does not wait.

        Raises:
            MavlinkError, BadLink, OSError: what the keeper failed with; MavlinkError: another actor flies it, or told
            to stop.
        """
        self._tap, self._tolerance, self._passed_over = tap, tolerance, 0
        self._period = robot_named(request.robot).period
        self._changed = threading.Condition()
        self._lines: SimpleQueue[logging.LogRecord] = SimpleQueue()
        threading.Thread(target=self._log, name="keeper's log", daemon=True).start()
        self._process: subprocess.Popen[bytes] | None = None
        self._asked = 0
        for attempts_left in reversed(range(ATTEMPTS)):
            self._meet(request, stop)
            try:
                self._await_flight(stop)
                return
            except BaseException as error:
                self.leave()
                if not (attempts_left and isinstance(error, HandoverRefused)):
                    raise
                logging.getLogger("brakeline.flight").info("taking control of it anew: %s", error)

    @property
    def current_period(self) -> ControlPeriod:
        """The latest."""
        assert self._current is not None
        return self._current

    def commit(self, plan: Array, number: int) -> bool:
        """See `MavlinkVehicle.commit`. Raises BadInput; MavlinkError: nobody flies any more."""
        answer = self._ask("commit", np.asarray(plan, float), number)
        if isinstance(answer, Exception):
            raise answer
        return bool(answer)

    def wait(self, number: int) -> ControlPeriod:
        """See `MavlinkVehicle.wait`. Raises MavlinkError."""
        with self._changed:
            patience = 2.0 + self._period * max(0, number - self.current_period.number)
            came = lambda: self.current_period.number >= number or self._failure is not None  # noqa: E731
            if not self._changed.wait_for(came, patience):
                raise MavlinkError(f"period {number} does not begin")
            self._check()
            return self.current_period

    def figures(self) -> dict[str, float]:
        """For Health: how time was kept, and what the judge of a simulated flight saw."""
        return self._figures

    def close(self) -> None:
        """Let go of the vehicle: its keeper brakes it, if it does not hover yet, and ends."""
        with contextlib.suppress(Exception):
            self._ask("close", patience=0.0)
        self._listener.join(ENDS_IN)  # to the keeper's last word
        self.leave()

    def leave(self) -> None:
        """As if this process had died: the keeper brakes it, and waits for another actor."""
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(self._pipe.fileno())) as connection:
            connection.shutdown(socket.SHUT_RDWR)
        self._listener.join(ENDS_IN)
        self._pipe.close()
        if self._process is not None and self._process.poll() is not None:
            self._process = None

    def _meet(self, request: FlightRequest, stop: Callable[[], bool]) -> None:
        """Knock at its keeper's, and start one if there is none."""
        self._current: ControlPeriod | None = None
        self._failure: Exception | None = None
        self._figures: dict[str, float] = {}
        self._answers: SimpleQueue[Answer] = SimpleQueue()
        self._heard, self._heard_at = False, time.monotonic()
        self._pipe = self._reach(request.flight, stop)
        with contextlib.suppress(OSError):  # it has ended meanwhile, as the listener finds
            self._pipe.send(request)
        self._listener = threading.Thread(target=self._listen, name="keeper", daemon=True)
        self._listener.start()

    def _reach(self, flight: FlightSettings, stop: Callable[[], bool]) -> Connection:
        """Raises MavlinkError: no keeper is there, and none starts; or told to stop."""
        deadline, process = time.monotonic() + STARTS_IN, None
        while (pipe := _knock(flight)) is None:
            if process is None:
                words = [sys.executable, "-P", "-m", "actors.vehicle_server", flight.url, str(flight.system)]
                # Not of our session: ^C is for the actor, which then brakes and says when it is over.
                process = self._process = subprocess.Popen(words, start_new_session=True)
            if process.poll() is not None or time.monotonic() > deadline or stop():
                raise MavlinkError(f"the process that keeps the vehicle does not start ({process.poll()})")
            time.sleep(0.2 * LOOK)
        return pipe

    def _await_flight(self, stop: Callable[[], bool]) -> None:
        with self._changed:
            while self._current is None:
                self._check()
                if stop():
                    raise MavlinkError("told to stop before it flew")
                if time.monotonic() - self._heard_at > PREDECESSOR:
                    raise MavlinkError("its keeper fell silent" if self._heard else "another process here flies it")
                self._changed.wait(LOOK)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _ask(self, *words: object, patience: float = ANSWERS_IN) -> object:
        """The answer; None: it comes late, or (without patience) is not waited for. Raises MavlinkError: it is gone."""
        self._asked += 1
        try:
            self._pipe.send((self._asked, *words))
            while patience:
                answer = self._answers.get(timeout=patience)
                self._check()
                if answer.number == self._asked:  # not that of a question that nobody waited for
                    return answer.value
        except OSError as error:
            raise self._failure or MavlinkError(ENDED) from error
        except Empty:
            pass  # too late for what it was asked; whether it still flies is `wait`'s question
        return None

    def _listen(self) -> None:
        """In a thread, to the keeper's last word."""
        try:
            while True:
                said = self._pipe.recv()
                self._heard, self._heard_at = True, time.monotonic()
                if isinstance(said, VehicleUpdate):
                    self._take(said)
                elif isinstance(said, Answer):
                    self._answers.put(said)
                elif isinstance(said, Failure):
                    self._fail(said.error)
                else:
                    self._lines.put(said)
        except (EOFError, OSError):
            self._fail(MavlinkError(ENDED) if self._heard else HandoverRefused(ENDED))
        except Exception as error:  # whatever it is: who is not understood any more does not fly for us
            self._fail(error)

    def _log(self) -> None:
        """In a thread of its own, for a line goes over the bus too, which may wait."""
        while True:
            record = self._lines.get()
            logging.getLogger(record.name).handle(record)

    def _take(self, news: VehicleUpdate) -> None:
        for frame in news.frames:
            self._tap(frame)
        self._tolerance.count += news.passed_over - self._passed_over
        self._passed_over = news.passed_over
        self._figures = news.figures or self._figures
        with self._changed:
            self._current = news.period
            self._changed.notify_all()

    def _fail(self, error: Exception) -> None:
        with self._changed:
            self._failure = self._failure or error
            self._changed.notify_all()
        self._answers.put(Answer(-1, None))  # who waits for one looks up


def _knock(flight: FlightSettings) -> Connection | None:
    """A connection to the vehicle's keeper, if there is one. Raises MavlinkError: it is not this user's."""
    knocking = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        knocking.connect(address(flight.url, flight.system))
    except OSError:
        knocking.close()
        return None
    if not ours(knocking):
        knocking.close()
        raise MavlinkError("somebody else keeps this vehicle")
    return Connection(knocking.detach())
