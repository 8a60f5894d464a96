"""Scripted policies of the ground robot, and what they say of its arenas; the random one and the names of both."""

from itertools import pairwise

import numpy as np
import pytest

from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging.robot import Robot
from brakeline.sim.scripted_policies import UnknownPolicy, scripted
from tests.robots import GROUND, ROBOTS


def play(policy_name: str, arena: str, episodes: int) -> list[dict[str, float]]:
    """Per episode: collision, at_goal, steps, least clearance, steps nearer than 4 cm, outside (before any touch)."""
    env = environment(GROUND, arena, 0)
    policy = scripted(policy_name, GROUND, np.random.default_rng(1))
    results = []
    for episode in range(episodes):
        observation, info = env.reset(options={"episode_seed": episode})
        clearances, outside, done = [], 0, False
        while not done:
            observation, _, terminated, truncated, info = env.step(policy(observation, info))
            clearances.append(info["clearance"])
            outside += info["outside"] and not info["collision"]
            done = terminated or truncated
        results.append(
            {
                "collision": info["collision"],
                "at_goal": info["at_goal"],
                "steps": len(clearances),
                "least": min(clearances),
                "near": sum(c < 0.04 for c in clearances),
                "outside": outside,
            }
        )
    return results


def share(results: list[dict[str, float]], key: str) -> float:
    return sum(result[key] for result in results) / len(results)


@pytest.mark.parametrize(("arena", "least"), [("default", 0.40), ("dense", 0.65)])
def test_greed_collides_often_enough(arena: str, least: float) -> None:
    results = play("greedy", arena, 70)
    assert least <= share(results, "collision") <= 0.9
    assert share(results, "outside") == 0.0


def test_knowing_the_map_reaches_every_goal_and_keeps_away() -> None:
    results = play("astar", "default", 25)
    assert share(results, "at_goal") == 1.0
    assert share(results, "collision") == 0.0
    assert share(results, "outside") == 0.0
    assert sorted(result["least"] for result in results)[1] > 0.08
    assert sum(result["near"] for result in results) <= 0.01 * sum(result["steps"] for result in results)


def test_the_adversary_hits_always_and_soon() -> None:
    results = play("adversary", "default", 20)
    assert share(results, "collision") == 1.0
    assert share(results, "steps") < 60


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_random_inputs_are_held_and_within_bounds(robot: Robot) -> None:
    policy = scripted("random", robot, np.random.default_rng(0))
    inputs = [policy(np.zeros(26, np.float32), {"time": 0.2 * i}) for i in range(300)]
    assert all((robot.low() <= u).all() and (u <= robot.high()).all() for u in inputs)
    assert np.ptp(inputs, axis=0) == pytest.approx(robot.high() - robot.low(), rel=0.1)
    changes = sum(bool((a != b).any()) for a, b in pairwise(inputs))
    assert 30 < changes < 120


def test_the_generator_decides() -> None:
    first, second = (scripted("random", GROUND, np.random.default_rng(3)) for _ in range(2))
    for i in range(20):
        info = {"time": 0.2 * i}
        assert (first(np.zeros(26, np.float32), info) == second(np.zeros(26, np.float32), info)).all()


def test_an_unknown_name_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(UnknownPolicy, match="random, greedy, adversary, astar"):
        scripted("psychic", GROUND, np.random.default_rng(0))
