"""The ground robot's motion without disturbances, and its collisions."""

import math

import mujoco
import numpy as np
import pytest

from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadInput
from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.sim.arena import Arena
from brakeline.sim.floor_physics import FloorPhysics
from brakeline.sim.ground_estimator import NoiseLevels
from brakeline.sim.ground_robot import MODEL, SAMPLE_TIME, WHEEL_RADIUS, GroundRobot
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.sim_conditions import ProcessNoise
from brakeline.sim.vehicle import Period
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


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("miss", "hit"), [(0.01, False), (-0.01, True)])
@pytest.mark.parametrize("kind", ["pillar", "box"])
def test_a_wheel_hits_or_misses_by_a_centimetre(side: float, miss: float, hit: bool, kind: str) -> None:
    reach = 0.089 + miss  # half the robot's width over the wheels
    at = (0.6, side * (reach + 0.2))
    obstacle = pillar(*at, 0.2) if kind == "pillar" else Obstacle(BOX, at, (0.4, 0.4))
    vehicle = robot(room(obstacle))
    assert any(drive(vehicle, 0.25, 0.0).collision for _ in range(25)) == hit


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
