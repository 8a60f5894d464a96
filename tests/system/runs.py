"""Start whole runs by the command line, watch them, and kill their processes."""

from __future__ import annotations

import io
import json
import signal
import subprocess
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, Self

import psutil

from brakeline.deploy import cli
from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run.processes import client_settings, launcher_pid
from brakeline.logs.metrics import Metrics
from brakeline.messaging.bus import Bus, BusSettings, Sample
from brakeline.messaging.topics import RECORDED
from tests.waiting import PATIENCE, until

BRAKELINE = (*PYTHON, "-m", "brakeline.deploy.cli")
OF_ITS_OWN = ("train", "safety", "learner")  # commands that are a process, or that start some
STRIDE = 200  # steps that a run takes within PATIENCE


def brakeline(*arguments: object, timeout: float = PATIENCE) -> subprocess.CompletedProcess[str]:
    """Run a command to its end. In this process, where it can: a new one would import everything again."""
    words = [*map(str, arguments)]
    if words[0] in OF_ITS_OWN:
        return subprocess.run([*BRAKELINE, *words], check=False, capture_output=True, text=True, timeout=timeout)
    return _in_this_process(words)


def succeeded(*arguments: object, timeout: float = PATIENCE) -> str:
    """Run a command, which must succeed. Returns what it prints."""
    done = brakeline(*arguments, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments: object) -> str:
    """Run a command that refuses its arguments, whichever it is. Returns its error message."""
    done = _in_this_process([*map(str, arguments)])
    assert done.returncode == 1 and "Traceback" not in done.stderr
    return done.stderr


def _in_this_process(words: list[str]) -> subprocess.CompletedProcess[str]:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = cli.main(words)
        except SystemExit as end:
            status = end.code
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


class Run:
    """A run in progress: `brakeline train` with the `debug` experiment, or another command that starts a run.

    At the end of the block the run and all its processes are killed.
    """

    def __init__(
        self,
        folder: Path,
        *arguments: object,
        fresh: bool = True,
        command: tuple[str, ...] = ("train", "ground", "--experiment", "debug"),
    ) -> None:
        self.folder = folder
        place = ("--out", folder) if fresh else ("--resume", folder)
        words = (*BRAKELINE, *(command if fresh else ("train",)), *place, *arguments)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._output = folder.parent / f"{folder.name}{'' if fresh else '-resumed'}.out"
        self.errors = self._output.with_suffix(".err")
        with self._output.open("w") as out, self.errors.open("w") as err:
            self.popen = subprocess.Popen([*map(str, words), "--json"], stdout=out, stderr=err)
        self._bus: Bus | None = None
        self.metrics = Metrics()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bus is not None:
            self._bus.close()
        for process in [self.popen, *self.children().values()]:
            process.kill()
        self.popen.wait()

    def children(self) -> dict[str, psutil.Process]:
        """Return the living processes of the run by name, without the launcher."""
        processes = {}
        for process in psutil.process_iter(["cmdline"]):
            words = process.info["cmdline"] or []
            if "brakeline.deploy.run.run_process" in words and str(self.folder) in words:
                processes[words[-1]] = process
        return processes

    def watch(self) -> Metrics:
        """Return the figures of all messages on the bus from now on."""

        def settings() -> BusSettings | None:
            try:
                return client_settings(self.folder) if launcher_pid(self.folder) == self.popen.pid else None
            except (OSError, ValueError):
                assert self.popen.poll() is None, self.errors.read_text()
                return None

        def take(sample: Sample) -> None:
            self.metrics.add(sample.key, sample.message(), sample.received)

        if self._bus is None:
            self._bus = Bus(until(settings, "an endpoint"), "viewer.test")
            for topic in RECORDED:
                self._bus.subscribe(topic, take)
        return self.metrics

    @property
    def there(self) -> tuple[object, ...]:
        """The options with which a command joins the bus of the run."""
        (endpoint,) = client_settings(self.folder).connect
        return "--connect", endpoint, "--keys", self.folder / "keys"

    def until_steps(self, count: int, actors: str = "actor-") -> None:
        """Wait for `count` more steps of the actors whose names begin so, as long as the run makes progress."""

        def steps() -> int:
            return sum(stats.steps for name, stats in metrics.actors.copy().items() if name.startswith(actors))

        metrics = self.watch()
        target = steps() + count
        while (done := steps()) < target:
            next_stop = min(done + STRIDE, target)
            until(lambda: steps() >= next_stop or self.popen.poll() is not None, f"{count} steps")  # noqa: B023
            assert self.popen.poll() is None, self.errors.read_text()

    def kill(self, name: str) -> None:
        """Kill a process (SIGKILL), and wait until the launcher has started it again."""
        victim = until(lambda: self.children().get(name), f"{name} lives")
        victim.kill()
        until(lambda: self.children().get(name, victim).pid != victim.pid, f"{name} is started again")
        until(lambda: not self._zombies(), "the launcher has reaped who ended")

    def _zombies(self) -> bool:
        try:
            return any(child.status() == psutil.STATUS_ZOMBIE for child in psutil.Process(self.popen.pid).children())
        except psutil.NoSuchProcess:  # a child ended in between: look again
            return True

    def end(self, number: signal.Signals | None = None) -> dict[str, Any]:
        """Wait for the end of the run, after a signal if you give one. Returns the printed figures."""
        if number is not None:
            self.popen.send_signal(number)
        self.popen.wait(PATIENCE)
        assert self.children() == {}, "processes are left"
        printed = self._output.read_text()
        assert printed.count("\n") == 1, f"one JSON object and nothing else: {printed}\n{self.errors.read_text()}"
        figures: dict[str, Any] = json.loads(printed)
        return figures
