"""The quadrotor follows setpoints, and keeps the bounds of its estimate, its wind and its size. Its compiled controller
is the plain twin, and compiled free flight is MuJoCo's.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brakeline.errors import BadInput
from brakeline.messaging.obstacle import Obstacle
from brakeline.sim.arena import Arena
from brakeline.sim.delayed_vehicle import delayed
from brakeline.sim.flight_controller import FlightController, controllers_at_rest
from brakeline.sim.kernels.flight_kernels import AIRFRAME, GRAVITY, OUTER, OUTER_EVERY
from brakeline.sim.kernels.flight_kernels import fly as fly_freely
from brakeline.sim.quadrotor import MODEL, SAMPLES, Quadrotor, QuadrotorNoise
from brakeline.sim.wind import Wind, WindProcess
from tests.arenas import staged_arena
from tests.robots import QUADROTOR
from tests.sim import flight_controller_twin
from tests.sim.station import field

QUIET = QuadrotorNoise(scale=0.0)
STAND = np.zeros(3)


def room(*obstacles: Obstacle, start: tuple[float, ...] = (0.0, 0.0, 500.0)) -> Arena:
    return staged_arena(*obstacles, start=start, goal=(50.0, 50.0, 50.0), half_width=1000.0, height=1000.0)


def fly(vehicle: Quadrotor, setpoint: tuple[float, float, float], periods: int) -> list[np.ndarray]:
    """Return the true states after each period."""
    return [vehicle.step(np.array(setpoint)).true for _ in range(periods)]


def quadrotor(seed: int = 0, noise: QuadrotorNoise = QUIET, wind: Wind | None = None) -> Quadrotor:
    return Quadrotor(room(), np.random.default_rng(seed), noise, wind)


def test_the_quadrotor_starts_in_steady_hover() -> None:
    vehicle = quadrotor()
    assert np.abs(vehicle.true - [0, 0, 500, *[0] * 6]).max() < 1e-3
    assert not vehicle.initial_period().collision
    assert vehicle.initial_period().clearance == pytest.approx(500.0 - QUADROTOR.footprint, abs=1e-3)


@pytest.mark.parametrize("setpoint", [(5, 5, 5), (-5, 5, -5), (5, -5, 0), (0, 0, 5)])
def test_full_speed_on_every_axis_at_once_then_a_stop(setpoint: tuple[float, float, float]) -> None:
    vehicle = quadrotor()
    at_speed = fly(vehicle, setpoint, 20)[-1][3:6]
    assert np.abs(at_speed - setpoint).max() < 0.1
    stop = fly(vehicle, (0, 0, 0), 7 + 4)  # seven periods of slew, three to settle, one spare
    assert np.abs(stop[-1][3:6]).max() < 0.03
    assert (np.sign(setpoint) * (stop[-1][:3] - stop[9][:3]) < 0.02).all()  # almost no overshoot
    for axis in range(3):
        backward = -np.sign(setpoint[axis]) * np.array([state[3 + axis] for state in stop])
        assert backward.max() < 0.05 or setpoint[axis] == 0


def test_a_setpoint_is_clipped_to_bounds_and_slew() -> None:
    vehicle = quadrotor()
    vehicle.step(np.array([9.0, -9.0, 0.5]))
    assert vehicle.input.tolist() == pytest.approx([0.8, -0.8, 0.5])
    for _ in range(20):
        vehicle.step(np.array([9.0, -9.0, 0.5]))
    assert vehicle.input.tolist() == pytest.approx([5.0, -5.0, 0.5])


@pytest.mark.parametrize("bad", [[1.0, 2.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])
def test_an_input_that_is_not_three_finite_numbers_is_refused(bad: list[float]) -> None:
    with pytest.raises(BadInput):
        quadrotor().step(np.array(bad))


def test_the_closed_loop_is_nearly_linear() -> None:
    """A linear map of (v, a, setpoint in force, new setpoint) predicts the next displacement to about a centimetre."""
    vehicle, rng = quadrotor(), np.random.default_rng(5)
    rows, moved = [], []
    for _ in range(500):
        before, held = vehicle.true.copy(), vehicle.input.copy()
        target = vehicle.input + rng.uniform(-0.8, 0.8, 3)
        vehicle.step(target)
        rows.append([*before[3:], *held, *vehicle.input, 1.0])
        moved.append(vehicle.true[:3] - before[:3])
    solution = np.linalg.lstsq(np.array(rows), np.array(moved), rcond=None)[0]
    residual = np.array(rows) @ solution - np.array(moved)
    assert np.sqrt((residual**2).mean()) < 0.005
    assert np.abs(residual).max() < 0.03


def test_a_stopped_quadrotor_holds_its_position() -> None:
    vehicle = quadrotor(noise=QuadrotorNoise())
    fly(vehicle, (3, -2, 1), 15)
    fly(vehicle, (0, 0, 0), 12)
    held = np.array(fly(vehicle, (0, 0, 0), 150))[:, :3]
    assert np.linalg.norm(held - held[0], axis=1).max() < 0.08


def test_the_estimate_stays_within_its_bound() -> None:
    vehicle, rng = quadrotor(noise=QuadrotorNoise()), np.random.default_rng(1)
    errors = []
    for _ in range(600):
        period = vehicle.step(vehicle.input + rng.choice([-0.8, 0.8], 3))
        errors.append(np.abs(period.measured - period.true))
    worst = np.max(errors, axis=0)
    assert (worst < QUADROTOR.measurement_bound).all()
    assert (worst[:6] > 0.9 * np.array(QUADROTOR.measurement_bound[:6])).all()  # the bound is not loose


def test_subsamples_lead_from_the_measured_start_to_the_measured_end() -> None:
    vehicle = quadrotor(noise=QuadrotorNoise())
    fly(vehicle, (2, 0, 0), 5)
    before = vehicle.measured[:3]
    period = vehicle.step(np.array([2.0, 1.0, 0.0]))
    assert period.subsamples.shape == (SAMPLES, 3)
    assert period.subsamples[-1] == pytest.approx(period.measured[:3] - before)


def test_every_geom_lies_within_the_footprint() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    body = model.body("base").id
    for geom in np.flatnonzero(model.geom_bodyid == body):
        assert np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom] < QUADROTOR.footprint


def test_the_controller_compensates_the_wind() -> None:
    vehicle = quadrotor(wind=Wind(speed=6.0, direction=0.7, gust=1.0))
    held = np.array(fly(vehicle, (0, 0, 0), 100))
    assert np.abs(held[:, :3] - [0, 0, 500]).max() < 0.6
    moving = np.array(fly(vehicle, (3, 0, 0), 40))[15:, 3]
    assert abs(moving.mean() - 3.0) < 0.1


def test_gusts_have_their_standard_deviation_and_cut_off() -> None:
    air = WindProcess(Wind(speed=2.0, direction=0.0, gust=1.5, correlation=0.5), np.random.default_rng(0), 0.05)
    course = []
    for _ in range(20000):
        air.advance()
        course.append(air.velocity)
    gusts = np.array(course) - [2.0, 0.0, 0.0]
    assert gusts.std(axis=0) == pytest.approx([1.5] * 3, rel=0.1)
    assert np.abs(gusts).max() <= 4.5


def test_payload_and_wind_can_change_and_invalid_changes_are_refused() -> None:
    vehicle = quadrotor()
    vehicle.alter(payload_kg=0.2, wind_speed=3.0)
    assert np.abs(fly(vehicle, (0, 0, 0), 40)[-1][:3] - [0, 0, 500]).max() < 1.0
    vehicle.alter(payload_kg=0.0, wind_speed=0.0, weak_motor=0.9)
    assert np.abs(fly(vehicle, (0, 0, 0), 40)[-1][3:6]).max() < 0.5
    with pytest.raises(ValueError, match="floor_friction"):
        vehicle.alter(floor_friction=0.5)
    with pytest.raises(ValueError, match="0 or more"):
        vehicle.alter(payload_kg=-1.0)


def test_the_seed_determines_the_flight() -> None:
    flights = []
    for _ in range(2):
        vehicle = Quadrotor(room(), np.random.default_rng(3), QuadrotorNoise(), Wind(speed=2.0, gust=1.0))
        flights.append([vehicle.step(np.array([1.0, 2.0, -1.0])).measured for _ in range(20)])
    assert np.array_equal(*flights)


def test_in_real_time_each_input_is_executed_one_period_later() -> None:
    at_once = quadrotor(3, QuadrotorNoise())
    late_vehicle = delayed(Quadrotor, QUADROTOR.in_real_time())(room(), np.random.default_rng(3))
    inputs = [*np.random.default_rng(4).uniform(-5.0, 5.0, (10, 3))]
    for executed, given in zip([np.zeros(3), *inputs[:-1]], inputs, strict=True):
        period, expected = late_vehicle.step(given), at_once.step(executed)
        assert period.true == pytest.approx(expected.true, abs=1e-12)
        assert period.measured == pytest.approx(expected.measured, abs=1e-12)
        assert (np.abs(late_vehicle.input - at_once.input) <= 0.8 + 1e-12).all(), "within the slew"
        assert (np.abs(late_vehicle.input - given) <= np.abs(at_once.input - given) + 1e-12).all(), "on the way to it"
    with pytest.raises(BadInput):
        late_vehicle.step(np.array([np.nan, 0.0, 0.0]))


def test_a_large_jump_of_the_setpoint_is_ramped() -> None:
    """The reference limits a setpoint without slew to the acceleration that the airframe can give."""
    controller, speeds = FlightController(), []
    controller.setpoint = (5.0, 0.0, 0.0)
    for _ in range(300 * OUTER_EVERY):
        controller.update(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.zeros(6), np.zeros(9), np.zeros(4))
        speeds.append(controller.record["velocity"][0, 0])
    assert np.diff(speeds[::OUTER_EVERY]).max() / OUTER < 5.5
    assert speeds[-1] == pytest.approx(5.0)


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
        fly_freely(one, coordinates, errors, path, accelerations)
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
    assert free.collision and free.closest < 0.05 and abs(free.true[0] - 5.0) < 0.4
