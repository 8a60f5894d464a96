"""The settings of a learner. This module does not import torch, because the launcher reads it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Precision = Literal["float32", "bfloat16"]
Stored = Literal["executed", "both"]  # actions of a corrected step to learn from (`learner/n_step.py`)


@dataclass(frozen=True)
class TD3Config:
    """Settings of TD3."""

    hidden: tuple[int, ...] = (256, 256)
    actor_rate: float = 3e-4
    critic_rate: float = 3e-4
    batch: int = 128
    gamma: float = 0.99
    n_step: int = 3
    tau: float = 0.005
    policy_delay: int = 2
    target_noise: float = 0.2  # σ, of the half range of an action
    target_noise_clip: float = 0.5  # η
    exploration_noise: float = 0.1  # of the half range; the actors get it with the weights
    reward_scale: float = 0.1  # keeps |Q| near 10 for rewards of ±100
    updates_per_step: float = 1.0
    stored: Stored = "both"
    symmetric: bool = True  # learn from the images of a step too, if the task is symmetric (`learner/symmetry.py`)
    warmup: int = 2000  # random steps before the first update
    precision: Precision = "float32"  # of the products of wide layers

    def __post_init__(self) -> None:
        widths = min(self.hidden, default=0)
        if min(self.batch, self.n_step, self.policy_delay, self.updates_per_step, widths) <= 0:
            raise ValueError(f"batch, n_step, policy_delay, updates_per_step and hidden must be positive: {self}")
        if self.warmup < self.n_step:
            raise ValueError(f"warmup {self.warmup} is shorter than n_step {self.n_step}: nothing to sample from")
        if not 0.0 <= self.gamma <= 1.0 or not 0.0 < self.tau <= 1.0:
            raise ValueError(f"gamma must be in [0, 1] and tau in (0, 1]: {self}")


@dataclass(frozen=True)
class LearnerConfig:
    """Settings of a learner."""

    td3: TD3Config = field(default_factory=TD3Config)
    seed: int = 0
    steps: int = 100_000  # length of the run; in lockstep the last episode is completed
    capacity: int = 200_000  # transitions
    window: int = 16  # steps that an actor may publish ahead of the learner
    ahead: int = 64  # steps that all actors together may be ahead of the updates
    publish_every: int = 50  # updates between two versions of the weights
    checkpoint_every: int = 10_000  # steps
    lockstep: bool = False  # one actor, with `window` 1, `ahead` 0 and `publish_every` 1

    def __post_init__(self) -> None:
        if min(self.steps, self.capacity, self.window, self.publish_every, self.checkpoint_every) < 1 or self.ahead < 0:
            raise ValueError(f"steps, capacity, window, publish_every, checkpoint_every must be positive: {self}")

    def lasting(self) -> dict[str, Any]:
        """Return the settings that a resumed run must share with the interrupted one, as JSON values."""
        values = asdict(self)
        for name in ("steps", "checkpoint_every"):
            del values[name]
        lasting: dict[str, Any] = json.loads(json.dumps(values))
        return lasting
