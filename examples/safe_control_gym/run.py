"""Drive episodes of the cart-pole with a filter or without one, and report the environment's own figures.

python run.py ppo brakeline --model data/cartpole/residual-one-step.safetensors --seeds 0 100 --out lines.jsonl

The script writes a line of JSON for each episode. `python table.py lines.jsonl` adds them up.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.foreign.run import report
from examples.safe_control_gym.adapter import SampledCartPole, make
from examples.safe_control_gym.filters import FILTERS, Unfiltered
from examples.safe_control_gym.policies import POLICIES, Policy

CHANGED = 0.01  # N, a force that differs by more counts as corrected


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", choices=tuple(POLICIES))
    parser.add_argument("filter", choices=tuple(FILTERS))
    parser.add_argument("--model", type=Path, help="the model set, for brakeline")
    parser.add_argument("--accept-bound", type=float, default=0.01, help="largest share of plans outside their tubes")
    parser.add_argument("--amplitude", type=float, default=1.0, help="of the reference [m]; the constraint is 2 m")
    parser.add_argument("--disturbed", action="store_true", help="push the pole by a random force in each step")
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 5), metavar=("FIRST", "BEYOND"))
    parser.add_argument("--out", type=Path, help="file to append the lines to")
    options = parser.parse_args()
    env, safety = make(options.amplitude, options.disturbed), FILTERS[options.filter](options)
    about = {name: getattr(options, name) for name in ("policy", "filter", "amplitude", "disturbed")}
    for seed in range(*options.seeds):
        policy = POLICIES[options.policy](env, np.random.default_rng(seed))
        report(about | {"seed": seed} | episode(env, policy, safety, seed), options.out)


def episode(env: SampledCartPole, policy: Policy, safety: Unfiltered, seed: int) -> dict[str, Any]:
    """Drive one episode, and return its figures."""
    observation, info = env.reset(seed=seed)
    safety.reset()
    violations, corrected, rewards, errors, times, nearest = 0, 0, [], [], [], -np.inf
    done = False
    while not done:
        proposed = policy(observation, info)
        started = time.process_time()
        force = safety(observation[:4], proposed, info)
        times.append(1e3 * (time.process_time() - started))
        corrected += abs(force - proposed) > CHANGED
        observation, reward, done, info = env.step(np.array([force]))
        violations += info["constraint_violation"]
        nearest = max(nearest, float(info["constraint_values"][:8].max()))
        rewards.append(float(reward))
        errors.append(float(info["mse"]))
    return {
        "steps": len(rewards),
        "violations": int(violations),
        "fell": bool(info["out_of_bounds"]),
        "corrected": int(corrected),
        "error": float(np.sqrt(np.mean(errors))),
        "return": float(np.sum(rewards)),
        "cpu_ms": float(np.median(times)),
        "slowest_cpu_ms": float(np.max(times)),
        "outside": safety.outside,
        "kinds": dict(safety.kinds),
    }


if __name__ == "__main__":
    main()
