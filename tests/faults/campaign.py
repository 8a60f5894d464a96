"""A run over five hosts with faults of six kinds, several at a time: kills, stops, full disks, clock jumps and more.

python -m benchmarks fault-campaign [--kills 1000] [--seed 0] [--folder runs/fault-campaign]

The other kinds are lost links and damaged files. The campaign has legs of 100 faults, each with a run of its own. A leg
draws one to twelve faults at a time; the next ones come when every process is back and both robots go on. Each leg adds
a line to `campaign-SEED.jsonl` in the folder; the same command goes on after the last line. At the end of a leg its
figures are compared with the logs, message by message, and each damaged file must have been named by what read it. The
logs of a leg with a mistake stay in the folder.
"""

from __future__ import annotations

import json
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from threading import Timer
from typing import Any

from benchmarks.timing import Figures
from brakeline.learner.checkpoint import CHECKPOINT, latest
from brakeline.logs.figure_tables import analyse
from brakeline.logs.reader import open_log
from brakeline.logs.segment import being_written
from tests.faults.five_hosts import CLOCKS, TURN, Fleet
from tests.faults.network_hosts import Hosts
from tests.faults.small_volume import SmallVolume
from tests.fuzz.mutations import flipped

ROBOTS = ("ground", "quadrotor")
CUT = (0.3, 6.0)  # s that a fault lasts
PROGRESS = 20  # steps of each robot between two groups of faults
PATIENCE = 240.0  # s until all goes on after a group
LAST = 300  # steps more, at the end
LEG = 100  # faults
MOST_AT_ONCE = 12
STAGGER = 0.5  # s, the longest time between two faults of a group
FARTHEST = 10.0  # h that a host's clock may be off: certificates are valid from a day before
VOLUME = 192  # MiB for each log and each learner
STARTED = ("resumed at step", " ready")  # log lines of a process that accepted what it read
KINDS = ("kill", "stop", "full disk", "clock jump", "lost link", "damaged file")


class Stuck(RuntimeError):
    """After a fault the run did not go on; the message names the missing processes."""


@dataclass
class Damage:
    """A file with a flipped bit, and where its reader has to name it."""

    path: Path
    named: Callable[[], bool]


