"""What a learner can be told, besides the algorithm's own numbers (`TD3Config`)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

from learner.td3 import TD3Config


@dataclass(frozen=True)
class LearnerConfig:
    td3: TD3Config = field(default_factory=TD3Config)
    seed: int = 0
    steps: int = 100_000  # the run's length; in lockstep the episode in which they end is finished
    capacity: int = 200_000  # transitions
    window: int = 16  # steps that an actor may have on their way
    ahead: int = 64  # steps that the actors together may be ahead of the updates
    publish_every: int = 50  # updates from one version of the weights to the next
    checkpoint_every: int = 10_000  # steps
    lockstep: bool = False  # one actor; `window`, `ahead` and `publish_every` are 1, 0 and 1

    def __post_init__(self) -> None:
        if min(self.steps, self.capacity, self.window, self.publish_every, self.checkpoint_every) < 1 or self.ahead < 0:
            raise ValueError(f"steps, capacity, window, publish_every, checkpoint_every must be positive: {self}")

    def lasting(self) -> dict[str, Any]:
        """What a resumed run must share with the interrupted one, as JSON gives it back."""
        values = asdict(self)
        for name in ("steps", "checkpoint_every"):
            del values[name]
        lasting: dict[str, Any] = json.loads(json.dumps(values))
        return lasting
