"""A vehicle that a process of its own keeps flying (`actors.keeper`), as its actor sees it."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import Pipe
from queue import Empty, SimpleQueue

import numpy as np

from actors.live import Turn
from actors.mavlink import MavlinkError
from actors.settings import FlightSettings
from actors.telemetry import Array
from messaging.robots import robot_named
from messaging.tolerant import Tolerance
from sim.world import Arena

ANSWERS_IN = 1.0  # s, for a process that does nothing else
ENDS_IN = 5.0  # s
LOOK = 0.1  # s between two looks at whether to go on waiting
ENDED = "the process that keeps the vehicle has ended"

Raw = tuple[int, bool, bytes]  # a MAVLink frame: when [ns], is it outgoing, its bytes


@dataclass(frozen=True)
class Charge:
    """What to fly: the first word to a keeper."""

    flight: FlightSettings
    robot: str
    arena: Arena  # for the judge of simulated flights


@dataclass(frozen=True)
class News:
    """Of a period that begins, and what came since the one before."""

    turn: Turn
    frames: list[Raw]
    passed_over: int  # messages, since the beginning
    figures: dict[str, float] | None


@dataclass(frozen=True)
class Answer:
    """To what the actor asked."""

    value: object


@dataclass(frozen=True)
class Failure:
    """Nobody flies any more."""

    error: Exception


class KeptVehicle:
    """To its actor what a `LiveVehicle` is, see there; but it goes on to the end of its plan when the actor dies."""

    def __init__(
        self, charge: Charge, tap: Callable[[Raw], None], tolerance: Tolerance, stop: Callable[[], bool]
    ) -> None:
        """Start its keeper and wait until it flies. tap: is called with every frame; stop: told to, it does not wait.

        Raises:
            MavlinkError, BadLink, OSError: what the keeper failed with.
        """
        self._tap, self._tolerance, self._passed_over = tap, tolerance, 0
        self._period = robot_named(charge.robot).period
        self._turned = threading.Condition()
        self._turn: Turn | None = None
        self._failure: Exception | None = None
        self._figures: dict[str, float] = {}
        self._answers: SimpleQueue[object] = SimpleQueue()
        self._pipe, theirs = Pipe()
        words = [sys.executable, "-P", "-m", "actors.keeper", str(theirs.fileno())]
        # Not of our session: ^C is for the actor, which then brakes and says when it is over.
        self._process = subprocess.Popen(words, pass_fds=[theirs.fileno()], start_new_session=True)
        theirs.close()
        self._pipe.send(charge)
        self._listener = threading.Thread(target=self._listen, name="keeper", daemon=True)
        self._listener.start()
        try:
            self._await_flight(stop)
        except BaseException:
            self.close()
            raise

    @property
    def turn(self) -> Turn:
        """The latest."""
        assert self._turn is not None
        return self._turn

    def commit(self, plan: Array, number: int) -> bool:
        """See `LiveVehicle.commit`. Raises BadInput; MavlinkError: nobody flies any more."""
        answer = self._ask("commit", np.asarray(plan, float), number)
        if isinstance(answer, Exception):
            raise answer
        return bool(answer)

    def wait(self, number: int) -> Turn:
        """See `LiveVehicle.wait`. Raises MavlinkError."""
        with self._turned:
            patience = 2.0 + self._period * max(0, number - self.turn.number)
            came = lambda: self.turn.number >= number or self._failure is not None  # noqa: E731
            if not self._turned.wait_for(came, patience):
                raise MavlinkError(f"period {number} does not begin")
            self._check()
            return self.turn

    def figures(self) -> dict[str, float]:
        """For Health: how time was kept, and what the judge of a simulated flight saw."""
        return self._figures

    def close(self) -> None:
        """Let go of the vehicle: its keeper ends."""
        with contextlib.suppress(MavlinkError):
            self._ask("close", patience=ENDS_IN)
        try:
            self._process.wait(ENDS_IN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join(ENDS_IN)
        self._pipe.close()

    def _await_flight(self, stop: Callable[[], bool]) -> None:
        with self._turned:
            while self._turn is None:
                self._check()
                if stop():
                    raise MavlinkError("told to stop before it flew")
                self._turned.wait(LOOK)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _ask(self, *words: object, patience: float = ANSWERS_IN) -> object:
        """Raises MavlinkError: it does not answer."""
        try:
            self._pipe.send(words)
            answer = self._answers.get(timeout=patience)
        except (OSError, Empty) as error:
            raise self._failure or MavlinkError(ENDED) from error
        if answer is ENDED:
            raise self._failure or MavlinkError(ENDED)
        return answer

    def _listen(self) -> None:
        """In a thread, to the keeper's last word."""
        try:
            while True:
                said = self._pipe.recv()
                if isinstance(said, News):
                    self._take(said)
                elif isinstance(said, Answer):
                    self._answers.put(said.value)
                elif isinstance(said, Failure):
                    self._fail(said.error)
                else:
                    logging.getLogger(said.name).handle(said)
        except (EOFError, OSError):
            self._fail(MavlinkError(ENDED))
        except Exception as error:  # whatever it is: who is not heard any more does not fly for us
            self._fail(error)

    def _take(self, news: News) -> None:
        for frame in news.frames:
            self._tap(frame)
        self._tolerance.count += news.passed_over - self._passed_over
        self._passed_over = news.passed_over
        self._figures = news.figures or self._figures
        with self._turned:
            self._turn = news.turn
            self._turned.notify_all()

    def _fail(self, error: Exception) -> None:
        with self._turned:
            self._failure = self._failure or error
            self._turned.notify_all()
        self._answers.put(ENDED)
