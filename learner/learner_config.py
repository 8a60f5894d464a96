"""The settings of a learner. This module does not import torch, because the launcher reads it."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from brakeline.messaging.number_checks import check_numbers

Precision = Literal["float32", "bfloat16"]
GROWTH_SHARES = 1 / 6, 1 / 2  # shares of the training between which penalties grow: first the goals are learned
Stored = Literal["executed", "both"]  # actions of a corrected step to learn from (`learner/n_step.py`)


@dataclass(frozen=True)
class TD3Config:
    """Set the parameters of TD3."""

    hidden: tuple[int, ...] = (256, 256)
    """Give the hidden layers of actor and critics these widths."""
    actor_rate: float = 3e-4
    """Train the actor at this learning rate."""
    critic_rate: float = 3e-4
    """Train the critics at this learning rate."""
    batch: int = 128
    """Draw this many steps for each update."""
    gamma: float = 0.99
    """Discount rewards by this factor a period."""
    n_step: int = 3
    """Sum the rewards of this many periods before the critic estimates the rest."""
    tau: float = 0.005
    """Move the target networks by this share at each update."""
    policy_delay: int = 2
    """Update the actor once in this many updates of the critics."""
    target_noise: float = 0.2
    """Smooth the target with noise of this standard deviation, as a share of half an input's range."""
    target_noise_clip: float = 0.5
    """Clip the noise of the target at this share of half an input's range."""
    exploration_noise: float = 0.1
    """Explore with noise of this standard deviation, as a share of half an input's range. The actors get it
    with the weights."""
    reward_scale: float = 0.1
    """Scale rewards by this factor. 0.1 keeps values near 10 for rewards of ±100."""
    updates_per_step: float = 1.0
    """Update this many times for each step."""
    cost_limit: float | None = None
    """Raise a penalty on collisions until at most this share of the episodes collides (a Lagrange multiplier). By
    default, the reward alone counts."""
    multiplier_rate: float = 10.0
    """With a cost limit, raise the penalty by this reward for each episode that collides."""
    stored: Stored = "both"
    """Learn from the executed action of a corrected step, or from both the proposed and the executed action."""
    imitation: float = 0.0
    """For corrected steps, add this weight times the squared distance between the actor's proposal and the executed
    action to the actor's loss."""
    penalty_growth: float = 1.0
    """Multiply penalties for corrections by a factor that grows linearly from 1 to this value, between one sixth and
    one half of the training."""
    symmetric: bool = True
    """Learn also from the mirror images of a step, if the task is symmetric."""
    warmup: int = 2000
    """Propose random actions for this many steps before the first update."""
    precision: Precision = "float32"
    """Compute the products of wide layers in this precision. bfloat16 is faster on a processor that multiplies it
    (AVX512-BF16, AMX), and slower on others."""

    def __post_init__(self) -> None:
        check_numbers(self, "actor_rate", "critic_rate", "target_noise", "target_noise_clip", least=0.0)
        check_numbers(self, "exploration_noise", "imitation", least=0.0)
        check_numbers(self, "penalty_growth", least=1.0)
        check_numbers(self, "reward_scale", "updates_per_step", "multiplier_rate", above=0.0)
        if min(self.batch, self.n_step, self.policy_delay, min(self.hidden, default=0)) <= 0:
            raise ValueError(f"batch, n_step, policy_delay and hidden must be positive: {self}")
        if self.warmup < self.n_step:
            raise ValueError(f"warmup {self.warmup} is shorter than n_step {self.n_step}: nothing to sample from")
        if not 0.0 <= (self.cost_limit or 0.0) < 1.0:
            raise ValueError(f"cost_limit must be in [0, 1): {self}")
        if not 0.0 <= self.gamma <= 1.0 or not 0.0 < self.tau <= 1.0:
            raise ValueError(f"gamma must be in [0, 1] and tau in (0, 1]: {self}")

    def with_settings(self, settings: Mapping[str, Any], given: Collection[str] = ()) -> TD3Config:
        """Return these settings, with `settings` in place of those that have their default value and are not `given`.

        >>> TD3Config(tau=0.01).with_settings({"tau": 0.02, "imitation": 1.0}).tau
        0.01

        Raises:
            ValueError: TD3 has no such setting, or not with this value.
        """
        default = TD3Config()
        if unknown := settings.keys() - asdict(default):
            raise ValueError(f"TD3 has no setting {', '.join(sorted(unknown))}")
        own: dict[str, Any] = {}
        for name, value in settings.items():
            if name not in given and getattr(self, name) == getattr(default, name):
                own[name] = tuple(value) if isinstance(value, list) else value
        try:
            return replace(self, **own)
        except TypeError as error:  # text in place of a number
            raise ValueError(f"{own}: {error}") from error

    def penalty_factor(self, done: float) -> float:
        """Return the factor on penalties after a share `done` of the training.

        >>> [TD3Config(penalty_growth=4.0).penalty_factor(done) for done in (0.0, 0.25, 0.5, 1.0)]
        [1.0, 1.75, 4.0, 4.0]
        """
        begin, end = GROWTH_SHARES
        return 1.0 + (self.penalty_growth - 1.0) * min(max((done - begin) / (end - begin), 0.0), 1.0)


@dataclass(frozen=True)
class LearnerConfig:
    """Configure the learner and its algorithm (TD3)."""

    td3: TD3Config = field(default_factory=TD3Config)
    seed: int = 0
    """Draw weights and batches from this seed. `train` and `learner` ignore this option: give --seed instead."""
    steps: int = 100_000
    """Learn from this many steps, and in lockstep to the end of the last episode. `train` and `learner` ignore this
    option: give --steps instead."""
    capacity: int = 200_000
    """Keep this many of the newest steps in the replay buffer."""
    window: int = 16
    """Let an actor publish this many steps that the learner has not read."""
    ahead: int = 64
    """Let all actors together be this many steps ahead of the updates."""
    publish_every: int = 50
    """Publish weights after this many updates."""
    checkpoint_every: int = 10_000
    """Write a checkpoint after this many steps."""
    lockstep: bool = False
    """Learn with one actor, and with window 1, ahead 0 and publish-every 1, so that you can repeat the run exactly.
    `train` ignores this option: give --deterministic instead."""

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
