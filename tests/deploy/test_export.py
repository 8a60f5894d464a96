"""Test the formats that a log is exported to, with the programs that read them."""

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from brakeline import Filter, InProcess, RecordedClient
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import robot_named
from tests.deploy.data.porter import FILE
from tests.full_disk import full_disk
from tests.logs.sample_log import written
from tests.robots import GROUND

STEPS = 150


def messages(path: Path) -> list[tuple[str, Any, bytes]]:
    """(topic, decoded, payload) of a log, by the plain reader."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(channel.topic, message, raw.data) for _, channel, raw, message in reader.iter_decoded_messages()]


def test_csv_has_every_step_with_every_field(log, tmp_path, figures) -> None:
    steps = [message for topic, message, _ in messages(log) if topic.startswith("step/")]
    assert figures("export", log, "--csv", tmp_path / "a" / "steps.csv")["csv"]["steps"] == len(steps) == STEPS
    with (tmp_path / "a" / "steps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == STEPS
    for row, step in zip(rows, steps, strict=True):
        assert (row["actor"], int(row["episode"]), int(row["step"])) == (step.actor, step.episode, step.step)
        assert float(row["reward"]) == step.reward and int(row["terminated"]) == step.terminated
        assert row["decision"] == pb.Kind.Name(step.decision) and float(row["header.time"]) == step.header.time
        for name, parts in (
            ("observation", GROUND.task.observed),
            ("action", GROUND.action),
            ("state", GROUND.state),
        ):
            assert [float(row[f"{name}.{part}"]) for part in parts] == list(getattr(step, name)), name
    asked = [message for topic, message, _ in messages(log) if topic.startswith("exchange/")]
    decisions = {(str(e.request.episode), str(e.request.step)): e.reply.decision for e in asked}
    assert any(decision.reason for decision in decisions.values())
    for row in rows:
        decision = decisions[row["episode"], row["step"]]
        assert [bool(int(row["decision.verified"])), float(row["decision.margin"])] == [
            decision.verified,
            decision.margin,
        ]
        assert [row["decision.model"], row["decision.reason"]] == [decision.model, decision.reason]
    missing = {f.name for f in pb.Step.DESCRIPTOR.fields} - {name.split(".")[0] for name in rows[0]}
    assert missing == {"path"}


def test_csv_of_a_robot_without_a_task_has_all_but_observations(tmp_path, command) -> None:
    """A program of your own records a robot that has a description alone."""
    robot = robot_named(str(FILE))
    about = {
        "robot": robot.name,
        "actor": "a",
        "proposed": [0.1] * robot.action_dim,
        "action": [0.2] * robot.action_dim,
    }
    steps = [pb.Step(**about, step=i, index=i + 1, state=[0.5 * i] * robot.state_dim) for i in range(3)]
    described = {"robots": {robot.name: json.dumps(robot.description)}}
    written(tmp_path / "run.mcap", ((f"step/{robot.name}/a", step, 1 + i) for i, step in enumerate(steps)), described)
    for words in ((), ("--robot", robot.name), ("--robot", FILE)):  # the log says what its only robot is
        status, _, err = command("export", tmp_path, "--csv", tmp_path / "steps.csv", *words)
        assert status == 0, err
        with (tmp_path / "steps.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [[float(row[f"state.{part}"]) for part in robot.state] for row in rows] == [list(s.state) for s in steps]
        assert not any(name.startswith("observation") for name in rows[0])
    for words, said in (("nobody", "no robot is called 'nobody'"), ("ground", f"steps of {robot.name}")):
        status, _, err = command("export", tmp_path, "--csv", tmp_path / "no.csv", "--robot", words)
        assert status == 1 and said in err


@pytest.mark.parametrize("form", [("--csv", "steps.csv"), ("--minari", "mine/ground-v0")])
def test_columns_of_another_description_are_not_named_by_that_of_today(form, tmp_path, command) -> None:
    """Two coordinates have changed places since: their values stood below each other's names."""
    robot = robot_named("ground")
    *pose, one, other = robot.description["state"].items()
    then = robot.description | {"state": dict([*pose, other, one])}
    step = pb.Step(robot="ground", actor="a", state=[0.0] * robot.state_dim, action=[0.0, 0.0])
    written(tmp_path / "run.mcap", [("step/ground/a", step, 1)], {"robots": {"ground": json.dumps(then)}})
    target = tmp_path / form[1] if form[0] == "--csv" else form[1]
    status, _, err = command("export", tmp_path, form[0], target)
    assert status == 1 and "was recorded with another description of ground: coordinates" in err
    assert not (tmp_path / "steps.csv").exists()


@pytest.mark.parametrize("words", [("export", "--csv"), ("export", "--tlog"), ("analyse", "--html")])
def test_no_file_is_written_over_a_log(log, words, tmp_path, command) -> None:
    """`brakeline export --csv run.mcap` means a log, not a file to write."""
    (mine := tmp_path / "run.mcap").write_bytes(log.read_bytes())
    status, _, err = command(*words, mine, log)
    assert status == 1 and "is a log, and is not overwritten" in err
    assert mine.read_bytes() == log.read_bytes()


