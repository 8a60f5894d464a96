"""What a step costs each process: a run of one ground robot over five hosts, with keys, the default networks and two
recorders.

python -m benchmarks costs

Processor time does not depend on who else is busy, or little; how fast the robot drives does.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import psutil

from benchmarks.timing import Figures
from tests.faults.five_hosts import PATIENCE, TURN, Fleet
from tests.faults.network_hosts import Hosts

WARM_UP = 300  # steps, of which 200 at random
MEASURED = 500


def _until(fleet: Fleet, steps: int) -> None:
    """Wait for as long as it gets on."""
    taken, since = fleet.taken("ground"), time.monotonic()
    while taken < steps:
        time.sleep(TURN)
        fleet.keep()
        if (now := fleet.taken("ground")) > taken:
            taken, since = now, time.monotonic()
        if time.monotonic() - since > 2.0 * PATIENCE:
            raise RuntimeError(f"no step for {2.0 * PATIENCE:.0f} s, after {taken}")


def run() -> Figures:
    """CPU ms a step, and resident MiB at the end. Raises NoHosts."""
    with tempfile.TemporaryDirectory(prefix="costs") as name, Hosts(5) as hosts:
        hosts.join(1, 2)
        with Fleet(Path(name), hosts, learning=("--learner.td3.warmup", 200)) as fleet:
            fleet.start()
            _until(fleet, WARM_UP)
            processes = {spot.name: psutil.Process(spot.popen.pid) for spot in fleet.spots.values() if spot.popen}
            before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
            steps, began = fleet.taken("ground"), time.monotonic()
            _until(fleet, steps + MEASURED)
            taken, seconds = fleet.taken("ground") - steps, time.monotonic() - began
            figures = {
                name: {
                    "CPU ms a step": 1e3 * (sum(process.cpu_times()[:2]) - before[name]) / taken,
                    "MiB": process.memory_info().rss / 2**20,
                }
                for name, process in processes.items()
            }
            fleet.end()
    return figures | {"the robot": {"steps /s": taken / seconds}}
