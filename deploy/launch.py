"""Starts the processes of a run on this machine, watches and restarts them, shows what happens, and ends them all."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deploy import experiments
from deploy.child import CONFIG, ENDPOINT, KINDS, LOG, Place, places
from deploy.experiments import RunConfig
from deploy.store import model_for
from logs.metrics import Metrics
from messaging.bus import BusError, BusSettings, Malformed, Sample
from messaging.process import Process
from messaging.robots import robot_named
from messaging.topics import RECORDED

log = logging.getLogger("brakeline.launcher")

FIRST_BACKOFF, LONGEST_BACKOFF = 0.5, 10.0  # s before a restart, doubled each time ...
HEALTHY_AFTER = 20.0  # s of life after which the next backoff is the first one again
TURN = 0.1  # s
END_PATIENCE = 10.0  # s from SIGTERM to SIGKILL: a checkpoint may be in progress
QUIET = 0.5  # s without a message after which the last one has come
FIGURES = "figures.json"


class LaunchError(RuntimeError):
    """A run cannot be started; the message says what to do."""


@dataclass
class Child:
    """A process of the run, through its restarts."""

    place: Place
    folder: Path
    restarts: int = 0
    backoff: float = FIRST_BACKOFF
    popen: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    due: float = 0.0  # when to start it (again)
    finished: bool = False  # it ended with 0: its work is done
    history: list[str] = field(default_factory=list)

    def start(self) -> None:
        logs = self.folder / "logs"
        logs.mkdir(exist_ok=True)
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        with (logs / f"{self.place.name}.log").open("ab") as errors:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", "deploy.child", str(self.folder), self.place.name],
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                env=environment,
                start_new_session=True,  # ^C goes to the launcher alone, which ends them in order
            )
        self.started = time.monotonic()

    @property
    def alive(self) -> bool:
        return self.popen is not None and self.popen.poll() is None

    def watch(self) -> None:
        """Start it if that is due; see how it ended if it did."""
        now = time.monotonic()
        if self.finished or self.alive:
            return
        if self.popen is None:
            if now >= self.due:
                self.start()
            return
        code, lived = self.popen.returncode, now - self.started
        self.popen = None
        if code == 0:
            self.finished = True
            return
        self.backoff = FIRST_BACKOFF if lived > HEALTHY_AFTER else self.backoff
        self.due = now + self.backoff
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
        line = f"{self.place.name} {how} after {lived:.1f} s; starting it again in {self.backoff:.1f} s"
        self.backoff = min(2.0 * self.backoff, LONGEST_BACKOFF)
        self.restarts += 1
        self.history.append(line)
        log.error("%s (its last words: %s)", line, last_line(self.folder / "logs" / f"{self.place.name}.log"))

    def terminate(self) -> None:
        if self.popen is not None and self.alive:
            self.popen.terminate()

    def end(self, deadline: float) -> None:
        """Wait until the deadline, then kill."""
        if self.popen is None:
            return
        try:
            self.popen.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            log.error("%s did not end; killing it", self.place.name)
            self.popen.kill()
            self.popen.wait()


def last_line(path: Path) -> str:
    try:
        lines = path.read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1] if lines else ""


@dataclass
class View:
    """What a display needs to know of a run in progress."""

    config: RunConfig
    folder: Path
    metrics: Metrics
    children: list[Child]
    lines: deque[str]
    started: float
    ending: bool = False


def free_endpoint() -> str:
    """A TCP port of this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def prepare(config: RunConfig, folder: Path, resume: bool) -> None:
    """Model sets, the run's folder and its configuration.

    Raises:
        LaunchError: the folder holds another run.
    """
    if not resume and (folder / CONFIG).exists():
        raise LaunchError(f"{folder} holds a run already: give --resume {folder}, or another --out")
    if config.method != "none":
        for robot in config.robots:
            model_for(robot_named(robot), config.recipe)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_text(experiments.encode(config))
    latest = folder.parent / "latest"
    if latest.is_symlink() or not latest.exists():
        latest.unlink(missing_ok=True)
        latest.symlink_to(folder.name)


