"""Observations have the documented order. They come from the measured state, the lidar's position from the true one."""

import numpy as np
import pytest

from brakeline.errors import BadWeights, UnknownTask
from brakeline.messaging.obstacle import CYLINDER, Obstacle
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.robot import ROBOTS_FOLDER, robot_named
from brakeline.messaging.task import MoverKind, RobotWithTask, address, read_task, robot_with_task
from brakeline.sim.arena import same_room
from brakeline.sim.lidar import Lidar
from brakeline.sim.observations import GroundObservation, QuadrotorObservation, TrackingObservation
from brakeline.sim.shared_world import FleetEnv
from brakeline.sim.traffic import Crowd
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

RNG = np.random.default_rng(0)


def test_the_ground_robots_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (1.0, 0.5), (0.3,)), goal=(-1.0, 2.0))
    true, measured = np.array([0.0, 0.0, 0.5, 0.1, 0.2]), np.array([0.01, -0.01, 0.51, 0.11, 0.19])
    input = np.array([0.2, -0.3])
    model = GroundObservation(GROUND, arena, RNG, 0.0)
    observation = model.observe(true, measured, input)
    named = dict(zip(GROUND.task.observed, observation.tolist(), strict=True))
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
    assert observation[:18] == pytest.approx(Lidar(arena, GROUND.task.rays).cast(mount, 0.5) / 3.5)
    assert observation[:18].min() < 0.3
    assert model.speed(true) == 0.1
    for _ in range(9):  # 2 s in all: the turn memory is a low-pass filter
        observation = model.observe(true, measured, input)
    assert observation[-1] == pytest.approx((1.0 - np.exp(-1.0)) * 0.19 / 0.5)


def test_the_quadrotors_observation_is_in_the_documented_order() -> None:
    arena = staged_arena(Obstacle(CYLINDER, (3.0, 0.0, 4.0), (1.0, 8.0)), goal=(-6.0, 2.0, 7.0), height=8.0)
    true = np.array([0.0, 0.0, 4.0, 1.0, 2.0, -2.0, 0.1, 0.2, 0.3])
    measured = true + 0.02
    input = np.array([1.0, -3.0, 5.0])
    model = QuadrotorObservation(QUADROTOR, arena, RNG, 0.0)
    observation = model.observe(true, measured, input)
    assert len(observation) == QUADROTOR.task.observation_dim == 189
    named = dict(zip(QUADROTOR.task.observed, observation.tolist(), strict=True))
    offset = np.array(arena.goal) - measured[:3]
    for i, axis in enumerate("xyz"):
        assert named[f"goal - p, {axis} [its length + 5 m]"] == pytest.approx(offset[i] / (np.linalg.norm(offset) + 5))
        assert named[f"v{axis} [5 m/s]"] == pytest.approx(measured[3 + i] / 5.0)
        assert named[f"last v{axis} setpoint [5 m/s]"] == pytest.approx(input[i] / 5.0)
    assert observation[:180] == pytest.approx(Lidar(arena, QUADROTOR.task.rays).cast(true[:3]) / 12.0)
    assert named["ray 2 [range/12 m]"] == pytest.approx(2.0 / 12.0)  # level, straight ahead
    assert model.speed(true) == pytest.approx(3.0)


TRACKS = read_task(ROBOTS_FOLDER / "ground+tracks.task.toml")


