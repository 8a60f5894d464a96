"""Real autopilots with their own physics, where there are any: a folder whose `sitl FOLDER INSTANCE` runs one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir

from filelock import FileLock, Timeout

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.messaging.byte_links import open_link

KINDS = ("ardupilot", "px4")
INSTANCES = range(1, 10)  # PX4 has no more ports
STARTS_IN = 30.0  # s
SAVED_IN = 4.0  # s until parameters that were set are in a file
LISTENS = "0A"  # a socket's state in /proc/net/tcp
# ArduCopter ends with its parent, and takes one of another user for gone: this one waits for it.
KEEPER = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"


class NoAutopilot(RuntimeError):
    """There is none, or it did not start."""


def variable(kind: str) -> str:
    """Of the environment: the folder with `sitl` in it."""
    return f"BRAKELINE_{kind.upper()}"


def program(kind: str, default: Path | None = None) -> Path:
    """What starts it. Raises NoAutopilot, naming the variable."""
    folder = os.environ.get(variable(kind), default)
    if folder is None or not (Path(folder) / "sitl").exists():
        raise NoAutopilot(f"no real {kind}: set {variable(kind)} to a folder with `sitl` in it")
    return Path(folder) / "sitl"


@contextmanager
def flying(
    kind: str, start: Path, folder: Path, parameters: Mapping[str, float] | None = None
) -> Iterator[tuple[str, int]]:
    """One that runs in a folder: (the URL for us, its system id).

    parameters: set before, in a first start, for some count from a start on only.

    Raises:
        NoAutopilot: with what it said, or the parameter that it does not take.
    """
    if parameters:
        with _running(kind, start, folder) as (url, system):
            configure(url, system, parameters)
    with _running(kind, start, folder) as reached:
        yield reached


def beside(kind: str, system: int, url: str) -> str:
    """Where a second one can talk to it while somebody flies it."""
    if kind == "px4":
        return f"udpout:127.0.0.1:{18570 + system - 1}"
    address, _, port = url.rpartition(":")
    return f"{address}:{int(port) + 2}"


def hall(system: int) -> str:
    """Where cameras can talk to a PX4 while somebody flies it and a second one listens: its simulator's port."""
    return f"udpout:127.0.0.1:{19450 + system - 1}"


def configure(url: str, system: int, parameters: Mapping[str, float]) -> None:
    """Set them, and wait until they are in a file. Raises NoAutopilot: it does not take one of them."""
    link = open_link(url)
    client = AutopilotClient(link.send, system)

    def wait(condition: Callable[[], bool], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            client.heartbeat()  # PX4 speaks to who spoke first
            client.feed(link.receive())
            time.sleep(0.05)
        return condition()

    try:
        client.identify(lambda condition, seconds: wait(condition, max(seconds, STARTS_IN)))
        for name, value in parameters.items():
            if not client.set_parameter(name, value, wait):
                raise NoAutopilot(f"it does not take {name} = {value:g}: {'; '.join(client.texts[-2:])}")
        wait(lambda: False, SAVED_IN)
    finally:
        link.close()


@contextmanager
def _running(kind: str, start: Path, folder: Path) -> Iterator[tuple[str, int]]:
    said = folder / f"{kind}.log"
    with _free(kind) as instance, said.open("wb") as output:
        command = [sys.executable, "-c", KEEPER, str(start), str(folder / kind), str(instance)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            deadline = time.monotonic() + STARTS_IN
            while not _taken(kind, instance):  # looked at, not tried: its first connection is its only one
                if time.monotonic() > deadline:
                    raise NoAutopilot(f"{kind} does not listen: {said.read_text(errors='replace')[-500:]}")
                time.sleep(0.1)
            if kind == "px4":
                yield f"udpin:127.0.0.1:{14540 + instance}", instance + 1
            else:
                yield f"tcp:127.0.0.1:{5760 + 10 * instance}", 1
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def _free(kind: str) -> Iterator[int]:
    """A number that nobody of this machine has, kept: of two that start at once each finds the other's ports free."""
    for instance in reversed(INSTANCES):
        lock = FileLock(Path(gettempdir(), f"{kind}-{instance}.brakeline"), blocking=False, mode=0o666)
        try:
            lock.acquire()
        except Timeout:
            continue
        try:
            if not _taken(kind, instance):
                yield instance
                return
        finally:
            lock.release()
    raise NoAutopilot(f"{len(INSTANCES)} of {kind} run on this machine already: it has no ports for more")


def _taken(kind: str, instance: int) -> bool:
    """Does one of that number run, or somebody who expects it?"""
    table, ports = "tcp", [5760 + 10 * instance]
    if kind == "px4":
        table, ports = "udp", [14540 + instance, 14580 + instance, 18570 + instance, 19450 + instance]
    rows = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    used = {int(row[1].split(":")[1], 16) for row in rows if table == "udp" or row[3] == LISTENS}
    return bool(used.intersection(ports))
