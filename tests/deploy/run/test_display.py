"""Console output of a run, on a terminal of 80 columns and in a file."""

import io
import shlex
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import Progress

from brakeline.deploy.commands import command_output
from brakeline.deploy.run.display import Display, line, live, run_phase, summary
from brakeline.deploy.run.launcher import Launcher
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.verdict import not_saved
from brakeline.learner.checkpoint import NOT_SAVED
from brakeline.logs.metrics import Metrics
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings


def step(number: int) -> pb.Step:
    message = pb.Step(actor="actor-0", episode=0, step=number, decision=pb.ALLOWED, decide_ms=123.45, reward=-1e4)
    message.truncated = number % 10 == 9
    message.header.sequence, message.header.run = number + 1, 1
    return message


@pytest.fixture
def view() -> Launcher:
    """The view of a run with the widest possible figures."""
    metrics = Metrics()
    for number in range(1000):
        metrics.add("step/ground/actor-0", step(number))
    values = {"critic_loss": -12345.678, "actor_loss": -12345.678, "missing": 123456, "updates": 800}
    learner = pb.LearnerMetrics(robot="ground", **values)
    metrics.add("metrics/ground", learner)
    exchange = pb.Exchange(round_trip_ms=543.21)
    metrics.add("exchange/ground/actor-0", exchange)
    folder = Path("/a/folder/with [brackets] in its name")
    run = Launcher(RunConfig(replicas=2), folder, BusSettings())
    run.metrics = metrics
    run.lines.append("safety-0: [red]no[/] markup " + "and very long " * 20)
    return run


def pictured(run: Launcher, width: int) -> str:
    console = Console(file=io.StringIO(), force_terminal=True, width=width, color_system=None)
    console.print(live(run, run.metrics.figures(), Progress()))
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [80, 100, 120])
def test_the_live_picture_fits_the_terminal(view: Launcher, width: int) -> None:
    shown = pictured(view, width)
    rows = shown.splitlines()
    assert max(map(len, rows)) <= width and len(rows) < 30
    words = ("collisions", "interventions", "decide p50 / p99", "critic loss", "safety-1", "[red]no[/]", "[brackets]")
    values = ("steps lost        123456", "123.45 / 123.45 ms", "543.21 / 543.21 ms")  # none is broken
    assert [word for word in (*words, *values) if word not in shown] == []


def test_without_a_terminal_it_says_a_line_now_and_then(view: Launcher, monkeypatch: pytest.MonkeyPatch) -> None:
    view.lines.clear()
    console = Console(file=io.StringIO(), soft_wrap=True)
    with Display(console, 1000) as display:
        for _ in range(100):
            display(view)
        shown = console.file.getvalue()  # type: ignore[attr-defined]
        assert shown.startswith("starting recorder, safety-0,") and shown.count("\n") == 1, "what it does, at once"
        monkeypatch.setattr("brakeline.deploy.run.display.SPACING", 0.0)
        display(view)
        monkeypatch.undo()
        view.ending = True
        display(view)
    rows = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert rows[1:] == [line(view.metrics.figures()), "ending every process in order"]


