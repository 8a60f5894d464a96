"""Drive episodes of another author's environment behind the safety service, and report their cost.

python run.py car adversarial --seeds 0 20 --out car.jsonl    (--connect none: without the filter)

The script writes a line of JSON at the end of each episode. After an interruption it goes on from the first missing
seed, and `python table.py *.jsonl` adds up the lines of any number of files.
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

from brakeline import SafetyClient, SafetyWrapper
from examples.foreign.adapter import FOLDERS, Adapter, load_adapter
from examples.foreign.policies import POLICIES

DEADLINE = 1.0  # s for an answer: the environment waits, so a busy machine must not count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=tuple(FOLDERS))
    parser.add_argument("policy", choices=tuple(POLICIES))
    parser.add_argument(
        "--seeds", type=int, nargs=2, default=(0, 5), metavar=("FIRST", "BEYOND"), help="seeds, one for each episode"
    )
    parser.add_argument("--steps", type=int, default=1000, help="largest number of steps of an episode")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7450", help="the service; none: without the filter")
    parser.add_argument("--out", type=Path, help="file to append the lines to")
    options = parser.parse_args()
    adapter = load_adapter(options.robot)
    client = None
    if options.connect != "none":
        client = SafetyClient.open(options.connect, adapter.robot, DEADLINE, name="client.episodes")
    env = filtered_task(adapter, client)
    with client or nullcontext():
        for seed in missing_seeds(options, client is not None):
            about = {"robot": options.robot, "policy": options.policy, "filter": client is not None, "seed": seed}
            report(about | episode(env, adapter, options.policy, seed, options.steps), options.out)


def report(figures: dict[str, Any], out: Path | None) -> None:
    """Print a line of JSON, and append it to a file."""
    line = json.dumps(figures)
    print(line, flush=True)
    if out is not None:
        with out.open("a") as file:
            file.write(line + "\n")


def missing_seeds(options: argparse.Namespace, filtered: bool) -> list[int]:
    """Return the seeds that the file does not have yet."""
    written = options.out.read_text().splitlines() if options.out is not None and options.out.exists() else []
    lines = [json.loads(line) for line in written]
    wanted = options.robot, options.policy, filtered
    present = {line["seed"] for line in lines if (line["robot"], line["policy"], line["filter"]) == wanted}
    return [seed for seed in range(*options.seeds) if seed not in present]


def filtered_task(adapter: Adapter, client: SafetyClient | None, penalty: float = 0.0) -> Any:
    """Return the adapter's task behind the filter, if there is one. penalty: for a correction, off the reward."""
    env = adapter.make()
    if client is None:
        return env
    return SafetyWrapper(env, client, penalty, obstacles=adapter.visible_obstacles, actions=adapter.actions())


@dataclass
class EpisodeFigures:
    """The environment's own figures of one episode, and the filter's decisions in it."""

    started: float = field(default_factory=time.perf_counter)
    steps: int = 0
    cost: float = 0.0
    reward: float = 0.0
    unverified: int = 0
    outside: int = 0
    decisions: Counter[str] = field(default_factory=Counter)

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """Add a step."""
        self.steps, self.cost, self.reward = self.steps + 1, self.cost + info["cost"], self.reward + reward
        if (decision := info.get("diagnostics")) is not None:
            self.decisions[decision["kind"]] += 1
            self.unverified += not decision["verified"]
            self.outside += not decision["contained"]

    def as_json(self) -> dict[str, Any]:
        """Return the figures for a line of JSON."""
        figures = {"steps": self.steps, "cost": self.cost, "reward": round(float(self.reward), 2)}
        decided = {"decisions": self.decisions, "unverified": self.unverified, "outside": self.outside}
        return figures | decided | {"seconds": round(time.perf_counter() - self.started, 1)}


def episode(env: Any, adapter: Adapter, policy: str, seed: int, steps: int) -> dict[str, Any]:
    """Drive one episode, and return its figures."""
    figures = EpisodeFigures()
    observation, _ = env.reset(seed=seed)
    choose = POLICIES[policy](env, adapter, np.random.default_rng(seed))
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(choose(observation))
        figures.add(reward, info)
        if terminated or truncated:
            break
    return figures.as_json()


if __name__ == "__main__":
    main()
