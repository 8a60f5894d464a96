"""A robot that its own model set simulates, because nobody wrote a simulator of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy import cli
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.data_paths import model_path
from brakeline.deploy.experiments.evaluate import Evaluation, model_of
from brakeline.deploy.learned_vehicle import LearnedMotion, LearnedVehicle
from brakeline.deploy.vehicle_factory import empty_arena, environment
from brakeline.errors import BadModel, Mismatch
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.task import RobotWithTask, robot_with_task, with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Request
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.in_process import InProcess
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.batch.batch_support import NoBatch
from brakeline.sim.delayed_vehicle import simulated_vehicle
from brakeline.sim.sim_conditions import Conditions
from tests.safety.test_one_step import CONFIG, certified, driven
from tests.safety.test_turning_in_place import LONG
from tests.safety.test_turning_in_place import ROBOT as DESCRIBED

ROBOT = with_task(DESCRIBED, robot_with_task("ground").task)
LEARNED = Conditions(learned=True)


def put_to_use(model: ModelSet, robot: RobotWithTask) -> None:
    path = model_path(robot, CONFIG)
    path.parent.mkdir(parents=True)
    model.save(path)


@pytest.fixture(autouse=True)
def _model_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    put_to_use(certified()[0], ROBOT)


def at_start(robot: RobotWithTask, heading: float = 0.7) -> Any:
    return simulated_vehicle(robot, LEARNED)(empty_arena(robot, (1.0, -2.0), heading), np.random.default_rng(0))


def with_errors(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    monkeypatch.setattr(LearnedMotion, "_share_used", lambda self: 1.0)
    monkeypatch.setattr(LearnedMotion, "errors", lambda self, rng, share: rng.choice([-size, size], (1, 5)))


def test_without_errors_it_moves_as_the_rollout_of_a_plan(monkeypatch) -> None:
    with_errors(monkeypatch, 0.0)
    vehicle, model, plan = at_start(ROBOT), certified()[0], np.tile([0.4, -1.0], (ROBOT.horizon, 1))
    periods = [vehicle.step(input) for input in plan]
    window = np.concatenate([np.zeros(4), plan.ravel()])[None]
    ahead = model.one_step.rollouts(ROBOT, window)[0]
    cos, sin = np.cos(0.7), np.sin(0.7)
    places = np.array([1.0, -2.0]) + ahead[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    states = np.array([period.true for period in periods])
    assert states[:, :2] == pytest.approx(places, abs=1e-9) and states[:, 2] == pytest.approx(0.7 + ahead[:, 2])
    assert states[:, 3:] == pytest.approx(ahead[:, 3:5]) and (periods[-1].measured == periods[-1].true).all()
    moved = ahead[1, :2] - ahead[0, :2]  # in the frame of the first period's start
    turn = ahead[0, 2]
    own = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ moved
    assert periods[1].subsamples[-1] == pytest.approx(own) and periods[1].turned == pytest.approx(ahead[1, 2] - turn)


def test_no_state_leaves_the_set_that_the_filter_predicts_and_nothing_is_hit() -> None:
    env, safety = environment(ROBOT, "dense", 0, LEARNED), InProcess(Filter(certified()[0]), accept_bound=0.1)
    rng, errors = np.random.default_rng(1), []
    for episode in range(4):
        _, info = env.reset(options={"episode_seed": episode})
        safety.reset()
        for _ in range(60):
            wanted = rng.uniform(ROBOT.low(), ROBOT.high())
            answer = safety.decide(info["state"], wanted, info["obstacles"], known_free=True)
            *_, ended, _, info = env.step(answer.action)
            assert answer.predicted.contains(ROBOT, info["state"]) and not info["collision"]
            errors.append(answer.predicted.share_used(ROBOT, info["state"]))
            if ended:
                break
    assert 0.05 < np.mean(errors) < 0.5, "and it has errors"


def test_errors_fill_the_tubes_of_stops_and_few_leave_them() -> None:
    """With errors too large for its sets, a simulated ArduCopter drifted out of the place where it hovered."""
    safety, rng, used = Filter(certified()[0]), np.random.default_rng(5), []
    for _ in range(200):
        vehicle, wanted = at_start(ROBOT), rng.uniform(ROBOT.low(), ROBOT.high())
        vehicle._rng = rng
        for _ in range(3):
            vehicle.step(wanted)
        stop = wanted * ROBOT.stop_profile()
        request = Request(vehicle.measured, wanted, wanted, stop, Shapes.of([], 2), known_free=True)
        decision = safety.decide(request)
        places = np.array([vehicle.step(input).true[:2] for input in decision.plan])
        used.append((np.abs(places - decision.tube_center) / decision.tube_half_width).max())
    assert np.mean(np.array(used) > 1.0) <= 0.02 and np.quantile(used, 0.9) > 0.3


def test_each_disc_of_the_body_can_collide() -> None:
    long = replace(ROBOT, body=LONG)
    model = certify(replace(driven(trajectories=3), robot=replace(DESCRIBED, body=LONG)), CONFIG)[0]
    empty = empty_arena(long)
    post = Obstacle("cylinder", (4.0, 0.5), (0.1,))
    arena = replace(empty, obstacles=(post, *empty.obstacles))
    vehicle = LearnedVehicle(arena, np.random.default_rng(0), LearnedMotion(model))
    across, towards = np.array([4.0, 0.0, 0.0, 0.0, 0.0]), np.array([4.0, 0.0, np.pi / 2, 0.0, 0.0])
    assert vehicle.clearance(np.stack([across, towards])) == pytest.approx([0.5 - 0.1 - 0.15, 0.38 - 0.1 - 0.1])
    vehicle.true = towards + 0.15 * np.eye(5)[1]
    assert not vehicle.step(np.zeros(2)).collision
    vehicle.true = towards + 0.2 * np.eye(5)[1]
    assert vehicle.step(np.zeros(2)).collision
    vehicle.true = towards - [0.0, 0.0, 0.3, 0.0, -1.5]
    turning = vehicle.step(np.array([0.0, 1.5]))
    assert turning.turned > 0.1 and turning.clearance == pytest.approx(vehicle.clearance(turning.true))


def test_speeds_stay_within_the_recorded_ones(monkeypatch) -> None:
    with_errors(monkeypatch, 1e6)
    vehicle, (low, high) = at_start(ROBOT), certified()[0].domain
    states = np.array([vehicle.step(np.array([0.6, 1.5])).true for _ in range(50)])
    assert (states[:, 3:] >= low[:2]).all() and (states[:, 3:] <= high[:2]).all()


def test_a_robot_in_real_time_has_a_model_set_of_its_own_and_answers_a_period_later(monkeypatch) -> None:
    late = ROBOT.in_real_time()
    with pytest.raises(BadModel, match="quick-turner-late has no model set of mode one-step"):
        at_start(late)
    data = replace(driven(trajectories=3), robot=DESCRIBED.in_real_time())
    model = certify(data, CONFIG)[0]
    put_to_use(replace(model, about={**model.about, "acceleration_age": "0.2"}), late)
    with_errors(monkeypatch, 0.0)
    vehicle = at_start(late)
    first, second = (vehicle.step(np.array([0.6, 0.0])).true for _ in range(2))
    assert abs(first[3]) < 0.02 < 0.2 < second[3]
    env = environment(late, "default", 0, LEARNED)
    runner = EpisodeRunner(late, env, ActorIdentity("actor-0", 0, 0))
    runner.begin(0)
    assert runner.request(np.zeros(2)).acceleration_age == 0.2, "the states hold what the data held"
    with pytest.raises(Mismatch, match=r"of 0\.2 s ago, and the simulator reports the present one.*--learned"):
        model_of(late, Evaluation(model_config=CONFIG, accept_bound=1.0))
    assert model_of(late, Evaluation(model_config=CONFIG, accept_bound=1.0, conditions=LEARNED))


def test_what_it_cannot_simulate_is_refused(capsys) -> None:
    with pytest.raises(ValueError, match="no payload"):
        simulated_vehicle(ROBOT, Conditions(learned=True, payload_kg=0.5))
    with pytest.raises(Mismatch, match="another quick-turner"):
        simulated_vehicle(replace(ROBOT, period=0.1), LEARNED)
    with pytest.raises(NoBatch, match="--learned"):
        BatchNavigationEnv(robot_with_task("ground"), 2, conditions=LEARNED)
    env = environment(ROBOT, "walkers", 0, LEARNED)
    with pytest.raises(ValueError, match="meets no moving obstacles: walkers"):
        env.reset()
    assert cli.main(["evaluate", "ground", "--learned", "--episodes", "1"]) == 1
    assert "brakeline certify ground --data LOG --use" in " ".join(capsys.readouterr().err.split())