def test_without_a_terminal_it_prints_each_warning_once_and_of_many_the_latest(
    view: Launcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    view.lines.extend(f"actor-0 hangs [{n}]" for n in range(7))
    console = Console(file=io.StringIO(), soft_wrap=True)
    monkeypatch.setattr("brakeline.deploy.run.display.SPACING", 0.0)
    with Display(console, 1000) as display:
        for _ in range(3):
            display(view)
    rows = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    warnings = [*(f"actor-0 hangs [{n}]" for n in range(2, 7)), "(3 earlier warnings are in the log)"]
    assert rows[1 : 1 + len(warnings)] == warnings and "hangs" not in "".join(rows[1 + len(warnings) :])


def ended(view: Launcher, **changes: object) -> dict[str, object]:
    folder = "/very/long" * 12
    paths = {"folder": folder, "log": f"{folder}/run.mcap", "policies": [f"{folder}/policy.safetensors"]}
    outcome = {"finished": False, "restarts": {"learner": 2, "safety-0": 1}}
    latest = {"ground": {"episodes": 100, "goals": 97}}
    return view.metrics.figures() | {"latest": latest} | paths | outcome | changes


def rows_of(figures: dict[str, object], verbose: bool = False) -> list[str]:
    console = Console(file=io.StringIO(), soft_wrap=command_output.console.soft_wrap)
    summary(console, figures, verbose)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_a_run_ends_with_a_verdict_in_three_lines_and_one_for_each_thing_that_went_wrong(view: Launcher) -> None:
    figures = ended(view, finished=True, fallbacks=0, collisions=1, interventions=3, steps=60)
    outcome, answers, following = rows_of(figures)
    assert outcome == "97 of the last 100 episodes reached the goal; 1 collision; 5.0% of 60 steps corrected"
    assert answers == "every answer came in time"
    assert following == f"next: brakeline analyse {figures['folder']} --html report.html"
    lacks = {"recorded": 6, "missing": 4, "failures": []}
    _, answers, _, stopped, log = rows_of(ended(view, fallbacks=2, log_messages=lacks))
    assert answers.startswith("2 answers came late or not at all")
    assert "brakeline train --resume /very/long" in stopped and log == "messages in the log: 6; NOT in the log: 4"
    assert rows_of(ended(view, folder="runs/my run"))[2].startswith("next: brakeline analyse 'runs/my run' --html")
    (only,) = rows_of(ended(view, steps=0, learners={}))
    assert only.startswith("ended before the first step") and "resume" not in only


def test_a_resumed_run_and_an_untrained_policy_are_named_as_such(view: Launcher) -> None:
    figures = ended(view, finished=True, resumed=True)
    assert rows_of(figures)[0].startswith("since the resumption: 97 of the last 100 episodes")
    assert not any("learned nothing" in row for row in rows_of(figures))
    fed = {"logs": ["runs/mine"], "published": 0, "known": 0, "unusable": 7}
    assert any("; 7 are unusable, see" in row for row in rows_of(figures | {"from_logs": fed}))
    assert rows_of(figures | {"steps": 0})[0].startswith("nothing was driven: the run had all its steps already.")
    learner = {"steps": 100, "updates": 0}
    (untrained,) = [row for row in rows_of(figures | {"learners": {"ground": learner}}) if "learned nothing" in row]
    assert untrained.startswith("the policy of ground has learned nothing: the run ended within the warm-up")
    stopped = figures | {"learners": {"ground": learner}, "finished": False}
    assert not any("learned nothing" in row for row in rows_of(stopped))


def test_a_policy_that_was_not_saved_is_named_with_what_to_do(view: Launcher) -> None:
    """Before, the run ended as if its policy were there; on a full disk, the file was an earlier one."""
    health = pb.Health(process="learner", notes={NOT_SAVED: "/disk/policy.safetensors: No space left on device"})
    health.header.sequence, health.header.run = 1, 7
    view.metrics.add("health/learner", health)
    figures = ended(view, finished=True, folder="/disk/my run")
    (row,) = [row for row in rows_of(figures) if "NOT SAVED" in row]
    assert row.startswith("THE POLICY WAS NOT SAVED: /disk/policy.safetensors: No space left on device. A file that")
    assert "Free some space" in row and "brakeline train --resume '/disk/my run'" in row
    assert not_saved(figures) and not not_saved(ended(view) | {"processes": {}})


def test_two_kinds_of_robots_and_no_episode(view: Launcher) -> None:
    latest = {"ground": {"episodes": 5, "goals": 4}, "quadrotor": {"episodes": 2, "goals": 0}}
    assert rows_of(ended(view, latest=latest))[0].startswith(
        "4 of the last 5 episodes reached the goal (ground), 0 of the last 2 episodes reached the goal (quadrotor); "
    )
    assert rows_of(ended(view, latest={}))[0].startswith("no episode ended; ")


def test_all_figures_and_paths_are_whole(view: Launcher) -> None:
    figures = ended(view)
    rows, folder = rows_of(figures, verbose=True), figures["folder"]
    assert f"log:    {folder}/run.mcap" in rows and f"policy: {folder}/policy.safetensors" in rows
    assert any(row.endswith("restarts: learner 2, safety-0 1") for row in rows)
    assert f"next:   brakeline replay {folder}" in rows, "and what comes next"
    mine = figures | {"folder": "/disk/my run", "policies": ["/disk/my run/policy.safetensors"]}
    words = [shlex.split(row) for row in rows_of(mine, verbose=True) if row.startswith("next:")]
    assert {"/disk/my run", "/disk/my run/policy.safetensors"} <= {line[-1] for line in words}, "a shell takes them"


def test_what_a_run_is_at_is_said_from_the_first_second(view: Launcher) -> None:
    young = Launcher(view.config, view.folder, BusSettings())
    shown = pictured(young, 80)
    assert "starting recorder, safety-0" in shown and shown.count(" starts ") == len(view.processes)
    for number, child in enumerate(view.processes):
        name = child.spec.name
        young.metrics.add(f"health/{name}", pb.Health(header=pb.Header(sequence=1, run=number + 1), process=name))
    assert run_phase(young) == "waiting for the first step"
    young.metrics.add("step/ground/actor-0", step(0))
    assert run_phase(young) == "driving and learning"
    young.ending = True
    assert run_phase(young) == "ending every process in order"
