"""What a spinning lidar with faults reports."""

import math

import numpy as np
import pytest

from brakeline.deploy.run.ros2_bridge import BridgeSettings
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import BEAMS, SpinningLidar
from brakeline.sim.ground_robot import SAMPLES
from brakeline.sim.sim_conditions import Conditions, Perception, SensorFaults
from tests.robots import GROUND

STAND = np.array([0.0, 0.0, 0.3, 0.0, 0.0])


def turn_of(faults):
    arena = draw_arena("dense", np.random.default_rng(1), GROUND)
    lidar = SpinningLidar(arena, np.random.default_rng(2), 0.0, nearest=1.0, faults=faults)
    return [lidar.measure_sector(STAND) for _ in range(SAMPLES)][-1]


def test_a_beam_without_information_is_nan_and_all_others_stay():
    good = turn_of(SensorFaults())
    assert np.isfinite(good).any() and np.isneginf(good).any()
    dropped = turn_of(SensorFaults(dropped=0.2))
    lost = np.isnan(dropped)
    assert 0.1 < lost.mean() < 0.3 and not np.isnan(good).any()
    np.testing.assert_array_equal(dropped[~lost], good[~lost])


def test_a_blind_sector_is_behind_the_robot():
    angles = 2.0 * math.pi / BEAMS * np.arange(BEAMS)
    lost = np.isnan(turn_of(SensorFaults(blind=1.0)))
    np.testing.assert_array_equal(lost, np.abs(angles - math.pi) < 0.5)


def test_a_simulated_ros_robot_refuses_faults_that_it_does_not_have():
    with pytest.raises(ValueError, match="late"):
        BridgeSettings(conditions=Conditions(perception=Perception("scan", SensorFaults(late=1))))
