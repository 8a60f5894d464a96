"""Scripted policies of both robots drive as their classes say."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from brakeline.errors import UnknownName
from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.quadrotor_policies import QuadrotorCarefulPolicy, QuadrotorRoutePolicy, StopPrediction, full_speed
from brakeline.sim.scripted_policies import scripted
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR, ROBOTS

NO_OBSERVATION = np.zeros(189, np.float32)
each_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


class Episodes:
    """The infos of all steps in episodes of a scripted policy."""

    def __init__(self, robot: RobotWithTask, policy_name: str, arena: str, episodes: int) -> None:
        env = NavigationEnv(robot, arena, Quadrotor if robot is QUADROTOR else None)
        policy = scripted(policy_name, robot, np.random.default_rng(1))
        self.infos = list[list[dict[str, Any]]]()
        for episode in range(episodes):
            observation, info = env.reset(options={"episode_seed": episode})
            self.infos.append([])
            done = False
            while not done:
                observation, _, terminated, truncated, info = env.step(policy(observation, info))
                self.infos[-1].append(info)
                done = terminated or truncated
        assert not any(info["outside"] and not info["collision"] for infos in self.infos for info in infos)

    def share(self, key: str) -> float:
        """Return the share of episodes at whose end a flag is set."""
        return float(np.mean([infos[-1][key] for infos in self.infos]))

    def values(self, key: str) -> np.ndarray:
        return np.array([info[key] for infos in self.infos for info in infos])


@each_robot
@pytest.mark.parametrize(("arena", "least"), [("default", 0.40), ("dense", 0.65)])
def test_the_greedy_policy_collides_in_many_episodes(robot: RobotWithTask, arena: str, least: float) -> None:
    episodes = Episodes(robot, "greedy", arena, 10)
    assert least <= episodes.share("collision") <= 0.9
    if robot is QUADROTOR:
        assert episodes.share("collision") + episodes.share("at_goal") == 1.0


def test_the_ground_route_policy_reaches_every_goal_with_clearance() -> None:
    episodes = Episodes(GROUND, "astar", "default", 4)
    assert episodes.share("at_goal") == 1.0 and episodes.share("collision") == 0.0
    assert sorted(min(info["clearance"] for info in infos) for infos in episodes.infos)[1] > 0.08
    assert (episodes.values("clearance") < 0.04).mean() <= 0.01


@pytest.mark.parametrize(
    ("policy", "arena", "episodes", "mean_speed", "top_speed", "clearance"),
    [
        ("astar", "default", 3, 4.0, 6.5, 0.2),
        ("astar", "dense", 4, 0.0, 0.0, 0.0),
        ("astar", "tall", 2, 0.0, 8.0, 0.0),  # fast on all axes at once
        ("careful", "dense", 3, 3.5, 0.0, 0.0),
    ],
)
def test_the_quadrotors_route_policies_reach_their_goals(
    policy: str, arena: str, episodes: int, mean_speed: float, top_speed: float, clearance: float
) -> None:
    flown = Episodes(QUADROTOR, policy, arena, episodes)
    assert flown.share("at_goal") == 1.0 and flown.share("collision") == 0.0
    speeds = flown.values("speed")
    assert speeds.mean() > mean_speed and speeds.max() > top_speed and flown.values("clearance").min() > clearance


@pytest.mark.parametrize(("robot", "most_steps"), [(GROUND, 60), (QUADROTOR, 15)], ids=["ground", "quadrotor"])
def test_the_adversary_collides_in_every_episode_and_soon(robot: RobotWithTask, most_steps: int) -> None:
    episodes = Episodes(robot, "adversary", "default", 6)
    assert episodes.share("collision") == 1.0
    assert len(episodes.values("time")) / 6 < most_steps


@each_robot
def test_the_random_policy_repeats_inputs_within_the_bounds(robot: RobotWithTask) -> None:
    first, second = (scripted("random", robot, np.random.default_rng(0)) for _ in range(2))
    infos = [{"time": 0.2 * i} for i in range(300)]
    inputs = [first(NO_OBSERVATION, info) for info in infos]
    assert all((robot.low() <= u).all() and (u <= robot.high()).all() for u in inputs)
    assert np.ptp(inputs, axis=0) == pytest.approx(robot.high() - robot.low(), rel=0.1)
    changes = sum(bool((a != b).any()) for a, b in pairwise(inputs))
    assert 30 < changes < 120
    assert np.array_equal(inputs, [second(NO_OBSERVATION, info) for info in infos]), "the generator determines it"


def test_an_unknown_name_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(UnknownName, match="random, greedy, adversary, astar"):
        scripted("psychic", GROUND, np.random.default_rng(0))


def test_full_speed_is_the_largest_input_in_a_direction() -> None:
    assert full_speed(QUADROTOR, np.array([0.1, -0.2, 0.0])) == pytest.approx([2.5, -5.0, 0.0])
    assert (full_speed(QUADROTOR, np.zeros(3)) == 0.0).all()


def test_a_prepared_policy_proposes_the_same_inputs() -> None:
    arena = draw_arena("default", np.random.default_rng(7), QUADROTOR)
    unprepared, ready = (QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0)) for _ in range(2))
    ready.prepare(arena)
    info = staged_info(arena, arena.start, (0.0, 0.0, 0.0))
    assert (unprepared(NO_OBSERVATION, info) == ready(NO_OBSERVATION, info)).all()


def test_stop_prediction_agrees_with_the_simulated_quadrotor() -> None:
    arena = staged_arena(start=(0.0, 0.0, 50.0), goal=(90.0, 0.0, 50.0), half_width=100.0, height=100.0)
    vehicle = Quadrotor(arena, np.random.default_rng(0))
    top = np.array([5.0, -5.0, 2.0])
    for k in range(12):
        vehicle.step(np.clip(0.8 * k, -np.abs(top), np.abs(top)) * np.sign(top))
    predicted = StopPrediction(QUADROTOR)(vehicle.true[:3], vehicle.true[3:6], top[None])[0]
    flown = []
    for fraction in QUADROTOR.stop_profile()[:, 0]:
        vehicle.step(top * fraction)
        flown.append(vehicle.true[:3])
    assert predicted[1::2] == pytest.approx(np.array(flown), abs=0.35)


def staged_info(
    arena: Arena, position: tuple[float, float, float], velocity: tuple[float, float, float]
) -> dict[str, Any]:
    state = np.array([*position, *velocity, 0.0, 0.0, 0.0])
    return {"arena": arena, "goal": arena.goal, "state": state, "input_in_force": state[3:6], "time": 0.0}


def flown_to_goal(arena: Arena, policy: QuadrotorRoutePolicy, most: int) -> np.ndarray:
    """Return the true states (k, 9) of a quadrotor on its way to the goal, without a collision in `most` steps."""
    vehicle, states = Quadrotor(arena, np.random.default_rng(0)), list[np.ndarray]()
    while not states or np.linalg.norm(vehicle.true[:3] - arena.goal) >= 1.0:
        assert len(states) < most, "the policy did not arrive"
        info = {"arena": arena, "goal": arena.goal, "state": vehicle.measured, "input_in_force": vehicle.input}
        assert not vehicle.step(policy(NO_OBSERVATION, info | {"time": 0.2 * len(states)})).collision
        states.append(vehicle.true)
    return np.array(states)


def test_the_route_policy_brakes_in_time_before_a_narrow_passage() -> None:
    wall = Obstacle(BOX, (0.0, 0.0, 4.5), (1.0, 30.0, 9.0))  # 3 m are left above it
    arena = staged_arena(wall, start=(-12.0, 0.0, 2.0), goal=(12.0, 0.0, 2.0), half_width=15.0, height=12.0)
    policy = QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0))
    assert policy(NO_OBSERVATION, staged_info(arena, (-12.0, 0.0, 2.0), (4.0, 0.0, 0.0)))[0] > 4.0
    assert policy(NO_OBSERVATION, staged_info(arena, (-5.0, 0.0, 2.0), (5.0, 0.0, 0.0)))[0] < 5.0
    flown_to_goal(arena, QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0)), 60)


def test_the_route_policy_leaves_a_position_without_clearance() -> None:
    pillar = Obstacle(CYLINDER, (0.0, 0.0, 5.0), (1.0, 10.0))
    arena = staged_arena(pillar, start=(-1.4, 0.0, 5.0), goal=(8.0, 0.0, 5.0), half_width=10.0, height=10.0)
    first = QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0))(
        NO_OBSERVATION, staged_info(arena, (-1.4, 0.0, 5.0), (0.0, 0.0, 0.0))
    )
    assert first[0] < 0.0


def nearest_to(pillar: Obstacle, policy: type[QuadrotorRoutePolicy]) -> float:
    """Return how near the policy passes a pillar [m]."""
    arena = staged_arena(pillar, start=(-10.0, 0.0, 5.0), goal=(10.0, 0.0, 5.0), half_width=15.0, height=10.0)
    states = flown_to_goal(arena, policy(QUADROTOR, np.random.default_rng(0)), 60)
    return float(np.linalg.norm(states[:, :2] - pillar.position[:2], axis=1).min()) - pillar.size[0]


def test_the_careful_policy_keeps_a_larger_distance() -> None:
    pillar = Obstacle(CYLINDER, (0.0, 0.5, 5.0), (1.0, 10.0))
    assert nearest_to(pillar, QuadrotorCarefulPolicy) > nearest_to(pillar, QuadrotorRoutePolicy) + 0.5
