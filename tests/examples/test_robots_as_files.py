"""Robots that consist of files only: the statements of `docs/your_robot.md` about them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import islice
from pathlib import Path

import mujoco
import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.cli import main
from brakeline.deploy.data import collect, data_paths, model_store, simulated_recording
from brakeline.deploy.data.certification import certify
from brakeline.deploy.experiments.evaluate import FRESH, in_process
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.run.processes import process_specs
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadData
from brakeline.messaging.obstacle import BOX, Obstacle
from brakeline.messaging.task import RobotWithTask, address, robot_with_task
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.validation import ValidationReport
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import NoiseLevels
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import Vehicle
from tests.accepting import BOUND
from tests.arenas import staged_arena
from tests.deploy.drive import episode
from tests.examples.programs import EXAMPLES

NAMES = ("car", "omni")
TRAJECTORIES = 20  # enough windows in both parts of the data


def robot(name: str) -> RobotWithTask:
    return robot_with_task(str(EXAMPLES / name / f"{name}.toml"))


@pytest.fixture(scope="module", params=NAMES)
def kind(request: pytest.FixtureRequest) -> RobotWithTask:
    return robot(request.param)


@pytest.fixture(scope="module")
def recorded(kind: RobotWithTask) -> Dataset:
    return collect.dataset(kind, list(collect.record(kind, TRAJECTORIES, 1, Conditions())), 1, Conditions())


@pytest.fixture(scope="module")
def certified(recorded: Dataset) -> tuple[ModelSet, ValidationReport]:
    return certify(recorded, ModelConfig())


def exact(name: str, arena: Arena | None = None) -> Vehicle:
    """Return the robot's vehicle without measurement errors, in an arena or far from everything, heading east."""
    task = robot(name).task
    make = task.code(task.simulator)(Conditions(NoiseLevels(scale=0.0)), None)
    return make(arena or staged_arena(), np.random.default_rng(0))


def drive(vehicle: Vehicle, *inputs: list[float]) -> np.ndarray:
    """Carry out inputs, and return the true state."""
    for values in inputs:
        vehicle.step(np.array(values))
    return vehicle.true


def test_a_task_observes_the_quantities_in_its_file(kind: RobotWithTask) -> None:
    env = environment(kind, "default", 0)
    observation, info = env.reset(seed=0)
    assert observation.shape == (kind.task.observation_dim,) == env.observation_space.shape
    x, y, heading = info["true_state"][:3]
    angle = math.atan2(info["goal"][1] - y, info["goal"][0] - x) - heading
    to_goal = observation[kind.task.rays.directions.shape[0] + 1 :][:2]
    assert np.allclose(to_goal.sum(), math.sin(angle) + math.cos(angle), atol=0.1)
    assert info["speed"] == pytest.approx(0.0, abs=0.01)


def test_the_car_drives_on_the_circle_of_its_steering() -> None:
    """Ackermann: the middle of the rear axle turns about a point at the distance wheelbase / tan(steering)."""
    car = exact("car")
    drive(car, [0.0, 0.3], [0.0, 0.5], [0.0, 0.5], [0.4, 0.5], [0.4, 0.5])
    before = car.true.copy()
    after = drive(car, *[[0.4, 0.5]] * 5)
    turned, distance = after[2] - before[2], 0.4 * 5 * 0.2
    assert turned == pytest.approx(distance * math.tan(0.5) / 0.26, rel=0.03)
    backwards = drive(exact("car"), *[[-0.4, 0.3]] * 5)
    assert backwards[0] < -0.25 and backwards[2] < -0.1  # steered left, it turns right when it drives backwards


