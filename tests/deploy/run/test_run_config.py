"""Test configurations: the saved one is loaded, and nothing unknown or impossible is accepted."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.actors.actor_settings import PhysicsChange
from brakeline.deploy.cli import parse
from brakeline.deploy.commands.common_options import ServiceOptions
from brakeline.deploy.commands.fly_command import FlyCommand
from brakeline.deploy.commands.train_command import TrainCommand, run_folder
from brakeline.deploy.experiments.evaluate import FRESH, Evaluation
from brakeline.deploy.experiments.tuning_trials import SEED_KEY
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.run.processes import client_settings, metrics_address, process_specs, write_endpoint
from brakeline.deploy.run.run_config import EXPERIMENTS, SEEDS, RunConfig, decode, encode, load
from brakeline.deploy.run.run_keys import make_run_keys
from brakeline.deploy.run.run_lock import only_launcher
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.bus.identity import tls
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.model_set import ModelConfig
from brakeline.sim.ground_estimator import NoiseLevels
from brakeline.sim.sim_conditions import Conditions, Perception

CHANGED = RunConfig(
    robots=("ground",),
    method="none",
    model_config=ModelConfig("set-membership", "recursion"),
    arena="dense",
    deadline=0.25,
    change=PhysicsChange(after=500, payload_kg=1.0),
    conditions=Conditions(NoiseLevels(scale=2.0), 0.5, 0.8),
    learner=LearnerConfig(td3=TD3Config(hidden=(8, 16, 4)), capacity=99),
)


@pytest.mark.parametrize("config", [*EXPERIMENTS.values(), CHANGED])
def test_a_saved_configuration_is_read_back(config: RunConfig, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(encode(config))
    assert load(tmp_path / "config.json") == config
    values = json.loads(encode(config))
    values["recipe"] = values.pop("model_config")  # the former name
    assert decode(json.dumps(values)) == config


def test_an_unknown_or_damaged_configuration_is_refused_with_the_name_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    values = json.loads(encode(RunConfig()))
    for damage, said in (
        (values | {"colour": "red"}, "colour: Unexpected keyword"),
        (values | {"learner": values["learner"] | {"depth": 3}}, "learner.depth: Unexpected keyword"),
        (values | {"change": {"when": 3}}, "change.when: Unexpected keyword"),
        (values | {"actors": "many"}, "actors: Input should be a valid integer"),
        (values | {"arena": "ballroom"}, "no arena is called 'ballroom'"),
        (values | {"method": "prayer"}, "no method is called 'prayer'"),
        ([1, 2], "is no run's configuration"),
    ):
        path.write_text(json.dumps(damage))
        with pytest.raises(ValueError, match=said) as refused:
            load(path)
        assert str(path) in str(refused.value)
    path.write_text("{")
    with pytest.raises(ValueError, match="is no run's configuration"):
        load(path)


def test_counts_are_one_or_more_and_a_deterministic_run_has_one_robot() -> None:
    for name in ("actors", "steps", "replicas", "robots_per_actor"):
        with pytest.raises(ValueError, match="1 or more"):
            RunConfig(**{name: 0})
    for method in ("ddpc", "none"):  # the access list is the same with and without a filter
        with pytest.raises(ValueError, match=r"at most 64 robots, not 65, with any .* give more --actors"):
            RunConfig(robots_per_actor=65, method=method)
    assert RunConfig(robots_per_actor=64).robots_per_actor == 64
    for penalty in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="a penalty is finite and not negative"):
            RunConfig(penalty=penalty)
    with pytest.raises(ValueError, match="20000 is out of proportion to the rewards of ground: give at most 2057"):
        RunConfig(penalty=20_000.0)
    assert RunConfig(penalty=300.0).penalty == 300.0
    with pytest.raises(ValueError, match="--actors 1"):
        RunConfig(deterministic=True)
    assert RunConfig(deterministic=True, actors=1).learning().lockstep
    learning = RunConfig(seed=4, steps=77).learning()
    assert (learning.seed, learning.steps, learning.lockstep) == (4, 77, False)


@pytest.mark.parametrize("seed", [-1, SEEDS])
def test_no_training_has_the_episodes_of_an_evaluation(seed: int) -> None:
    """With a seed of a million, it had those of `evaluate --seed 0`."""
    assert RunConfig(seed=SEEDS - 1).seed < FRESH <= FRESH + Evaluation("random", seed=SEEDS - 1).seed < SEED_KEY
    with pytest.raises(ValueError, match="a seed is a number from 0 to 999999"):
        RunConfig(seed=seed)
    with pytest.raises(ValueError, match="a seed from 0 to 999999"):
        Evaluation("random", seed=seed)


def test_the_processes_of_a_run() -> None:
    names = [spec.name for spec in process_specs(RunConfig(actors=2, replicas=2))]
    assert names == ["recorder", "safety-0", "safety-1", "learner", "actor-0", "actor-1"]
    names = [spec.name for spec in process_specs(RunConfig(actors=1, method="none"))]
    assert names == ["recorder", "learner", "actor-0"]
    certifier = process_specs(RunConfig(actors=1, adapt=True))[2]
    assert (certifier.name, certifier.needed) == ("certify.adapt", False)
    with pytest.raises(ValueError, match="--adapt certifies model sets of the method ddpc, not of sailr"):
        RunConfig(adapt=True, method="sailr")
    several = process_specs(RunConfig(actors=3, robots_per_actor=4))
    assert [spec.number for spec in several if spec.kind == "actor"] == [0, 4, 8], "no robot's number comes twice"


def test_the_options_start_from_the_experiment(tmp_path: Path) -> None:
    debug = EXPERIMENTS["debug"]
    assert TrainCommand.defaults(["ground", "--experiment", "debug"]).config() == debug
    assert TrainCommand.defaults(["ground", "--experiment=debug"]).config() == debug
    assert TrainCommand.defaults(["ground"]).config() == EXPERIMENTS["default"]
    with pytest.raises(ValueError, match=r"no experiment is called 'debag'; there are: default, demo, debug"):
        TrainCommand.defaults(["--experiment", "debag"])


def test_a_penalty_without_robots_is_refused() -> None:
    with pytest.raises(ValueError, match="--penalty is for robots that drive"):
        parse("train", ["--from-logs", "runs/a", "--actors", "0", "--penalty", "5"]).config()
    assert parse("train", ["--from-logs", "runs/a", "--actors", "1", "--penalty", "5"]).config().penalty == 5.0


def test_a_resumed_run_keeps_its_configuration_but_for_the_steps(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(encode(CHANGED))
    resume = replace(TrainCommand.defaults(["ground"]), resume=tmp_path)
    assert resume.config() == CHANGED
    assert replace(resume, steps=5).config() == replace(CHANGED, steps=5)
    assert replace(resume, arena="dense", deadline=0.25, out=tmp_path, actors=2).config() == CHANGED, "the same again"
    assert replace(resume, from_logs=("log",)).config() == replace(CHANGED, from_logs=("log",))


def test_a_resumed_run_refuses_an_option_with_the_usual_value_if_it_has_another_one(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(encode(CHANGED))
    words = ["--resume", str(tmp_path)]
    assert parse("train", words).config() == CHANGED
    assert parse("train", [*words, "--steps", "5"]).config() == replace(CHANGED, steps=5)
    same = [*words, "--arena", CHANGED.arena, "--seed", str(CHANGED.seed), "--actors", str(CHANGED.actors)]
    assert parse("train", same).config() == CHANGED
    usual = RunConfig()
    assert usual.arena != CHANGED.arena
    with pytest.raises(ValueError, match="asked for by --arena: leave that out"):
        parse("train", [*words, "--arena", usual.arena]).config()
    with pytest.raises(ValueError, match="is no run's configuration"):
        parse("train", ["--resume", str(tmp_path / "none")]).config()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"arena": "open", "seed": 3}, "--arena, --seed"),
        ({"out": Path("elsewhere")}, "--out"),
        ({"filtering": ServiceOptions(mode="one-step")}, "--certificate or --mode"),
        ({"actors": 0}, "--actors"),
    ],
)
def test_a_resumed_run_refuses_what_it_would_ignore(options: dict[str, Any], said: str, tmp_path: Path) -> None:
    """With `--out` it would go on in the old folder, which one may want to keep."""
    (tmp_path / "config.json").write_text(encode(CHANGED))
    with pytest.raises(ValueError, match=f"asked for by {said}: leave that out"):
        replace(TrainCommand.defaults(["ground"]), resume=tmp_path, **options).config()


def test_an_impossible_world_is_refused_before_anything_starts() -> None:
    scans = Conditions(perception=Perception("scan"))
    for wrong, said in (
        ({"fleet": 2, "arena": "walkers"}, "obstacles that move"),
        ({"fleet": 2, "arena": "crossing", "conditions": scans}, "a scan shows other robots as walls"),
        ({"fleet": 2, "robots": ("quadrotor",), "arena": "default"}, "only ground robots can share a world"),
        ({"robots": ("ground", "ground+tracks")}, "each robot once, with one task"),
        ({"robots": ("ground+trucks",)}, r"there is no task ground\+trucks"),
    ):
        with pytest.raises(ValueError, match=said):
            RunConfig(**wrong)
    config = RunConfig(robots=("ground+tracks",), arena="walkers")
    assert decode(encode(config)) == config
    (spec,) = (spec for spec in process_specs(config) if spec.kind == "learner")
    assert robot_with_task(spec.robot).task.observation_dim == 50, "its process has the task"
    stored = policy_named("trained", robot_with_task(spec.robot), 0)
    assert stored(np.zeros(50, np.float32), {}).shape == (2,), "of its own observation, in a folder of its own"


def test_each_process_of_a_flight_can_read_the_robot_by_itself() -> None:
    """A robot of somebody's own has no name that another process knows."""
    path = Path(__file__).parents[3] / "examples" / "px4" / "quadrotor_px4.toml"
    (spec,) = (spec for spec in process_specs(FlyCommand(robot=str(path)).config()) if spec.kind == "actor")
    assert robot_with_task(spec.robot).name == "quadrotor-px4-late"


