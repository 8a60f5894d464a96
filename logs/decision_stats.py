"""Summarize the exchanges between actors and the safety service: latency by part, solver, tube widths."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np

from brakeline.logs.episode_stats import KINDS, Figures
from brakeline.logs.quantiles import BATCH, QuantileSketch, merged, spread, summary
from brakeline.messaging import brakeline_pb2 as pb

# Parts of the latency from an actor's request to the reply.
PARTS = {
    "round_trip": "from the request to the reply, measured by the actor",
    "network": "the rest of the round trip: bus, encoding, and the other robots of the same request",
    "queue": "from the receipt of the request in the service to the start of the decision",
    "decide": "in the filter, including solve and verify",
    "solve": "quadratic programs, for decisions that solve one",
    "verify": "exact verification of plans",
}
MOST_REASONS, OTHER = 50, "other"
SOLVED = "solved"  # the solver's status after success


Row = tuple[float, ...]  # kind, round trip, queue, decide, verify, solve [ms], iterations, half-width, margin [m]
ROW = 9  # numbers in a row
MISSING = math.nan  # in a row without a program or a tube


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
    pending: array[float] = field(default_factory=lambda: array("d"))  # rows that the sketches do not include yet

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add an exchange."""
        if failure := exchange.failure:
            count(self.failures, failure.split(":", 1)[0])
            return
        decision = exchange.reply.decision
        solve = iterations = width = margin = MISSING
        if solver := decision.solver:
            solve, iterations = decision.solve_ms, decision.iterations
            count(self.statuses, solver)
        if not decision.verified:
            self.unverified += 1
        if not all(map(math.isfinite, exchange.request.action)):
            self.not_finite += 1
        if widths := decision.tube_half_width[:]:
            width, margin = max(widths), decision.margin
        times = exchange.round_trip_ms, decision.queue_ms, decision.time_ms, decision.verify_ms
        pending = self.pending
        pending.extend((decision.kind, *times, solve, iterations, width, margin))
        if len(pending) >= ROW * BATCH:
            self._flush()

    def _flush(self) -> None:
        """Add the pending rows to the sketches."""
        rows, self.pending = np.asarray(self.pending).reshape(-1, ROW), array("d")
        kind, round_trip, queue, decide, verify, solve, iterations, width, margin = rows.T
        self.round_trip_ms.add_array(round_trip)
        with np.errstate(invalid="ignore"):  # a message may have infinities, whose difference is NaN
            network = np.maximum(0.0, round_trip - queue - decide)
        values = {
            "round_trip": round_trip, "network": network, "queue": queue, "decide": decide, "solve": solve,
            "verify": verify,
        }  # fmt: skip
        for number, sketches in self.latency.items():
            for part, sketch in sketches.items():
                sketch.add_array(values[part][kind == number])
        for sketch, column in ((self.iterations, iterations), (self.half_width, width), (self.margin, margin)):
            sketch.add_array(column)

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
    parts = [_flushed(part) for part in parts]
    return DecisionStats(
        round_trip_ms=merged(part.round_trip_ms for part in parts),
        latency={kind: {name: merged(part.latency[kind][name] for part in parts) for name in PARTS} for kind in KINDS},
        iterations=merged(part.iterations for part in parts),
        statuses=sum((part.statuses for part in parts), Counter()),
        half_width=merged(part.half_width for part in parts),
        margin=merged(part.margin for part in parts),
        unverified=sum(part.unverified for part in parts),
        not_finite=sum(part.not_finite for part in parts),
        failures=sum((part.failures for part in parts), Counter()),
    )


def _flushed(part: DecisionStats) -> DecisionStats:
    """Return a copy without pending rows, so that reading the figures never changes the sums."""
    copy = deepcopy(part)
    copy._flush()
    return copy