def test_tracks_have_position_velocity_and_time_to_encounter() -> None:
    model = TrackingObservation(GROUND, staged_arena(), RNG, 0.0)
    facing_up = np.array([1.0, 1.0, 0.5 * np.pi, 0.0, 0.0])
    # 2 m ahead and 0.3 m to the left, coming straight back at 1 m/s; one that stands 1 m to the right; one too far off
    positions = np.array([[0.7, 3.0], [2.0, 1.0], [1.0, -4.0]])
    velocities = np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]])
    tracks = model.tracks(facing_up, positions, velocities)
    names = TRACKS.observation[-len(tracks) :]
    named = dict(zip(names, tracks.tolist(), strict=True))
    assert named["track 1 near·left"] == pytest.approx(-(1.0 - 1.0 / 3.5)) and named["track 1 soon"] == 0.0
    away = np.hypot(2.0, 0.3)
    assert named["track 2 near·ahead"] == pytest.approx((1.0 - away / 3.5) * 2.0 / away)
    assert named["track 2 near·left"] == pytest.approx((1.0 - away / 3.5) * 0.3 / away)
    assert named["track 2 speed ahead [1.2 m/s]"] == pytest.approx(-1.0 / 1.2)
    assert named["track 2 speed to the left [1.2 m/s]"] == pytest.approx(0.0)
    assert named["track 2 soon"] == pytest.approx(np.exp(-2.0 / 2.0))
    # it moves down in the world, 0.3 m to the left of the robot: the robot is on its left
    assert named["track 2 soon·aside"] == pytest.approx(-0.3 * np.exp(-1.0))
    assert not tracks[12:].any()
    # after it has passed, the time to the encounter is over
    assert model.tracks(facing_up, np.array([[0.7, 0.5]]), velocities[:1])[4] == 0.0


def test_a_tracking_observation_is_the_ground_observation_and_tracks() -> None:
    usual = GROUND.task
    assert TRACKS.observed[: usual.observation_dim] == usual.observed and TRACKS.arenas == usual.arenas
    kind = MoverKind((1, 1), 0.2, 1.2, 1.0, 1.0)
    arena = same_room(staged_arena(), crowd=Crowd(kind, np.array([[2.0, 0.0]]), staged_arena().shapes, 0))
    state, input = np.zeros(5), np.zeros(2)
    tracks = TrackingObservation(GROUND, arena, np.random.default_rng(0), 0.0).observe(state, state, input, 0.0)
    seen = GroundObservation(GROUND, arena, np.random.default_rng(0), 0.0).observe(state, state, input, 0.0)
    assert np.array_equal(tracks[: len(seen)], seen) and len(tracks) == TRACKS.observation_dim
    assert tracks[len(seen)] == pytest.approx(1.0 - 2.0 / 3.5, abs=0.02) and not tracks[len(seen) + 6 :].any()


@pytest.fixture
def tracking() -> RobotWithTask:
    """Return the ground robot with its tracking task."""
    return robot_with_task("ground+tracks")


def test_robots_of_a_fleet_are_tracks_to_each_other(tracking) -> None:
    env = FleetEnv(tracking, "crossing", 3, 0)
    env.draw(5)
    for member in env.members:
        member.reset(options={"episode_seed": 5})
    results = [env.step([np.array([0.25, 0.0])] * 3) for _ in range(10)][-1]
    observation, info = results[0][0], results[0][4]
    own, others = info["state"], info["others"]
    nearest = min(others, key=lambda other: np.hypot(*(other[:2] - own[:2])))
    p, heading = nearest[:2] - own[:2], nearest[2] - own[2]
    named = dict(zip(tracking.task.observed, observation.tolist(), strict=True))
    near = (1.0 - np.hypot(*p) / 3.5) * np.cos(np.arctan2(p[1], p[0]) - own[2])
    assert named["track 1 near·ahead"] == pytest.approx(near, abs=1e-5)
    assert named["track 1 speed ahead [1.2 m/s]"] == pytest.approx(nearest[3] * np.cos(heading) / 1.2, abs=1e-5)
    assert nearest[3] > 0.2, "the other robot drives"
    seen = sum(np.hypot(*(other[:2] - own[:2])) < 3.5 for other in others)
    assert [bool(named[f"track {i} near·ahead"]) for i in (1, 2, 3)] == [i <= seen for i in (1, 2, 3)]


def test_another_task_of_a_robot_is_read_by_its_name(tracking) -> None:
    assert tracking.layout() == GROUND.layout() and tracking.task.observation_dim == 50
    assert address("ground+tracks") == "ground+tracks" and robot_named("ground+tracks-late").late
    ours = MLP.untrained(tracking, 0).encode()
    assert GROUND.task.observation_dim == 26, "without a suffix the robot has its usual task"
    with pytest.raises(BadWeights, match="layout"):
        decode(ours, GROUND)
    with pytest.raises(UnknownTask, match=r"additional tasks of ground: ground\+tracks"):
        robot_with_task("ground+trucks")
