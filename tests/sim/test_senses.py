"""What is observed: the documented order, from the measured state; the lidar from the true one."""

import numpy as np
import pytest

from messaging.shapes import CYLINDER, Obstacle
from messaging.tasks import task_of
from sim.lidar import Lidar
from sim.senses import AirSenses, GroundSenses, TurnMemory
from sim.world import staged_arena
from tests.robots import GROUND, QUADROTOR

RNG = np.random.default_rng(0)


def test_the_ground_robots_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (1.0, 0.5), (0.3,)), goal=(-1.0, 2.0))
    true, measured = np.array([0.0, 0.0, 0.5, 0.1, 0.2]), np.array([0.01, -0.01, 0.51, 0.11, 0.19])
    input = np.array([0.2, -0.3])
    senses = GroundSenses(GROUND, arena, RNG, 0.0)
    observation = senses.observe(true, measured, input)
    named = dict(zip(task_of(GROUND).observed, observation.tolist(), strict=True))
    offset = np.array(arena.goal) - measured[:2]
    angle = np.arctan2(offset[1], offset[0]) - measured[2]
    assert named["goal distance [5 m]"] == pytest.approx(np.linalg.norm(offset) / 5.0)
    assert named["goal bearing sin"] == pytest.approx(np.sin(angle))
    assert named["goal bearing cos"] == pytest.approx(np.cos(angle))
    assert named["speed [0.25 m/s]"] == pytest.approx(0.11 / 0.25)
    assert named["turn rate [0.5 rad/s]"] == pytest.approx(0.19 / 0.5)
    assert named["last speed input [0.25 m/s]"] == pytest.approx(0.2 / 0.25)
    assert named["last turn input [0.5 rad/s]"] == pytest.approx(-0.3 / 0.5)
    assert named["turn memory: low-passed turn rate [0.5 rad/s]"] == pytest.approx((1 - np.exp(-0.1)) * 0.19 / 0.5)
    mount = -0.032 * np.array([np.cos(0.5), np.sin(0.5)])
    assert observation[:18] == pytest.approx(Lidar(arena, task_of(GROUND).rays).cast(mount, 0.5) / 3.5)
    assert observation[:18].min() < 0.3
    assert senses.speed(true) == 0.1


def test_the_quadrotors_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (3.0, 0.0, 4.0), (1.0, 8.0)), goal=(-6.0, 2.0, 7.0), height=8.0)
    true = np.array([0.0, 0.0, 4.0, 1.0, 2.0, -2.0, 0.1, 0.2, 0.3])
    measured = true + 0.02
    input = np.array([1.0, -3.0, 5.0])
    senses = AirSenses(QUADROTOR, arena, RNG, 0.0)
    observation = senses.observe(true, measured, input)
    assert len(observation) == task_of(QUADROTOR).observation_dim == 189
    named = dict(zip(task_of(QUADROTOR).observed, observation.tolist(), strict=True))
    offset = np.array(arena.goal) - measured[:3]
    for i, axis in enumerate("xyz"):
        assert named[f"goal - p, {axis} [its length + 5 m]"] == pytest.approx(offset[i] / (np.linalg.norm(offset) + 5))
        assert named[f"v{axis} [5 m/s]"] == pytest.approx(measured[3 + i] / 5.0)
        assert named[f"last v{axis} setpoint [5 m/s]"] == pytest.approx(input[i] / 5.0)
    assert observation[:180] == pytest.approx(Lidar(arena, task_of(QUADROTOR).rays).cast(true[:3]) / 12.0)
    assert named["ray 2 [range/12 m]"] == pytest.approx(2.0 / 12.0)  # level, straight ahead
    assert senses.speed(true) == pytest.approx(3.0)


def test_turn_memory_forgets_within_seconds() -> None:
    memory = TurnMemory()
    for _ in range(10):  # 2 s
        memory.update(0.5, 0.2)
    assert memory.value == pytest.approx(0.5 * (1.0 - np.exp(-1.0)))
