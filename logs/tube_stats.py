"""Count how many verified plans left their tubes while robots followed them.

`containment` compares a measured state with the prediction one period before. That says little about a stop of many
periods, and the stop is what prevents a collision. So the unit here is a plan (docs/method.md §12).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from brakeline.logs.decision_explanation import bound_in, plan_score
from brakeline.logs.decision_view import tube_boxes
from brakeline.logs.episode_stats import Figures
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Array
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.stated_share import UNSTATED, percent

SAME = 1e-6  # input units: rounding between a plan and its tail in the next request
SMALLEST, MOST = 1e-9, 1e9  # m; a ratio that is not finite counts as MOST
_OWN = (int(pb.ALLOWED), int(pb.ADJUSTED))


@dataclass
class TubeStats:
    """Plans that one actor followed beyond their first period, because no newer plan was verified.

    Attributes:
        flown: number of these plans.
        outside: how many of them left their tube: a measured position was outside at the end of a period.
        excess: largest ratio of the distance from the tube's center to its half-width.
        bound: largest fraction of plans outside that the model sets state; None if a decision has no bound.
        scored: number of windows of a plan's length that the filter scored, whatever the plans were.
        beyond: how many of them left the stated sets, of plans or of the state after one period.
        beyond_plan: how many left the stated sets of plans. beyond_widened: the same, as widened at their end.
        widening: largest widening of a request.
        slowed: number of requests whose proposals were limited (`brakeline.actors.slow_down`).
        slow_downs: how often that began.
    """

    robots: RecordedRobots = field(default_factory=RecordedRobots)
    flown: int = 0
    outside: int = 0
    excess: float = 0.0
    bound: float | None = 0.0
    scored: int = 0
    beyond: int = 0
    beyond_plan: int = 0
    beyond_widened: int = 0
    widening: float = 1.0
    slowed: int = 0
    slow_downs: int = 0
    _slow: bool = False  # whether the last request's proposal was limited
    _own: pb.Exchange | None = None  # latest exchange whose own proposal was verified
    _tube: tuple[Array, Array] | None = None  # centers and half-widths (N, d), once the actor follows the plan
    _periods: int = 0  # since `_own`
    _worst: float = 0.0
    _executes: bool = False  # whether the latest decision lets the robot execute the plan's input of its period

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add the actor's next exchange."""
        decision = exchange.reply.decision
        self.widening = max(self.widening, exchange.request.widening)
        slow = exchange.request.slow > 0.0
        self.slowed += slow
        self.slow_downs += slow and not self._slow
        self._slow = slow
        if decision.HasField("score"):
            self.scored += 1
            self.beyond += not decision.score <= 1.0
            self.beyond_plan += not plan_score(decision) <= 1.0
            self.beyond_widened += not plan_score(decision) <= max(exchange.request.widening, 1.0)
        if self._own is not None and not self._goes_on(exchange):
            self._end()
        if self._own is not None:
            self._periods += 1
            newer = decision.verified and decision.kind in _OWN
            if self._tube is None and not newer and decision.kind != pb.RECOVERING:
                self._tube = _tube_of(self._own)
            if self._tube is not None:
                self._compare(exchange.request.robot, exchange.request.state, slice(self._periods - 1, self._periods))
            self._executes = self._is_input_of_plan(exchange)
        if decision.kind in _OWN and decision.verified:
            self._end()
            self._own = exchange
        elif decision.kind == pb.RECOVERING:
            self._end()

    def last_step(self, step: pb.Step) -> None:
        """Add the last step of an episode. No request follows, so only this step has the state at its period's end."""
        own = self._own
        if own is None or (step.header.run, step.episode) != (own.header.run, own.request.episode):
            return
        if step.step != own.request.step + self._periods:
            return
        if self._tube is not None and (step.fallback or self._executes):
            # A robot in real time may miss periods: its state may belong to a later box.
            last = None if step.robot.endswith(REAL_TIME_SUFFIX) else self._periods + 1
            self._compare(step.robot, step.state, slice(self._periods, last))
        self._end()

    def ended(self) -> TubeStats:
        """Return a copy that counts the plan in progress, as at the end of a log."""
        part = copy.copy(self)
        part._end()
        return part

    def _goes_on(self, exchange: pb.Exchange) -> bool:
        """Return whether this is the next period of the same episode and the request has the tail of the plan."""
        assert self._own is not None
        before, now = self._own.request, exchange.request
        same = self._own.header.run == exchange.header.run and before.episode == now.episode
        if not same or now.step != before.step + self._periods + 1:
            return False
        return self._has_input(now.plan, len(now.action), self._periods + 1)

    def _is_input_of_plan(self, exchange: pb.Exchange) -> bool:
        """Return whether the decision's first input is the plan's of this period; in real time it is fixed before."""
        if exchange.request.robot.endswith(REAL_TIME_SUFFIX):
            return True
        decision = exchange.reply.decision
        inputs = len(exchange.request.action)
        return decision.kind == pb.FAILSAFE and self._has_input(decision.plan, inputs, self._periods)

    def _has_input(self, plan: Sequence[float], inputs: int, period: int) -> bool:
        """Return whether a plan begins with the input that the followed plan has in a period; its last input stays."""
        assert self._own is not None
        following = self._own.reply.decision.plan
        start = min(inputs * period, len(following) - inputs)
        tail, committed = following[max(start, 0) : start + inputs], plan[:inputs]
        # An infinity is the same as itself, and NaN as nothing.
        same_inputs = all(one == other or abs(one - other) <= SAME for one, other in zip(committed, tail, strict=False))
        return 0 < inputs == len(tail) == len(committed) and same_inputs

    def _compare(self, name: str, state: Sequence[float], boxes: slice) -> None:
        """Compare the measured position of a robot with one of the tube's boxes, that in which it is nearest."""
        assert self._tube is not None
        centers, half = (bounds[boxes] for bounds in self._tube)
        d = centers.shape[1]
        robot = self.robots.named(name)
        error = np.zeros(d) if robot is None else np.asarray(robot.measurement_bound[:d])
        if not len(centers) or len(state) < d:
            return
        with np.errstate(invalid="ignore", over="ignore"):
            share = np.abs(np.array(state[:d]) - centers) / (half + error + SMALLEST)
        worst = np.nan_to_num(share, nan=MOST, posinf=MOST).max(axis=1, initial=0.0)
        self._worst = max(self._worst, float(worst.min()))

    def _end(self) -> None:
        """Count the plan: the actor no longer follows it."""
        if self._tube is not None:
            self.flown += 1
            self.outside += self._worst > 1.0
            self.excess = max(self.excess, self._worst)
            stated = None if self._own is None else bound_in(self._own.reply.decision)
            self.bound = None if self.bound is None or stated is None else max(self.bound, stated)
        self._own, self._tube, self._periods, self._worst = None, None, 0, 0.0


def _tube_of(exchange: pb.Exchange) -> tuple[Array, Array] | None:
    """Return the tube of an exchange; None if it is missing or malformed."""
    try:
        centers, half_widths = tube_boxes(exchange)
    except ValueError:
        return None
    return (centers, half_widths) if len(centers) else None


def figures(parts: Iterable[TubeStats]) -> Figures:
    """Return the figures of all actors. A plan in progress counts as if it ended here."""
    every = [part.ended() for part in parts]
    stated = [part.bound for part in every if part.flown]
    known = [bound for bound in stated if bound is not None]
    counts = ("flown", "outside", "scored", "beyond", "beyond_plan", "beyond_widened", "slowed", "slow_downs")
    return {name: sum(getattr(part, name) for part in every) for name in counts} | {
        "excess": max((part.excess for part in every), default=0.0),
        "bound": max(known) if known and len(known) == len(stated) else None,
        "widening": max((part.widening for part in every), default=1.0),
    }


def stated(plans: Figures) -> str:
    """Describe the bound on the fraction of plans that leave their tube."""
    bound = plans.get("bound")
    if bound is None:
        return "no bound was recorded"
    if bound == UNSTATED:
        return "no bound was stated"
    return f"stated: at most {percent(bound)}, at 99 % confidence"