def test_the_car_keeps_its_steering_while_it_brakes_and_where_it_is_recorded() -> None:
    car = robot("car")
    assert (braking_plan(car, np.array([0.4, 0.5]))[1:] == [0.0, 0.5]).all()
    vehicle = exact("car")
    drive(vehicle, [0.4, 0.3], [0.4, 0.5], [0.4, 0.5], [0.0, 0.5], [0.0, 0.5], [0.0, 0.5])
    assert vehicle.true[3] == pytest.approx(0.0, abs=0.005) and vehicle.true[4] == pytest.approx(0.5, abs=0.01)
    (recorded,) = collect.record(car, 1, 3, Conditions())
    stopped = car.is_stop_input(recorded.inputs)
    assert stopped.any() and (np.abs(np.diff(recorded.inputs[:, 1])) <= 0.3 + 1e-9).all()
    assert np.abs(recorded.inputs[stopped, 1]).max() > 0.05


def test_the_base_moves_sideways_while_it_turns() -> None:
    omni = exact("omni")
    after = drive(omni, *[[0.0, 0.4, 0.8]] * 6)
    assert after[3:] == pytest.approx([0.0, 0.4, 0.8], abs=0.03)
    stopped = drive(omni, *[[0.0, 0.0, 0.0]] * 4)
    assert np.abs(stopped[3:]).max() < 0.002


@pytest.mark.parametrize("name", NAMES)
def test_every_geom_lies_in_the_discs_of_the_description(name: str) -> None:
    """Compare the corners in MuJoCo, with the car's wheels turned to the stop."""
    vehicle, body = exact(name), robot(name).body
    if name == "car":
        drive(vehicle, [0.0, 0.3], [0.0, 0.5], [0.0, 0.5])
    model, data = vehicle.model, vehicle.data
    frame = data.body("base")
    rotation = frame.xmat.reshape(3, 3)
    for i in range(model.ngeom):
        if model.geom_conaffinity[i] & 2:
            points = _surface(model, i) @ data.geom_xmat[i].reshape(3, 3).T + data.geom_xpos[i]
            points = (points - frame.xpos) @ rotation
            outside = [np.linalg.norm(points[:, :2] - np.array(disc.at), axis=1) - disc.radius for disc in body]
            assert np.min(outside, axis=0).max() <= 0.0, model.geom(i).name


def _surface(model: mujoco.MjModel, i: int) -> np.ndarray:
    """Return points on a geom, in its frame."""
    size, kind = model.geom_size[i], model.geom_type[i]
    around = np.linspace(0.0, 2.0 * np.pi, 60)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(np.meshgrid(*([-s, s] for s in size))).reshape(3, -1).T
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return np.column_stack([size[0] * np.cos(around), size[0] * np.sin(around), np.zeros(60)])
    assert kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    a, b = (grid.ravel() for grid in np.meshgrid(around, 0.5 * around))
    return size * np.column_stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)])


@pytest.mark.parametrize("name", NAMES)
def test_driving_into_something_is_a_collision(name: str) -> None:
    """The contacts of the physics count: the robot stops with its nose at a box."""
    vehicle = exact(name, staged_arena(Obstacle(BOX, (0.6, 0.0), (0.2, 1.0))))
    ahead = np.zeros(robot(name).action_dim)
    ahead[0] = 0.4
    touched = [vehicle.step(ahead).collision for _ in range(12)]
    assert any(touched) and not touched[0]
    assert 0.5 - vehicle.true[0] < 0.2


@pytest.mark.parametrize("heading, nose", [(0.0, 0.0), (0.5 * math.pi, 0.11), (-0.5 * math.pi, 0.11)])
def test_clearance_is_measured_from_the_discs_of_the_body(heading: float, nose: float) -> None:
    """A car parallel to a wall is farther from it than one whose nose or tail points at the wall."""
    wall = Obstacle(BOX, (0.0, 0.35), (4.0, 0.1))
    vehicle = exact("car", staged_arena(wall, start=(0.0, 0.0, heading)))
    for period in (vehicle.initial_period(), vehicle.step(np.zeros(2))):
        assert period.closest == pytest.approx(0.3 - nose - 0.155, abs=1e-3)
        assert period.clearance == pytest.approx(period.closest, abs=1e-3) and not period.collision


