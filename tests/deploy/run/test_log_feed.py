"""Test the steps that a learner gets from logs, and the processes of a run that learns from logs."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.deploy.commands.train_command import TrainCommand
from brakeline.deploy.run.log_feed import LoggedSteps, count
from brakeline.deploy.run.processes import process_specs
from brakeline.deploy.run.run_config import RunConfig
from brakeline.errors import BadData
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.topics import STEP
from tests.logs.sample_log import written
from tests.robots import GROUND, QUADROTOR


def record(path: Path, *steps: pb.Step) -> None:
    written(path, ((STEP.at(robot="ground", source=step.actor), step, 1 + i) for i, step in enumerate(steps)))


def step(number: int, actor: str = "a", episode: int = 0, **more: object) -> pb.Step:
    about = {"observation": [0.5] * 26, "next_observation": [0.5] * 26, "action": [0.1, 0.0], "proposed": [0.1, 0.0]}
    fields = {"robot": "ground", "actor": actor, "episode": episode, "step": number, "index": number + 1}
    return pb.Step(**(fields | about | more))


def names(steps: LoggedSteps) -> list[tuple[str, int, int]]:
    return [(one.actor, one.episode, one.step) for one in steps]


def test_the_learner_gets_each_step_once_in_its_order(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", step(0), step(1), step(1), step(0, "b"), step(3), step(2))
    steps = LoggedSteps([str(tmp_path)], GROUND)
    assert names(steps) == [("a", 0, 0), ("a", 0, 1), ("b", 0, 0), ("a", 0, 3), ("a", 0, 2)]
    assert steps.counts == {"taken": 5, "duplicate": 1}


def test_unusable_steps_are_counted_and_left_out(tmp_path: Path) -> None:
    bad = [step(1, observation=[0.5]), step(2, reward=float("nan")), step(3, action=[float("inf"), 0.0])]
    record(tmp_path / "run.mcap", step(0), *bad, step(4))
    steps = LoggedSteps([str(tmp_path)], GROUND)
    assert names(steps) == [("a", 0, 0), ("a", 0, 4)]
    assert steps.counts == {"taken": 2, "unusable": 2}  # the reader has passed over the reward that is no number
    (tmp_path / "own").mkdir()
    record(tmp_path / "own" / "run.mcap", *bad)
    with pytest.raises(ValueError, match=r"none of the 2 steps of ground .* \(observation: 1 values, not 26\)"):
        count([str(tmp_path / "own")], GROUND)


def test_steps_of_another_description_teach_nothing(tmp_path: Path) -> None:
    """A step of 0.1 s is none of 0.2 s, and speeds in an observation are shares of the largest one."""
    recorded = [(STEP.at(robot="ground", source="a"), step(i), 1 + i) for i in range(3)]
    former = (replace(GROUND, horizon=GROUND.horizon + 1), None), (replace(GROUND, period=0.1), "period")
    for number, (robot, word) in enumerate((*former, (replace(GROUND, action_high=(1.0, 1.0)), "upper bounds"))):
        folder = tmp_path / str(number)
        folder.mkdir()
        written(folder / "run.mcap", recorded, {"robots": {"ground": json.dumps(robot.description)}})
        if word is None:
            assert count([str(folder)], GROUND) == 3
            continue
        with pytest.raises(BadData, match=rf"run.mcap was recorded with another description of ground: {word}"):
            count([str(folder)], GROUND)
        with pytest.raises(BadData, match=word):
            TrainCommand(from_logs=(str(folder),), out=tmp_path / "new").run()
        assert not (tmp_path / "new").exists()


def test_actors_of_different_runs_differ_and_of_one_run_stay_the_same(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        record(tmp_path / folder / "run.mcap", step(0), step(1))
    record(tmp_path / "one" / "run.mcap", step(1), step(2))  # goes on in run_0001.mcap
    steps = LoggedSteps([str(tmp_path / "one"), str(tmp_path / "two")], GROUND)
    assert names(steps) == [("a", 0, 0), ("a", 0, 1), ("a", 0, 2), ("a.run2", 0, 0), ("a.run2", 0, 1)]
    assert count([str(tmp_path / "one"), str(tmp_path / "two")], GROUND) == 5
    with pytest.raises(ValueError, match="no steps of quadrotor"):
        count([str(tmp_path / "one")], QUADROTOR)


def test_a_copy_of_a_log_in_its_folder_teaches_nothing_twice(tmp_path: Path) -> None:
    for run in (1, 2):
        steps = [step(i, header=pb.Header(run=run, wall_time=10**9 * run + i)) for i in range(3)]
        record(tmp_path / "run.mcap", *steps)  # of another start in run_0001.mcap
    shutil.copy(tmp_path / "run.mcap", tmp_path / "pictures.mcap")
    steps_of_folder = LoggedSteps([str(tmp_path)], GROUND)
    assert len(names(steps_of_folder)) == 6 and steps_of_folder.counts == {"taken": 6, "duplicate": 3}


@pytest.mark.parametrize("copy", ["a.mcap", "z.mcap"])
def test_a_copy_of_the_first_part_of_a_log_hides_nothing(tmp_path: Path, copy: str) -> None:
    """Somebody copied the log while its run went on. The copy may be read before the log, or after it."""
    steps = [step(i, header=pb.Header(run=1, wall_time=10**9 + i)) for i in range(9)]
    record(tmp_path / copy, *steps[:4])
    record(tmp_path / "run.mcap", *steps)
    fed = LoggedSteps([str(tmp_path)], GROUND)
    assert sorted(number for _, _, number in names(fed)) == list(range(9))
    assert fed.counts == {"taken": 9, "duplicate": 4}


def test_two_sessions_of_an_actor_in_one_log_are_two_actors_and_a_restart_is_one(tmp_path: Path) -> None:
    first = [step(i, header=pb.Header(run=1)) for i in range(2)]
    restarted = [step(i, episode=1, header=pb.Header(run=2)) for i in range(2)]
    anew = [step(i, episode=e, header=pb.Header(run=3)) for e in range(2) for i in range(2)]
    record(tmp_path / "run.mcap", *first, *restarted, restarted[1], *anew, anew[0])
    steps = LoggedSteps([str(tmp_path)], GROUND)
    mine = [("a", 0, 0), ("a", 0, 1), ("a", 1, 0), ("a", 1, 1)]
    assert names(steps) == [*mine, *(("a.session2", *numbers) for _, *numbers in mine)]
    assert steps.counts == {"taken": 8, "duplicate": 2}


def test_a_truncated_log_gives_its_remaining_steps(log: Path, tmp_path: Path) -> None:
    whole = log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    shutil.copy(log, tmp_path / "whole.mcap")
    steps = LoggedSteps([str(tmp_path / "cut.mcap")], GROUND)
    left = names(steps)
    assert len(steps.damage) == 1 and "cut.mcap" in steps.damage[0]
    assert left and left == names(LoggedSteps([str(tmp_path / "whole.mcap")], GROUND))[: len(left)]


def test_an_offline_run_has_no_robots_and_a_warm_start_has_both() -> None:
    offline = RunConfig(from_logs=("runs/a",), actors=0)
    assert [spec.name for spec in process_specs(offline)] == ["recorder", "learner", "feeder"]
    warm = RunConfig(from_logs=("runs/a",), actors=1)
    assert [spec.name for spec in process_specs(warm)] == ["recorder", "safety-0", "learner", "feeder", "actor-0"]
    with pytest.raises(ValueError, match="deterministic"):
        RunConfig(from_logs=("runs/a",), actors=1, deterministic=True)
