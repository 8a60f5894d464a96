"""Test the first minute with the program: `brakeline demo`, the log of its run, and the next commands that it names."""

import csv
import json
import re
import shlex
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import EXPERIMENTS, load
from brakeline.logs.reader import find, read
from brakeline.messaging.policy_weights import MLP
from tests.logs.sample_log import agree, counted, decoded
from tests.robots import GROUND
from tests.system.runs import refused, succeeded

ROOT = Path(__file__).parents[2]
# The log lacks what these publish after the recorder has stopped.
OUTLIVE_THE_LOG = {f"{topic}/{process}" for topic in ("health", "log") for process in ("launcher", "recorder")}
CLOSED_LOOP = (
    *("episodes", "goals", "collisions", "timeouts", "steps", "interventions", "failsafes", "fallbacks", "mean_speed"),
    *("max_speed", "mean_reward", "decision_ms", "containment", "outside", "actors", "learners"),
    *("method", "certificate", "policy", "arena", "seed"),
)


@pytest.fixture(scope="module")
def figures(logged_run: Path) -> dict:
    """The figures that the run ended with."""
    return json.loads((logged_run / "figures.json").read_text())


@pytest.fixture(scope="module")
def analysed(logged_run: Path) -> dict:
    return json.loads(succeeded("analyse", logged_run, "--json"))


def test_the_first_screen_leads_from_the_demo_to_a_report_a_replay_and_an_evaluation(demo, figures, monkeypatch):
    screen = (ROOT / "README.md").read_text().partition("## Data flow")[0]
    assert "    make demo " in screen and "    make test " in screen, "the two commands"
    recipe = (ROOT / "Makefile").read_text().partition("demo: setup\n")[2].splitlines()[0]
    assert recipe.strip() == "$(BIN)/brakeline demo"

    folder, output = demo
    monkeypatch.chdir(folder)
    alone, filtered, *_ = output.splitlines()
    assert alone.startswith("the stored policy alone") and not alone.endswith(" 0 collisions")
    assert filtered.startswith("the same episodes behind the filter") and filtered.endswith(" 0 collisions")
    assert re.search(r"^live page: http://127\.0\.0\.1:\d+/$", output, re.M)
    assert "log:    runs/first/run.mcap" in output
    commands = [shlex.split(line.removeprefix("next:"))[1:] for line in output.splitlines() if line.startswith("next:")]
    assert [command[0] for command in commands] == ["replay", "evaluate", "analyse"]
    replay, evaluate, analyse = commands

    replayed = json.loads(succeeded(*replay, "--json"))
    assert replayed["requests"] == sum(record.topic == "exchange" for record in read(Path("runs/first"))) > 0
    assert replayed["requests"] - replayed["unanswered"] > 0.95 * replayed["requests"] and replayed["different"] == 0
    (policy,) = figures["policies"]
    assert MLP.load(Path(policy), GROUND).sizes == (26, 256, 256, 2)
    evaluated = json.loads(succeeded(*evaluate, "--episodes", 2, "--json"))
    assert evaluated["episodes"] == 2 and evaluated["collisions"] == 0 and evaluated["policy"] == policy
    assert succeeded(*analyse) and 'data-figure="goals"' in Path("report.html").read_text()


def test_it_ends_at_its_last_step_without_a_fault(logged_run, figures):
    config = load(logged_run / CONFIG)
    assert config.steps == 800 and figures["finished"] and figures["restarts"] == {}
    assert figures["collisions"] == 0 and figures["episodes"] > 0
    learner = figures["learners"]["ground"]
    assert (learner["steps"], learner["done"], learner["missing"], learner["duplicates"]) == (800, True, 0, 0)
    assert 800 <= figures["steps"] <= 800 + 2 * config.learner.window
    late = figures["no_decision"].get("Late", 0)  # on two cores that others use too, a few
    assert set(figures["no_decision"]) <= {"Late"} and figures["fallbacks"] == late <= 0.02 * 800
    assert set(figures["processes"]) == {"launcher", "recorder", "safety-0", "learner", "actor-0", "actor-1"}
    assert not any(process["alive"] for name, process in figures["processes"].items() if name != "launcher")
    assert {process["starts"] for process in figures["processes"].values()} == {1}


