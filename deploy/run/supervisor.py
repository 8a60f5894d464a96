"""Start a process of a run, and restart it when it fails."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from brakeline.deploy.interpreter import ONE_THREAD, PYTHON
from brakeline.deploy.run.processes import HELD, HOPELESS, UNFINISHED, ProcessSpec
from brakeline.errors import LaunchError
from brakeline.messaging.process_runtime import MAX_SILENCE

log = logging.getLogger("brakeline.launcher")

RUN_PROCESS = (*PYTHON, "-m", "brakeline.deploy.run.run_process")
FIRST_BACKOFF, LONGEST_BACKOFF = 0.5, 10.0  # s from a failure to the restart; doubles with each failure in a row
HEALTHY_AFTER = 20.0  # s after its first sign of life at which a process counts as healthy
START_ALLOWANCE = 60.0  # s from the start of a process that gives no sign of life: imports are slow on a busy machine
HANGING_AFTER = 50.0  # s from the report of silence until the process is killed; a busy machine needs far less
LONG_WORK = ("certifier",)  # kinds whose compiled code may hold up signs of life for longer
LAST_BYTES = 2**16  # of a process's output, in which its last line is looked for
MOST_FAILURES = 5  # in a row, none of them after a healthy time, before the run ends


@dataclass
class SupervisedProcess:
    """A process of a run, with its restarts."""

    spec: ProcessSpec
    folder: Path
    restarts: int = 0
    failures: int = 0  # in a row, none of them after a healthy time
    popen: subprocess.Popen[bytes] | None = None
    started: float = 0.0  # monotonic time [s], as of the signs of life and of `next_start`
    first_sign_of_life: float | None = None
    last_sign_of_life: float | None = None
    reported_silent: float | None = None  # when
    next_start: float = 0.0
    finished: bool = False  # it ended with status 0: its work is done

    def start(self, held: bool = False) -> None:
        """Start the process. Its output goes to logs/NAME.log in the run's folder.

        Args:
            held: let it only import; it begins after `release`.
        """
        logs = self.folder / "logs"
        logs.mkdir(exist_ok=True)
        # MuJoCo draws nothing; looking for a display would start another process.
        environment = os.environ | ONE_THREAD | {"MUJOCO_GL": "disable"}
        with (logs / f"{self.spec.name}.log").open("ab") as errors:
            self.popen = subprocess.Popen(
                [*RUN_PROCESS, *([HELD] if held else []), str(self.folder), self.spec.name],
                stdin=subprocess.PIPE if held else subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                env=environment,
                start_new_session=True,  # ^C reaches only the launcher, which ends the processes in order
            )
        self.started, self.first_sign_of_life, self.last_sign_of_life = time.monotonic(), None, None
        self.reported_silent = None

    def release(self) -> None:
        """Let a process that was started as `held` begin."""
        if self.popen is not None and self.popen.stdin is not None:
            self.popen.stdin.close()

    @property
    def alive(self) -> bool:
        return self.popen is not None and self.popen.poll() is None

    def record_sign_of_life(self, pid: int) -> None:
        """Note a health message of the process with this id and this name."""
        if self.popen is None or self.popen.pid != pid:
            return
        now = time.monotonic()
        if self.reported_silent is not None:
            log.warning("%s gives signs of life again", self.spec.name)
        self.reported_silent = None
        self.first_sign_of_life = now if self.first_sign_of_life is None else self.first_sign_of_life
        self.last_sign_of_life = now

    def end_if_silent(self) -> None:
        """Log once that the process runs but gives no sign of life, and later kill it: then it starts again.

        Call it when no health message waits. Not ended are a process that has not given any sign of life yet, which may
        still import, and one of `LONG_WORK`. The time counts from the report, so that a whole machine that was stopped
        for a while ends nothing.
        """
        if self.popen is None or not self.alive:
            return
        now, last = time.monotonic(), self.last_sign_of_life
        ends = last is not None and self.spec.kind not in LONG_WORK
        if self.reported_silent is None:
            since, most = (self.started, START_ALLOWANCE) if last is None else (last, MAX_SILENCE)
            if now - since > most:
                self.reported_silent = now
                self._log_silence(now - since, ends)
        elif ends and now - self.reported_silent > HANGING_AFTER:
            log.error("%s still gives no sign of life: killing it", self.spec.name)
            self.reported_silent = now
            self.popen.kill()

    def _log_silence(self, seconds: float, ends: bool) -> None:
        """Say what the silence may be, and what to do. ends: whether the launcher kills the process if it goes on."""
        assert self.popen is not None
        end = f"`kill -9 {self.popen.pid}`"
        advice = f"If it hangs, end it with {end}: the launcher starts it again"
        if ends:
            advice = f"After {HANGING_AFTER:.0f} s more, the launcher kills it and starts it again. To do so now: {end}"
        message = "%s has given no sign of life for %.0f s: it hangs, or the machine is too busy. %s"
        log.error(message, self.spec.name, seconds, advice)

    def supervise(self) -> None:
        """Start the process if it is time, and schedule a restart if it has failed.

        Raises:
            LaunchError: it failed MOST_FAILURES times in a row, or says itself that a restart would not help, and the
                run needs it.
        """
        now = time.monotonic()
        if self.finished or self.alive:
            return
        if self.popen is None:
            if now >= self.next_start:
                self.start()
            return
        code, lifetime = self.popen.returncode, now - self.started
        self.popen = None
        if code == 0:
            self.finished = True
            return
        first_sign = self.first_sign_of_life
        ready = self.started + START_ALLOWANCE if first_sign is None else first_sign
        self.failures = 1 if now - ready > HEALTHY_AFTER else self.failures + 1
        ending = describe_end(code, lifetime)
        log_file = self.folder / "logs" / f"{self.spec.name}.log"
        message = last_line(log_file)
        output = f"its last output: {message or 'none'}"
        if code == HOPELESS and self.spec.needed:
            raise LaunchError(f"{message}; see {log_file}")
        if self.failures == MOST_FAILURES:
            message = f"{self.spec.name} {ending}, the {MOST_FAILURES}th time in a row; {output}; see {log_file}"
            if self.spec.needed:
                raise LaunchError(message)
            self.finished = True
            log.error("%s; the run goes on without it", message)
            return
        backoff = min(FIRST_BACKOFF * 2.0 ** (self.failures - 1), LONGEST_BACKOFF)
        self.next_start = now + backoff
        self.restarts += 1
        log.error("%s %s; starting it again in %.1f s (%s)", self.spec.name, ending, backoff, output)

    def terminate(self) -> None:
        if self.popen is not None and self.alive:
            self.popen.terminate()

    def end(self, deadline: float) -> None:
        """Wait for the end of the process until the deadline (monotonic time [s]), then kill it."""
        if self.popen is None:
            return
        try:
            self.popen.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            log.error("%s did not end; killing it", self.spec.name)
            self.popen.kill()
            self.popen.wait()


def describe_end(code: int, lifetime: float) -> str:
    """Say how a process ended too early. code: exit status; lifetime [s]."""
    if code < 0:
        name = next((one.name for one in signal.Signals if one == -code), f"signal {-code}")  # of real time: no name
        return f"was killed by {name} after {lifetime:.1f} s"
    if code == UNFINISHED:
        return f"was asked to end after {lifetime:.1f} s, not by the launcher"
    return f"ended with {code} after {lifetime:.1f} s"


def last_line(path: Path) -> str:
    """Return the last line of a text file, which may be of any size; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_BYTES))
            lines = file.read(LAST_BYTES).decode(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1] if lines else ""
