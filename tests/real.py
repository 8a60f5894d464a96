"""Real autopilots with their own physics, where there are any: a folder whose `sitl FOLDER INSTANCE` runs one.

`$BRAKELINE_ARDUPILOT`, `$BRAKELINE_PX4`, else `../shared/ardupilot`, `../shared/px4` beside the checkout.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
INSTANCES = range(1, 10)  # PX4 has no more ports
KINDS = ("ardupilot", "px4")
LISTENS = "0A"  # a socket's state in /proc/net/tcp
# ArduCopter ends with its parent, and takes one of another user for gone: this one waits for it.
KEEPER = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"


def sitl(kind: str) -> Path:
    """The program that starts it; skips the test, by the variable's name, where there is none."""
    variable = f"BRAKELINE_{kind.upper()}"
    program = Path(os.environ.get(variable, ROOT.parent / "shared" / kind)) / "sitl"
    if not program.exists():
        pytest.skip(f"no real {kind}: set {variable} to a folder with `sitl` in it")
    return program


@contextmanager
def autopilot(kind: str, folder: Path) -> Iterator[tuple[str, int]]:
    """One that runs: (the URL for us, its system id)."""
    program, instance = sitl(kind), next(i for i in reversed(INSTANCES) if not _taken(kind, i))
    with (folder / "sitl.log").open("wb") as output:
        command = [sys.executable, "-c", KEEPER, str(program), str(folder / kind), str(instance)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            if kind == "px4":
                yield f"udpin:127.0.0.1:{14540 + instance}", instance + 1
                return
            deadline = time.monotonic() + 30.0
            while not _taken(kind, instance):  # looked at, not tried: its first connection is its only one
                assert time.monotonic() < deadline, (folder / "sitl.log").read_text()
                time.sleep(0.1)
            yield f"tcp:127.0.0.1:{5760 + 10 * instance}", 1
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _taken(kind: str, instance: int) -> bool:
    """Does one of that number run, or somebody who expects it?"""
    table, ports = "tcp", (5760 + 10 * instance,)
    if kind == "px4":
        table, ports = "udp", (14540 + instance, 14580 + instance, 18570 + instance)
    rows = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    used = {int(row[1].split(":")[1], 16) for row in rows if table == "udp" or row[3] == LISTENS}
    return bool(used.intersection(ports))
