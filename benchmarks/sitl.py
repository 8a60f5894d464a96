"""Run real autopilots with their own physics: programs `sitl FOLDER INSTANCE` in folders that variables name."""

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

from brakeline.actors.mavlink.autopilot_commands import AutopilotClient, Wait
from brakeline.messaging.byte_links import Link, open_link

KINDS = ("ardupilot", "px4")
INSTANCES = range(1, 10)  # PX4 has no more ports
STARTS_IN = 30.0  # s
SAVED_IN = 4.0  # s until the autopilot has saved its parameters
LISTENS = "0A"  # a socket's state in /proc/net/tcp
# ArduCopter ends with its parent, and takes a parent of another user for gone. This program is a parent that waits.
KEEPER = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"


class NoAutopilot(RuntimeError):
    """There is no such autopilot, or it did not start."""


def variable(kind: str) -> str:
    """Return the environment variable with the folder of `sitl`."""
    return f"BRAKELINE_{kind.upper()}"


def program(kind: str, default: Path | None = None) -> Path:
    """Return the program that starts an autopilot. Raises NoAutopilot, with the name of the variable."""
    folder = os.environ.get(variable(kind), default)
    if folder is None or not (Path(folder) / "sitl").exists():
        raise NoAutopilot(f"no real {kind}: set {variable(kind)} to a folder with `sitl` in it")
    return Path(folder) / "sitl"


@contextmanager
def flying(
    kind: str, start: Path, folder: Path, parameters: Mapping[str, float] | None = None
) -> Iterator[tuple[str, int]]:
    """Run an autopilot in a folder until the end of the block. Yields its URL and its system id.

    Args:
        parameters: set in a start before, since some take effect at a start only.

    Raises:
        NoAutopilot: it did not start, or refused a parameter; with its output.
    """
    if parameters:
        with _running(kind, start, folder) as (url, system):
            configure(url, system, parameters)
    with _running(kind, start, folder) as reached:
        yield reached


def beside(kind: str, system: int, url: str) -> str:
    """Return the URL for a second client while another one flies the vehicle."""
    if kind == "px4":
        return f"udpout:127.0.0.1:{18570 + system - 1}"
    address, _, port = url.rpartition(":")
    return f"{address}:{int(port) + 2}"


def hall(system: int) -> str:
    """Return the URL of a PX4's simulator, for cameras besides two other clients."""
    return f"udpout:127.0.0.1:{19450 + system - 1}"


def connected(link: Link, client: AutopilotClient) -> Wait:
    """Wait for the autopilot behind a link. Returns the function with which its client waits for more."""

    def wait(condition: Callable[[], bool], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            client.heartbeat()  # PX4 answers clients that spoke first
            client.feed(link.receive())
            time.sleep(0.05)
        return condition()

    client.identify(lambda condition, seconds: wait(condition, max(seconds, STARTS_IN)))
    return wait


def configure(url: str, system: int, parameters: Mapping[str, float]) -> None:
    """Set parameters, and wait until the autopilot has saved them. Raises NoAutopilot if it refuses one."""
    link = open_link(url)
    client = AutopilotClient(link.send, system)
    try:
        wait = connected(link, client)
        for name, value in parameters.items():
            if not client.set_parameter(name, value, wait):
                raise NoAutopilot(f"it does not take {name} = {value:g}: {'; '.join(client.texts[-2:])}")
        wait(lambda: False, SAVED_IN)
    finally:
        link.close()


@contextmanager
def _running(kind: str, start: Path, folder: Path) -> Iterator[tuple[str, int]]:
    """Run an autopilot with its saved parameters. Yields its URL and its system id."""
    log_file = folder / f"{kind}.log"
    with _free(kind) as instance, log_file.open("wb") as output:
        command = [sys.executable, "-c", KEEPER, str(start), str(folder / kind), str(instance)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            deadline = time.monotonic() + STARTS_IN
            while not _taken(kind, instance):  # without a connection: its first one is its only one
                if time.monotonic() > deadline:
                    raise NoAutopilot(f"{kind} does not listen: {log_file.read_text(errors='replace')[-500:]}")
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
    """Reserve an instance number on this machine: two that start at once would both find its ports free."""
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
    """Return whether an instance of this number runs, or a program waits for it."""
    table, ports = "tcp", [5760 + 10 * instance]
    if kind == "px4":
        table, ports = "udp", [14540 + instance, 14580 + instance, 18570 + instance, 19450 + instance]
    rows = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    used = {int(row[1].split(":")[1], 16) for row in rows if table == "udp" or row[3] == LISTENS}
    return bool(used.intersection(ports))
