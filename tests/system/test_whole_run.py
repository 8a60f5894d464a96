"""Test a run without faults, from the command line to the figures of its log."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from brakeline.deploy.run.run_config import EXPERIMENTS, load
from brakeline.logs.figure_tables import analyse
from brakeline.messaging.policy_weights import MLP
from tests.robots import GROUND
from tests.system.runs import brakeline

# The log lacks what these publish after the recorder has stopped.
OUTLIVE_THE_LOG = {f"{topic}/{process}" for topic in ("health", "log") for process in ("launcher", "recorder")}
CLOSED_LOOP = (
    *("episodes", "goals", "collisions", "timeouts", "steps", "interventions", "failsafes", "fallbacks", "mean_speed"),
    *("max_speed", "mean_reward", "decision_ms", "containment", "outside"),
    *("method", "certificate", "policy", "arena", "seed"),
)


def test_it_ends_at_its_last_step_without_a_fault(whole_run):
    _, figures = whole_run
    steps = EXPERIMENTS["debug"].steps
    assert figures["finished"] and figures["restarts"] == {}
    assert figures["collisions"] == 0 and figures["episodes"] > 0
    learner = figures["learners"]["ground"]
    assert (learner["steps"], learner["done"], learner["missing"], learner["duplicates"]) == (steps, True, 0, 0)
    assert learner["updates"] == steps - EXPERIMENTS["debug"].learner.td3.warmup
    assert steps <= figures["steps"] <= steps + 2 * EXPERIMENTS["debug"].learner.window
    late = figures["no_decision"].get("Late", 0)  # on two cores that others use too, a few
    assert set(figures["no_decision"]) <= {"Late"} and figures["fallbacks"] == late <= 0.02 * steps
    assert set(figures["processes"]) == {"launcher", "recorder", "safety-0", "learner", "actor-0", "actor-1"}
    assert not any(process["alive"] for name, process in figures["processes"].items() if name != "launcher")
    assert {process["starts"] for process in figures["processes"].values()} == {1}


def test_every_message_that_was_published_is_in_the_log(whole_run):
    folder, _ = whole_run
    numbers: dict[str, list[int]] = {}
    published: Counter[str] = Counter()
    with (folder / "run.mcap").open("rb") as file:
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


def test_analyse_gives_the_figures_that_the_display_ended_with(whole_run):
    folder, figures = whole_run
    assert json.loads((folder / "figures.json").read_text()) == figures
    analysed = json.loads(brakeline("analyse", folder, "--json").stdout)
    assert analysed == json.loads(json.dumps(analyse(folder)))
    for name in CLOSED_LOOP:
        assert analysed[name] == figures[name], name
    assert analysed["actors"] == figures["actors"] and analysed["learners"] == figures["learners"]
    assert analysed["round_trip_ms"] == pytest.approx(figures["round_trip_ms"])
    assert (analysed["cuts"], analysed["malformed"]) == ([], 0)
    topics, shown = analysed["topics"], figures["topics"]
    assert topics.keys() == shown.keys()
    for key in topics:
        assert topics[key]["missing"] == topics[key]["duplicates"] == 0, key
        assert topics[key] == shown[key] or key in OUTLIVE_THE_LOG, key


def test_the_configuration_is_in_the_folder_and_in_the_log(whole_run):
    folder, _ = whole_run
    config = load(folder / "config.json")
    wanted = EXPERIMENTS["debug"]
    assert config == replace(wanted, model_config=replace(wanted.model_config, mode="direct")), "the form is pinned"
    with (folder / "run.mcap").open("rb") as file:
        metadata = {item.name: item.metadata for item in make_reader(file).iter_metadata()}
    assert json.loads(metadata["configuration"]["json"]) == json.loads((folder / "config.json").read_text())
    assert metadata["run"]["certificate"] == "residual" and "numpy" in metadata["versions"]
    assert float(metadata["model ground"]["bound_step"]) < 1.0
    assert metadata["conditions"]["encoder_ticks"]


def test_the_policy_loads_and_drives(whole_run):
    _, figures = whole_run
    (path,) = figures["policies"]
    assert MLP.load(Path(path), GROUND).sizes == (26, 32, 32, 2)
    done = brakeline("evaluate", "ground", "--policy", path, "--episodes", 2, "--json")
    assert done.returncode == 0, done.stderr
    evaluated = json.loads(done.stdout)
    assert evaluated["episodes"] == 2 and evaluated["collisions"] == 0 and evaluated["policy"] == path


def test_the_latest_run_is_linked_and_its_folder_is_not_used_again(whole_run):
    folder, _ = whole_run
    assert (folder.parent / "latest").resolve() == folder.resolve()
    again = brakeline("train", "ground", "--experiment", "debug", "--out", folder)
    assert again.returncode == 1 and "holds a run already" in again.stderr and "Traceback" not in again.stderr


def test_the_processes_logs_hold_no_errors(whole_run):
    folder, _ = whole_run
    for name in ("recorder", "safety-0", "learner", "actor-0", "actor-1"):
        lines = (folder / "logs" / f"{name}.log").read_text().splitlines()
        assert lines and not [line for line in lines if "ERROR" in line or "Traceback" in line], name
