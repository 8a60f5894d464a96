"""A process of a run through its restarts."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run.processes import UNFINISHED, ProcessSpec

log = logging.getLogger("brakeline.launcher")

FIRST_BACKOFF, LONGEST_BACKOFF = 0.5, 10.0  # s before a restart, doubled each time ...
HEALTHY_AFTER = 20.0  # s from its first sign of life on after which the next backoff is the first one again
SPEAKS_AFTER = 60.0  # s from its start: a busy machine takes long to import what it needs, and not everybody speaks
MOST_FAILURES = 5  # in a row, none of them healthy: then it is no accident


class LaunchError(RuntimeError):
    """A run cannot be started; the message says what to do."""


@dataclass
class SupervisedProcess:
    """A process of the run, through its restarts."""

    place: ProcessSpec
    folder: Path
    restarts: int = 0
    failures: int = 0  # in a row
    popen: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    spoke: float | None = None  # when its first sign of life was heard
    due: float = 0.0  # when to start it (again)
    finished: bool = False  # it ended with 0: its work is done

    def start(self) -> None:
        logs = self.folder / "logs"
        logs.mkdir(exist_ok=True)
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        environment["MUJOCO_GL"] = "disable"  # nobody draws by it, and asking for a display is a process of its own
        with (logs / f"{self.place.name}.log").open("ab") as errors:
            self.popen = subprocess.Popen(
                [*PYTHON, "-m", "brakeline.deploy.run.run_process", str(self.folder), self.place.name],
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                env=environment,
                start_new_session=True,  # ^C goes to the launcher alone, which ends them in order
            )
        self.started, self.spoke = time.monotonic(), None

    @property
    def alive(self) -> bool:
        return self.popen is not None and self.popen.poll() is None

    def heard(self, pid: int) -> None:
        """A process of this name gave a sign of life."""
        if self.popen is not None and self.popen.pid == pid and self.spoke is None:
            self.spoke = time.monotonic()

    def watch(self) -> None:
        """Start it if that is due; see how it ended if it did.

        Raises:
            LaunchError: it fails again and again.
        """
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
        since = self.started + SPEAKS_AFTER if self.spoke is None else self.spoke
        self.failures = 1 if now - since > HEALTHY_AFTER else self.failures + 1
        how = ended(code, lived)
        log_file = self.folder / "logs" / f"{self.place.name}.log"
        words = f"its last words: {last_line(log_file) or 'none'}"
        if self.failures == MOST_FAILURES:
            raise LaunchError(
                f"{self.place.name} {how}, the {MOST_FAILURES}th time in a row; {words}; more in {log_file}"
            )
        backoff = min(FIRST_BACKOFF * 2.0 ** (self.failures - 1), LONGEST_BACKOFF)
        self.due = now + backoff
        self.restarts += 1
        log.error("%s %s; starting it again in %.1f s (%s)", self.place.name, how, backoff, words)

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


def ended(code: int, lived: float) -> str:
    """How a process ended that should not have."""
    if code < 0:
        return f"was killed by {signal.Signals(-code).name} after {lived:.1f} s"
    if code == UNFINISHED:
        return f"was asked to end after {lived:.1f} s, not by the launcher"
    return f"ended with {code} after {lived:.1f} s"


def last_line(path: Path) -> str:
    try:
        lines = path.read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1] if lines else ""
