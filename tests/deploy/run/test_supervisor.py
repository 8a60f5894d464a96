"""Test that repeated failures end the run and accidents do not, however slowly a busy machine starts a process."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from brakeline.deploy.run import run_process, supervisor
from brakeline.deploy.run.processes import HOPELESS, ProcessSpec
from brakeline.deploy.run.supervisor import (
    HANGING_AFTER,
    HEALTHY_AFTER,
    MOST_FAILURES,
    START_ALLOWANCE,
    SupervisedProcess,
    describe_end,
    last_line,
)
from brakeline.errors import BadDescription, BadKeys, CommandLost, LaunchError, Mismatch
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.process_runtime import MAX_SILENCE


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Its one entry is what time it is, s."""
    now = [1000.0]
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: now[0])
    return now


class Failing(SupervisedProcess):
    """Ends with 1 at once; by the clock, when the test says."""

    def start(self, held: bool = False) -> None:
        self.popen = subprocess.Popen([sys.executable, "-c", "raise SystemExit(1)"])
        self.popen.wait()
        self.started, self.first_sign_of_life = supervisor.time.monotonic(), None


def lives(child: SupervisedProcess, clock: list[float], until_it_speaks: float | None, after: float) -> None:
    """One life: how long until its first sign of life, None: it gives none; and how long after that."""
    clock[0] = max(clock[0], child.next_start)
    child.supervise()
    assert child.popen is not None
    clock[0] += until_it_speaks or 0.0
    child.record_sign_of_life(child.popen.pid + 1)  # the one before it: too late to count
    if until_it_speaks is not None:
        child.record_sign_of_life(child.popen.pid)
    clock[0] += after
    child.supervise()


@pytest.mark.parametrize("speaks", [0.5, 200.0])
def test_however_slowly_it_starts_the_fifth_failure_in_a_row_ends_the_run(speaks, clock, tmp_path) -> None:
    child = Failing(ProcessSpec("learner", "learner", "ground"), tmp_path)
    for _ in range(MOST_FAILURES - 1):
        lives(child, clock, speaks, 2.0)
    with pytest.raises(LaunchError, match="5th time in a row"):
        lives(child, clock, speaks, 2.0)


@pytest.mark.parametrize(
    ("speaks", "after"), [(5.0, HEALTHY_AFTER + 1.0), (None, START_ALLOWANCE + HEALTHY_AFTER + 1.0)]
)
def test_a_process_that_was_healthy_may_fail_any_number_of_times(speaks, after, clock, tmp_path) -> None:
    child = Failing(ProcessSpec("autopilot", "autopilot"), tmp_path)
    for _ in range(3 * MOST_FAILURES):
        lives(child, clock, speaks, after)
    assert child.restarts == 3 * MOST_FAILURES and child.failures == 1


def test_a_run_goes_on_without_a_process_that_it_does_not_need(clock, tmp_path, caplog) -> None:
    child = Failing(ProcessSpec("certify.adapt", "certifier", needed=False), tmp_path)
    for _ in range(MOST_FAILURES):
        lives(child, clock, 0.5, 2.0)
    assert child.finished and "the run goes on without it" in caplog.text


class Hanging(SupervisedProcess):
    """Runs until it is killed."""

    def start(self, held: bool = False) -> None:
        self.popen = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600.0)"])
        self.started = supervisor.time.monotonic()


def test_a_process_that_hangs_is_reported_once_and_when_it_goes_on(clock, tmp_path, caplog) -> None:
    child = Hanging(ProcessSpec("actor-0", "actor", "ground"), tmp_path)
    child.supervise()
    assert child.popen is not None
    try:
        clock[0] += START_ALLOWANCE - 1.0
        child.end_if_silent()
        child.record_sign_of_life(child.popen.pid)
        clock[0] += MAX_SILENCE - 1.0
        child.end_if_silent()
        assert not caplog.text
        for _ in range(3):
            clock[0] += 1.5
            child.end_if_silent()
        assert caplog.text.count("actor-0 has given no sign of life for 10 s") == 1
        assert f"kill -9 {child.popen.pid}" in caplog.text
        child.record_sign_of_life(child.popen.pid)
        assert "actor-0 gives signs of life again" in caplog.text
        clock[0] += MAX_SILENCE + 1.0
        child.end_if_silent()
        assert caplog.text.count("no sign of life") == 2
    finally:
        child.popen.kill()
    child.popen.wait()
    child.supervise()
    assert child.restarts == 1, "as the report promises"
    child.end_if_silent()
    assert caplog.text.count("no sign of life") == 2


