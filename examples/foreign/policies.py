"""Policies to put behind the filter. Some use the environment's observation, others what the adapter knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from examples.foreign.adapter import Adapter
from examples.foreign.distance_field import DistanceField
from examples.foreign.trained import TrainedPolicy

Policy = Callable[[Any], Any]


def untrained(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Return a network with random weights and some noise, as a learner begins."""
    size = env.observation_space.shape[0]
    first, last = rng.normal(size=(size, 64)) / math.sqrt(size), rng.normal(size=(64, 2)) / 8.0
    return lambda observation: np.clip(
        np.tanh(np.tanh(observation @ first) @ last) + rng.normal(0.0, 0.1, 2), -1.0, 1.0
    )


def random(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    return lambda observation: rng.uniform(-1.0, 1.0, 2)


def adversarial(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drive at the nearest hazard."""
    return lambda observation: adapter.action_towards(env, adapter.nearest_hazard(env))


def goal(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drive straight at the goal, whatever lies between."""
    return lambda observation: adapter.action_towards(env, adapter.goal(env))


def around(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Drive to the goal by the shortest path around the hazards, which is computed for each goal."""
    fields: dict[tuple[float, ...], DistanceField] = {}

    def choose(observation: Any) -> Any:
        target = tuple(adapter.goal(env)[:2])
        if target not in fields:
            fields[target] = DistanceField(adapter, adapter.obstacles(env, observation, {}), target)
        return adapter.action_towards(env, fields[target].ahead(adapter.state(env, None, {})[:2]))

    return choose


def trained(env: Any, adapter: Adapter, rng: np.random.Generator) -> Policy:
    """Return the policy that `train.py` stored, without noise."""
    return TrainedPolicy.load(adapter.trained, adapter.robot)


POLICIES = {policy.__name__: policy for policy in (untrained, random, adversarial, goal, around, trained)}
