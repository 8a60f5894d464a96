"""Disturbances of the ground robot's true motion: no two drives are equal, and a standing robot stands."""

import numpy as np
import pytest

from brakeline.messaging.obstacle import Array
from brakeline.sim.ground_realtime import RealtimeGroundRobot
from brakeline.sim.ground_robot import GroundRobot, NoiseLevels
from brakeline.sim.sim_conditions import Conditions, ProcessNoise
from brakeline.sim.vehicle import Vehicle
from tests.arenas import staged_arena

STAND, AHEAD, CURVE = np.zeros(2), np.array([0.25, 0.0]), np.array([0.2, 0.4])
EVEN = ProcessNoise(scale=0.0)


def robot(seed: int, noise: ProcessNoise | None = None) -> GroundRobot:
    """Return a robot in an empty room, by default with the disturbances that come with it."""
    return GroundRobot(staged_arena(half_width=20.0), np.random.default_rng(seed), process_noise=noise)


def after(vehicle: Vehicle, input: Array, periods: int) -> Array:
    """Return the true state after driving at an input."""
    for _ in range(periods):
        vehicle.step(input)
    return vehicle.true


def test_the_same_inputs_give_another_true_motion_under_each_seed() -> None:
    """After five seconds straight ahead at 0.25 m/s, which are 1.23 m."""
    ends = np.array([after(robot(seed), AHEAD, 25) for seed in range(10)])
    assert len(np.unique(ends, axis=0)) == 10
    along, across, heading = ends[:, :3].std(axis=0)
    assert 0.004 < along < 0.02 and 0.03 < across < 0.12 and 0.05 < heading < 0.2
    assert np.abs(ends[:, 1]).max() < 0.3


@pytest.mark.parametrize("seed", range(2))
def test_a_robot_at_rest_stays_at_rest(seed: int) -> None:
    vehicle = robot(seed)
    start = vehicle.true.copy()
    assert np.abs(after(vehicle, STAND, 25) - start).max() < 2e-5
    after(vehicle, CURVE, 5)
    stopped = after(vehicle, STAND, 3).copy()
    assert np.abs(after(vehicle, STAND, 25) - stopped).max() < 1e-4


def test_disturbances_change_no_other_number_of_an_episode() -> None:
    """They have a generator of their own, so sensors err as without them."""
    rngs = [np.random.default_rng(3) for _ in range(2)]
    robots = [
        GroundRobot(staged_arena(), rng, process_noise=noise) for rng, noise in zip(rngs, (None, EVEN), strict=True)
    ]
    assert (robots[0].measured == robots[1].measured).all()
    assert rngs[0].random() == rngs[1].random()


def test_a_robot_in_real_time_has_the_disturbances_of_one_in_lockstep() -> None:
    arena = staged_arena()
    lockstep = GroundRobot(arena, np.random.default_rng(5))
    realtime = RealtimeGroundRobot(arena, np.random.default_rng(5))
    for input in (AHEAD, CURVE, STAND, STAND, STAND, CURVE):
        realtime.drive(input)
        for _ in range(lockstep.samples):
            realtime.advance()
        assert np.abs(lockstep.step(input).true - realtime.true).max() < 1e-9


def test_the_scale_is_a_condition_that_a_run_logs() -> None:
    told = Conditions(NoiseLevels(), process_noise=ProcessNoise(scale=0.5)).describe()
    assert told["process_scale"] == "0.5" and told["process_motor_gain"] == "0.01" and told["scale"] == "1"


@pytest.mark.parametrize("wrong", [{"scale": -1.0}, {"scale": float("nan")}, {"wheel_correlation": 0.0}])
def test_noise_that_is_no_number_or_negative_is_refused(wrong):
    with pytest.raises(ValueError, match="process noise"):
        ProcessNoise(**wrong)