@dataclass
class Leg:
    """One run with its faults."""

    fleet: Fleet
    random: Random
    volumes: dict[str, SmallVolume]
    counts: Counter[str] = field(default_factory=Counter)
    damages: list[Damage] = field(default_factory=list)
    recovery: list[float] = field(default_factory=list)  # s from each group of faults until all went on

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

    def group(self, most: int) -> str:
        """Make some faults at a time, undo them, and return their descriptions."""
        said, timers = [], []
        for _ in range(min(self.random.randint(1, MOST_AT_ONCE), most)):
            kind = self.random.choice(KINDS)
            self.counts[kind] += 1
            text, seconds, back = getattr(self, f"_{kind.replace(' ', '_')}")()
            said.append(text)
            timers.append(Timer(seconds, back))
            timers[-1].start()
            time.sleep(self.random.uniform(0.0, STAGGER))
        for timer in timers:
            timer.join()
        return ", ".join(said)

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

    def _kill(self) -> tuple[str, float, Callable[[], None]]:
        name = self.random.choice(list(self.fleet.spots))
        self._end(name)
        return f"kill -9 {name}", 0.0, lambda: None

    def _stop(self) -> tuple[str, float, Callable[[], None]]:
        spot = self.fleet.spots[self.random.choice(list(self.fleet.spots))]
        seconds, popen = self.random.uniform(*CUT), spot.popen
        assert popen is not None
        popen.send_signal(signal.SIGSTOP)
        return f"{spot.name} stopped for {seconds:.1f} s", seconds, lambda: popen.send_signal(signal.SIGCONT)

    def _full_disk(self) -> tuple[str, float, Callable[[], None]]:
        name = self.random.choice(list(self.volumes))
        seconds = self.random.uniform(*CUT)
        self.volumes[name].fill()
        return f"disk of {name} full for {seconds:.1f} s", seconds, self.volumes[name].free

    def _clock_jump(self) -> tuple[str, float, Callable[[], None]]:
        host = self.random.choice(list(CLOCKS_OF_ALL))
        hours = self.random.uniform(-FARTHEST, FARTHEST)
        self.fleet.hosts.set_clock(host, hours)
        return f"clock of host {host} set to {hours:+.2f} h", 0.0, lambda: None

    def _lost_link(self) -> tuple[str, float, Callable[[], None]]:
        hosts, host, seconds = self.fleet.hosts, self.random.randrange(6), self.random.uniform(*CUT)
        if host == 0:
            hosts.unjoin(1)
            return f"cable between the routers cut for {seconds:.1f} s", seconds, lambda: hosts.unjoin(1, joined=True)
        hosts.cut(host)
        return f"host {host} cut for {seconds:.1f} s", seconds, lambda: hosts.heal(host)

    def _damaged_file(self) -> tuple[str, float, Callable[[], None]]:
        what = self.random.choice(("log", "checkpoint", "model"))
        logs = [path for i in range(self.fleet.recorders) for path in self.fleet.log(i).parent.glob("*.mcap")]
        finished = [path for path in logs if path.stat().st_size and not being_written(path)]
        fresh = [path for path in finished if path not in {damage.path for damage in self.damages}]
        learner = f"learner-{self.random.choice(ROBOTS)}"
        root = self.fleet.folder / learner / CHECKPOINT
        if what == "log" and fresh:
            path = self.random.choice(fresh)
            self._flip(path)
            self.damages.append(Damage(path, lambda: _is_named(path)))
            return f"a bit of {path.parent.name}/{path.name}", 0.0, lambda: None
        if what == "checkpoint" and (root / "latest").exists():
            self._end(learner)
            path = self.random.choice([root / "latest", *sorted(latest(root).iterdir())])
            return self._damaged_start(learner, path)
        robot = self.random.choice(ROBOTS)
        models = self.fleet.folder / "data" / robot
        return self._damaged_start(
            f"safety-{self.random.randrange(2)}", self.random.choice(sorted(filter(Path.is_file, models.iterdir())))
        )

    def _damaged_start(self, name: str, path: Path) -> tuple[str, float, Callable[[], None]]:
        """Start a process with a damaged file, see it refuse the file, and give it the whole file back."""
        self._end(name)
        whole, output = self._flip(path), self.fleet.folder / f"{name}.out"
        before = output.stat().st_size if output.exists() else 0
        self.fleet.launch(name)
        deadline, spot = time.monotonic() + PATIENCE, self.fleet.spots[name]
        said, refused, started = "", False, False
        while not (refused or started) and time.monotonic() < deadline:
            time.sleep(TURN)
            ended = not spot.alive  # before the output is read, so that its last words are
            with output.open("rb") as file:
                file.seek(before)
                said = file.read().decode(errors="replace")
            started = any(word in said for word in STARTED)
            refused = ended and not spot.done and (path.stem in said or path.name in said)
            if ended and not refused:
                self.fleet.keep()  # other faults kept it from the file: start it again, as a container engine does
        # A space, or a letter of a hexadecimal number: the signature or the number is the same.
        same = path.suffix in (".seal", "") and started
        if not (refused or same):
            print(f"{name} did not name {path.name}: {said}", file=sys.stderr, flush=True)
        self.damages.append(Damage(path, lambda: refused or same))
        self.counts["damaged file, the same in meaning"] += same
        self._end(name)
        _overwrite(path, whole)
        return f"a bit of {path.name}, which {name} reads", 0.0, lambda: None

    def _end(self, name: str) -> None:
        if self.fleet.spots[name].alive:
            self.fleet.kill(name)

    def _flip(self, path: Path) -> bytes:
        """Flip a bit of a file. Returns the file as it was."""
        whole = path.read_bytes()
        _overwrite(path, flipped(whole, self.random.randrange(len(whole)), self.random.randrange(8)))
        return whole


def _overwrite(path: Path, data: bytes) -> None:
    """Write as many bytes as the file has, in place: its disk may be full."""
    with path.open("r+b") as file:
        file.write(data)


CLOCKS_OF_ALL = {host: CLOCKS.get(host, 0.0) for host in range(1, 6)}


def _is_named(path: Path) -> bool:
    """Return whether the reader names the damage of a log, and still reads it to the end."""
    log = open_log([path])
    for _ in log:
        pass
    return bool(log.cuts or log.malformed)


@dataclass
class Recorded:
    """The steps in the log of a recorder."""

    steps: dict[tuple[str, int, int], bool] = field(default_factory=dict)  # key, run and number: a collision or not
    twice: int = 0


def recorded(log_file: Path) -> Recorded:
    """Read a log."""
    found = Recorded()
    for record in open_log(log_file):
        if record.topic == "step":
            header = record.message.header
            step = record.key, header.run, header.sequence
            found.twice += step in found.steps
            found.steps.setdefault(step, record.message.collision)
    return found


def wrong_figures(fleet: Fleet, logs: list[Recorded], elapsed: float) -> list[str]:
    """Compare the figures of each recorder's log with its messages. Returns what is wrong."""
    wrong = []
    for recorder, log in enumerate(logs):
        figures = analyse(fleet.log(recorder))
        last: dict[tuple[str, int], int] = {}
        for key, run, number in log.steps:
            last[key, run] = max(last.get((key, run), 0), number)
        lost = sum(last.values()) - len(log.steps)
        counted = sum(topic["missing"] for key, topic in figures["topics"].items() if key.startswith("step/"))
        for name, said, true in (
            ("steps", figures["steps"] + figures["refused"], len(log.steps)),
            ("refused", figures["refused"], 0),
            ("collisions", figures["collisions"], sum(log.steps.values())),
        ):
            if said != true:
                wrong.append(f"recorder-{recorder}: {name} {said}, not {true}")
        if counted < lost:
            wrong.append(f"recorder-{recorder}: {counted} steps missing, at least {lost} are")
        if not 0.0 < figures["seconds"] <= elapsed:
            wrong.append(f"recorder-{recorder}: {figures['seconds']:.1f} s, but the run took {elapsed:.1f} s")
    for robot in ROBOTS:
        learned = fleet.metrics.learners.get(robot)
        if learned is not None and learned.duplicates:
            wrong.append(f"learner-{robot}: {learned.duplicates} duplicates")
    return wrong


