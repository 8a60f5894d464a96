"""Policies to put behind the filter: of the environment's observation, or of what the adapter knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from examples.foreign.adapter import Adapter
from examples.foreign.trained import Trained
from examples.foreign.ways import Ways

Policy = Callable[[Any], Any]


def untrained(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """A network with its first weights, as a learner begins: tanh of the observation, 64 wide, and some noise."""
    size = env.observation_space.shape[0]
    first, last = rng.normal(size=(size, 64)) / math.sqrt(size), rng.normal(size=(64, 2)) / 8.0
    return lambda seen: np.clip(np.tanh(np.tanh(seen @ first) @ last) + rng.normal(0.0, 0.1, 2), -1.0, 1.0)


def random(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    return lambda seen: rng.uniform(-1.0, 1.0, 2)


def adversarial(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drives at the nearest of what costs."""
    return lambda seen: adapter.at(env, adapter.nearest_hazard(env))


def goal(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drives at the goal, whatever lies between."""
    return lambda seen: adapter.at(env, adapter.goal(env))


def around(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drives at the goal by the shortest way around what costs, found anew for each goal."""
    ways: dict[tuple[float, ...], Ways] = {}

    def choose(seen: Any) -> Any:
        target = tuple(adapter.goal(env)[:2])
        if target not in ways:
            ways[target] = Ways(adapter, adapter.obstacles(env, seen, {}), target)
        return adapter.at(env, ways[target].ahead(adapter.state(env, None, {})[:2]))

    return choose


def trained(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """What `train.py` left, without noise."""
    return Trained.load(adapter.trained, adapter.robot)


POLICIES = {policy.__name__: policy for policy in (untrained, random, adversarial, goal, around, trained)}