@pytest.mark.parametrize(
    ("launcher", "third"), [("9100", "9103"), ("0.0.0.0:9100", "0.0.0.0:9103"), ("", "")], ids=["here", "there", "none"]
)
def test_processes_have_the_ports_after_that_of_their_launcher(launcher: str, third: str, tmp_path: Path) -> None:
    write_endpoint(tmp_path, BusSettings(listen=("tcp/127.0.0.1:7447",), metrics=launcher))
    assert metrics_address(tmp_path, 2) == third
    assert client_settings(tmp_path).metrics == "", "who looks on does not take a port"


def test_the_processes_of_a_robot_with_a_dot_in_its_name_have_certificates(tmp_path: Path) -> None:
    """`actor-rover.v2-0` looked for the certificate of `actor-rover`, and no run of two robots began."""
    ground = (ROBOTS_FOLDER / "ground.toml").read_text()
    (tmp_path / "rover.toml").write_text(ground.replace('name = "ground"', 'name = "rover.v2"'))
    shutil.copy(ROBOTS_FOLDER / "ground.task.toml", tmp_path / "rover.task.toml")
    config = RunConfig(robots=("ground", str(tmp_path / "rover.toml")), actors=1)
    keys = make_run_keys(config, tmp_path)
    for spec in process_specs(config):
        assert tls(keys, spec.name, listens=False)


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch) -> None:
    """Before, both made keys and copied models in one folder, and one of them ended with an error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20260930-120000")
    with run_folder(None) as first, run_folder(None) as second, run_folder(None) as empty, run_folder(first) as given:
        assert [first.name, second.name] == ["20260930-120000", "20260930-120000_2"] and given == first
        for folder in (first, second):
            (folder / "config.json").touch()
    assert empty.name == "20260930-120000_3" and sorted(Path("runs").iterdir()) == [first, second]
    with run_folder(None) as locked, only_launcher(locked):
        pass
    assert not locked.exists(), "a lock is no run"
    Path("runs").rename("elsewhere")
    Path("runs").symlink_to("nowhere")
    with pytest.raises(FileExistsError), run_folder(None):
        pass
