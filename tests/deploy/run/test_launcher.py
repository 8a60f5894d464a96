"""Test the launcher against malformed messages, and its processes against modules in the working directory."""

import os
from pathlib import Path

import pytest

from brakeline.deploy.interpreter import spawning
from brakeline.deploy.run.launcher import Launcher
from brakeline.deploy.run.processes import UNFINISHED, ProcessSpec
from brakeline.deploy.run.run_config import EXPERIMENTS, RunConfig, encode
from brakeline.deploy.run.supervisor import SupervisedProcess
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.topics import EPISODE, EXCHANGE, HEALTH, LOG, STEP, Topic


@pytest.fixture
def launcher(tmp_path: Path) -> Launcher:
    return Launcher(RunConfig(), tmp_path, BusSettings(listen=("tcp/127.0.0.1:7447",)))


def test_a_run_without_a_recorder_has_no_log(tmp_path: Path) -> None:
    launcher = Launcher(RunConfig(record=False), tmp_path, BusSettings())
    assert launcher.figures()["log"] is None and launcher.processes[0].spec.name == "safety-0"


def say(launcher: Launcher, topic: Topic, message: object) -> None:
    payload = message if isinstance(message, bytes) else message.SerializeToString()
    launcher._inbox.append(Sample(topic, topic.at(robot="ground", source="a"), payload, 1))
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


def test_processes_do_not_import_modules_of_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
