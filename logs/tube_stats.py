"""Verified plans that robots went on along: did they stay in the tubes that had been verified for them?

A measured state is compared with what was predicted a period before (`containment`). That says little about a stop of
many periods, and a stop is what keeps a robot from hitting anything: the unit is a plan (docs/method.md §12).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brakeline.logs.decision_explanation import bound_in
from brakeline.logs.episode_stats import Figures
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.stated_share import UNSTATED, percent

Array = NDArray[np.float64]

SAME = 1e-6  # of inputs, in their units: rounding between a plan and what is asked about as its tail
SMALLEST, MOST = 1e-9, 1e9  # m; and what is no number counts as
_OWN = (int(pb.ALLOWED), int(pb.ADJUSTED))


@dataclass
class TubeStats:
    """Of one actor. flown: verified plans that it went on along for more than their first period, for nothing newer was
    verified; outside: of these, in which it was measured outside of the plan's tube, at any period's end; excess: the
    largest share of a tube's half-width that any position came to; bound: the largest share of them outside that the
    model sets stated which verified them, None: not all say."""

    robots: RecordedRobots = field(default_factory=RecordedRobots)
    flown: int = 0
    outside: int = 0
    excess: float = 0.0
    bound: float | None = 0.0
    _own: pb.Exchange | None = None  # the latest with a verified plan of its own
    _tube: tuple[Array, Array] | None = None  # of that plan, once it is gone on along: centers and half-widths (N, d)
    _periods: int = 0  # since then
    _worst: float = 0.0

    def exchange(self, exchange: pb.Exchange) -> None:
        """Take the actor's next exchange."""
        decision = exchange.reply.decision
        if self._own is not None and not self._goes_on(exchange):
            self._end()
        if self._own is not None:
            self._periods += 1
            newer = decision.verified and decision.kind in _OWN
            if self._tube is None and not newer and decision.kind != pb.RECOVERING:
                self._tube = _tube_of(self._own)
            if self._tube is not None:
                self._compare(exchange.request)
        if decision.kind in _OWN and decision.verified:
            self._end()
            self._own = exchange
        elif decision.kind == pb.RECOVERING:
            self._end()

    def _goes_on(self, exchange: pb.Exchange) -> bool:
        """Is it the next period of the same episode, and of who accepted the plan?"""
        assert self._own is not None
        before, now = self._own.request, exchange.request
        same = self._own.header.run == exchange.header.run and before.episode == now.episode
        if not same or now.step != before.step + self._periods + 1:
            return False
        inputs, following = len(now.action), self._own.reply.decision.plan
        start = min(inputs * (self._periods + 1), len(following) - inputs)
        tail, given = following[max(start, 0) : start + inputs], now.plan[:inputs]
        return 0 < inputs == len(tail) == len(given) and np.allclose(given, tail, rtol=0.0, atol=SAME)

    def _compare(self, request: pb.Request) -> None:
        """The measured position with the tube's set at the end of the last period, while there is one."""
        assert self._tube is not None
        centers, half = self._tube
        k, d = self._periods - 1, centers.shape[1]
        robot = self.robots.named(request.robot)
        error = np.zeros(d) if robot is None else np.asarray(robot.measurement_bound[:d])
        if k >= len(centers) or len(request.state) < d:
            return
        with np.errstate(invalid="ignore", over="ignore"):
            share = np.abs(np.array(request.state[:d]) - centers[k]) / (half[k] + error + SMALLEST)
        self._worst = max(self._worst, float(np.nan_to_num(share, nan=MOST, posinf=MOST).max(initial=0.0)))

    def _end(self) -> None:
        """That plan is followed no longer."""
        if self._tube is not None:
            self.flown += 1
            self.outside += self._worst > 1.0
            self.excess = max(self.excess, self._worst)
            stated = None if self._own is None else bound_in(self._own.reply.decision)
            self.bound = None if self.bound is None or stated is None else max(self.bound, stated)
        self._own, self._tube, self._periods, self._worst = None, None, 0, 0.0


def _tube_of(exchange: pb.Exchange) -> tuple[Array, Array] | None:
    """Of its decision; None: it is not one."""
    decision, inputs = exchange.reply.decision, len(exchange.request.action)
    periods = len(decision.plan) // max(inputs, 1)
    centers, half = np.array(decision.tube_center), np.array(decision.tube_half_width)
    if not periods or len(centers) != len(half) or len(centers) % periods or not len(centers):
        return None
    return centers.reshape(periods, -1), half.reshape(periods, -1)


def figures(parts: Iterable[TubeStats]) -> Figures:
    """Of all actors."""
    parts = [part for part in parts if part.flown]
    stated = [part.bound for part in parts]
    known = [bound for bound in stated if bound is not None]
    return {
        "flown": sum(part.flown for part in parts),
        "outside": sum(part.outside for part in parts),
        "excess": max((part.excess for part in parts), default=0.0),
        "bound": max(known) if known and len(known) == len(stated) else None,
    }


def stated(plans: Figures) -> str:
    """What was stated of such plans, beside the count of those whose tubes were left."""
    bound = plans.get("bound")
    if bound is None:
        return "no bound was recorded"
    if bound == UNSTATED:
        return "no bound was stated"
    return f"stated: at most {percent(bound)}, at 99 % confidence"
