"""Summarize the exchanges between actors and the safety service: latency by part, solver, tube widths."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

from brakeline.logs.episode_stats import KINDS, Figures
from brakeline.logs.quantiles import QuantileSketch, merged, spread, summary
from brakeline.messaging import brakeline_pb2 as pb

# Parts of the latency from an actor's request to the reply.
PARTS = {
    "round_trip": "from the request to the reply, measured by the actor",
    "network": "the rest of the round trip: encoding, bus (in one process: none), other robots of the same request",
    "queue": "from the receipt of the request in the service to the start of the decision",
    "decide": "in the filter, including solve and verify",
    "solve": "quadratic programs, for decisions that solve one",
    "verify": "exact verification of plans",
}
MOST_REASONS, OTHER = 50, "other"
SOLVED = "solved"  # the solver's status after success


def _latency() -> dict[int, dict[str, QuantileSketch]]:
    return {kind: {part: QuantileSketch() for part in PARTS} for kind in KINDS}


@dataclass
class DecisionStats:
    """Statistics of one actor's exchanges."""

    round_trip_ms: QuantileSketch = field(default_factory=QuantileSketch)
    latency: dict[int, dict[str, QuantileSketch]] = field(default_factory=_latency)
    iterations: QuantileSketch = field(default_factory=QuantileSketch)  # of decisions that solved a program
    statuses: Counter[str] = field(default_factory=Counter)  # status of the last program of these decisions
    half_width: QuantileSketch = field(default_factory=QuantileSketch)  # m, the largest of each tube
    margin: QuantileSketch = field(default_factory=QuantileSketch)  # m, from the tube to the edge of free space
    unverified: int = 0  # failsafe decisions without a verified plan
    not_finite: int = 0  # proposals with NaN or infinity
    failures: Counter[str] = field(default_factory=Counter)  # exchanges without a decision, by reason

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add an exchange."""
        if failure := exchange.failure:
            count(self.failures, failure.split(":", 1)[0])
            return
        decision = exchange.reply.decision
        solver = decision.solver
        self._add_latency(exchange.round_trip_ms, decision, bool(solver))
        if solver:
            self.iterations.add(decision.iterations)
            count(self.statuses, solver)
        self.unverified += not decision.verified
        self.not_finite += not all(map(math.isfinite, exchange.request.action))
        if widths := decision.tube_half_width[:]:
            self.half_width.add(max(widths))
            self.margin.add(decision.margin)

    def _add_latency(self, round_trip: float, decision: pb.Decision, solved: bool) -> None:
        """Add the times, ms."""
        self.round_trip_ms.add(round_trip)
        if (parts := self.latency.get(decision.kind)) is None:
            return
        queue, decide = decision.queue_ms, decision.time_ms
        rest = round_trip - queue - decide  # NaN, if the message has infinities
        parts["round_trip"].add(round_trip)
        parts["network"].add(0.0 if rest < 0.0 else rest)
        parts["queue"].add(queue)
        parts["decide"].add(decide)
        parts["verify"].add(decision.verify_ms)
        if solved:
            parts["solve"].add(decision.solve_ms)

    def figures(self) -> Figures:
        """Return the figures of all exchanges; None for what was not measured."""
        programs = self.statuses.total()
        return {
            "round_trip_ms": spread(self.round_trip_ms),
            "no_decision": dict(sorted(self.failures.items())),
            "latency_ms": {
                name: {part: summary(values) for part, values in self.latency[kind].items()}
                for kind, name in KINDS.items()
            },
            "solver": {
                "programs": programs,
                "failures": programs - self.statuses[SOLVED],
                "statuses": dict(sorted(self.statuses.items())),
                "iterations": summary(self.iterations),
            },
            "unverified": self.unverified,
            "not_finite": self.not_finite,
            "tube_half_width": summary(self.half_width),
            "margin": summary(self.margin),
        }


def count(words: Counter[str], word: str) -> None:
    """Count a word from a message: the first `MOST_REASONS` words separately, the others as `OTHER`."""
    words[word if word in words or len(words) < MOST_REASONS else OTHER] += 1


def merge_decisions(parts: Iterable[DecisionStats]) -> DecisionStats:
    """Merge parts. The floating-point sums depend only on the order of the parts."""
    whole, parts = DecisionStats(), list(parts)
    for item in fields(DecisionStats):
        setattr(whole, item.name, _merge([getattr(part, item.name) for part in (whole, *parts)]))
    return whole


def _merge(values: list[Any]) -> Any:
    first = values[0]
    if isinstance(first, QuantileSketch):
        return merged(values)
    if isinstance(first, Counter | int):
        return sum(values, type(first)())
    return {key: _merge([value[key] for value in values]) for key in first}
