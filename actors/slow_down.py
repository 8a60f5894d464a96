"""Drive slower while more plans leave their tubes than the model set states (docs/method.md §15).

The widening follows a change within seconds. If it does not suffice, more verified plans leave their tubes than the
model set states. A slower robot covers less ground in a plan, so leaving a tube is less dangerous.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.stated_share import percent

log = logging.getLogger("brakeline.actor")

SLOW = 0.5  # share of the bounds of each input that moves the position
BY_CHANCE = 0.001  # the limit begins if the stated bound makes so many plans outside less likely than this


class SlowDown:
    """The limit on the proposals of one robot. It begins and ends by itself, and logs both."""

    def __init__(self, robot: Robot, actor: str) -> None:
        self._robot, self._actor = robot, actor
        self._moves = np.array(robot.translates)
        self.active = False  # whether proposals are limited

    @property
    def share(self) -> float:
        """The share of the bounds that a proposal may use; 0 without a limit."""
        return SLOW if self.active else 0.0

    def update(self, left: Sequence[bool], bound: float | None) -> None:
        """Begin or end the limit.

        Args:
            left: of the last plans, whether each left its tube (`Widening.left`).
            bound: the share of plans that the model set states at most; None: it states nothing.
        """
        outside, plans = sum(left), len(left)
        bound = 1.0 if bound is None else bound
        counts = f"{outside} of the last {plans} plans left their tubes, stated: at most {percent(bound)}"
        if not self.active and outside and probability_of_at_least(outside, plans, bound) < BY_CHANCE:
            self.active = True
            log.warning("%s: slowing down to %.0f %% of the largest inputs: %s", self._actor, 100.0 * SLOW, counts)
        elif self.active and outside <= bound * plans:
            self.active = False
            log.warning("%s: no longer slowed down: %s", self._actor, counts)

    def proposal(self, proposal: Array) -> Array:
        """Return a proposal (m,) within the limit, in the same direction.

        Only inputs that move the position are limited. NaN and infinity pass: the filter refuses them.
        """
        if not self.active or not np.isfinite(proposal).all():
            return proposal
        bounds = SLOW * np.where(proposal > 0.0, self._robot.high(), -self._robot.low())
        with np.errstate(divide="ignore", invalid="ignore"):
            excess = np.where(self._moves & (proposal != 0.0), np.abs(proposal) / np.maximum(bounds, 0.0), 1.0)
        finite = excess[np.isfinite(excess)]  # an input beyond a bound of zero: the filter clips it
        return np.where(self._moves, proposal / max(1.0, float(finite.max(initial=1.0))), proposal)


def probability_of_at_least(outside: int, plans: int, bound: float) -> float:
    """Return the probability that at least `outside` of `plans` plans are outside, if `bound` is that of each."""
    less = (math.comb(plans, k) * bound**k * (1.0 - bound) ** (plans - k) for k in range(outside))
    return max(1.0 - math.fsum(less), 0.0)
