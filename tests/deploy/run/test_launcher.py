"""Test the launcher against malformed messages, and its processes against modules in the working directory."""

import errno
import fcntl
import itertools
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from brakeline.actors.actor_settings import FlightSettings
from brakeline.deploy.commands.common_options import RunBusOptions
from brakeline.deploy.commands.train_command import train
from brakeline.deploy.interpreter import spawning
from brakeline.deploy.run.launcher import Launcher, prepare
from brakeline.deploy.run.processes import CONFIG, UNFINISHED, ProcessSpec, write_endpoint
from brakeline.deploy.run.run_config import BATCH, EXPERIMENTS, RunConfig, encode, load
from brakeline.deploy.run.run_keys import make_run_keys
from brakeline.deploy.run.run_lock import only_launcher
from brakeline.deploy.run.supervisor import SupervisedProcess
from brakeline.errors import DamagedPart, LaunchError
from brakeline.learner import checkpoint
from brakeline.learner.checkpoint import CHECKPOINT
from brakeline.logs.segment import Entry, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.topics import EPISODE, EXCHANGE, HEALTH, LOG, STEP, Topic
from tests.deploy.run.test_display import rows_of
from tests.waiting import PATIENCE, until


def launcher_in(folder: Path) -> Launcher:
    return Launcher(RunConfig(), folder, BusSettings(listen=("tcp/127.0.0.1:7447",)))


@pytest.fixture
def launcher(tmp_path: Path) -> Launcher:
    return launcher_in(tmp_path)


def say(launcher: Launcher, topic: Topic, message: object) -> None:
    payload = message if isinstance(message, bytes) else message.SerializeToString()
    launcher._inbox.put(Sample(topic, topic.at(robot="ground", source="a"), payload, 1))
    launcher._drain()


@pytest.mark.parametrize("text", ["", "\n", " \r\n\n"])
def test_an_empty_error_message_does_not_end_the_launcher(launcher: Launcher, text: str) -> None:
    say(launcher, LOG, pb.LogLine(process="a", level="ERROR", text=text))
    say(launcher, LOG, pb.LogLine(header=pb.Header(sequence=2), process="a", level="ERROR", text="words"))
    assert list(launcher.lines) == ["a: ", "a: words"]


def test_the_launcher_skips_messages_that_it_cannot_handle(launcher: Launcher) -> None:
    for topic in (LOG, HEALTH, STEP, EPISODE, EXCHANGE):
        say(launcher, topic, b"\xff\xff")
    say(launcher, STEP, pb.Step(header=pb.Header(time=float("inf")), actor="a"))
    assert launcher._rejected.count == 6
    say(launcher, STEP, pb.Step(actor="a"))
    assert launcher.metrics.figures()["steps"] == 1


