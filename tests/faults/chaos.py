"""Run on five hosts with faults: processes and routers die by `kill -9`, and cables are pulled.

python -m benchmarks chaos [--kills 100] [--seed 0] [--delay 0.01]

One random fault at a time; the next one comes when every process is back and both robots go on. A process that died is
started again, as by a container engine; learners change their host each time. At the end the learners get a last number
of steps, and finish. The outcome is read from the logs of the two recorders, not from the processes.
"""

from __future__ import annotations

import itertools
import signal
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from benchmarks.timing import Figures
from brakeline.logs.reader import Record, open_log
from tests.faults.five_hosts import CLOCKS, LEARNERS, MOVED, TURN, Fleet
from tests.faults.network_hosts import Hosts

ROBOTS = ("ground", "quadrotor")
CUT = (0.3, 6.0)  # s that a cable is out
PROGRESS = 20  # steps of each robot between two faults
PATIENCE = 240.0  # s until all goes on after a fault
ROUTERS = "the cable between the routers"
LAST = 300  # steps more, at the end


class Stuck(RuntimeError):
    """After a fault the run did not go on; the message names the missing processes."""


@dataclass
class Chaos:
    fleet: Fleet
    random: Random
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    recovery: list[float] = field(default_factory=list)  # s from each fault until all went on
    unsaved: list[float] = field(default_factory=list)  # s that a killed recorder had heard and not saved

    def settle(self) -> None:
        """Wait until every process lives and each robot has taken some more steps. Raises Stuck."""
        began = time.monotonic()
        before = {robot: self.fleet.taken(robot) for robot in ROBOTS}
        missing: set[str] = set()
        while time.monotonic() - began < PATIENCE:
            self.fleet.keep()
            missing = set(self.fleet.spots) - self.fleet.living()
            on = all(self.fleet.taken(robot) - before[robot] >= PROGRESS for robot in ROBOTS)
            if not missing and on:
                self.recovery.append(time.monotonic() - began)
                return
            time.sleep(TURN)
        taken = {robot: self.fleet.taken(robot) - before[robot] for robot in ROBOTS}
        raise Stuck(f"not within {PATIENCE:.0f} s: missing {sorted(missing)}, steps since then {taken}")

    def fault(self) -> str:
        """Kill or cut something; return its description."""
        hosts = self.fleet.hosts
        what = self.random.choice([*self.fleet.spots, *(f"host {i}" for i in range(1, 6)), ROUTERS])
        self.counts["cuts" if " " in what else what.split("-")[0]] += 1
        if " " not in what:
            self._kill(what)
            return f"kill -9 {what}"
        seconds = self.random.uniform(*CUT)
        if what == ROUTERS:
            hosts.unjoin(1)
            time.sleep(seconds)
            hosts.unjoin(1, joined=True)
        else:
            number = int(what.split()[1])
            hosts.cut(number)
            time.sleep(seconds)
            hosts.heal(number)
        return f"{what} cut for {seconds:.1f} s"

    def _kill(self, name: str) -> None:
        spot = self.fleet.spots[name]
        path = newest(self.fleet.log(int(name[-1]))) if name.startswith("recorder") else None
        at = time.time() + 3600.0 * CLOCKS.get(spot.host, 0.0) * (self.fleet.hosts.clock is not None)
        self.fleet.kill(name)
        if path is not None:
            saved = max((record.log_time for record in open_log([path])), default=None)
            if saved is not None:
                self.unsaved.append(at - saved * 1e-9)
        move = {LEARNERS: MOVED, MOVED: LEARNERS} if name.startswith("learner") else {}
        self.fleet.launch(name, move.get(spot.host))

    def finish(self) -> None:
        """Let the learners reach their last step and end by themselves."""
        for robot in ROBOTS:
            name = f"learner-{robot}"
            self.fleet.kill(name, signal.SIGTERM)  # with a checkpoint
            spot = self.fleet.spots[name]
            words = list(spot.words)
            words[words.index("--steps") + 1] = str(self.fleet.learned(robot) + LAST)
            spot.words = tuple(words)
            self.fleet.launch(name)
        deadline = time.monotonic() + PATIENCE
        while not all(self.fleet.spots[f"learner-{robot}"].done for robot in ROBOTS):
            if time.monotonic() > deadline:
                raise Stuck("the learners did not finish")
            self.fleet.keep()
            time.sleep(TURN)
        time.sleep(1.0)  # for the last messages
        self.fleet.end()


