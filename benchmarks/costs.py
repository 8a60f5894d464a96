"""Measure the processor time of each process for a step of one ground robot: five hosts, keys, two recorders.

    python -m benchmarks costs

The networks have their default size. Other load on the machine changes the processor time little; it changes the speed
of the robot.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import psutil

from benchmarks.safety_processes import used
from benchmarks.timing import Figures
from tests.faults.five_hosts import PATIENCE, TURN, Fleet
from tests.faults.network_hosts import Hosts

WARM_UP = 300  # steps, of which 200 at random
MEASURED = 500


def _until(fleet: Fleet, steps: int) -> None:
    """Wait until the robot has taken so many steps. Raises RuntimeError if it makes no progress."""
    taken, since = fleet.taken("ground"), time.monotonic()
    while taken < steps:
        time.sleep(TURN)
        fleet.keep()
        if (now := fleet.taken("ground")) > taken:
            taken, since = now, time.monotonic()
        if time.monotonic() - since > 2.0 * PATIENCE:
            raise RuntimeError(f"no step for {2.0 * PATIENCE:.0f} s, after {taken}")


def run() -> Figures:
    """Return a row for each process: processor time of a step, and memory at the end. Raises NoHosts."""
    with tempfile.TemporaryDirectory(prefix="costs") as name, Hosts(5) as hosts:
        hosts.join(1, 2)
        with Fleet(Path(name), hosts, learning=("--learner.td3.warmup", 200)) as fleet:
            fleet.start()
            _until(fleet, WARM_UP)
            pids = {spot.name: spot.popen.pid for spot in fleet.spots.values() if spot.popen}
            before = {name: used([pid]) for name, pid in pids.items()}
            steps, began = fleet.taken("ground"), time.monotonic()
            _until(fleet, steps + MEASURED)
            taken, seconds = fleet.taken("ground") - steps, time.monotonic() - began
            figures = {
                name: {
                    "CPU ms a step": 1e3 * (used([pid]) - before[name]) / taken,
                    "MiB": psutil.Process(pid).memory_info().rss / 2**20,
                }
                for name, pid in pids.items()
            }
            fleet.end()
    return figures | {"the robot": {"steps /s": taken / seconds}}
