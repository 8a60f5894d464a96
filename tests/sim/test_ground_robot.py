"""The ground robot: its motion with disturbances and without, its collisions, its sensors and their fusion."""

import math

import mujoco
import numpy as np
import pytest

from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadInput
from brakeline.messaging.obstacle import CYLINDER, Array, Obstacle
from brakeline.sim.arena import Arena
from brakeline.sim.floor_physics import FloorPhysics
from brakeline.sim.ground_estimator import CUT, GroundEstimator, cut_normal, steady_gain, wrap
from brakeline.sim.ground_realtime import RealtimeGroundRobot
from brakeline.sim.ground_robot import MODEL, SAMPLE_TIME, WHEEL_RADIUS, GroundRobot, NoiseLevels
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.sim_conditions import Conditions, ProcessNoise
from brakeline.sim.vehicle import Period, Vehicle
from tests.arenas import staged_arena as room
from tests.robots import GROUND

QUIET, EVEN = NoiseLevels(scale=0.0), ProcessNoise(scale=0.0)


def pillar(x: float, y: float, radius: float) -> Obstacle:
    return Obstacle(CYLINDER, (x, y), (radius,))


def robot(arena: Arena | None = None, **options: float) -> GroundRobot:
    return GroundRobot(arena or room(), np.random.default_rng(0), QUIET, process_noise=EVEN, **options)


def drive(vehicle: GroundRobot, speed: float, turn: float, periods: int = 1) -> Period:
    for _ in range(periods):
        period = vehicle.step(np.array([speed, turn]))
    return period


def moved(vehicle: GroundRobot, speed: float, turn: float, periods: int = 1) -> float:
    before = vehicle.true[:2]
    return float(np.linalg.norm(drive(vehicle, speed, turn, periods).true[:2] - before))


def test_the_robot_stops_from_full_speed_within_a_period() -> None:
    vehicle = robot()
    drive(vehicle, 0.25, 0.0, 5)
    assert 0.006 < moved(vehicle, 0.0, 0.0) < 0.015
    assert abs(vehicle.true[3]) < 1e-3
    assert moved(vehicle, 0.0, 0.0) < 1e-4


@pytest.mark.parametrize("speed", [0.05, 0.15, 0.25])
def test_the_speed_is_that_of_the_input(speed: float) -> None:
    vehicle = robot()
    drive(vehicle, speed, 0.0, 2)
    assert moved(vehicle, speed, 0.0, 10) == pytest.approx(speed * 2.0, rel=0.01)  # the caster does not drag
    assert abs(vehicle.true[1]) < 1e-3
    assert vehicle.true[3] == pytest.approx(speed, rel=0.01)


@pytest.mark.parametrize(("speed", "turn"), [(0.0, 0.5), (0.0, -0.5), (0.0, 0.1), (0.1, 0.3), (0.25, -0.5)])
def test_the_turn_rate_is_that_of_the_input(speed: float, turn: float) -> None:
    vehicle = robot()
    drive(vehicle, speed, turn, 2)
    before = vehicle.true[2]
    drive(vehicle, speed, turn, 5)
    assert vehicle.true[2] - before == pytest.approx(turn, rel=0.04)


def test_wheels_roll_without_slip() -> None:
    vehicle = robot()
    for inputs in ((0.25, 0.0), (0.0, 0.5), (0.25, -0.5), (0.0, 0.0)):
        before = vehicle.true[:3]
        period = drive(vehicle, *inputs)
        cos, sin = math.cos(before[2]), math.sin(before[2])
        dead_reckoned = np.array([[cos, -sin], [sin, cos]]) @ period.subsamples[-1]
        assert period.true[:2] - before[:2] == pytest.approx(dead_reckoned, abs=5e-4)
        assert period.turned == pytest.approx(period.true[2] - before[2], abs=1e-6)


def test_subsamples_are_the_path_within_the_period_in_the_robots_frame() -> None:
    vehicle = robot(room(start=(1.0, -1.0, 2.0)))
    drive(vehicle, 0.25, 0.0, 3)
    period = drive(vehicle, 0.25, 0.0)
    assert period.subsamples.shape == (10, 2)
    assert period.subsamples[:, 0] == pytest.approx(0.005 * np.arange(1, 11), abs=2e-4)
    assert period.subsamples[:, 1] == pytest.approx(np.zeros(10), abs=1e-4)