def test_minari_loads_the_episodes(log, tmp_path, monkeypatch, command, figures) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    exported = figures("export", log, "--minari", "brakeline/ground-v0")["minari"]
    steps = [message for topic, message, _ in messages(log) if topic.startswith("step/")]
    numbers = Counter(step.episode for step in steps)
    assert (exported["steps"], exported["episodes"]) == (STEPS, len(numbers))
    data = minari.load_dataset("brakeline/ground-v0")
    assert data.action_space.shape == (2,) and data.action_space.low.tolist() == pytest.approx([0.0, -0.5])
    for episode, number in zip(data.iterate_episodes(), sorted(numbers), strict=True):
        mine = [step for step in steps if step.episode == number]
        assert len(episode.observations) == len(mine) + 1 and len(episode.actions) == len(mine)
        assert np.array_equal(episode.observations[:-1], np.array([s.observation for s in mine], np.float32))
        assert np.array_equal(episode.observations[-1], np.array(mine[-1].next_observation, np.float32))
        assert np.array_equal(episode.actions, np.array([s.action for s in mine], np.float32))
        assert episode.rewards.tolist() == [s.reward for s in mine]
        assert episode.terminations[-1] == mine[-1].terminated
        assert episode.truncations[-1] == (not mine[-1].terminated), "also where the log ends within an episode"
        assert np.array_equal(episode.infos["proposed"], np.array([s.proposed for s in mine], np.float32))
        assert episode.infos["decision"].tolist() == [s.decision for s in mine]
    status, _, err = command("export", log, "--minari", "brakeline/ground-v0")
    assert status == 1 and "exists already" in err


def test_minari_refuses_a_name_without_a_version_and_a_log_without_observations(log, tmp_path, monkeypatch, command):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    status, _, err = command("export", log, "--minari", "brakeline/ground")
    assert status == 1 and "end its name in -v<number>" in err
    with RecordedClient(InProcess(Filter.load("ground")), tmp_path / "mine") as client:
        for _ in range(3):
            client.decide([0.0] * 5, [0.0, 0.0], known_free=True)
    status, _, err = command("export", client.path, "--minari", "brakeline/mine-v0")
    assert status == 1 and "without the 26 observed values of the task" in err
    assert not (tmp_path / "minari" / "brakeline" / "mine-v0").exists()


def test_foxglove_draws_every_step_and_keeps_every_byte(log, tmp_path, command, figures) -> None:
    out = tmp_path / "full.mcap"
    count = figures("export", log, "--foxglove", out)["foxglove"]["messages"]
    before, after = messages(log), messages(out)
    assert count == len(after)
    ours = [(topic, payload) for topic, _, payload in after if not topic.startswith("foxglove/")]
    assert ours == [(topic, payload) for topic, _, payload in before]
    drawn = Counter(topic.split("/")[1] for topic, _, _ in after if topic.startswith("foxglove/"))
    assert drawn["decision"] == drawn["lidar"] == STEPS
    again = tmp_path / "again.mcap"
    assert figures("export", out, "--foxglove", again)["foxglove"]["messages"] == count, "old pictures are not kept"
    assert command("replay", out)[0] == 0, "the model sets are in it too"
    assert command("export", log, "--foxglove", out)[0] == 1


def test_a_full_disk_leaves_no_part_of_an_export(log, tmp_path, command) -> None:
    """Else the next attempt would find the file there and refuse to write it."""
    with full_disk(20_000):
        for form in ("--foxglove", "--csv"):
            assert command("export", log, form, tmp_path / "out")[0] == 1
    assert not list(tmp_path.iterdir())


def test_an_export_of_a_damaged_log_says_what_it_lacks(damaged, tmp_path, command) -> None:
    status, out, err = command("export", damaged, "--csv", tmp_path / "steps.csv", "--json")
    figures = json.loads(out)
    assert status == 0 and figures["csv"]["steps"] == STEPS - 1
    assert len(figures["cuts"]) == 2 and figures["malformed"] == 0 and all(cut in err for cut in figures["cuts"])


def test_a_failed_export_leaves_an_existing_file_as_it_was(log, tmp_path, command) -> None:
    kept = tmp_path / "precious"
    kept.write_text("precious")
    for words in (
        (tmp_path / "nosuch", "--csv", kept),
        (log, "--csv", kept, "--robot", "quadrotor"),
        (log, "--tlog", kept),
    ):
        assert command("export", *words)[0] == 1
        assert kept.read_text() == "precious" and list(tmp_path.iterdir()) == [kept]
    assert command("export", log, "--tlog", tmp_path / "new")[0] == 1 and list(tmp_path.iterdir()) == [kept]
    assert command("export", log, "--csv", kept)[0] == 0 and kept.read_text().startswith("log_time,")
    status, out, _ = command("export", log, "--csv", "/dev/null")
    assert status == 0 and f"{STEPS} steps" in out and not Path("/dev/null").is_file()


def test_an_impossible_export_fails_with_a_reason(log, tmp_path, command) -> None:
    for words, said in (
        ((log,), "--csv, --minari, --foxglove"),
        ((tmp_path, "--csv", tmp_path / "a.csv"), "no log"),
        ((log, "--csv", tmp_path / "q.csv", "--robot", "quadrotor"), "but steps of ground: give one of these names"),
    ):
        status, _, err = command("export", *words)
        assert status == 1 and said in err
    assert not list(tmp_path.glob("q.csv*")), "no file with a headline alone"
