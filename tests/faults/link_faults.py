"""Fly real autopilots whose companion fails: its link is cut, or its safety service or its actor is killed.

Run it after `flights`: it needs their model sets. The policy is A*, the fastest. The faults come one after the other,
at random times; the next one comes when the vehicle flies again. The autopilots keep their own timeouts. A judge hears
the simulator's ground truth on another port, also while no actor lives. In real time: half a minute for each fault.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random
from typing import TypeVar

import numpy as np
import psutil

from benchmarks import sitl
from benchmarks.flights import SETUPS, started_autopilot
from benchmarks.timing import Words, repeated
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.ground_truth import MavlinkGroundTruth
from brakeline.actors.mavlink.telemetry import MOTION, TRUTH, Array
from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.quadrotor_vehicles import flight_arena
from brakeline.errors import MavlinkError
from brakeline.messaging.byte_links import Link, TcpServer, open_link
from brakeline.messaging.robot import robot_named

T = TypeVar("T")

ARENA, POLICY = "default", "astar"
FAULTS = ("link", "safety-0", "actor-0")  # the link to the autopilot, and children of a run
BETWEEN = (3.0, 12.0)  # s from when the vehicle flies again to the next fault
AGAIN = 15  # steps after which it counts as flying again
ROOM = 0.3  # m of clearance that it needs before the next fault: first it must leave what it ran into
CUT = (0.3, 5.0)  # s that a link is cut
PUMP = 0.002  # s
FLIES_WITHIN = 180.0  # s
LINE = re.compile(r"steps (\d+) ")
TRUTH_INTERVAL = 0.02  # s between two messages of ground truth


def run(faults: int, seed: int, folder: Path) -> Words:
    """Return rows of faults; columns: how often, and the collisions from then until the next fault."""
    rows: Words = {}
    for name, setup in SETUPS.items():
        try:
            start = sitl.program(setup.kind)
        except sitl.NoAutopilot as none:
            print(none, file=sys.stderr)
            continue
        record = Record(name, faults)
        while record.left:
            before = record.done
            with tempfile.TemporaryDirectory() as place:
                _flight(record, start, Path(place), folder / name, Random(seed + before))
            if record.done == before:
                raise MavlinkError("the vehicle did not fly")
        rows |= record.rows()
    return rows


@dataclass
class Outcomes:
    """The outcomes of one kind of fault."""

    count: int = 0
    collisions: int = 0
    nearest: float = float("inf")  # m
    stuck: int = 0  # times that the vehicle did not leave what it had run into
    crashed: int = 0  # times that the autopilot disarmed, mostly on the floor
    way: float = 0.0  # m, the longest while a link was cut
    speed: float = 0.0  # m/s at the start of that way

    def take_way(self, way: float, speed: float) -> None:
        if way > self.way:
            self.way, self.speed = way, speed

    def row(self) -> dict[str, float | str]:
        row: dict[str, float | str] = {"faults": self.count, "collisions": self.collisions}
        row |= {"stuck": self.stuck, "crashed": self.crashed, "nearest m": round(self.nearest, 2)}
        return row | ({"way most m": round(self.way, 1), "from m/s": round(self.speed, 1)} if self.way else {})


class Record:
    """The outcomes of all faults of an autopilot in one setup."""

    def __init__(self, name: str, faults: int) -> None:
        self.name, self.setup, self._faults, self.done = name, SETUPS[name], faults, 0
        self.of = {name: Outcomes() for name in FAULTS}
        self.calm = Outcomes()

    @property
    def left(self) -> int:
        return self._faults - self.done

    def next(self) -> str:
        """Return the next fault."""
        name = FAULTS[self.done % len(FAULTS)]
        self.done += 1
        self.of[name].count += 1
        print(f"{self.name}: fault {self.done} of {self._faults}: {name}", file=sys.stderr)
        return name

    def rows(self) -> Words:
        return {f"{self.name}: {name}": one.row() for name, one in {"in between": self.calm, **self.of}.items()}


def _flight(record: Record, start: Path, home: Path, folder: Path, random: Random) -> None:
    """Fly from the start of the autopilot to the last fault, or to a crash."""
    with (
        started_autopilot(record.setup, start, home) as (url, system),
        relayed(url) as relay,
        judged(sitl.beside(record.setup.kind, system, url), system) as judge,
        _running_flight([*record.setup.words, "--url", relay.url, "--system", str(system)], home, folder) as (
            fly,
            steps,
        ),
    ):
        _until(lambda: judge.airborne, fly)
        _until(partial(steps.beyond, AGAIN), fly)
        time.sleep(random.uniform(*BETWEEN))
        while record.left:
            judge.take(record.calm)
            name = record.next()
            if name == "link":
                at, speed = judge.motion()
                relay.cut(random.uniform(*CUT))
                _until(lambda: not relay.dead, fly)
                record.of[name].take_way(float(np.linalg.norm(judge.motion()[0] - at)), speed)
            else:
                _until(partial(child_of, home, name), fly).kill()
            _until(steps.next_line(), fly)  # the latest line may be some seconds old
            _until(partial(steps.beyond, steps.taken + AGAIN), fly)
            outcomes = record.of[name]
            outcomes.stuck += not _comes_out(judge, fly)
            judge.take(outcomes)
            if not judge.client.armed:
                outcomes.crashed += 1
                return
            time.sleep(random.uniform(*BETWEEN))


@contextmanager
def _running_flight(where: list[str], home: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], Steps]]:
    words = [*where, "--policy", POLICY, "--arena", ARENA, "--at-start", "--minutes", "600", "--pictures", "0"]
    fly = subprocess.Popen(
        [*PYTHON, "-m", "brakeline.deploy.cli", "fly", *words, "--raise-limits", "--json", "--out", str(home / "run")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"BRAKELINE_DATA": str(folder.absolute() / "data")},
    )
    assert fly.stderr is not None
    try:
        yield fly, Steps(fly.stderr)
    finally:
        fly.terminate()
        fly.wait()


class Steps:
    """The number of steps of a flight, by the lines that it prints now and then."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.taken = self._lines = 0
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()

    def beyond(self, number: int) -> bool:
        return self.taken > number

    def next_line(self) -> Callable[[], bool]:
        """Return a condition: another line has come since this call."""
        before = self._lines
        return lambda: self._lines > before

    def _read(self, lines: Iterable[str]) -> None:
        for line in lines:
            if said := LINE.match(line):
                self.taken = int(said.group(1))
                self._lines += 1
            else:
                print(line, end="", file=sys.stderr)