def test_payload_and_friction_change_the_motion_during_a_run() -> None:
    vehicle, ways = robot(), []
    for change in ({}, {"payload_kg": 2.0}, {"payload_kg": 0.0, "floor_friction": 0.15}, {"floor_friction": 1.0}):
        vehicle.alter(**change)
        drive(vehicle, 0.25, 0.0, 3)
        ways.append(moved(vehicle, 0.0, 0.0, 2))
    bare, laden, slippery, again = ways
    assert laden > 1.5 * bare and slippery > 2.0 * bare and again == pytest.approx(bare, rel=0.02)
    assert moved(robot(payload_kg=2.0), 0.25, 0.0) < 0.85 * moved(robot(), 0.25, 0.0)


def test_a_weak_motor_turns_the_robot_aside_as_it_speeds_up_until_it_is_whole_again() -> None:
    vehicle, turned = robot(), []
    for share in (1.0, 0.3, 1.0):
        vehicle.alter(weak_motor=share)
        before = vehicle.true[2]
        drive(vehicle, 0.25, 0.0)
        turned.append(abs(vehicle.true[2] - before))
        drive(vehicle, 0.0, 0.0, 3)
    whole, weak, again = turned
    assert weak > 0.02 and max(whole, again) < 1e-3


@pytest.mark.parametrize("bad", [[0.1], [0.1, math.nan], [math.inf, 0.0], [0.1, 0.0, 0.0]])
def test_an_input_that_is_not_two_finite_numbers_is_refused(bad: list[float]) -> None:
    with pytest.raises(BadInput):
        robot().step(np.array(bad))


@pytest.mark.parametrize("change", [{"payload_kg": -1.0}, {"floor_friction": 0.0}, {"weak_motor": 1.1}, {"wings": 2.0}])
def test_an_impossible_change_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        robot().alter(**change)


def test_inputs_are_clipped_to_the_bounds() -> None:
    vehicle = robot()
    drive(vehicle, 9.0, 0.0, 5)
    assert vehicle.true[3] == pytest.approx(0.25, rel=0.01)
    assert (vehicle.input == [0.25, 0.0]).all()
    drive(vehicle, -1.0, 0.0, 2)
    assert abs(vehicle.true[3]) < 1e-3


def test_a_wall_is_a_collision_and_the_floor_is_not() -> None:
    vehicle = robot(room(half_width=0.5))
    periods = [drive(vehicle, 0.25, 0.0) for _ in range(12)]
    first = next(i for i, period in enumerate(periods) if period.collision)
    assert not any(period.collision for period in periods[:first])
    assert periods[first].true[0] == pytest.approx(0.5 - 0.037, abs=0.01)  # the front of the plates touches
    assert periods[first].closest == pytest.approx(-0.07, abs=0.01)
    assert all(period.clearance > 0.0 for period in periods[: first - 2])


def body_gap(state: np.ndarray, arena: Arena) -> float:
    """From the outline of plates and wheels to the nearest obstacle, m, by the distances of
    `brakeline.messaging.obstacle`."""
    angles = np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    circle = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    wheel, left = circle * (0.033, 0.009), np.array([0.0, 0.08])
    outline = np.concatenate((circle * 0.069 + (-0.032, 0.0), wheel + left, wheel - left))
    cos, sin = math.cos(state[2]), math.sin(state[2])
    points = outline @ np.array([[cos, sin], [-sin, cos]]) + state[:2]
    return float(arena.shapes.distance(points).min())


def test_collisions_agree_with_the_geometry() -> None:
    env = environment(GROUND, "dense", 0)
    policies = [scripted(name, GROUND, np.random.default_rng(0)) for name in ("adversary", "random", "greedy")]
    collisions = 0
    for episode in range(15):
        observation, info = env.reset(options={"episode_seed": episode})
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(policies[episode % 3](observation, info))
            gap = body_gap(info["true_state"], info["arena"])
            # it may bounce back a little after touching; a touch a millimetre deep is never missed
            assert gap < 0.006 if info["collision"] else gap > 0.0
            assert np.linalg.norm(info["true_state"][:2]) < 4.0
            done = terminated or truncated
        collisions += info["collision"]
    assert collisions > 10


