"""Policies that propose a force for the cart-pole. None of them knows of the filter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from examples.safe_control_gym.adapter import Array, SampledCartPole
from examples.safe_control_gym.velocity_loop import STRONGEST

Policy = Callable[[Array, dict[str, Any]], float]
LONGEST_HOLD = 8  # control steps of one random force


def random(env: SampledCartPole, generator: np.random.Generator) -> Policy:
    """Draw a force and hold it for some steps."""
    held, left = 0.0, 0

    def choose(observation: Array, info: dict[str, Any]) -> float:
        nonlocal held, left
        if left == 0:
            held, left = generator.uniform(-STRONGEST, STRONGEST), int(generator.integers(1, LONGEST_HOLD + 1))
        left -= 1
        return held

    return choose


def ppo(env: SampledCartPole, generator: np.random.Generator) -> Policy:
    """Return the policy that the authors trained for this task and put behind their own filter (`ppo.json`)."""
    tensors = safetensors.numpy.load_file(Path(__file__).with_name("ppo.safetensors"))
    *hidden, last = [(tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"]) for k in range(3)]

    def choose(observation: Array, info: dict[str, Any]) -> float:
        value = observation.astype(np.float32)
        for weight, bias in hidden:
            value = np.tanh(weight @ value + bias)
        return float(np.clip(last[0] @ value + last[1], -1.0, 1.0)[0] * STRONGEST)

    return choose


def lqr(env: SampledCartPole, generator: np.random.Generator) -> Policy:
    """Return the authors' LQR for this task. It follows the reference, wherever it leads."""
    from safe_control_gym.controllers.lqr.lqr_utils import compute_lqr_gain

    gain = compute_lqr_gain(env.symbolic, np.zeros(4), np.zeros(1), np.eye(4), np.array([[0.1]]), True)

    def choose(observation: Array, info: dict[str, Any]) -> float:
        wanted = env.X_GOAL[min(info["current_step"], len(env.X_GOAL) - 1)]
        return float(np.clip(-gain @ (observation[:4] - wanted), -STRONGEST, STRONGEST)[0])

    return choose


POLICIES = {policy.__name__: policy for policy in (random, ppo, lqr)}
