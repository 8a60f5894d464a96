"""A Lagrange multiplier on the cost of collisions, for the learner's reward (Ray et al. 2019, Tessler et al. 2019).

The learner maximises E[Σ γ^t (r_t − λ c_t)] with the cost c_t = 1 at a collision, and λ ascends the dual problem of
"at most `limit` collisions an episode" at the end of every episode:

    λ ← max(0, λ + η (Σ_t c_t − limit))

Rewards and costs are apart in the replay buffer, so that old steps count with the present λ. The rule is
Ray et al.'s in "Benchmarking safe exploration in deep reinforcement learning"; Stooke et al. 2020 add PID terms to it.
As in Tessler et al., "Reward constrained policy optimization", one critic estimates the penalised reward.
"""

from __future__ import annotations

from brakeline.learner.checkpoint import PartState


class LagrangeMultiplier:
    """λ, in units of the reward.

    >>> multiplier = LagrangeMultiplier(limit=0.01, rate=10.0)
    >>> multiplier.end_episode(collided=True)
    >>> multiplier.value
    9.9
    """

    def __init__(self, limit: float, rate: float) -> None:
        self.limit, self.rate, self.value = limit, rate, 0.0

    def end_episode(self, collided: bool) -> None:
        """Ascend by the cost of an episode."""
        self.value = max(0.0, self.value + self.rate * (float(collided) - self.limit))

    def state(self) -> PartState:
        return PartState({}, {"value": self.value})

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        value = state.value("value")
        if type(value) is not float or not 0.0 <= value < float("inf"):
            raise ValueError(f"value: {value!r} is no multiplier")
        self.value = value
