"""Compute the factors by which the filter must widen a robot's sets at present (docs/method.md §15).

A payload, a worn tyre or wind makes any model wrong. The client that stores the backup plan also stores the last states
and inputs. The filter scores each window of a plan's length when it ends: the largest ratio of an error to its set.
The largest recent score, and a tenth more, is a factor by which the filter widens sets of the next decision. The sets
of plans follow the scores of positions (those of all discs of the body) and of coordinates with a limit alone, because
only they decide what is verified. The set of the next state follows the scores of all coordinates.
`certify --outside` lets a share of the windows leave their sets. So many of the largest scores do not count.
Some model sets predict plans only, so the filter cannot score windows. Then the client scores each period itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.value_equality import ComparedByValue

WINDOWS = 600  # last windows whose scores count
PLANS = 200  # last windows that do not overlap, of which it is known how many left their sets
ROUNDING = 1e-9  # of a share times `WINDOWS`
MOST = 1e3  # beyond it nothing is verified anyway, and a request needs a finite factor
CHANGED = 1.3  # a robot whose sets are widened by more does not move as recorded
RESERVE = 1.1  # factor on the largest score that counts
MODELS = 4  # model sets whose scores a client keeps: replicas of a service may serve different versions


def widening_factor(scores: Array, outside_share: float) -> Array:
    """Return the factors (...,) on every set that follow from scores.

    Args:
        scores (..., WINDOWS): the last scores; 0 where there were fewer.
        outside_share: the share of windows that may leave their sets. So many of the largest scores do not count,
            unless one is infinite.
    """
    largest = scores.max(axis=-1)
    if left_out := int(outside_share * WINDOWS + ROUNDING):
        place = WINDOWS - 1 - left_out
        counting = np.partition(scores, place, axis=-1)[..., place]
        largest = np.where(np.isfinite(largest), counting, largest)
    return np.asarray(np.clip(RESERVE * largest, 1.0, MOST))


@dataclass(frozen=True, eq=False)
class PastWindow(ComparedByValue):
    """The last periods of a plan's length, up to the state in the request."""

    states: Array  # (N, n): measured states at the periods' starts
    inputs: Array  # (N + 1, m): the input in force before the first period, then the executed inputs
    # it began within a plan's length of an episode's start, or of a gap in the measurements. No request held a window
    # then.
    from_start: bool = False


@dataclass
class _ModelScores:
    """The scores of one model set, which are relative to its sets: of plans, and of all coordinates."""

    scores: Array = field(default_factory=lambda: np.zeros((2, WINDOWS)))  # scores i stand at i modulo WINDOWS
    count: int = 0
    factors: tuple[float, float] = (1.0, 1.0)  # on the sets of plans, and on the set of the next state
    left: deque[bool] = field(default_factory=lambda: deque(maxlen=PLANS))


class Widening:
    """The last measured states and executed inputs of one robot, and the factors that follow from their scores.

    Attributes:
        factors: on every set of a plan, and on the set of the next state. Both are at least 1.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.interrupt()
        self.forget()

    @property
    def factor(self) -> float:
        """The factor on every set of a plan."""
        return self.factors[0]

    @property
    def state_factor(self) -> float:
        """The factor on the set of the next state."""
        return self.factors[1]

    @property
    def left(self) -> deque[bool]:
        """Of the last `PLANS` windows that do not overlap, whether each left its sets as they were widened."""
        return self._of.left

    def forget(self) -> None:
        """Drop the scores of every model set."""
        self._models: dict[str, _ModelScores] = {}
        self._asked = (1.0, 1.0)  # the factors of the last request
        self._begin("")

    def use(self, model: str) -> bool:
        """Count the scores of this model set from now on. Return whether it has decided before: it keeps its scores."""
        if model == self._model:
            return True
        known = model in self._models
        self._begin(model)
        return known

    def _begin(self, model: str) -> None:
        self._model, self._of = model, self._models.pop(model, _ModelScores())
        self._models[model] = self._of  # the last one of the dictionary decided last
        if len(self._models) > MODELS:
            del self._models[next(iter(self._models))]
        self.factors = self._of.factors
        self._uncounted = 0  # periods since the last window in `left` ended
        self._factors.extend((1.0, 1.0) for _ in range(len(self._factors)))

    def interrupt(self) -> None:
        """Begin a new window: an episode has ended, or a period had no measurement. The scores stay."""
        self._states: deque[Array] = deque(maxlen=self.robot.horizon)
        self._inputs: deque[Array] = deque(maxlen=self.robot.horizon + 1)
        # `factors` of the requests at the periods' starts
        self._factors: deque[tuple[float, float]] = deque(maxlen=self.robot.horizon)
        self._uncounted = self._periods = 0

    def executed(self, state: Array, before: Array, action: Array) -> None:
        """Add a period: the measured state (n,) at its start, the input before it and its own input (m,)."""
        if not self._states:
            self._inputs.append(before.copy())
        self._states.append(state.copy())
        self._inputs.append(action.copy())
        self._factors.append(self._asked)
        self._asked = self.factors
        self._uncounted += 1
        self._periods += 1

    @property
    def past(self) -> PastWindow | None:
        """The window that ends at the next measurement; None before a plan's length has passed."""
        if (N := self.robot.horizon) > len(self._states):
            return None
        return PastWindow(np.array(self._states), np.array(self._inputs), self._periods < 2 * N)

    def judge(self, score: float, outside_share: float = 0.0, plan_score: float | None = None) -> None:
        """Add the scores of a window that has ended. A score that is no number counts as infinite.

        Args:
            score: of all coordinates.
            outside_share: the share of windows that may leave the sets.
            plan_score: of positions and limited coordinates. None: `score` stands for it, too.
        """
        of_plan = score if plan_score is None else plan_score
        of_plan, score = (one if one == one else np.inf for one in (of_plan, score))
        self._add((of_plan, score), bool(self._factors) and of_plan > self._factors[0][0], outside_share)

    def judge_period(self, share_used: float) -> None:
        """Add the score of the last period, for a model set that cannot score windows.

        Such a set predicts plans only, and a robot that drives freely follows each plan for one period. If the state is
        outside after this period, the plan has left its tube. A score of at most 1 counts as 0: the sets keep their
        stated widths until the robot leaves one.

        Args:
            share_used: share of the predicted set, as it was widened, that the measured state used.
        """
        if self._factors:
            score = share_used * self._factors[-1][1]
            score = score if score > 1.0 else 0.0
            self._add((score, score), share_used > 1.0, 0.0)

    def _add(self, scores: tuple[float, float], left: bool, outside_share: float) -> None:
        scored = self._of
        if self._factors and self._uncounted >= self.robot.horizon:
            scored.left.append(left)
            self._uncounted = 0
        scored.scores[:, scored.count % WINDOWS] = scores
        scored.count += 1
        of_plan, of_state = widening_factor(scored.scores, outside_share).tolist()
        self.factors = scored.factors = of_plan, of_state
