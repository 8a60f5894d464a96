"""Measure what a step of a whole run costs in processor time: by process in real runs, and by stage in one thread.

    python -m benchmarks step                       # processes and stages of this checkout
    python -m benchmarks step --against ../main     # the same runs of both checkouts at once, and their ratios

Both run at once, so that other load on the machine slows both alike; the steps a second then say little. The runs train
with two actors and a log. The learner makes few updates, so that it does not set the pace.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.step_stages import stages
from benchmarks.timing import Figures, processor_times
from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run.processes import ENDPOINT, client_settings
from brakeline.messaging.bus import Bus, Sample
from brakeline.messaging.task import robot_with_task
from brakeline.messaging.topics import HEALTH

HERE = Path(__file__).parents[1]
ROBOTS = ("ground", "quadrotor")
ACTORS = 2
STEPS = {"ground": 9000, "quadrotor": 6000}
WARM_UP = 1500  # steps that do not count: caches fill, and the first QPs are set up
PAIRS = 3
# One update for fifty steps, and permission far ahead: the learner never sets the pace.
LEARNER = (*("--learner.td3.updates-per-step", "0.02"), *("--learner.window", "256"), *("--learner.ahead", "4096"))


class Run:
    """A training that is watched from outside: the steps of its actors, and the processor time of its processes.

    Attributes:
        steps: for each actor, the times [s] and counts of its signs of life.
        used: for each process, the times [s] and its processor time until then [s].
    """

    def __init__(self) -> None:
        self.steps: dict[str, list[tuple[float, float]]] = {}
        self.used: dict[str, list[tuple[float, float]]] = {}

    def take(self, sample: Sample) -> None:
        message = sample.message()
        if message.process.startswith("actor") and message.figures["steps"]:
            self.steps.setdefault(message.process, []).append((time.monotonic(), message.figures["steps"]))

    def look(self, launcher: int) -> None:
        """Read the processor times of the launcher and of the processes that it started."""
        now = time.monotonic()
        for name, spent in processor_times(launcher).items():
            self.used.setdefault(name, []).append((now, spent))

    def taken(self, at: float) -> float:
        """Return the number of steps of all actors until a time."""
        return sum(_at(at, series) for series in self.steps.values())

    def figures(self) -> dict[str, float]:
        """Return the processor time of a step by role [µs], in all, and the steps a second, after the warm-up."""
        end = min(series[-1][0] for series in self.steps.values())
        begin = next(at for at, _ in self.used["launcher"] if self.taken(at) >= WARM_UP)
        steps = self.taken(end) - self.taken(begin)
        costs: dict[str, float] = {}
        for name, series in self.used.items():
            role = "launcher, router" if name == "launcher" else name.partition("-")[0]
            costs[role] = costs.get(role, 0.0) + 1e6 * (_at(end, series) - _at(begin, series)) / steps
        return {**costs, "all": sum(costs.values()), "steps/s": steps / (end - begin)}


def _at(time: float, series: list[tuple[float, float]]) -> float:
    """Return the value of a series of times and values at a time."""
    times, values = np.array(series).T
    return float(np.interp(time, times, values))


@contextmanager
def _training(tree: Path, robot: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a training with the code of a checkout, and end it with the block."""
    command = [*PYTHON, "-m", "brakeline.deploy.cli", "train", robot, "--out", str(folder)]
    command += ["--steps", str(STEPS[robot]), "--actors", str(ACTORS), *LEARNER]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    with folder.with_suffix(".txt").open("wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output, cwd=folder.parent)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()


def watched(tree: Path, robot: str) -> dict[str, float]:
    """Run a training with the code of a checkout, and return its figures. Raises RuntimeError if it does not start."""
    run = Run()
    with tempfile.TemporaryDirectory(prefix="step") as name:
        folder = Path(name) / "run"
        with _training(tree, robot, folder) as process:
            while not (folder / ENDPOINT).exists():
                if process.poll() is not None:
                    raise RuntimeError(folder.with_suffix(".txt").read_text()[-2000:])
                time.sleep(0.1)
            with Bus(client_settings(folder), "viewer") as bus:
                bus.subscribe(HEALTH, run.take)
                while process.poll() is None and run.taken(time.monotonic()) < 0.9 * STEPS[robot]:
                    run.look(process.pid)
                    time.sleep(0.2)
    return run.figures()


def run(against: Path | None = None) -> Figures:
    """Return a row for the processes and one for the stages of each robot [µs a step].

    Args:
        against: another checkout. It adds its row of processes, and the ratios of `PAIRS` pairs of runs.
    """
    figures: Figures = {}
    trees = {"": HERE} | ({} if against is None else {", against": against.resolve()})
    for robot in ROBOTS:
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
        for _ in range(1 if against is None else PAIRS):
            with ThreadPoolExecutor(len(trees)) as pool:
                for name, row in zip(trees, pool.map(partial(watched, robot=robot), trees.values()), strict=True):
                    rows[name].append(row)
        for name, some in rows.items():
            figures[f"{robot}{name}: processes"] = {k: float(np.median([row[k] for row in some])) for k in some[0]}
        if against is not None:
            ratios = {key: [a[key] / b[key] for a, b in zip(*rows.values(), strict=True)] for key in rows[""][0]}
            for what, of in (("median", np.median), ("least", np.min), ("largest", np.max)):
                figures[f"{robot}: ratio, {what}"] = {key: float(of(some)) for key, some in ratios.items()}
        figures[f"{robot}: stages"] = stages(robot_with_task(robot))
    return figures
