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
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.service.client import SafetyClient
from examples.foreign.adapter import Adapter
from examples.foreign.policies import POLICIES
from examples.foreign.robots import FOLDERS, adapter_of

DEADLINE = 1.0  # s: the environment waits, a busy machine must not count


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
        client = SafetyClient.open(given.connect, adapter.robot, DEADLINE, name="client.episodes")
    env = behind(adapter, client)
    with client or nullcontext():
        for seed in missing(given, client is not None):
            told = {"robot": given.robot, "policy": given.policy, "filter": client is not None, "seed": seed}
            line = json.dumps(told | episode(env, adapter, given.policy, seed, given.steps))
            print(line, flush=True)
            if given.out is not None:
                with given.out.open("a") as file:
                    file.write(line + "\n")


def missing(given: argparse.Namespace, filtered: bool) -> list[int]:
    """The seeds that the file does not have yet."""
    told = given.out.read_text().splitlines() if given.out is not None and given.out.exists() else []
    lines = [json.loads(line) for line in told]
    asked = given.robot, given.policy, filtered
    have = {line["seed"] for line in lines if (line["robot"], line["policy"], line["filter"]) == asked}
    return [seed for seed in range(*given.seeds) if seed not in have]


def behind(adapter: Adapter, client: SafetyClient | None, penalty: float = 0.0) -> Any:
    """The adapter's task, behind the filter where there is one; penalty: of leaning on it, taken off the reward."""
    env = adapter.make()
    if client is None:
        return env
    return SafetyWrapper(env, client, penalty, obstacles=adapter.near, actions=adapter.actions())


@dataclass
class Tally:
    """The environment's own figures of one episode, and what was decided in it."""

    started: float = field(default_factory=time.perf_counter)
    steps: int = 0
    cost: float = 0.0
    reward: float = 0.0
    unverified: int = 0
    outside: int = 0
    decisions: Counter[str] = field(default_factory=Counter)

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """A step."""
        self.steps, self.cost, self.reward = self.steps + 1, self.cost + info["cost"], self.reward + reward
        if "diagnostics" in info:
            told = info["diagnostics"]
            self.decisions[told["kind"]] += 1
            self.unverified += not told["verified"]
            self.outside += not told["contained"]

    def told(self) -> dict[str, Any]:
        """As a line of JSON has it."""
        figures = {"steps": self.steps, "cost": self.cost, "reward": round(float(self.reward), 2)}
        decided = {"decisions": self.decisions, "unverified": self.unverified, "outside": self.outside}
        return figures | decided | {"seconds": round(time.perf_counter() - self.started, 1)}


def episode(env: Any, adapter: Adapter, policy: str, seed: int, steps: int) -> dict[str, Any]:
    tally = Tally()
    observation, _ = env.reset(seed=seed)
    choose = POLICIES[policy](env, adapter, np.random.default_rng(seed))
    for _ in range(steps):
        observation, paid, terminated, truncated, info = env.step(choose(observation))
        tally.add(paid, info)
        if terminated or truncated:
            break
    return tally.told()


if __name__ == "__main__":
    main()