def test_held_out_plans_stay_in_their_tubes(certified: tuple[ModelSet, ValidationReport], recorded: Dataset) -> None:
    model, report = certified
    assert report.windows > 50 and report.violations <= 0.05 * report.windows
    assert report.bound_plan < 0.2
    assert model.robot == recorded.robot


def test_adversarial_episodes_collide_only_without_the_filter(kind, certified) -> None:
    model, _ = certified
    assert _collisions(kind, in_process(model, BOUND)) == (0, 0)
    assert _collisions(kind, None)[0] > 0


def _collisions(kind: RobotWithTask, question: object) -> tuple[int, int]:
    """Return the collisions and the steps outside of the predicted sets, in 51 periods of two adversarial episodes."""
    env = environment(kind, "default", FRESH)
    runner = EpisodeRunner(kind, env, ActorIdentity("test", 0, 0), filtered=question is not None)
    policy = scripted("adversary", kind, np.random.default_rng(0))
    collisions = outside = 0
    for number in range(2):
        for step in islice(episode(runner, policy, question, number), 51):
            collisions, outside = collisions + step.collision, outside + (step.compared and not step.contained)
    return collisions, outside


def test_a_changed_description_leads_to_a_new_model_set(kind, recorded, tmp_path, monkeypatch) -> None:
    """A wider body needs a new model set from the same recording; another period needs a new recording."""
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    recorded.save(data_paths.record_path(kind))
    before = model_store.model_for(kind, ModelConfig(), BOUND)
    assert model_store.model_for(kind, ModelConfig(), BOUND).version == before.version
    wider = replace(kind, body=tuple(replace(disc, radius=disc.radius + 0.05) for disc in kind.body))
    assert model_store.model_for(wider, ModelConfig(), BOUND).robot.body == wider.body
    with pytest.raises(BadData, match="changed"):
        simulated_recording.data_for(replace(kind, period=0.1))


def test_a_process_has_the_name_of_the_robot_and_not_of_its_file() -> None:
    config = RunConfig(robots=tuple(address(str(EXAMPLES / name / f"{name}.toml")) for name in NAMES))
    names = {spec.name for spec in process_specs(config) if spec.kind == "learner"}
    assert names == {"learner-car", "learner-omni"}


def test_the_trained_policy_lies_beside_the_task(kind: RobotWithTask) -> None:
    policy = policy_named("trained", kind, 0)
    observation, info = environment(kind, "default", FRESH).reset(seed=0)
    assert policy(observation, info).shape == (kind.action_dim,)


def test_check_finds_every_mistake_in_the_code_that_a_task_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("car.toml", "car.task.toml", "car.py", "car.xml"):
        (tmp_path / name).write_text((EXAMPLES / "car" / name).read_text())
    file, task = str(tmp_path / "car.toml"), tmp_path / "car.task.toml"
    assert main(["robot", "check", file]) == 0 and "no mistake" in capsys.readouterr().out
    right = task.read_text()
    task.write_text(right.replace("car.py:Greedy", "car.py:Gredy").replace(":PlanarObservation", ":np"))
    assert main(["robot", "check", file, "--json"]) == 1
    problems = dict(json.loads(capsys.readouterr().out)["problems"])
    assert problems.keys() == {"policies.greedy", "senses"} and "Gredy" in problems["policies.greedy"]
    task.write_text(right.replace("car.py", "broken.py"))
    for code, said in (
        ("import nothing_of_this_name", "nothing_of_this_name"),
        ("1 / 0", "ZeroDivision"),
        ("(", "Synt"),
    ):
        (tmp_path / "broken.py").write_text(code)
        assert main(["robot", "check", file]) == 1
        told = capsys.readouterr().err
        assert told.count(said) >= 4, "the second policy from the file too, not half of a module"
