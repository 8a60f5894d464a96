"""The filter (or a rival: `safety/methods.py`) in front of any policy, in process, as a Gymnasium wrapper.

env = SafetyWrapper(NavigationEnv(), Filter(ModelSet.load(path)))
model = AnyLibrary("MlpPolicy", env).learn(...)
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from messaging.movers import parted
from messaging.tasks import UnknownTask, task_of
from safety.commitment import Commitment, correction_penalty
from safety.memory import Memory
from safety.methods import Method
from safety.request import Decision, Request

Observation = NDArray[np.float32]


class SafetyWrapper(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Replaces each action by the filter's decision on it.

    The environment's `info` must hold, after `reset` and `step`: `state`, the measured state (n,), and `obstacles`,
    a list of `messaging.shapes.Obstacle` with at least those within `filter.reach`; it may hold `scan`, a
    `messaging.scans.Scan` that takes their place. The wrapper adds `safety` (the
    `Decision`), `proposed` and `penalty`; the penalty is subtracted from the reward.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], filter: Method, penalty: float = 0.0) -> None:
        super().__init__(env)
        self.filter, self.penalty = filter, penalty
        self.commitment = Commitment(filter.robot)
        self._memory = Memory(filter.robot.footprint)
        self._info: dict[str, Any] = {}
        self._seen: Any = None  # the last observation, which some methods need

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._seen, self._info = self.env.reset(seed=seed, options=options)
        self.commitment.reset()
        self._memory.reset()
        self._remember()
        return self._seen, self._info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        decision, before = self.decide(np.asarray(action, dtype=float)), self.commitment.input_in_force
        executed = self.commitment.accept(decision.plan, decision.model, decision.predicted, decision.verified)
        self._seen, reward, terminated, truncated, self._info = self.env.step(executed.astype(np.float32))
        self._remember()
        cost = correction_penalty(self.filter.robot, action, before, executed, self.penalty)
        self._info |= {"safety": decision, "proposed": action, "penalty": cost}
        return self._seen, float(reward) - cost, terminated, truncated, self._info

    def decide(self, action: NDArray[np.float64]) -> Decision:
        """The decision on an action in the current state; a proposal that is no number becomes standing still."""
        kept, robot = self.commitment, self.filter.robot
        obstacles, movers = parted(self._info["obstacles"], robot.position_dim)
        kept.seen = np.asarray(self._info["state"], dtype=float)
        proposal = action if np.isfinite(action).all() else np.zeros(robot.action_dim)
        return self.filter.decide(
            Request(
                state=np.asarray(self._info["state"], dtype=float),
                action=proposal,
                input_in_force=kept.input_in_force,
                plan=kept.plan,
                obstacles=obstacles,
                movers=movers,
                scan=self._scan,
                model=kept.model,
                predicted=kept.predicted,
                observation=self._observed(),
            )
        )

    def _remember(self) -> None:
        scan = self._info.get("scan")
        self._scan = None if scan is None else self._memory.fill(scan, self.filter.robot.period)

    def _observed(self) -> Observation:
        """The observation, if it is the robot's own: another environment has none that a method could read."""
        seen = np.asarray(self._seen, np.float32) if isinstance(self._seen, np.ndarray) else np.zeros(0, np.float32)
        try:
            wanted = task_of(self.filter.robot).observation_dim
        except UnknownTask:  # then no method reads it
            wanted = 0
        return seen if seen.shape == (wanted,) else np.zeros(0, np.float32)