def test_every_message_that_was_published_is_in_the_log(logged_run):
    numbers: dict[str, list[int]] = {}
    published: Counter[str] = Counter()
    with (logged_run / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, stored, message in reader.iter_decoded_messages():
            if channel.topic.startswith("foxglove/"):  # drawn by the recorder, published by nobody
                continue
            numbers.setdefault(channel.topic, []).append(message.header.sequence)
            assert stored.sequence == message.header.sequence
            if channel.topic.startswith("health/"):
                published |= Counter(dict(message.published))
        summary = reader.get_summary()
    for key, sequence in numbers.items():
        assert sequence == list(range(1, len(sequence) + 1)), key
    recorded = {key: len(sequence) for key, sequence in numbers.items()}
    unrecorded = {"weights/ground", "flow/ground"}
    for key in published.keys() - unrecorded:
        assert recorded.get(key, 0) >= published[key] if key in OUTLIVE_THE_LOG else recorded[key] == published[key]
    assert {f"{topic}/ground/actor-{i}" for topic in ("step", "exchange", "episode") for i in (0, 1)} <= set(recorded)
    assert recorded["step/ground/actor-0"] == recorded["exchange/ground/actor-0"]
    by_channel = {summary.channels[i].topic: count for i, count in summary.statistics.channel_message_counts.items()}
    assert {topic: count for topic, count in by_channel.items() if not topic.startswith("foxglove/")} == recorded


def test_analyse_gives_the_figures_that_the_display_ended_with(figures, analysed):
    for name in CLOSED_LOOP:
        assert analysed[name] == figures[name], name
    assert analysed["round_trip_ms"] == pytest.approx(figures["round_trip_ms"])
    assert (analysed["cuts"], analysed["malformed"]) == ([], 0)
    topics, shown = analysed["topics"], figures["topics"]
    assert topics.keys() == shown.keys()
    for key in topics:
        assert topics[key]["missing"] == topics[key]["duplicates"] == 0, key
        assert topics[key] == shown[key] or key in OUTLIVE_THE_LOG, key


def test_analyse_agrees_with_a_count_by_another_reader_field_by_field(logged_run, analysed):
    expected = counted(decoded(find(logged_run)))
    agree({name: analysed[name] for name in expected}, expected)
    assert analysed["tube_half_width"]["max"] < 0.1


def test_rows_of_runs_and_of_steps(logged_run, analysed):
    (row,) = csv.DictReader(succeeded("analyse", logged_run, "--csv").splitlines())
    assert (row["run"], int(row["steps"]), int(row["collisions"])) == (logged_run.name, analysed["steps"], 0)
    assert float(row["decision_ms.adjusted.p99"]) == analysed["decision_ms"]["adjusted"]["p99"]
    words = ("analyse", logged_run, "--episode", 0, "--actor", "actor-0", "--csv")
    steps = list(csv.DictReader(succeeded(*words).splitlines()))
    assert [int(step["step"]) for step in steps] == list(range(len(steps))) and steps[0]["actor"] == "actor-0"
    decisions = {step["decision"] for step in steps}
    assert decisions <= {"allowed", "adjusted", "failsafe"} | ({"no decision"} if analysed["fallbacks"] else set())
    assert "step" in succeeded("analyse", logged_run, "--episode", 0)
    assert "there is no episode 12345" in refused("analyse", logged_run, "--episode", 12345)


def test_the_configuration_is_in_the_folder_and_in_the_log(logged_run):
    wanted = replace(EXPERIMENTS["demo"], steps=800)
    config = replace(wanted, model_config=replace(wanted.model_config, mode="direct"))
    assert load(logged_run / CONFIG) == config, "the form is pinned"
    with (logged_run / "run.mcap").open("rb") as file:
        metadata = {item.name: item.metadata for item in make_reader(file).iter_metadata()}
    assert json.loads(metadata["configuration"]["json"]) == json.loads((logged_run / CONFIG).read_text())
    assert metadata["run"]["certificate"] == "residual" and "numpy" in metadata["versions"]
    assert float(metadata["model ground"]["bound_step"]) < 1.0
    assert metadata["conditions"]["encoder_ticks"]


def test_the_latest_run_is_linked_and_its_folder_is_not_used_again(logged_run):
    assert (logged_run.parent / "latest").resolve() == logged_run.resolve()
    assert "holds a run already" in refused("train", "ground", "--experiment", "debug", "--out", logged_run)


def test_the_processes_logs_hold_no_errors(logged_run):
    for name in ("recorder", "safety-0", "learner", "actor-0", "actor-1"):
        lines = (logged_run / "logs" / f"{name}.log").read_text().splitlines()
        assert lines and not [line for line in lines if "ERROR" in line or "Traceback" in line], name
