"""The committed backup plans of many robots of one kind as arrays: `BackupPlan` for each row.

plans = BackupPlanBatch(Filter.load("ground"), size=64)
outcome = plans.decide(states, actions, obstacles)       # once a period; then drive(outcome.inputs)
plans.reset(ended)                                       # the robots whose episode begins anew
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import FARTHEST
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import SAME_SET, UNVERIFIED
from brakeline.safety.filter.batch.decision_arrays import KINDS, DecisionArrays
from brakeline.safety.filter.batch.obstacle_arrays import ObstacleArrays, mapped, plausible
from brakeline.safety.filter.batch.request_arrays import PastArrays, PredictionArrays, RequestArrays
from brakeline.safety.filter.request import FAILSAFE
from brakeline.safety.filter.widening import WINDOWS, widening_factor

if TYPE_CHECKING:
    from brakeline.safety.filter.batch.row_by_row import BatchMethod

Flags = NDArray[np.bool_]
Observations = NDArray[np.float32]

log = logging.getLogger(__name__)

SAME_INPUT = 1e-9  # rounding allowed in a plan at the bounds of its inputs
NO_DECISION = "a state, observation or obstacle that is not finite or too large, or a plan that is not possible"
STANDING, VERIFIED, OPEN = range(3)  # of a committed plan: it stands, the model set verified it, nothing did


@dataclass(frozen=True)
class BatchOutcome:
    """The outcome of one request about B robots."""

    inputs: Array  # (B, m): to execute in the coming period
    decided: Flags  # (B,): whether the row has a decision; without one, the robot follows its committed plan
    # the decisions; None: the whole batch has none. A row without one has the kind failsafe, and is not verified.
    answers: DecisionArrays | None
    failure: str = ""  # why a row has no decision. Empty if all rows have one.


class BackupPlanBatch:
    """The committed plans of B robots between two decisions, and the requests about them.

    It is for robots in lockstep, without feedback and without reservations, in a batch with one filter. A row
    without a valid decision follows its committed plan. If the filter raises an error, all rows do.

    Attributes:
        acceleration_age: age of the horizontal acceleration in the measured states [s] (`RequestArrays`).
    """

    def __init__(self, safety: BatchMethod, size: int, turn_aside: bool = False) -> None:
        """Begin with all robots standing. turn_aside: the filter turns blocked robots aside (`Request.turn_aside`).

        Raises:
            ValueError: batches do not decide for this kind of robot.
        """
        robot = safety.robot
        if robot.late or robot.feedback or not robot.position_dim:
            raise ValueError(f"{robot.name} keeps no plans in batches: decide with BackupPlan, one robot at a time")
        N, n, m = robot.horizon, robot.state_dim, robot.action_dim
        self.independent = False  # a robot forgets its scores when an episode begins, so no episode depends on another
        self.safety, self.robot, self._size, self._turn_aside = safety, robot, size, turn_aside
        self.acceleration_age = 0.0
        # plan (B, N, m), input_in_force (B, m): see `BackupPlan`
        self.plan, self.input_in_force = np.zeros((size, N, m)), np.zeros((size, m))
        # the sets of the next measured states
        self.predicted = PredictionArrays(
            np.zeros((size, n)), np.zeros((size, n)), np.zeros(size), np.zeros(size, dtype=bool)
        )
        # boxes of the positions now and later, from the last decisions' tubes: centers and half-widths
        self._tube = np.zeros((2, size, N + 1, robot.position_dim))
        self._status, self._still = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
        self._states, self._inputs = np.zeros((size, N, n)), np.zeros((size, N + 1, m))
        self._periods = np.zeros(size, dtype=np.int64)
        self._judged, self._widened = False, np.ones(size)  # factors by which the predicted sets were widened
        # scores of plans, and of all coordinates
        self._scores, self._place = np.zeros((size, 2, WINDOWS)), np.zeros(size, dtype=np.int64)
        self._outside_share = 0.0
        self.reset(np.ones(size, dtype=bool))

    def reset(self, which: Flags) -> None:
        """Begin an episode of some robots (B,): they stand. Their scores stay, unless episodes are independent."""
        zero = self.robot.zero_input()
        self.input_in_force[which], self.plan[which], self._inputs[which] = zero, zero, zero
        self._status[which], self._still[which], self._periods[which] = STANDING, self.robot.horizon, 0
        self.predicted.given[which] = False
        if self.independent:
            self._scores[which] = 0.0

    @property
    def widening(self) -> Array:
        """The factor (B,) on every set of the next plan."""
        return widening_factor(self._scores[:, 0], self._outside_share)

    @property
    def state_widening(self) -> Array:
        """The factor (B,) on the sets of the next states."""
        return widening_factor(self._scores[:, 1], self._outside_share)

    def request(
        self, states: Array, actions: Array, obstacles: ObstacleArrays, observations: Observations | None = None
    ) -> RequestArrays:
        """Return the request about measured states (B, n) and proposals (B, m); all other space is free."""
        N = self.robot.horizon
        names = np.array(["", self.safety.version, UNVERIFIED], dtype=object)
        past = PastArrays(self._states, self._inputs, self._periods < 2 * N, self._periods >= N)
        return RequestArrays(
            states,
            actions,
            self.input_in_force,
            self.plan,
            obstacles=obstacles,
            known_free=np.ones(self._size, dtype=bool),
            turn_aside=self._turn_aside,
            widening=self.widening,
            state_widening=self.state_widening,
            model=names[self._status].tolist(),
            predicted=self.predicted if self.predicted.given.any() else None,
            past=past if self._judged and past.given.any() else None,
            observation=observations,
            acceleration_age=self.acceleration_age,
        )

    def decide(
        self, states: Array, actions: Array, obstacles: ObstacleArrays, observations: Observations | None = None
    ) -> BatchOutcome:
        """Decide on proposals (B, m), and commit to the plans of the decisions.

        The decision on a proposal that is not finite is a failsafe. Arrays in single precision are converted.

        observations (B, o): by which a rival decides; the filter does not need them.

        Raises:
            BadRequest: there is not one state of the robot's size for each robot.
        """
        states, actions, obstacles = np.asarray(states, float), np.asarray(actions, float), mapped(obstacles, _precise)
        if states.shape != (sized := self.predicted.center.shape):
            raise BadRequest("state", f"states has shape {states.shape}: give {sized}, a state for each robot")
        usable = _plausible(states)
        self._status[usable & ~self.predicted.given & (self._status == VERIFIED) & ~self._in_tubes(states)] = OPEN
        if observations is not None:
            usable &= np.isfinite(observations).all(axis=1)
            observations = np.where(usable[:, None], observations, np.float32(0.0))
        # One row that is not valid would cost all others their decisions: it gets valid values, and no decision.
        obstacles, possible = self._possible_obstacles(obstacles)
        usable &= possible
        measured = np.where(usable[:, None], states, 0.0)
        try:
            answers = self.safety.decide_batch(self.request(measured, actions, obstacles, observations))
        except (BadRequest, ArithmeticError, np.linalg.LinAlgError) as error:
            log.exception("no decisions, so all robots brake along their committed plans")
            failure = f"{type(error).__name__}: {error}"
            nothing = np.zeros(self._size, dtype=bool)
            return BatchOutcome(self._follow(states, nothing, None), nothing, None, failure)
        decided = usable & self._is_possible(answers)
        if decided.all():
            return BatchOutcome(self._follow(states, decided, answers), decided, answers)
        inputs = self._follow(states, decided, answers)
        # The other rows hold the answers to values that nobody asked about, or plans that are not possible.
        singly = {row: one for row, one in answers.singly.items() if decided[row]}
        kind, verified = np.where(decided, answers.kind, KINDS.index(FAILSAFE)), answers.verified & decided
        answers = replace(answers, kind=kind, verified=verified, singly=singly)
        return BatchOutcome(inputs, decided, answers, NO_DECISION)

    def _possible_obstacles(self, obstacles: ObstacleArrays) -> tuple[ObstacleArrays, Flags]:
        """Return the obstacles without those of robots that have an impossible one, and which robots (B,) have none.

        Arrays of other shapes are returned as they are: the filter refuses them.
        """
        shapes = obstacles.row_shapes(self.robot.position_dim)
        if any(getattr(obstacles, name).shape != (self._size, *shape) for name, shape in shapes.items()):
            return obstacles, np.ones(self._size, dtype=bool)
        with np.errstate(all="ignore"):
            possible = np.asarray(plausible(np, obstacles))
        return replace(obstacles, count=np.where(possible, obstacles.count, 0)), possible

    def contains(self, states: Array) -> Flags:
        """Return whether measured states (B, n) lie in the predicted sets: `Prediction.contains` for each row."""
        sets = self.predicted
        with np.errstate(all="ignore"):  # states may be infinite
            errors = sets.errors(np, states, self.robot.heading)
        return np.asarray(sets.given & (errors <= sets.half_width + SAME_SET).all(axis=1))

    def _in_tubes(self, states: Array) -> Flags:
        """Return whether the positions lie in the committed plans' tubes (B,): see `BackupPlan.still_verified`."""
        (center, half_width), d = self._tube[:, :, 0], self.robot.position_dim
        if not d:
            return np.zeros(len(states), dtype=bool)
        with np.errstate(all="ignore"):
            return np.asarray((np.abs(states[:, :d] - center) <= half_width + SAME_SET).all(axis=1))

    def _shares_used(self, states: Array) -> Array:
        """Return the shares (B,) of the predicted sets that measured states (B, n) use: see `Prediction.share_used`."""
        with np.errstate(all="ignore"):
            errors = np.maximum(self.predicted.errors(np, states, self.robot.heading) - SAME_SET, 0.0)
            shares = np.where(errors == 0.0, 0.0, errors / self.predicted.half_width)
        return np.asarray(shares.max(axis=1))  # `_judge` takes NaN as infinite

    def _is_possible(self, answers: DecisionArrays) -> Flags:
        """Return which plans the robot can follow: within the bounds and the slew, and to a stop."""
        robot, plan = self.robot, answers.plan
        slew = np.asarray(robot.action_slew)
        within = (plan >= robot.low() - SAME_INPUT) & (plan <= robot.high() + SAME_INPUT)  # NaN fails too
        follows = np.abs(plan[:, 0] - self.input_in_force) <= slew + SAME_INPUT
        return np.asarray(within.all(axis=(1, 2)) & follows.all(axis=1) & robot.is_stop_input(plan[:, -1]))

    def _follow(self, states: Array, decided: Flags, answers: DecisionArrays | None) -> Array:
        """Commit to the decided plans, keep the others, and return the inputs of the coming period (B, m)."""
        outside = self.predicted.given & _plausible(states) & ~self.contains(states)
        self._status[~decided & outside] = OPEN
        self.predicted.given[~decided] = False
        if answers is not None:
            self._accept(states, decided, answers)
        return self._advance(states)

    def _accept(self, states: Array, rows: Flags, answers: DecisionArrays) -> None:
        self._judged, asked = answers.judges, self.state_widening
        self._outside_share = answers.outside_share
        self._judge(rows & answers.scored, answers.plan_score, answers.score)
        if not answers.judges:  # as `BackupPlan.accept`: the client scores the last period
            scores = self._shares_used(states) * self._widened
            scores = np.where(scores <= 1.0, 0.0, scores)
            self._judge(rows & self.predicted.given, scores, scores)
        self._widened = np.where(rows, asked, self._widened)
        self.plan[rows] = answers.plan[rows]
        self._tube[:, rows, 1:] = answers.tube_center[rows], answers.tube_half_width[rows]
        self._status[rows] = np.where(answers.verified[rows], VERIFIED, OPEN)
        sets = self.predicted
        sets.center[rows], sets.half_width[rows] = answers.predicted_center[rows], answers.predicted_half_width[rows]
        sets.heading[rows] = answers.predicted_heading[rows]
        sets.given[rows] = np.isfinite(answers.predicted_center[rows]).all(axis=1)

    def _judge(self, rows: Flags, of_plans: Array, scores: Array) -> None:
        """Add the scores of windows that have ended. A score that is no number counts as infinite."""
        where = np.flatnonzero(rows)
        both = np.stack([of_plans, scores], axis=1)[where]
        self._scores[where, :, self._place[where]] = np.where(np.isnan(both), np.inf, both)
        self._place[where] = (self._place[where] + 1) % WINDOWS

    def _advance(self, states: Array) -> Array:
        robot, now = self.robot, self.plan[:, 0].copy()
        self._states = np.concatenate([self._states[:, 1:], states[:, None]], axis=1)
        self._inputs = np.concatenate([self._inputs[:, 1:], now[:, None]], axis=1)
        self._tube = np.concatenate([self._tube[:, :, 1:], self._tube[:, :, -1:]], axis=2)
        self._periods = np.where(_plausible(states), self._periods + 1, 0)  # a gap ends the window
        rests = robot.is_stop_input(now)
        last = np.where(robot.zero_at_rest, 0.0, self.plan[:, -1])
        self.plan = np.concatenate([self.plan[:, 1:], last[:, None]], axis=1)
        self.input_in_force = now
        self._still = np.where(rests, self._still + 1, 0)
        stopped = self._still >= robot.horizon
        self._status[stopped & robot.is_stop_input(self.plan).all(axis=1)] = STANDING
        return now.copy()


def _plausible(states: Array) -> Flags:
    """Return which measured states (B, n) a request may hold."""
    return np.asarray((np.abs(states) <= FARTHEST).all(axis=1))  # NaN fails too


def _precise(array: Array) -> Array:
    """Return an array of numbers in double precision, as requests have them. Integers and flags stay."""
    return array.astype(float, copy=False) if array.dtype.kind == "f" else array


def correction_penalties(robot: Robot, proposed: Array, before: Array, executed: Array, weight: float) -> Array:
    """Return the penalties (B,) of B corrections: `correction_penalty` for each row."""
    low, high, slew = robot.low(), robot.high(), np.asarray(robot.action_slew)
    wanted = np.nan_to_num(proposed, posinf=0.0, neginf=0.0)
    clipped = np.clip(wanted, np.maximum(low, before - slew), np.minimum(high, before + slew))
    return np.asarray(weight * np.sqrt((((executed - clipped) / (high - low)) ** 2).sum(axis=1)))