def test_every_geom_lies_within_the_footprint() -> None:
    vehicle = robot()
    model, data = vehicle._physics.model, vehicle._physics.data
    for name, reach in (("plates", 0.069), ("caster", 0.005)):
        centre = data.geom_xpos[model.geom(name).id, :2] - data.qpos[:2]
        assert np.linalg.norm(centre) + reach <= GROUND.footprint
    assert math.hypot(0.08, 0.0) + 0.009 <= GROUND.footprint
    assert model.geom("plates").size[0] == 0.069
    assert model.body_mass.sum() == pytest.approx(1.0)


def test_samples_without_a_look_at_contacts_have_the_same_motion_to_the_bit() -> None:
    motions = []
    for apart in (False, True):
        arena = room(Obstacle(CYLINDER, (1.0, 0.5), (0.2,)), start=(0.0, 0.0, 0.3), goal=(2.0, 0.0))
        physics = FloorPhysics(MODEL, WHEEL_RADIUS, arena, SAMPLE_TIME, GROUND.period)
        mujoco.mj_forward(physics.model, physics.data)
        for sample in range(60):
            physics.data.ctrl[:] = (3.0, 3.0 - 0.1 * sample)
            assert not physics.advance(at_rest=False, apart=apart)
        motions.append(np.concatenate((physics.data.qpos, physics.data.qvel, physics.data.qacc_warmstart)))
    assert np.array_equal(*motions)


SAMPLE, RADIUS, SAMPLES = 0.02, 0.033, 10


def estimator(noise: NoiseLevels, seed: int = 0) -> GroundEstimator:
    return GroundEstimator(noise, np.random.default_rng(seed), np.zeros(3), np.zeros(2), RADIUS, SAMPLE)


def test_noise_is_cut_off_and_otherwise_normal() -> None:
    draws = cut_normal(np.random.default_rng(0), 0.5, (50_000,))
    assert np.abs(draws).max() <= CUT * 0.5
    assert draws.mean() == pytest.approx(0.0, abs=0.005)
    assert draws.std() == pytest.approx(0.5 * 0.8796, rel=0.01)  # of a normal distribution cut at 2 sigma
    assert (cut_normal(np.random.default_rng(0), 0.0, (5,)) == 0.0).all()


@pytest.mark.parametrize(("drift", "fix"), [(0.001, 0.005), (0.01, 0.005)])
def test_the_steady_gain_is_the_limit_of_the_kalman_gain(drift: float, fix: float) -> None:
    variance = 1.0
    for _ in range(1000):
        prior = variance + drift**2
        gain = prior / (prior + fix**2)
        variance = (1.0 - gain) * prior
    assert steady_gain(drift, fix) == pytest.approx(gain, rel=1e-9)


def test_dead_reckoning_of_an_arc_without_noise() -> None:
    sensors = estimator(NoiseLevels(scale=0.0))
    speed, turn = 0.2, 0.5
    times = SAMPLE * np.arange(1, SAMPLES + 1)
    wheels = np.outer(times, [speed - 0.08 * turn, speed + 0.08 * turn]) / RADIUS
    angle = turn * times
    path = np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=1) * speed / turn
    reading = sensors.update(wheels, np.full(SAMPLES, turn), np.array([*path[-1], angle[-1]]))
    tick = 2.0 * math.pi / 4096 * RADIUS
    assert reading.path == pytest.approx(path, abs=2.0 * tick)
    assert reading.turned == pytest.approx(angle[-1])
    assert reading.measured == pytest.approx([*path[-1], angle[-1], speed, turn], abs=2.0 * tick / SAMPLE)


def test_speed_and_turn_rate_come_from_the_last_samples() -> None:
    sensors = estimator(NoiseLevels(scale=0.0))
    steps = np.where(np.arange(SAMPLES) < 5, 0.0, 0.2 * SAMPLE / RADIUS)
    wheels = np.cumsum(np.stack((steps, steps), axis=1), axis=0)
    rates = np.where(np.arange(SAMPLES) < 5, 0.5, 0.0)
    measured = sensors.update(wheels, rates, np.zeros(3)).measured
    assert measured[3] == pytest.approx(0.2, abs=0.003)
    assert measured[4] == 0.0