def _until(condition: Callable[[], T | None], fly: subprocess.Popen[str]) -> T:
    """Wait for a true result and return it. Raises MavlinkError: the flight has ended, or it takes too long."""
    deadline = time.monotonic() + FLIES_WITHIN
    while not (result := condition()):
        if fly.poll() is not None or time.monotonic() > deadline:
            raise MavlinkError(f"the vehicle does not fly; status {fly.poll()}")
        time.sleep(0.2)
    return result


def _comes_out(judge: Judge, fly: subprocess.Popen[str]) -> bool:
    """Return whether the vehicle leaves what it ran into. Raises MavlinkError: the flight has ended."""
    try:
        return _until(lambda: judge.truth.clearance > ROOM or not judge.client.armed, fly)
    except MavlinkError:
        if fly.poll() is not None:
            raise
        return False


def child_of(home: Path, name: str) -> psutil.Process | None:
    """Return the living process of that name in the run in that folder."""
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        if words[-2:] == [str(home / "run"), name]:
            return process
    return None


class Relay:
    """Carries bytes between an autopilot and its client, until it is cut."""

    def __init__(self, upstream: Link) -> None:
        self._upstream, self._server = upstream, TcpServer("127.0.0.1", 0)
        self.url = f"tcp:127.0.0.1:{self._server.port}"
        self._dead_until = 0.0

    def cut(self, seconds: float) -> None:
        """Lose everything that is sent in the next seconds."""
        self._dead_until = time.monotonic() + seconds

    @property
    def dead(self) -> bool:
        return time.monotonic() < self._dead_until

    def pump(self) -> None:
        up, down = self._upstream.receive(), self._server.receive()
        if self.dead:
            return
        if up:
            self._server.send(up)
        if down:
            self._upstream.send(down)

    def close(self) -> None:
        self._server.close()
        self._upstream.close()


@contextmanager
def relayed(url: str) -> Iterator[Relay]:
    relay = Relay(open_link(url))
    with repeated(relay.pump, PUMP):
        yield relay
    relay.close()


@dataclass
class Judge:
    """Hears ground truth and estimate beside the actor, and counts collisions with the map."""

    client: AutopilotClient
    link: Link
    truth: MavlinkGroundTruth
    airborne: bool = False
    _seen: int = 0
    _beaten: float = 0.0
    _nearest: float = field(default=float("inf"))

    def listen(self) -> None:
        client, truth = self.client, self.truth
        if time.monotonic() - self._beaten > 1.0:
            self._beaten = time.monotonic()
            client.heartbeat()
        client.feed(self.link.receive())
        if client.truth is None or client.position is None:
            return
        truth.take(client.truth, client.position + ORIGIN, client.velocity)
        client.truth = None
        self.airborne |= truth.state is not None and truth.state[2] > 2.0
        if not self.airborne:
            self._seen = truth.collisions  # it touches the ground that it stands on
        else:
            self._nearest = min(self._nearest, truth.clearance)

    def motion(self) -> tuple[Array, float]:
        """Return the estimated position (3,) [m] and speed [m/s]."""
        assert self.client.position is not None
        return self.client.position.copy(), float(np.linalg.norm(self.client.velocity))

    def take(self, outcomes: Outcomes) -> None:
        """Add what happened since the last call to some outcomes."""
        outcomes.collisions += self.truth.collisions - self._seen
        outcomes.nearest = min(outcomes.nearest, self._nearest)
        self._seen, self._nearest = self.truth.collisions, float("inf")


MAP = flight_arena(ARENA, 0)
ORIGIN = (MAP.start[0], MAP.start[1], 0.0)  # of the autopilot's local frame, on the floor below the start


@contextmanager
def judged(url: str, system: int) -> Iterator[Judge]:
    robot = robot_named("quadrotor-late")
    link = open_link(url)
    client = AutopilotClient(link.send, system)
    judge = Judge(client, link, MavlinkGroundTruth(MAP.shapes, robot.footprint))
    try:
        wait = sitl.connected(link, client)
        wait(lambda: False, 60.0)  # until its estimator is ready
        for what in (MOTION, TRUTH):
            client.choose(what, TRUTH_INTERVAL, wait)
        with repeated(judge.listen, 0.01):
            yield judge
    finally:
        link.close()
