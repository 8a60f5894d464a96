"""No simulator ignores a condition in silence."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.deploy import cli
from brakeline.deploy.run.autopilot_run import AutopilotSettings, vehicle
from brakeline.deploy.run.launcher import prepare
from brakeline.deploy.vehicle_factory import empty_arena, vehicle_in_empty_arena
from brakeline.errors import Mismatch
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import robot_with_task
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.delayed_vehicle import simulated_vehicle
from brakeline.sim.sim_conditions import Conditions, NoiseLevels, ProcessNoise, QuadrotorNoise, Wind
from tests.robots import GROUND, QUADROTOR

IN_WIND = Conditions(wind=Wind(speed=3.0))


@pytest.mark.parametrize(
    ("robot", "conditions", "words"),
    [
        (GROUND, IN_WIND, "no wind"),
        (QUADROTOR, Conditions(floor_friction=0.5), "no friction of a floor"),
        (QUADROTOR, Conditions(process_noise=ProcessNoise(scale=2.0)), "no disturbances of the motion"),
        (QUADROTOR.in_real_time(), Conditions(floor_friction=0.5, process_noise=ProcessNoise(scale=0.0)), "and no"),
    ],
)
def test_a_condition_that_a_simulator_does_not_have_is_refused(robot, conditions, words) -> None:
    with pytest.raises(ValueError, match=words):
        vehicle_in_empty_arena(robot, np.random.default_rng(0), conditions)
    if not robot.late:
        with pytest.raises(ValueError, match=words):
            BatchNavigationEnv(robot, 2, conditions=conditions)


@pytest.mark.parametrize("words", ["evaluate ground --episodes 1", "train ground --steps 100", "collect ground"])
def test_a_command_refuses_it_before_it_begins(words, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    out = ("--out", str(tmp_path / "run")) if words.startswith("train") else ()
    assert cli.main([*words.split(), "--wind", "3", *out]) == 1
    assert "simulator of this robot has no wind" in capsys.readouterr().err and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("kind", "name", "value", "said"),
    [
        (Conditions, "payload_kg", -1.0, "not -1"),
        (Conditions, "floor_friction", 0.0, "not 0"),
        (Conditions, "weak_motor", 1.1, "not 1.1"),
        (NoiseLevels, "scale", math.nan, "scale = nan is not finite"),
        (NoiseLevels, "scale", -1.0, "scale = -1.0 is not 0 or more"),
        (NoiseLevels, "lidar", math.inf, "lidar = inf is not finite"),
        (NoiseLevels, "encoder_ticks", 0, "encoder_ticks = 0 is not 1 or more"),
        (NoiseLevels, "fix_position", 0.0, "fix_position = 0.0 is not above 0"),
        (QuadrotorNoise, "scale", math.nan, "scale = nan is not finite"),
        (QuadrotorNoise, "gyro", -0.1, "gyro = -0.1 is not 0 or more"),
        (ProcessNoise, "scale", math.nan, "process noise"),
        (ProcessNoise, "scale", -1.0, "process noise"),
        (ProcessNoise, "wheel_correlation", 0.0, "process noise"),
        (Wind, "speed", math.nan, "speed = nan is not finite"),
        (Wind, "speed", -2.0, "speed = -2.0 is not 0 or more"),
        (Wind, "gust", -1.0, "gust = -1.0 is not 0 or more"),
        (Wind, "direction", math.inf, "direction = inf is not finite"),
        (Wind, "correlation", 0.0, "correlation = 0.0 is not above 0"),
    ],
)
def test_a_condition_that_cannot_be_is_refused(kind, name, value, said) -> None:
    with pytest.raises(ValueError, match=said):
        kind(**{name: value})


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.kind)
@pytest.mark.parametrize("changed", [Conditions(payload_kg=0.3), Conditions(weak_motor=0.5)], ids=["payload", "motor"])
def test_a_payload_and_a_weak_motor_change_how_a_vehicle_moves(robot, changed) -> None:
    ways = []
    for conditions in (Conditions(), Conditions(), changed):
        vehicle = vehicle_in_empty_arena(robot, np.random.default_rng(0), conditions)
        for _ in range(5):
            vehicle.step(np.asarray(robot.high()))
        ways.append(vehicle.true.copy())
    assert (ways[0] == ways[1]).all() and np.abs(ways[2] - ways[0]).max() > 1e-3


def test_a_flight_has_the_conditions_of_its_simulated_vehicle_and_none_behind_a_link(tmp_path) -> None:
    flight = cli.parse("fly", ["--url", "udpin:127.0.0.1:14999", "--payload", "0.2"]).config()
    with pytest.raises(ValueError, match="no payload"):
        prepare(flight, tmp_path / "run", resume=False)
    settings = AutopilotSettings("", noise=QuadrotorNoise(scale=0.0), changes={"payload_kg": 0.3}, airborne=True)
    heavy, light = (vehicle(one, empty_arena(QUADROTOR), 1) for one in (settings, replace(settings, changes={})))
    assert heavy.vehicle._model.body_mass.sum() == pytest.approx(light.vehicle._model.body_mass.sum() + 0.3)


@pytest.mark.parametrize(
    ("kind", "before", "after", "why"),
    [
        ("ground", "period = 0.2", "period = 0.1", r"has a period of 0\.2 s, not 0\.1 s"),
        ("quadrotor", "period = 0.2", "period = 0.1", r"has a period of 0\.2 s, not 0\.1 s"),
        ("ground", "high = 0.25", "high = 0.3", "narrower bounds"),
        ("quadrotor", "slew = 0.8", "slew = 1.6", "smaller slew"),
        ("ground", "radius = 0.105", "radius = 0.04", r"body that reaches 0\.105 m from its position, not 0\.04 m"),
        ("quadrotor", "radius = 0.3", "radius = 0.2", r"reaches 0\.3 m"),
    ],
)
def test_a_simulator_refuses_a_description_that_it_cannot_follow(kind, before, after, why, tmp_path):
    text = (ROBOTS_FOLDER / f"{kind}.toml").read_text()
    path = tmp_path / "other.toml"
    (tmp_path / "other.task.toml").write_text((ROBOTS_FOLDER / f"{kind}.task.toml").read_text())
    path.write_text(text.replace(f'name = "{kind}"', 'name = "other"'))
    simulated_vehicle(robot_with_task(str(path)), Conditions())
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(Mismatch, match=f"other: .*{why}"):
        simulated_vehicle(robot_with_task(str(path)), Conditions())
