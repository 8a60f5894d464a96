"""Drives episodes of Safety-Gymnasium behind the safety service, and prints what they cost.

python run.py car adversarial --episodes 20 --connect tcp/127.0.0.1:7450    (--connect none: without the filter)
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.safety_gymnasium import adapter
from safety.client import SafetyClient
from safety.gym import SafetyWrapper


def untrained(env: Any, rng: np.random.Generator) -> Any:
    """A network with its first weights, as a learner begins: tanh of the observation, 64 wide, and some noise."""
    size = env.observation_space.shape[0]
    first, last = rng.normal(size=(size, 64)) / math.sqrt(size), rng.normal(size=(64, 2)) / 8.0
    return lambda seen: np.clip(np.tanh(np.tanh(seen @ first) @ last) + rng.normal(0.0, 0.1, 2), -1.0, 1.0)


def random(env: Any, rng: np.random.Generator) -> Any:
    return lambda seen: rng.uniform(-1.0, 1.0, 2)


def adversarial(env: Any, rng: np.random.Generator) -> Any:
    """Drives at the nearest hazard."""
    return lambda seen: _at(env, min(env.unwrapped.task.hazards.pos, key=lambda pos: _way(env, pos)))


def goal(env: Any, rng: np.random.Generator) -> Any:
    """Drives at the goal, whatever lies between."""
    return lambda seen: _at(env, env.unwrapped.task.goal.pos)


POLICIES = {policy.__name__: policy for policy in (untrained, random, adversarial, goal)}


def _way(env: Any, at: Any) -> float:
    return math.dist(at[:2], env.unwrapped.task.agent.pos[:2])


def _at(env: Any, target: Any) -> Any:
    """The action that drives at a point, forwards."""
    x, y, heading, *_ = adapter.state(env, None, {})
    bearing = (math.atan2(target[1] - y, target[0] - x) - heading + math.pi) % (2.0 * math.pi) - math.pi
    return adapter.steered(env, bearing)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=("car", "point"))
    parser.add_argument("policy", choices=tuple(POLICIES))
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000, help="of an episode, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7450", help="the service; none: without the filter")
    given = parser.parse_args()
    robot = adapter.robot_of(given.robot)
    env = adapter.make(f"Safety{given.robot.title()}Goal1-v0", robot)
    client = None
    if given.connect != "none":
        client = SafetyClient.open(given.connect, robot.name, deadline=1.0, name="client.episodes")
        views: dict[str, Any] = {"state": adapter.state, "obstacles": adapter.obstacles}
        env = SafetyWrapper(env, client, actions=adapter.actions(robot), **views)
    print(json.dumps(drive(env, given) | {"robot": given.robot, "policy": given.policy, "filter": client is not None}))
    if client is not None:
        client.close()


def drive(env: Any, given: argparse.Namespace) -> dict[str, Any]:
    """Episodes from `seed` on; the environment's own figures of them."""
    costs: list[float] = []
    rewards: list[float] = []
    kinds: dict[str, int] = {}
    steps = unverified = outside = 0
    started = time.perf_counter()
    for episode in range(given.episodes):
        rng = np.random.default_rng((given.seed, episode))
        observation, _ = env.reset(seed=given.seed + episode)
        policy, cost, reward = POLICIES[given.policy](env, rng), 0.0, 0.0
        for _ in range(given.steps):
            observation, paid, terminated, truncated, info = env.step(policy(observation))
            cost, reward, steps = cost + info.get("cost", 0.0), reward + paid, steps + 1
            if "diagnostics" in info:
                told = info["diagnostics"]
                kinds[told["kind"]] = kinds.get(told["kind"], 0) + 1
                unverified, outside = unverified + (not told["verified"]), outside + (not told["contained"])
            if terminated or truncated:
                break
        costs.append(cost)
        rewards.append(reward)
    return {
        "episodes": len(costs),
        "steps": steps,
        "cost": float(np.mean(costs)),
        "worst cost": max(costs),
        "episodes without cost": sum(cost == 0.0 for cost in costs),
        "reward": round(float(np.mean(rewards)), 2),
        "decisions": kinds,
        "unverified": unverified,
        "outside prediction": outside,
        "steps/s": round(steps / (time.perf_counter() - started), 1),
    }


if __name__ == "__main__":
    main()