def test_fusion_is_better_than_a_fix_and_within_its_bound() -> None:
    noise, errors = NoiseLevels(), []
    for seed in range(8):
        sensors = estimator(noise, seed)
        for _ in range(200):
            reading = sensors.update(np.zeros((SAMPLES, 2)), np.zeros(SAMPLES), np.zeros(3))
            errors.append(reading.measured)
    error = np.array(errors)
    assert (np.abs(error) <= GROUND.measurement_bound).all()
    assert (error[:, :3].std(axis=0) < 0.5 * np.array([0.005, 0.005, 0.01])).all()
    assert (error[:, :3].std(axis=0) > 0.1 * np.array([0.005, 0.005, 0.01])).all()


def test_the_heading_wraps() -> None:
    assert wrap(3.0 * math.pi) == pytest.approx(-math.pi)
    sensors = GroundEstimator(
        NoiseLevels(scale=0.0), np.random.default_rng(0), np.array([0, 0, 3.1]), np.zeros(2), RADIUS, SAMPLE
    )
    reading = sensors.update(np.zeros((SAMPLES, 2)), np.full(SAMPLES, 0.5), np.array([0.0, 0.0, wrap(3.2)]))
    assert reading.measured[2] == pytest.approx(wrap(3.2))


STAND, AHEAD, CURVE = np.zeros(2), np.array([0.25, 0.0]), np.array([0.2, 0.4])


def disturbed(seed: int) -> GroundRobot:
    """Return a robot in an empty room, with the errors and disturbances that come with it."""
    return GroundRobot(room(half_width=20.0), np.random.default_rng(seed))


def after(vehicle: Vehicle, input: Array, periods: int) -> Array:
    """Return the true state after driving at an input."""
    for _ in range(periods):
        vehicle.step(input)
    return vehicle.true


def test_the_same_inputs_give_another_true_motion_under_each_seed() -> None:
    """After five seconds straight ahead at 0.25 m/s, which are 1.23 m."""
    ends = np.array([after(disturbed(seed), AHEAD, 25) for seed in range(10)])
    assert len(np.unique(ends, axis=0)) == 10
    along, across, heading = ends[:, :3].std(axis=0)
    assert 0.004 < along < 0.02 and 0.03 < across < 0.12 and 0.05 < heading < 0.2
    assert np.abs(ends[:, 1]).max() < 0.3


@pytest.mark.parametrize("seed", range(2))
def test_a_robot_at_rest_stays_at_rest(seed: int) -> None:
    vehicle = disturbed(seed)
    start = vehicle.true.copy()
    assert np.abs(after(vehicle, STAND, 25) - start).max() < 2e-5
    after(vehicle, CURVE, 5)
    stopped = after(vehicle, STAND, 3).copy()
    assert np.abs(after(vehicle, STAND, 25) - stopped).max() < 1e-4


def test_disturbances_change_no_other_number_of_an_episode() -> None:
    """They have a generator of their own, so sensors err as without them."""
    rngs = [np.random.default_rng(3) for _ in range(2)]
    robots = [GroundRobot(room(), rng, process_noise=noise) for rng, noise in zip(rngs, (None, EVEN), strict=True)]
    assert (robots[0].measured == robots[1].measured).all()
    assert rngs[0].random() == rngs[1].random()


def test_a_robot_in_real_time_has_the_disturbances_of_one_in_lockstep() -> None:
    arena = room()
    lockstep = GroundRobot(arena, np.random.default_rng(5))
    realtime = RealtimeGroundRobot(arena, np.random.default_rng(5))
    for input in (AHEAD, CURVE, STAND, STAND, STAND, CURVE):
        realtime.set_input(input)
        for _ in range(lockstep.samples):
            realtime.advance()
        assert np.abs(lockstep.step(input).true - realtime.true).max() < 1e-9


def test_the_scale_is_a_condition_that_a_run_logs() -> None:
    told = Conditions(NoiseLevels(), process_noise=ProcessNoise(scale=0.5)).describe()
    assert told["process_scale"] == "0.5" and told["process_motor_gain"] == "0.01" and told["scale"] == "1"
