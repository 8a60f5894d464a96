"""Robots whose lidars do not see all round drive, ram what they see, and hit nothing, also behind and beside them."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.decision_guard import Ask
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.safety.model.model_set import ModelConfig
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import RealtimeGroundRobot
from tests.actors.ros2.lidar_drives import ROBOT, drive, ram
from tests.robots import GROUND

MAST = ((math.pi, 0.3), (1.5, 0.1))  # rad: middle and half width of the masked directions
LIDARS = {"270": (270, ()), "240": (240, ()), "180": (180, ()), "mast": (360, MAST)}


@pytest.fixture(scope="module")
def late_ask(data_folder: Path) -> Ask:
    return in_process(model_for(ROBOT, ModelConfig()))


def free_at_start(arena, seed):
    """Return the radius [m] of the largest disc that is free at the start, 0.5 m at most."""
    room = draw_arena(arena, np.random.default_rng(seed), GROUND)
    return min(0.5, RealtimeGroundRobot(room, np.random.default_rng(0)).closest + GROUND.footprint)


@pytest.mark.parametrize("policy", [(0.0, 0.0), (0.2, 0.0), (0.0, 0.5)])
def test_with_a_lidar_of_270_degrees_the_robot_stands_drives_and_turns_if_space_at_the_start_is_stated(
    late_ask, policy
):
    refused = drive(late_ask, 1, 15, 270, lambda angles, ranges: policy)
    assert refused.kinds == {"blind": 15} and any("no information in 90 of 360" in reason for reason in refused.reasons)
    driven = drive(late_ask, 1, 30, 270, lambda angles, ranges: policy, free_at_start=free_at_start("default", 1))
    assert driven.kinds["allowed"] + driven.kinds["adjusted"] == 28 and driven.robot.collisions == 0
    assert driven.robot.distance_driven > 3.0 * policy[0] and driven.turned > 3.0 * policy[1]


@pytest.mark.parametrize("lidar", LIDARS)
def test_a_robot_that_rams_what_it_sees_hits_nothing(late_ask, lidar):
    degrees, masked = LIDARS[lidar]
    outcome = drive(late_ask, 5, 80, degrees, ram(5), "dense", masked, free_at_start=free_at_start("dense", 5))
    assert outcome.robot.collisions == 0 and outcome.robot.closest > GROUND.footprint
    assert outcome.kinds["allowed"] + outcome.kinds["adjusted"] > 60


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_eighty_episodes_of_ramming_hit_nothing(late_ask):
    for name, (degrees, masked) in LIDARS.items():
        total: Counter[str] = Counter()
        for seed in range(20):
            arena = "dense" if seed % 2 else "default"
            radius = free_at_start(arena, seed)
            outcome = drive(late_ask, seed, 120, degrees, ram(seed), arena, masked, free_at_start=radius)
            assert outcome.robot.collisions == 0, (name, seed)
            total.update(outcome.kinds)
        print(name, dict(total))
        assert total["allowed"] + total["adjusted"] > 0.9 * total.total()
