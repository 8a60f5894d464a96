"""What every asker answers with, whether it asks in process or over the bus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from messaging.robots import Robot
from safety.commitment import Commitment
from safety.request import Decision

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Answer(Decision):
    """A decision as the asker gets it.

    Attributes:
        action: (m,) the input to execute next. This is the plan's first row. For a late robot it is the second row,
            because the first row is in force already.
        queue_ms: time from the service's receipt of the question to the decision; 0 in process.
        unvouched: the service did not believe that the request's model verified its plan.
        vouchers: for the next requests, in their order; empty in process.
    """

    action: Array
    queue_ms: float = 0.0
    unvouched: bool = False
    vouchers: tuple[bytes, ...] = ()

    @staticmethod
    def of(decision: Decision, robot: Robot, **more: Any) -> Answer:
        """The answer that holds this decision; more: the attributes that a decision has not."""
        return Answer(**vars(decision), action=decision.plan[robot.given].copy(), **more)


def accept(commitment: Commitment, answer: Answer) -> Array:
    """Commit to an answer's plan; returns the input to execute next, which is `answer.action`."""
    return commitment.accept(
        answer.plan, answer.model, answer.predicted, answer.verified, answer.vouchers, answer.promise
    )
