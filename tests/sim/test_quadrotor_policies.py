"""Scripted policies of the quadrotor, and what they say of its arenas, flown by a point without physics."""

from typing import Any

import numpy as np
import pytest

from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.sim.arena import Arena, staged_arena
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.quadrotor_policies import QuadrotorCarefulPolicy, QuadrotorRoutePolicy, StopPrediction, full_speed
from brakeline.sim.scripted_policies import scripted
from tests.robots import QUADROTOR
from tests.sim.kinematic import PointMass

BLIND = np.zeros(189, np.float32)


def fly(policy: str, arena: str, episodes: int) -> list[dict[str, Any]]:
    """Per episode: the last info, and of all steps the speeds, the least clearance, measurements off their bound."""
    env = NavigationEnv(QUADROTOR, arena, PointMass)
    act = scripted(policy, QUADROTOR, np.random.default_rng(1))
    flights = []
    for number in range(episodes):
        observation, info = env.reset(options={"episode_seed": number})
        infos, done = [info], False
        while not done:
            observation, _, terminated, truncated, info = env.step(act(observation, info))
            infos.append(info)
            done = terminated or truncated
        flights.append(
            {
                "last": info,
                "speeds": [i["speed"] for i in infos[1:]],
                "least": min(i["clearance"] for i in infos),
                "outside": sum(i["outside"] for i in infos),
            }
        )
    return flights


def share(flights: list[dict[str, Any]], key: str) -> float:
    return sum(flight["last"][key] for flight in flights) / len(flights)


@pytest.mark.parametrize(("arena", "least"), [("default", 0.40), ("dense", 0.65)])
def test_greed_collides_often_enough(arena: str, least: float) -> None:
    flights = fly("greedy", arena, 60)
    assert least <= share(flights, "collision") <= 0.9
    assert share(flights, "collision") + share(flights, "at_goal") == 1.0
    assert sum(flight["outside"] for flight in flights) == 0


def test_knowing_the_map_reaches_every_goal_fast_and_keeps_away() -> None:
    flights = fly("astar", "default", 20)
    assert share(flights, "at_goal") == 1.0
    speeds = np.concatenate([flight["speeds"] for flight in flights])
    assert speeds.mean() > 4.0
    assert speeds.max() > 6.5
    assert min(flight["least"] for flight in flights) > 0.2


def test_knowing_the_map_works_among_many_obstacles_too() -> None:
    flights = fly("astar", "dense", 15)
    assert share(flights, "collision") == 0.0
    assert share(flights, "at_goal") > 0.9


def test_in_a_tall_room_it_is_fast_on_all_axes_at_once() -> None:
    flights = fly("astar", "tall", 10)
    assert share(flights, "at_goal") == 1.0
    assert max(max(flight["speeds"]) for flight in flights) > 8.0


def test_the_adversary_hits_always_and_soon() -> None:
    flights = fly("adversary", "default", 20)
    assert share(flights, "collision") == 1.0
    assert np.mean([len(flight["speeds"]) for flight in flights]) < 15


def test_full_speed_is_the_largest_input_in_that_direction() -> None:
    assert full_speed(QUADROTOR, np.array([0.1, -0.2, 0.0])) == pytest.approx([2.5, -5.0, 0.0])
    assert (full_speed(QUADROTOR, np.zeros(3)) == 0.0).all()


def test_predicted_stops_are_those_of_the_quadrotor() -> None:
    arena = staged_arena(start=(0.0, 0.0, 50.0), goal=(90.0, 0.0, 50.0), half_width=100.0, height=100.0)
    vehicle = Quadrotor(arena, np.random.default_rng(0))
    top = np.array([5.0, -5.0, 2.0])
    for k in range(12):
        vehicle.step(np.clip(0.8 * k, -np.abs(top), np.abs(top)) * np.sign(top))
    predicted = StopPrediction(QUADROTOR)(vehicle.true[:3], vehicle.true[3:6], top[None])[0]
    flown = []
    for fraction in QUADROTOR.plan_matrix()[::3, 0]:
        vehicle.step(top * fraction)
        flown.append(vehicle.true[:3])
    assert predicted[1::2] == pytest.approx(np.array(flown), abs=0.35)


