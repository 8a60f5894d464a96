"""Drives episodes of another author's environment behind the safety service, and says what they cost.

python run.py car adversarial --seeds 0 20 --out car.jsonl    (--connect none: without the filter)

Every episode is a line of JSON, written when it ends: what was killed goes on from its first missing seed, and
`python table.py *.jsonl` adds up any pieces.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.foreign.adapter import Adapter
from examples.foreign.policies import POLICIES
from examples.foreign.robots import FOLDERS, adapter_of
from safety.client import SafetyClient
from safety.gym import SafetyWrapper


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=tuple(FOLDERS))
    parser.add_argument("policy", choices=tuple(POLICIES))
    parser.add_argument(
        "--seeds", type=int, nargs=2, default=(0, 5), metavar=("FIRST", "BEYOND"), help="an episode each"
    )
    parser.add_argument("--steps", type=int, default=1000, help="of an episode, at most")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7450", help="the service; none: without the filter")
    parser.add_argument("--out", type=Path, help="to which the episodes' lines are added")
    given = parser.parse_args()
    adapter = adapter_of(given.robot)
    client = None
    if given.connect != "none":
        client = SafetyClient.open(given.connect, given.robot, deadline=1.0, name="client.episodes")
    env = behind(adapter, client)
    with client or nullcontext():
        for seed in range(*given.seeds):
            told = {"robot": given.robot, "policy": given.policy, "filter": client is not None, "seed": seed}
            line = json.dumps(told | episode(env, adapter, given.policy, seed, given.steps))
            print(line, flush=True)
            if given.out is not None:
                with given.out.open("a") as file:
                    file.write(line + "\n")


def behind(adapter: Adapter, client: SafetyClient | None) -> Any:
    """The adapter's task, behind the filter where there is one."""
    env = adapter.make()
    if client is None:
        return env
    return SafetyWrapper(env, client, state=adapter.state, obstacles=adapter.obstacles, actions=adapter.actions())


def episode(env: Any, adapter: Adapter, policy: str, seed: int, steps: int) -> dict[str, Any]:
    """The environment's own figures of one episode, and what was decided in it."""
    started = time.perf_counter()
    observation, _ = env.reset(seed=seed)
    choose = POLICIES[policy](env, adapter, np.random.default_rng(seed))
    cost = reward = 0.0
    kinds: dict[str, int] = {}
    driven = unverified = outside = 0
    for _ in range(steps):
        observation, paid, terminated, truncated, info = env.step(choose(observation))
        cost, reward, driven = cost + info["cost"], reward + paid, driven + 1
        if "diagnostics" in info:
            told = info["diagnostics"]
            kinds[told["kind"]] = kinds.get(told["kind"], 0) + 1
            unverified, outside = unverified + (not told["verified"]), outside + (not told["contained"])
        if terminated or truncated:
            break
    seconds = round(time.perf_counter() - started, 1)
    figures = {"steps": driven, "cost": cost, "reward": round(float(reward), 2), "decisions": kinds}
    return figures | {"unverified": unverified, "outside": outside, "seconds": seconds}


if __name__ == "__main__":
    main()