@pytest.mark.parametrize(
    ("kind", "speaks", "killed"), [("actor", True, True), ("actor", False, False), ("certifier", True, False)]
)
def test_a_process_that_goes_on_hanging_is_killed_and_starts_again(
    kind, speaks, killed, clock, tmp_path, caplog
) -> None:
    """Not one that may still import, nor a certifier in a long fit."""
    child = Hanging(ProcessSpec("one", kind, "ground"), tmp_path)
    child.supervise()
    assert child.popen is not None
    popen = child.popen
    popen.send_signal(signal.SIGSTOP)
    try:
        if speaks:
            child.record_sign_of_life(popen.pid)
        clock[0] += 3600.0  # also as after a sleep of the whole machine: the report comes first
        child.end_if_silent()
        clock[0] += HANGING_AFTER - 1.0
        child.end_if_silent()
        assert caplog.text.count("no sign of life") == 1 and "still" not in caplog.text
        clock[0] += 2.0
        child.end_if_silent()
        assert ("still gives no sign of life: killing it" in caplog.text) == killed
        if killed:
            popen.wait(20.0)
            child.supervise()
            assert child.restarts == 1 and not child.finished
    finally:
        popen.kill()
        popen.wait()


class Diverging(SupervisedProcess):
    """A process that says why no restart would help."""

    def start(self, held: bool = False) -> None:
        log = self.folder / "logs" / f"{self.spec.name}.log"
        log.parent.mkdir(exist_ok=True)
        log.write_text("learner: Diverged: lower the learning rates\n")
        self.popen = subprocess.Popen([sys.executable, "-c", f"raise SystemExit({HOPELESS})"])
        self.popen.wait()
        self.started, self.first_sign_of_life = supervisor.time.monotonic(), None


def test_a_process_that_a_restart_does_not_help_ends_the_run_at_once_with_its_own_words(clock, tmp_path) -> None:
    child = Diverging(ProcessSpec("learner", "learner", "ground"), tmp_path)
    with pytest.raises(LaunchError, match=r"^learner: Diverged: lower the learning rates; see "):
        lives(child, clock, 0.5, 2.0)


def test_the_output_of_a_process_may_be_larger_than_the_memory(tmp_path: Path) -> None:
    """The launcher read all of it to find the last line, and ended with a MemoryError."""
    with (tmp_path / "actor-0.log").open("wb") as file:
        file.seek(2**38)
        file.write(b"\nValueError: the reason\n\n")
    assert last_line(tmp_path / "actor-0.log") == "ValueError: the reason"
    (tmp_path / "short.log").write_text("a\nb\n")
    assert last_line(tmp_path / "short.log") == "b" and last_line(tmp_path / "none.log") == ""


def test_a_process_that_a_signal_without_a_name_has_killed_does_not_end_the_launcher() -> None:
    assert describe_end(-9, 1.0) == "was killed by SIGKILL after 1.0 s"
    assert describe_end(-40, 1.0) == "was killed by signal 40 after 1.0 s"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (CommandLost("our command of the vehicle has ended"), "CommandLost: our command of the vehicle has ended"),
        (
            BadDescription("my.toml", [("period", "must be positive"), ("body", "is missing")]),
            "BadDescription: my.toml is no robot's description: period: must be positive body: is missing",
        ),
        (Mismatch("the simulated ground has a larger body"), "Mismatch: the simulated ground has a larger body"),
        (BadKeys("the key is too short"), "BadKeys: the key is too short"),
    ],
)
def test_a_process_is_not_started_again_after_an_error_that_it_would_meet_again(
    error, said, tmp_path, monkeypatch, capsys
) -> None:
    """An actor that lost its command of a vehicle would also arm one that a person may have in hand, and take off."""

    def drive() -> bool:
        raise error

    spec = ProcessSpec("actor-0", "actor")
    monkeypatch.setattr(run_process, "PROCESSES", {"actor": lambda *_: drive})
    for name, result in (
        ("load", None),
        ("process_specs", [spec]),
        ("client_settings", BusSettings()),
        ("metrics_address", ""),
        ("launcher_pid", 1),
        ("end_with_parent", True),
    ):
        monkeypatch.setattr(run_process, name, lambda *_, result=result: result)
    monkeypatch.setattr(run_process.signal, "signal", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["run_process", str(tmp_path), spec.name])
    assert run_process.main() == HOPELESS
    assert capsys.readouterr().err == f"actor-0: {said}\n"
