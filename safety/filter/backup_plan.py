"""The committed backup plan, which an actor keeps between two decisions (docs/method.md §4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.value_equality import ComparedByValue
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.filter.widening import PastWindow, Widening

SAME_SET = 1e-9  # m, rad, ...: rounding allowed in the comparison of a measurement with its predicted set
UNVERIFIED = "unverified"  # in place of a version: no model set verified the committed plan


@dataclass(frozen=True, eq=False)
class Prediction(ComparedByValue):
    """The predicted set of the next measured state: |state - center| <= half_width, in the frame of `heading`.

    >>> from brakeline import robot_named
    >>> box = Prediction(center=np.zeros(5), half_width=np.full(5, 0.1), heading=0.0)
    >>> box.contains(robot_named("ground"), np.array([0.05, 0.0, 0.0, 0.0, 0.0]))
    True

    Attributes:
        center (n,): center of the set; its position is in the world.
        half_width (n,): half-widths of the set.
        heading: angle by which the box of the position is turned [rad].
    """

    center: Array
    half_width: Array
    heading: float

    def contains(self, robot: Robot, state: Array) -> bool:
        """Return whether the measured state (n,) lies in the set."""
        return all(off <= most + SAME_SET for off, most in self._errors(robot, state))

    def copy(self) -> Prediction:
        """Return the same set in arrays of its own."""
        return Prediction(self.center.copy(), self.half_width.copy(), self.heading)

    def share_used(self, robot: Robot, state: Array) -> float:
        """Return the share of the set that the measured state (n,) uses.

        It is the largest ratio of an error, less `SAME_SET`, to its half-width. Above 1, the state is outside; NaN
        gives infinity.
        """
        beyond = [(off - SAME_SET, most) for off, most in self._errors(robot, state) if not off <= SAME_SET]
        shares = [off / most if most > 0.0 else math.inf for off, most in beyond]
        return math.inf if any(map(math.isnan, shares)) else max(shares, default=0.0)

    def _errors(self, robot: Robot, state: Array) -> Iterator[tuple[float, float]]:
        """Yield the distance from the center and the half-width of each coordinate."""
        away = (state - self.center).tolist()  # a few numbers: a loop is faster than NumPy
        if robot.heading is not None:
            cos, sin = math.cos(self.heading), math.sin(self.heading)
            away[0], away[1] = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
            away[robot.heading] = (away[robot.heading] + math.pi) % math.tau - math.pi
        return zip(map(abs, away), self.half_width.tolist(), strict=True)


NO_PREDICTION = Prediction(np.zeros(0), np.zeros(0), 0.0)  # of a method that predicts nothing


class BackupPlan:
    """The committed backup plan of one robot, verified from the time when it was made until the robot stands.

    `accept` takes the plan of a decision, `fallback` goes on with the plan when no decision came. Both return the input
    to execute; for a robot in real time, the input of the next period.

    >>> from brakeline import robot_named
    >>> backup_plan = BackupPlan(robot_named("ground"))
    >>> brake = np.array([[0.2, 0.0], [0.1, 0.0], [0.0, 0.0]])
    >>> backup_plan.accept(brake, model="f3c1", predicted=None, verified=True).tolist()
    [0.2, 0.0]
    >>> backup_plan.fallback().tolist()
    [0.1, 0.0]

    Attributes:
        plan (N, m): rest of the plan. Its first row is the input to execute if no better answer comes; in real time, it
            is the input that the robot is executing.
        model: version of the model set that verified the plan. Empty if the robot stands, `UNVERIFIED` if none did.
        predicted: set of the next measured state, if the decision had one.
        reservation: the rest of the robot's reservation, in a world with other robots.
        seen (n,): last measured state.
        widening: the last states and inputs, and the factors on the sets of the next decision.
        turn_aside: its requests let the filter turn a blocked robot aside (`Request.turn_aside`).
        acceleration_age: age of the horizontal acceleration in the measured states [s] (`Request.acceleration_age`).
    """

    def __init__(self, robot: Robot, turn_aside: bool = False, acceleration_age: float = 0.0) -> None:
        self.robot, self.turn_aside, self.acceleration_age = robot, turn_aside, acceleration_age
        self.widening = Widening(robot)
        self.reset()

    def reset(self) -> None:
        """Start an episode: the robot stands."""
        self.input_in_force: Array = self.robot.zero_input()
        self.plan: Array = np.tile(self.input_in_force, (self.robot.horizon, 1))
        self.model = ""
        self.predicted: Prediction | None = None
        self.reservation: Reservation | None = None
        self.seen: Array = np.zeros(self.robot.state_dim)  # the last measured state: of feedback, a stop is made of it
        self.widening.interrupt()
        self._judged = False
        # boxes of the next positions, from the last decision's tube: centers and half-widths (k, d)
        self._tube: tuple[Array, Array] | None = None
        self._compare = False  # a state was measured since the last decision
        self._still = self.robot.horizon  # periods of a stop's inputs
        self._plan_tokens: tuple[bytes, ...] = ()  # for this period and the later ones; the last one stays

    @property
    def next_input(self) -> Array:
        """(m,) the input to execute in the coming period, after `accept` or `fallback`."""
        return (self.plan[0] if self.robot.late else self.input_in_force).copy()

    @property
    def past(self) -> PastWindow | None:
        """The window that ends with the next request, if the last decision asked for it."""
        return self.widening.past if self._judged else None

    @property
    def plan_token(self) -> bytes:
        """The plan token for the next request. Empty if the service gave none."""
        return self._plan_tokens[0] if self._plan_tokens else b""

    def measured(self, state: Array) -> None:
        """Store the measured state (n,) of a period before its request; ignore it if the filter would refuse it."""
        if state.shape == self.seen.shape and (np.abs(state) <= FARTHEST).all():  # NaN fails too
            self.seen, self._compare = state.copy(), True  # the caller may overwrite its array
            if self.predicted is None and self.model and not self.still_verified:
                self.model, self._plan_tokens = UNVERIFIED, ()

    def accept(
        self,
        plan: Array,
        model: str,
        predicted: Prediction | None,
        verified: bool,
        plan_tokens: Iterable[bytes] = (),
        reservation: Reservation | None = None,
        score: float | None = None,
        judges: bool = False,
        outside_share: float = 0.0,
        plan_score: float | None = None,
        tube: tuple[Array, Array] | None = None,
    ) -> Array:
        """Commit to the plan of a decision; return the input to execute next.

        Args:
            plan, model, predicted, verified, plan_tokens, reservation: those of the decision.
            score: the score of the window that ended with the request, if the filter gave one.
            judges: whether the filter can score a window. If not, `past` gives none, and the last period is scored.
            outside_share: the share of windows that may leave the sets.
            plan_score: that of the decision; None: `score` stands for it, too.
            tube: centers and half-widths (N, d) of the decision's tube. After a period without a decision there is no
                predicted set, so the next positions are compared with the tube.
        """
        self._judged = judges
        if score is None and not judges and self._compare and self.predicted is not None:  # the model set before did
            self.widening.judge_period(self.predicted.share_used(self.robot, self.seen))
        known = not model or self.widening.use(model)
        if score is not None and known:
            self.widening.judge(score, outside_share, plan_score)
        self.reservation = reservation
        self._plan_tokens = (b"", *plan_tokens)
        self.plan, self.model = plan, model if verified else UNVERIFIED
        self.predicted = predicted.copy() if predicted is not None and len(predicted.center) else None
        action = self._advance()
        self._tube = None if tube is None else (tube[0].copy(), tube[1].copy())
        return action

    @property
    def still_verified(self) -> bool:
        """Whether the plan is verified and the measured state is in its predicted set; without one, in its tube.

        In joint space a tube has no boxes: nothing shows that the robot still follows a plan without a predicted set.
        """
        if self.model == UNVERIFIED or not self._compare:
            return self.model != UNVERIFIED
        if self.predicted is not None:
            return self.predicted.contains(self.robot, self.seen)
        if self._tube is None or not self._tube[0].size:
            return bool(self.robot.position_dim)  # in joint space, there are no boxes to compare with
        center, half_width = (part[0] for part in self._tube)
        return bool((np.abs(self.seen[: len(center)] - center) <= half_width + SAME_SET).all())

    def executes(self, action: Array) -> None:
        """Take in the input (m,) that a robot in real time executes. If the plan has another, it is not verified."""
        if not np.abs(action - self.plan[0]).max() <= SAME_SET:  # true for NaN, too
            self.distrust()
            self.plan[0] = action

    def distrust(self) -> None:
        """Stop counting the plan as verified, since the robot left it: the robot brakes along it all the same."""
        self.model, self.predicted, self.reservation, self._tube = UNVERIFIED, None, None, None
        self._plan_tokens, self._compare = (), False
        self.widening.interrupt()

    def fallback(self) -> Array:
        """Return the next input of the committed plan, since no decision came.

        No service compared the measured state with its predicted set. If the state is outside, the plan no longer
        counts as verified. Neither does that of a robot that stops by feedback, without a state to feed back: the
        robot then executes the plan's input as it is, which is zero once the robot brakes.
        """
        robot, blind = self.robot, bool(self.robot.feedback) and not self._compare
        if blind or not self.still_verified:
            self.model, self._plan_tokens = UNVERIFIED, ()
        self.predicted = None
        if blind:
            self.plan[0] = robot.clip_input(self.plan[0], self.input_in_force)
        elif robot.feedback:
            self.plan[0] = robot.stop_by_feedback(self.plan[0], self.seen, self.input_in_force)
        return self._advance(blind)

    def _advance(self, blind: bool = False) -> Array:
        """Begin the next period of the plan. blind: nobody knows whether the robot stands, for want of a state."""
        robot = self.robot
        now: Array = self.plan[0].copy()
        if self._compare:
            self.widening.executed(self.seen, self.input_in_force, now)
        else:
            self.widening.interrupt()
        self._compare = False
        self._plan_tokens = self._plan_tokens[1:] or self._plan_tokens
        if self._tube is not None and len(self._tube[0]) > 1:  # after the plan's end, the robot stands in the last box
            self._tube = self._tube[0][1:], self._tube[1][1:]
        self.reservation = None if self.reservation is None else self.reservation.later()
        rests = not blind and robot.is_stopping(now, self.seen, self.input_in_force)
        last = np.where(robot.zero_at_rest, 0.0, self.plan[-1])
        self.plan = np.vstack([self.plan[1:], last[None]])
        self.input_in_force = now
        self._still = self._still + 1 if rests else 0
        if self._still >= robot.horizon and robot.is_stop_input(self.plan).all():
            self.model = ""  # it has coasted to a stand, and a standing robot needs no model set
        return self.next_input


def correction_penalty(
    robot: Robot, proposed: ArrayLike, before: ArrayLike, executed: ArrayLike, weight: float
) -> float:
    """Return weight · ‖executed - proposed‖, with each input in units of its range (docs/method.md §7).

    The proposal is first clipped to the bounds and to the slew around the input `before`. NaN and infinity count as
    zero input.
    """
    low, high, slew = robot.low(), robot.high(), robot.slew
    before = np.asarray(before, float)
    wanted = np.asarray(proposed, float)
    wanted = np.where(np.isfinite(wanted), wanted, 0.0)
    clipped = np.minimum(np.maximum(wanted, np.maximum(low, before - slew)), np.minimum(high, before + slew))
    return weight * float(np.linalg.norm((np.asarray(executed, float) - clipped) / (high - low)))


def brake(robot: Robot, before: Array) -> Array:
    """Return the input (m,) after the input `before` (m,) while braking as fast as the slew allows.

    This is the backup policy μ of methods that verify nothing: μ(u_before) = u_before − clip(u_before, −slew, slew).
    Without a slew limit the input is zero at once. An input that the stop rule holds stays as it is.
    """
    slew = np.asarray(robot.action_slew)
    return np.where(robot.zero_at_rest, before - np.clip(before, -slew, slew), before)


def braking_plan(robot: Robot, first: Array) -> Array:
    """Return the plan (N, m): `first`, then μ. Its last input is zero: the horizon suffices to brake from any input."""
    plan = np.zeros((robot.horizon, robot.action_dim))
    plan[0] = first
    for k in range(1, robot.horizon):
        plan[k] = brake(robot, plan[k - 1])
    return plan