def test_the_launchers_figures_stay_bounded(launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.logs.metrics.MOST_STREAMS", 100)
    monkeypatch.setattr("brakeline.logs.metrics.MOST_NAMES", 100)
    for number in range(300):
        header = pb.Header(run=number)
        say(launcher, STEP, pb.Step(header=header, actor=f"a{number}"))
        say(launcher, HEALTH, pb.Health(header=header, process=f"p{number}", published={f"step/{number}": 1}))
        say(launcher, LOG, pb.LogLine(header=header, level=f"LEVEL{number}"))
        say(launcher, EXCHANGE, pb.Exchange(header=header, request=pb.Request(actor="a"), failure=f"F{number}"))
    metrics = launcher.metrics
    reasons = metrics.figures()["no_decision"]
    assert max(map(len, (metrics.streams, metrics.actors, metrics.processes, metrics.log_lines, reasons))) <= 100
    assert launcher._rejected.count > 0


def test_processes_do_not_import_modules_of_the_working_directory(tmp_path, monkeypatch) -> None:
    """A launched process and a worker of `compare` begin as usual, with the packages that this process has."""
    for name in ("safetensors", "zenoh", "numpy", "pickle", "deploy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'run')!r}, 'a').write({name!r})")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.json").write_text(encode(EXPERIMENTS["debug"]))
    (tmp_path / "endpoint").write_text('{"endpoint": "tcp/127.0.0.1:1", "pid": 1}')
    child = SupervisedProcess(ProcessSpec("actor-0", "actor", "ground"), tmp_path)
    child.start()
    assert child.popen is not None and child.popen.wait(60.0) == UNFINISHED, "its launcher is another"
    worker = spawning().Process(target=os.getcwd)
    worker.start()
    worker.join(60.0)
    assert worker.exitcode == 0
    assert not (tmp_path / "run").exists(), (tmp_path / "run").read_text()


def test_a_held_process_imports_and_does_not_connect_before_it_is_released(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(encode(EXPERIMENTS["debug"]))
    with socket.create_server(("127.0.0.1", 0)) as bus:
        endpoint = f"tcp/127.0.0.1:{bus.getsockname()[1]}"
        (tmp_path / "endpoint").write_text(json.dumps({"endpoint": endpoint, "pid": os.getpid()}))
        child = SupervisedProcess(ProcessSpec("recorder", "recorder"), tmp_path)
        child.start(held=True)
        assert child.popen is not None
        call, read = Path(f"/proc/{child.popen.pid}/syscall"), ("0", "63")  # numbers of `read`: x86-64, ARM
        until(lambda: call.read_text().startswith(tuple(f"{one} 0x0 " for one in read)), "it reads its input")
        bus.setblocking(False)
        with pytest.raises(BlockingIOError):
            bus.accept()
        child.release()
        bus.settimeout(PATIENCE)
        bus.accept()[0].close()
        child.terminate()
        child.end(time.monotonic() + PATIENCE)


def test_a_worker_does_not_change_how_a_users_own_scripts_start(tmp_path, monkeypatch) -> None:
    """A script imports its neighbour, also after this process has started a worker, which must not do so."""
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    worker = spawning().Process(target=os.getcwd)
    worker.start()
    worker.join(60.0)
    (tmp_path / "neighbour.py").write_text("")
    (tmp_path / "script.py").write_text("import neighbour")
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, check=True)


def test_a_run_whose_checkpoint_is_lost_is_not_resumed_at_step_0(tmp_path: Path) -> None:
    config = RunConfig(method="none")
    with pytest.raises(LaunchError, match=f"no checkpoint in .*--resume {tmp_path} --from-logs {tmp_path}"):
        prepare(config, tmp_path, resume=True)
    root = tmp_path / "learner" / CHECKPOINT
    checkpoint.save(root, {}, {})
    prepare(config, tmp_path, resume=True)
    (root / "000001").rename(tmp_path / "elsewhere")
    with pytest.raises(DamagedPart, match="latest"):
        prepare(config, tmp_path, resume=True)
    prepare(replace(config, from_logs=(str(tmp_path),)), tmp_path, resume=True)


@pytest.mark.parametrize("kind", [{"backend": BATCH}, {"deterministic": True, "actors": 1}])
def test_a_run_that_cannot_learn_from_its_log_is_not_told_to(tmp_path: Path, kind: dict[str, Any]) -> None:
    with pytest.raises(LaunchError, match=r"there is no checkpoint in .*Begin anew in another folder") as refused:
        prepare(RunConfig(method="none", **kind), tmp_path, resume=True)
    assert "--from-logs" not in str(refused.value)


@pytest.mark.parametrize("logs", [(), ("runs/a",)])
def test_a_resumed_run_keeps_its_configuration_if_it_has_more_steps_than_are_asked_for(
    tmp_path: Path, logs: tuple[str, ...]
) -> None:
    config = RunConfig(method="none", steps=5000, from_logs=logs)
    (tmp_path / CONFIG).write_text(encode(config))
    checkpoint.save(tmp_path / "learner" / CHECKPOINT, {}, {"steps": 5003})  # to the end of the last episode
    with pytest.raises(LaunchError, match=r"has 5003 steps already, more than --steps 4000. To go on, give more"):
        prepare(replace(config, steps=4000), tmp_path, resume=True)
    for steps in (5000, 6000):
        assert prepare(replace(config, steps=steps), tmp_path, resume=True).steps == steps
    checkpoint.save(tmp_path / "learner" / CHECKPOINT, {}, {"steps": 3000})
    prepare(replace(config, steps=4000), tmp_path, resume=True)  # ends earlier than planned


def test_a_learner_with_a_checkpoint_gets_no_logs_of_another_run(tmp_path: Path) -> None:
    """Their actors have the names of its own, so that it took their episodes for those that it had."""
    config, folder = RunConfig(method="none", steps=5000, from_logs=("runs/earlier",)), tmp_path / "run"
    folder.mkdir()
    (folder / CONFIG).write_text(encode(config))
    own = (str(folder), f"{folder}/../run/run.mcap", "runs/earlier")
    with_other = replace(config, from_logs=(str(folder), "runs/other"))
    prepare(with_other, folder, resume=True)  # the checkpoint is lost
    checkpoint.save(folder / "learner" / CHECKPOINT, {}, {"steps": 3000})
    for logs in ((), own):
        prepare(replace(config, from_logs=logs), folder, resume=True)
    with pytest.raises(LaunchError, match=r"3000 steps of its own, and would take steps of runs/other for.* new run"):
        prepare(with_other, folder, resume=True)


@contextmanager
def running_elsewhere(folder: Path) -> Iterator[None]:
    """Hold the lock of a run's folder in another process."""
    hold = f"""
import time
from pathlib import Path
from brakeline.deploy.run.run_lock import only_launcher
with only_launcher(Path({str(folder)!r})):
    print("held", flush=True)
    time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
            yield
        finally:
            holder.kill()


def test_a_run_that_is_running_is_not_resumed_and_its_lock_ends_with_its_process(tmp_path: Path) -> None:
    write_endpoint(tmp_path, BusSettings(listen=("tcp/127.0.0.1:7447",)))
    with running_elsewhere(tmp_path), pytest.raises(LaunchError, match=rf"is running \(process {os.getpid()}\)"):
        launcher_in(tmp_path).run()
    with only_launcher(tmp_path):
        pass


def test_a_resumption_changes_nothing_of_a_run_that_is_running(tmp_path: Path) -> None:
    """Before, it wrote new keys, with which the processes of the run could not start again."""
    config = RunConfig(method="none")
    (tmp_path / CONFIG).write_text(encode(config))
    make_run_keys(config, tmp_path)
    checkpoint.save(tmp_path / "learner" / CHECKPOINT, {}, {})
    write_endpoint(tmp_path, BusSettings(listen=("tcp/127.0.0.1:7447",)))
    with running_elsewhere(tmp_path):
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        with pytest.raises(LaunchError, match="is running"):
            train(config, tmp_path, True, RunBusOptions(), as_json=True)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_run_begins_on_a_file_system_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with only_launcher(tmp_path):
        pass


@pytest.mark.parametrize("text", ["", "[]", "\xff", '{"a":' * 100_000, '{"steps": 1e999}', '{"robots": 5}'])
def test_a_damaged_configuration_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_bytes(text.encode("latin1"))
    with pytest.raises(ValueError, match=r"config\.json is no run's configuration"):
        load(tmp_path / "config.json")


def test_the_summary_says_what_the_log_lacks_not_what_the_launcher_missed(tmp_path: Path, launcher: Launcher) -> None:
    """The launcher heard all ten steps; the recorder wrote six, then the disk was full."""
    launcher._earlier = {tmp_path / "run.mcap"}
    for name, count in (("run.mcap", 10), ("run_0001.mcap", 4), ("run_0002.mcap", 2)):
        segment = open_segment(tmp_path / "run.mcap", {})
        assert segment.path.name == name
        segment.save([Entry("step/ground/a", pb.Step, b"", 1, 1, number) for number in range(count)])
        if name == "run_0001.mcap":
            segment.abandon()  # its recorder was killed: it has no summary
        else:
            segment.finish()
    for number in range(10):
        say(launcher, STEP, pb.Step(header=pb.Header(sequence=number + 1), actor="a"))
    notes = {"failure": "[Errno 28] No space left on device"}
    recorder = pb.Health(header=pb.Header(sequence=7), process="recorder", notes=notes)
    launcher.metrics.add("health/recorder", recorder, 1)
    figures = launcher.figures()
    assert figures["log_messages"] == {"recorded": 6, "missing": 4, "failures": [notes["failure"]]}
    assert sum(topic["missing"] for topic in figures["topics"].values()) == 6, "of the recorder's signs of life"
    assert "messages in the log: 6; NOT in the log: 4 ([Errno 28] No space left on device)" in rows_of(figures)
    (tmp_path / "run_0003.mcap").write_bytes(b"no log at all")
    (failure,) = launcher.figures()["log_messages"]["failures"][1:]
    assert "run_0003.mcap is not an MCAP file" in failure


def test_figures_that_are_not_finite_are_saved_as_null(tmp_path: Path, launcher: Launcher) -> None:
    learner = pb.LearnerMetrics(header=pb.Header(sequence=1), robot="ground", steps=5, critic_loss=float("nan"))
    launcher.metrics.add("metrics/ground", learner, 1)
    launcher._save(launcher.figures() | {"loss": float("inf")})

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    assert json.loads((tmp_path / "figures.json").read_text(), parse_constant=refuse)["loss"] is None


def test_a_run_without_a_recorder_has_no_log(tmp_path: Path) -> None:
    launcher = Launcher(RunConfig(record=False), tmp_path, BusSettings())
    assert launcher.figures()["log"] is None and launcher.processes[0].spec.name == "safety-0"


def test_only_a_run_in_which_nothing_has_begun_may_end_at_once(launcher: Launcher) -> None:
    assert not launcher._begun()
    launcher.metrics.add("metrics/ground", pb.LearnerMetrics(header=pb.Header(sequence=1), robot="ground"), 1)
    assert not launcher._begun(), "the learner waits for steps"
    launcher.config = replace(launcher.config, actors=1, flights=(FlightSettings("udpin:127.0.0.1:1"),))
    assert launcher._begun(), "a vehicle may fly already"
    launcher.config = replace(launcher.config, flights=())
    say(launcher, STEP, pb.Step(header=pb.Header(sequence=1), actor="a"))
    assert launcher._begun()


@pytest.mark.parametrize("error", [errno.EACCES, errno.EPERM, errno.EROFS])
def test_a_run_goes_on_where_no_link_can_be_made(tmp_path: Path, monkeypatch, caplog, error: int) -> None:
    """On a disk without links, or in the only writable folder, the training ended before it began."""

    def refuse(self: Path, *_: object) -> None:
        raise OSError(error, os.strerror(error), str(self))

    (tmp_path / "run").mkdir()
    monkeypatch.setattr(Path, "symlink_to", refuse)
    launcher_in(tmp_path / "run")._claim_folder()
    assert (tmp_path / "run" / CONFIG).exists() and [path.name for path in tmp_path.iterdir()] == ["run"]
    assert f"{tmp_path}/latest does not point to this run: " in caplog.text


def test_two_runs_that_start_at_once_do_not_take_the_link_from_each_other(tmp_path: Path, monkeypatch) -> None:
    """The second found the link of the first in its place, and ended."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    launchers = [launcher_in(tmp_path / name) for name in ("first", "second")]
    link, pid = Path.symlink_to, os.getpid()

    def link_after_the_other(self: Path, target: str) -> None:
        monkeypatch.setattr(Path, "symlink_to", link)
        monkeypatch.setattr(os, "getpid", lambda: pid + 1)
        launchers[1]._claim_folder()
        link(self, target)

    monkeypatch.setattr(Path, "symlink_to", link_after_the_other)
    launchers[0]._claim_folder()
    assert (tmp_path / "latest").readlink() == Path("first")


def test_a_run_that_is_resumed_as_the_latest_stays_the_latest(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    (tmp_path / "latest").symlink_to("first")
    launcher_in(tmp_path / "latest")._claim_folder()
    assert (tmp_path / "latest").readlink() == Path("first")


def test_the_figures_say_whether_they_count_from_a_resumption_on(tmp_path: Path) -> None:
    for resumed in (False, True):
        launcher = launcher_in(tmp_path)
        launcher._claim_folder()
        assert launcher.figures()["resumed"] is resumed


def test_steps_that_the_learner_refuses_do_not_count(launcher: Launcher) -> None:
    """An actor floods: 20 steps that it may take, then thousands beyond its limit, repeated ones and ones gone back."""

    def step(number: int, episode: int = 0, step: int | None = None) -> pb.Step:
        place = {"index": number, "episode": episode, "step": number if step is None else step}
        step_ = pb.Step(robot="ground", actor="a", speed=1.0, **place)
        step_.header.sequence = next(sequence)
        return step_

    sequence = itertools.count(1)
    launcher.metrics.add("metrics/ground", pb.LearnerMetrics(robot="ground", limit={"a": 20}), 1)
    for number in range(1, 21):
        say(launcher, STEP, step(number))
    for number in (5, 20):
        say(launcher, STEP, step(number))
    for number in range(5000, 9000):
        say(launcher, STEP, step(number, 1))
    say(launcher, STEP, step(21, 0, 3))
    say(launcher, STEP, step(0, 9))
    figures = launcher.figures()
    assert (figures["steps"], figures["refused"]) == (20, 4004)
    assert "4004 steps do not count: repeated, or not permitted by the learner" in rows_of(figures)
    say(launcher, STEP, step(21))
    assert launcher.figures()["steps"] == 21