def leg(seed: str, faults: int, evidence: Path) -> dict[str, Any]:
    """Make a run with faults, and judge it. Raises NoHosts, and CalledProcessError if nothing can be mounted here.

    Args:
        seed: of the faults.
        faults: how many.
        evidence: the logs and outputs of a leg with a mistake are copied to this folder.
    """
    random, began = Random(seed), time.monotonic()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="campaign")))
        hosts = stack.enter_context(Hosts(5, CLOCKS_OF_ALL))
        hosts.join(1, 2)
        small = ("recorder-0", "recorder-1", *(f"learner-{robot}" for robot in ROBOTS))
        volumes = {name: stack.enter_context(SmallVolume(folder / name, VOLUME)) for name in small}
        fleet = stack.enter_context(Fleet(folder, hosts, ROBOTS, seed=random.randrange(10**6)))
        stack.callback(hosts.close)  # before the volumes go
        fleet.start()
        run = Leg(fleet, random, volumes)
        stuck = ""
        try:
            run.settle()
            while (left := faults - sum(run.counts[kind] for kind in KINDS)) > 0:
                said = run.group(left)
                run.settle()
                print(f"{faults - left}: {said}: {run.recovery[-1]:.1f} s", file=sys.stderr, flush=True)
            run.finish()
        except Stuck as error:
            stuck = str(error)
            hosts.close()  # kills every process
        logs = [recorded(fleet.log(recorder)) for recorder in range(fleet.recorders)]
        steps = {step: collision for log in logs for step, collision in log.steps.items()}
        elapsed = time.monotonic() - began
        row = {
            "seed": seed,
            "faults": dict(run.counts),
            "steps": len(steps),
            "steps twice in a log": sum(log.twice for log in logs),
            "collisions": sum(steps.values()),
            "damaged": len(run.damages),
            "not named": [damage.path.name for damage in run.damages if not damage.named()],
            "wrong": wrong_figures(fleet, logs, elapsed),
            "stuck": stuck,
            "longest recovery": max(run.recovery, default=0.0),
            "minutes": elapsed / 60.0,
        }
        if any(row[what] for what in ("steps twice in a log", "collisions", "not named", "wrong", "stuck")):
            shutil.copytree(folder, evidence, ignore=shutil.ignore_patterns("keys", "data", "ballast"))
        return row


def campaign(faults: int, seed: int, folder: Path) -> Figures:
    """Run the legs that the folder lacks, and return the figures of all of them. Raises as `leg`."""
    folder.mkdir(parents=True, exist_ok=True)
    results = folder / f"campaign-{seed}.jsonl"
    while (done := sum(row["faults"].get(kind, 0) for row in _rows(results) for kind in KINDS)) < faults:
        number = len(_rows(results))
        print(f"leg {number}, after {done} of {faults} faults", file=sys.stderr, flush=True)
        if number and not any(_rows(results)[-1]["faults"].values()):
            raise Stuck(f"the last leg made no fault: {_rows(results)[-1]['stuck']}")
        row = leg(f"{seed}/{number}", min(LEG, faults - done), folder / f"leg-{seed}-{number}")
        with results.open("a") as file:
            file.write(json.dumps(row) + "\n")
    return table(_rows(results))


def _rows(results: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []


def table(rows: list[dict[str, Any]]) -> Figures:
    """Sum the results of legs."""
    counts: Counter[str] = Counter()
    for row in rows:
        counts.update(row["faults"])
    said: dict[str, float] = {
        "legs": len(rows),
        "faults": sum(counts[kind] for kind in KINDS),
        **{f"faults: {kind}": counts[kind] for kind in KINDS},
        **{name: sum(row[name] for row in rows) for name in ("steps", "steps twice in a log", "collisions", "damaged")},
        "damaged, but the same in meaning": counts["damaged file, the same in meaning"],
        "damage that nothing named": sum(len(row["not named"]) for row in rows),
        "figures that were wrong": sum(len(row["wrong"]) for row in rows),
        "legs that did not go on": sum(bool(row["stuck"]) for row in rows),
        "s until all go on, longest": max((row["longest recovery"] for row in rows), default=0.0),
        "minutes": sum(row["minutes"] for row in rows),
    }
    return {name: {"value": float(value)} for name, value in said.items()}