class Launcher:
    """A run from its first process to its last."""

    def __init__(self, config: RunConfig, folder: Path, endpoint: str | None = None) -> None:
        self.config, self.folder = config, folder
        self.endpoint = endpoint or free_endpoint()
        self.children = [Child(place, folder) for place in places(config)]
        assert all(child.place.kind in KINDS for child in self.children)
        self.metrics = Metrics()
        self.lines: deque[str] = deque(maxlen=200)
        self._inbox: deque[Sample] = deque()

    def run(self, show: Callable[[View], Any] = lambda view: None) -> dict[str, Any]:
        """Until the learners are done or SIGINT or SIGTERM; returns the figures, also saved in the run's folder."""
        view = View(self.config, self.folder, self.metrics, self.children, self.lines, time.monotonic())
        settings = BusSettings(listen=(self.endpoint,))
        with Process(settings, "launcher", stderr=False) as process:
            (self.folder / ENDPOINT).write_text(json.dumps({"endpoint": self.endpoint, "pid": os.getpid()}))
            for topic in RECORDED:
                process.bus.subscribe(topic, self._inbox.append)
            process.refresh = lambda: process.figures.update(
                {f"restarts {child.place.name}": child.restarts for child in self.children}
            )
            try:
                self._start_recorder(process)
                while not process.stop.is_set() and not self._done():
                    for child in self.children:
                        child.watch()
                    self._drain()
                    show(view)
                    process.stop.wait(TURN)
                view.ending = True
                show(view)
            finally:
                self._end()
            self._drain()
        self._drain()
        figures = self.figures()
        (self.folder / FIGURES).write_text(json.dumps(figures, indent=2))
        show(view)
        return figures

    def figures(self) -> dict[str, Any]:
        """As `analyse` would give them for the log, with what only the launcher knows."""
        setup = {
            "method": self.config.method,
            "certificate": self.config.recipe.certificate if self.config.method != "none" else None,
            "policy": "learning",
            "arena": self.config.arena,
            "seed": self.config.seed,
        }
        restarts = {child.place.name: child.restarts for child in self.children if child.restarts}
        paths = {"folder": str(self.folder), "log": str(self.folder / LOG), "policies": self.policies()}
        return setup | self.metrics.figures() | {"restarts": restarts} | paths

    def policies(self) -> list[str]:
        """The policy files that were saved."""
        return [str(path) for path in sorted(self.folder.glob("learner*/policy.safetensors"))]

    def _start_recorder(self, process: Process) -> None:
        """The recorder first, and nothing else before it listens: no message shall be missing in the log."""
        recorder = self.children[0]
        deadline = time.monotonic() + 15.0
        while not process.stop.is_set() and time.monotonic() < deadline:
            recorder.watch()
            self._drain()
            known = self.metrics.processes.get("recorder")
            if known is not None and known.notes.get("file"):
                return
            process.stop.wait(0.05)
        if not process.stop.is_set():
            log.error("the recorder does not record: %s", last_line(self.folder / "logs" / "recorder.log"))

    def _done(self) -> bool:
        """Have all learners finished? Then nobody needs the others."""
        return all(child.finished for child in self.children if child.place.kind == "learner")

    def _drain(self) -> None:
        while self._inbox:
            sample = self._inbox.popleft()
            try:
                message = sample.message()
            except Malformed as error:
                log.error("%s", error)
                continue
            self.metrics.add(sample.key, message)
            if sample.topic.name == "log" and message.level in ("WARNING", "ERROR"):
                self.lines.append(f"{message.process}: {message.text.splitlines()[0]}")

    def _end(self) -> None:
        """Everything but the recorder first, so that their last words are in the log."""
        recorder, others = self.children[0], self.children[1:]
        for group in (others, [recorder]):
            for child in group:
                child.terminate()
            deadline = time.monotonic() + END_PATIENCE
            while any(child.alive for child in group) and time.monotonic() < deadline:
                self._drain()
                time.sleep(0.02)
            for child in group:
                child.end(deadline)
            quiet = time.monotonic() + QUIET
            while time.monotonic() < quiet:
                if self._inbox:
                    quiet = time.monotonic() + QUIET
                self._drain()
                time.sleep(0.02)


__all__ = ["BusError", "LaunchError", "Launcher", "View", "prepare"]
