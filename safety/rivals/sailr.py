"""SAILR: execute the proposed action, unless it is riskier by more than η than the backup policy.

Wagener et al. 2021, "Safe Reinforcement Learning Using Advantage-Based Intervention". The rule is (Q, μ, η). Q(s, a) is
the expected cost of action a followed by the backup policy μ, and V(s) is the expected cost of μ alone:

    intervene  ⟺  Q(s, a) − V(s) > η                 (their eq. 6: the advantage of a over μ); then execute μ(s)

Q and V are learned beforehand, with two networks each: the larger Q and the smaller V count. μ brakes
(`backup_plan.brake`). In training, an intervention ends the episode: the learner sees a terminal step with the lowest
reward (`actors/episode_runner.py`, `learner/n_step.py`). In use, the rule applies anew at every step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadModel
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.request import ALLOWED, Decision, Request
from brakeline.safety.model.model_config import SAILR
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.rival import Rival


def normalised_input(robot: Robot, action: Array) -> Array:
    """Return inputs (..., m) scaled to [-1, 1], the units of Q."""
    low, high = robot.low(), robot.high()
    return np.asarray((2.0 * action - low - high) / (high - low))


class Sailr(Rival):
    """The rule of SAILR with trained critics, whose outputs are logits of the cost in [0, 1]."""

    def __init__(self, model: Pretrained) -> None:
        """Make the method. Raises BadModel if the model is of another method or does not fit the robot."""
        super().__init__(model)
        try:
            self.q, self.v, self.threshold = model.networks["q"], model.networks["v"], model.settings["threshold"]
        except KeyError as error:
            raise BadModel(f"no model of SAILR: {error} is missing") from error
        self.observed = self.v.inputs  # the size of an observation
        sizes = (self.q.inputs, self.q.outputs, self.v.inputs, self.v.outputs)
        if model.method != SAILR or sizes != (self.observed + self.robot.action_dim, 1, self.observed, 1):
            raise BadModel(f"no model of SAILR for {self.robot.name}: {model.method}, networks {sizes}")

    def advantage(self, observation: NDArray[np.float32], action: Array) -> float:
        """Return max Q(s, a) − min V(s), in [-1, 1]: how much costlier the action is than the backup policy."""
        worst = self.q(np.concatenate([observation, normalised_input(self.robot, action)])).max()
        best = self.v(observation).min()
        return _sigmoid(float(worst)) - _sigmoid(float(best))

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the proposal, or the backup policy's input."""
        advantage = self.advantage(request.observation, proposal)
        if not advantage <= self.threshold:  # NaN brakes too
            above = f"{advantage:.3f}, above {self.threshold:g}"
            reason = f"its advantage over braking is {'not a number' if math.isnan(advantage) else above}"
            return self.braking(request, started, reason)
        return self.decision(ALLOWED, braking_plan(self.robot, proposal), 0.0, started)


def _sigmoid(x: float) -> float:
    return float(0.5 * (1.0 + np.tanh(0.5 * x)))
