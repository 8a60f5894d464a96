"""What whoever drives a robot keeps between two decisions: the committed plan and what it predicts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.robot import Robot
from brakeline.safety.filter.reservation import Reservation

Array = NDArray[np.float64]

SAME_SET = 1e-9  # m, rad, ...: rounding allowed when a measurement is compared with its prediction
UNVERIFIED = "unverified"  # in place of a model's version: no model vouches for the committed plan


@dataclass(frozen=True)
class Prediction:
    """Where the next measured state must lie: |displacement - center| <= half_width in the frame of `heading`.

    center, half_width: (n,); the position part of the center is in the world, its box turned by heading [rad].
    """

    center: Array
    half_width: Array
    heading: float

    def contains(self, robot: Robot, state: Array) -> bool:
        """Does the measured state (n,) lie in the set?"""
        away = state - self.center
        if robot.heading is not None:
            cos, sin = math.cos(self.heading), math.sin(self.heading)
            away[0], away[1] = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
            away[robot.heading] = (away[robot.heading] + np.pi) % (2.0 * np.pi) - np.pi
        return bool((np.abs(away) <= self.half_width + SAME_SET).all())


NO_PREDICTION = Prediction(np.zeros(0), np.zeros(0), 0.0)  # of a method that predicts nothing


class BackupPlan:
    """The committed plan of one robot: verified when it was made, from then to standstill.

    plan (N, m) is its tail: the first row is what to execute if no better answer comes; of a late robot what is being
    executed, and `accept` and `fallback` return the input of the next period. model is the version of the
    model set that verified it, empty when the robot stands still, `UNVERIFIED` if none did; voucher is the service's
    word for that, if it gave one. promise: of a robot that others share its world with, what is left of it.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.reset()

    def reset(self) -> None:
        """At an episode's start: standing still."""
        self.input_in_force: Array = self.robot.zero_input()
        self.plan: Array = np.tile(self.input_in_force, (self.robot.horizon, 1))
        self.model = ""
        self.predicted: Prediction | None = None
        self.reservation: Reservation | None = None
        self.seen: Array = np.zeros(self.robot.state_dim)  # the last measured state: of feedback, a stop is made of it
        self._compare = False  # was it measured where the prediction speaks of it?
        self._still = self.robot.horizon  # periods of a stop's inputs
        self._plan_tokens: tuple[bytes, ...] = ()  # of this period and those to come; the last stays

    @property
    def next_input(self) -> Array:
        """(m,) the input to execute in the coming period, after `accept` or `fallback`."""
        return self.plan[0].copy() if self.robot.late else self.input_in_force

    @property
    def plan_token(self) -> bytes:
        """For the next request; empty: the service gave none."""
        return self._plan_tokens[0] if self._plan_tokens else b""

    def measured(self, state: Array) -> None:
        """At a period's beginning, before a question about it; one that is no state (n,) counts as none."""
        if state.shape == self.seen.shape and np.isfinite(state).all():
            self.seen, self._compare = state, True

    def accept(
        self,
        plan: Array,
        model: str,
        predicted: Prediction | None,
        verified: bool,
        plan_tokens: Iterable[bytes] = (),
        reservation: Reservation | None = None,
    ) -> Array:
        """A decision's plan becomes the committed one; returns the input to execute next."""
        self.reservation = reservation
        self._plan_tokens = (b"", *plan_tokens)
        self.plan, self.model = plan, model if verified else UNVERIFIED
        self.predicted = predicted if predicted is not None and len(predicted.center) else None
        return self._advance()

    @property
    def still_verified(self) -> bool:
        """Does what was verified of the plan still hold, by the state that was measured?"""
        outside = self._compare and self.predicted is not None and not self.predicted.contains(self.robot, self.seen)
        return self.model != UNVERIFIED and not outside

    def fallback(self) -> Array:
        """No decision came: the committed plan's next input. Nobody else saw whether the state that was measured is in
        its predicted set; where it is not, what was verified of the plan does not hold any more."""
        if not self.still_verified:
            self.model, self._plan_tokens = UNVERIFIED, ()
        self.predicted = None
        if self.robot.feedback:
            self.plan[0] = self.robot.stop_by_feedback(self.plan[0], self.seen, self.input_in_force)
        return self._advance()

    def _advance(self) -> Array:
        robot = self.robot
        self._compare = False
        now: Array = self.plan[0].copy()
        self._plan_tokens = self._plan_tokens[1:] or self._plan_tokens
        self.reservation = None if self.reservation is None else self.reservation.later()
        rests = robot.is_stopping(now, self.seen, self.input_in_force)
        last = np.where(robot.zero_at_rest, 0.0, self.plan[-1])
        self.plan = np.vstack([self.plan[1:], last[None]])
        self.input_in_force = now
        self._still = self._still + 1 if rests else 0
        stopped = self.model != UNVERIFIED or self._still >= robot.horizon
        if stopped and rests and robot.is_stop_input(self.plan).all():
            self.model = ""  # standing still needs nobody's word
        return self.next_input


def correction_penalty(
    robot: Robot, proposed: ArrayLike, before: ArrayLike, executed: ArrayLike, weight: float
) -> float:
    """weight · ‖executed - proposed‖, each input in units of its range: what leaning on the filter costs.

    From the proposal clipped to bounds and to the slew from the input `before`, which is what `allowed` lets pass; one
    that is no number counts as zero input.
    """
    low, high, slew = robot.low(), robot.high(), np.asarray(robot.action_slew)
    before = np.asarray(before, float)
    wanted = np.nan_to_num(np.asarray(proposed, float), posinf=0.0, neginf=0.0)
    clipped = np.clip(wanted, np.maximum(low, before - slew), np.minimum(high, before + slew))
    return weight * float(np.linalg.norm((np.asarray(executed, float) - clipped) / (high - low)))