def staged_info(
    arena: Arena, position: tuple[float, float, float], velocity: tuple[float, float, float]
) -> dict[str, Any]:
    state = np.array([*position, *velocity, 0.0, 0.0, 0.0])
    return {"arena": arena, "goal": arena.goal, "state": state, "input_in_force": state[3:6], "time": 0.0}


def test_it_brakes_in_time_for_what_it_cannot_pass_at_speed() -> None:
    wall = Obstacle(BOX, (0.0, 0.0, 4.5), (1.0, 30.0, 9.0))  # a metre is left above it
    arena = staged_arena(wall, start=(-12.0, 0.0, 2.0), goal=(12.0, 0.0, 2.0), half_width=15.0, height=12.0)
    pilot = QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0))
    assert pilot(BLIND, staged_info(arena, (-12.0, 0.0, 2.0), (4.0, 0.0, 0.0)))[0] > 4.0
    assert pilot(BLIND, staged_info(arena, (-5.0, 0.0, 2.0), (5.0, 0.0, 0.0)))[0] < 5.0
    vehicle = PointMass(arena, np.random.default_rng(0))
    pilot = QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0))
    for k in range(80):
        info = {"arena": arena, "goal": arena.goal, "state": vehicle.measured, "input_in_force": vehicle.input}
        assert not vehicle.step(pilot(BLIND, info | {"time": 0.2 * k})).collision
        if np.linalg.norm(vehicle.true[:3] - arena.goal) < 1.0:
            break
    assert k < 60


def test_it_gets_out_of_a_place_without_room() -> None:
    pillar = Obstacle(CYLINDER, (0.0, 0.0, 5.0), (1.0, 10.0))
    arena = staged_arena(pillar, start=(-1.4, 0.0, 5.0), goal=(8.0, 0.0, 5.0), half_width=10.0, height=10.0)
    first = QuadrotorRoutePolicy(QUADROTOR, np.random.default_rng(0))(
        BLIND, staged_info(arena, (-1.4, 0.0, 5.0), (0.0, 0.0, 0.0))
    )
    assert first[0] < 0.0


def nearest_to(pillar: Obstacle, pilot: type[QuadrotorRoutePolicy]) -> float:
    """How near to it the pilot gets on its way past, m."""
    arena = staged_arena(pillar, start=(-10.0, 0.0, 5.0), goal=(10.0, 0.0, 5.0), half_width=15.0, height=10.0)
    vehicle, fly, least = PointMass(arena, np.random.default_rng(0)), pilot(QUADROTOR, np.random.default_rng(0)), np.inf
    for k in range(60):
        info = {"arena": arena, "goal": arena.goal, "state": vehicle.measured, "input_in_force": vehicle.input}
        vehicle.step(fly(BLIND, info | {"time": 0.2 * k}))
        least = min(least, float(np.hypot(*(vehicle.true[:2] - pillar.position[:2]))) - pillar.size[0])
        if np.linalg.norm(vehicle.true[:3] - arena.goal) < 1.0:
            return least
    raise AssertionError("it does not arrive")


def test_with_care_it_keeps_a_wide_berth() -> None:
    pillar = Obstacle(CYLINDER, (0.0, 0.5, 5.0), (1.0, 10.0))
    assert nearest_to(pillar, QuadrotorCarefulPolicy) > nearest_to(pillar, QuadrotorRoutePolicy) + 0.5


def test_with_care_it_arrives_among_many_obstacles_too() -> None:
    flights = fly("careful", "dense", 15)
    assert share(flights, "at_goal") == 1.0
    assert np.concatenate([flight["speeds"] for flight in flights]).mean() > 3.5