def newest(log_file: Path) -> Path:
    """Return the segment that is being written."""
    return max(log_file.parent.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)


@dataclass
class Judged:
    """Both recorders' logs, read after the end."""

    steps: int = 0  # in either log
    twice: int = 0  # in one log
    collisions: int = 0
    lost: int = 0  # steps in neither log, between two that are in one
    longest: int = 0  # most of them in a row

    def read(self, fleet: Fleet) -> None:
        seen: dict[tuple[str, int], set[int]] = defaultdict(set)
        for recorder in range(fleet.recorders):
            mine: dict[tuple[str, int], set[int]] = defaultdict(set)
            for record in open_log(fleet.log(recorder)):
                if record.topic == "step":
                    self._take(record, mine, seen)
        for numbers in seen.values():
            self.steps += len(numbers)
            ordered = sorted(numbers)
            gaps = [after - before - 1 for before, after in itertools.pairwise(ordered)]
            self.lost += sum(gaps)
            self.longest = max(self.longest, *gaps, 0)

    def _take(
        self, record: Record, mine: dict[tuple[str, int], set[int]], seen: dict[tuple[str, int], set[int]]
    ) -> None:
        header = record.message.header
        name = record.key, header.run
        if header.sequence in mine[name]:
            self.twice += 1
        elif header.sequence not in seen[name]:
            self.collisions += record.message.collision
        mine[name].add(header.sequence)
        seen[name].add(header.sequence)


def chaos(kills: int, seed: int, delay: float = 0.0) -> Figures:
    """Run with faults. delay: s each way between actors and routers. Raises NoHosts, and Stuck if the run ended."""
    with tempfile.TemporaryDirectory(prefix="chaos") as name, Hosts(5, CLOCKS) as hosts:
        folder = Path(name)
        hosts.join(1, 2)
        with Fleet(folder, hosts, ROBOTS, seed=seed, delay=delay) as fleet:
            fleet.start()
            run = Chaos(fleet, Random(seed))
            run.settle()
            begun = run.recovery.pop()
            for number in range(kills):
                print(f"{number + 1}: {run.fault()}", file=sys.stderr, end="", flush=True)
                run.settle()
                print(f", all go on after {run.recovery[-1]:.1f} s", file=sys.stderr, flush=True)
            run.finish()
            judged = Judged()
            judged.read(fleet)
            learned = {robot: fleet.metrics.learners[robot] for robot in ROBOTS}
            policies = sum((folder / f"learner-{robot}" / "policy.safetensors").exists() for robot in ROBOTS)
    recovery = sorted(run.recovery) or [0.0]
    said: dict[str, float] = {
        "faults": kills,
        **{f"faults: {name}": count for name, count in sorted(run.counts.items())},
        "steps": judged.steps,
        "collisions": judged.collisions,
        "steps twice in a log": judged.twice,
        "duplicates, as the learners say": sum(m.duplicates for m in learned.values()),
        "learners that ended, with a policy": policies,
        "most s of the log unsaved by a kill": max(run.unsaved, default=0.0),
        "steps in neither log": judged.lost,
        "of them in a row": judged.longest,
        "s of the start": begun,
        "s until all go on, p50": recovery[len(recovery) // 2],
        "s until all go on, longest": recovery[-1],
    }
    return {name: {"value": float(value)} for name, value in said.items()}
