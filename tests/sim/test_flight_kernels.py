"""The compiled flight controller is its plain twin, and compiled free flight is MuJoCo's."""

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle
from brakeline.sim.flight_controller import FlightController, controllers_at_rest
from brakeline.sim.kernels.flight_kernels import AIRFRAME, GRAVITY, fly
from brakeline.sim.quadrotor import Quadrotor, QuadrotorNoise
from tests.sim import flight_controller_twin
from tests.sim.station import field

TICKS = 10  # of a period


@pytest.mark.fast
def test_the_controller_is_its_twin_bit_for_bit() -> None:
    """Along random motions, with holds, jumps of the setpoint, a turning heading and saturated rotors."""
    rng, mine, twin = np.random.default_rng(0), FlightController(), flight_controller_twin.FlightController()
    thrusts, qpos, qvel, errors = np.zeros(4), np.zeros(7), np.zeros(6), np.zeros(9)
    for step in range(1600):
        if step % 200 == 0:
            setpoint = rng.uniform(-6.0, 6.0, 3) * (rng.random() < 0.6)
            mine.setpoint, twin.setpoint = tuple(setpoint.tolist()), setpoint
            yaw, rate = float(rng.uniform(-7.0, 7.0)), float(rng.choice([0.0, 0.5]))
            mine.turn_to(yaw)
            mine.turn_at(rate)
            twin.yaw_goal, twin.yaw_rate = yaw, rate
        attitude = np.array([1.0, *rng.normal(0.0, 0.3, 3)])
        qpos[:3], qpos[3:] = rng.normal(0.0, 2.0, 3), attitude / np.linalg.norm(attitude)
        qvel[:3], qvel[3:], errors[:6] = rng.normal(0.0, 3.0, 3), rng.normal(0.0, 2.0, 3), rng.normal(0.0, 0.01, 6)
        mine.update(qpos, qvel, errors, thrusts)
        expected = twin.update(qpos[:3] + errors[:3], qvel[:3] + errors[3:6], qpos[3:], qvel[3:])
        assert thrusts == pytest.approx(expected, abs=1e-12)


@pytest.mark.fast
def test_free_flight_is_that_of_mujoco() -> None:
    """Twelve seconds of restless flight, within 1e-9 m, m/s and m/s²."""
    vehicle = Quadrotor(field(), np.random.default_rng(0), QuadrotorNoise(scale=0.0))
    vehicle.alter(weak_motor=1.0)  # so that MuJoCo flies it
    one, errors, rng = controllers_at_rest(1), np.zeros((1, 2 * TICKS, 9)), np.random.default_rng(1)
    one["hold"], one["holds"] = vehicle.arena.start, True
    hover = 0.25 * AIRFRAME.mass * GRAVITY
    coordinates = np.array([[*vehicle.arena.start, 1.0, *[0.0] * 9, *[hover] * 4]])
    path, accelerations = np.zeros((1, TICKS, 3)), np.zeros((1, 3))
    for period in range(60):
        if period % 4 == 0:
            setpoint = rng.uniform(-5.0, 5.0, 3) * (rng.random() < 0.8)
        vehicle.step(setpoint)
        one["setpoint"] = vehicle.input
        fly(one, coordinates, errors, path, accelerations)
        mine = [*coordinates[0, :3], *coordinates[0, 7:10], *accelerations[0]]
        assert np.abs(vehicle.true - mine).max() < 1e-9
        assert path[0, -1].tolist() == coordinates[0, :3].tolist()


@pytest.mark.fast
def test_a_vehicle_flies_freely_until_it_may_touch_something() -> None:
    """Beside one that MuJoCo flies all the time, towards a wall: the same motion, and the same collision."""
    wall = Obstacle("box", (6.0, 0.0, 10.0), (2.0, 8.0, 8.0))
    pair = [Quadrotor(field(wall), np.random.default_rng(5)) for _ in range(2)]
    pair[1].alter(weak_motor=1.0)
    for _ in range(30):
        free, always = (vehicle.step(np.array([4.0, 0.0, 0.0])) for vehicle in pair)
        assert free.collision == always.collision
        if free.collision:
            break
        assert np.abs(free.true - always.true).max() < 1e-9 and abs(free.clearance - always.clearance) < 1e-9
        assert np.abs(free.measured - always.measured).max() < 1e-9
    assert free.collision
