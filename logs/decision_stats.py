"""How the filter decided, from the exchanges between actors and the safety service: where the time went, what the
solver did, how wide the tubes were."""

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

# Parts of the time from an actor's question to its answer.
PARTS = {
    "round_trip": "from the question to the answer, as the actor saw it",
    "network": "the rest of the round trip: the bus, coding, and the other robots of the same question",
    "queue": "from the service's receipt of the question to the beginning of the decision",
    "decide": "inside the filter; solve and verify are parts of it",
    "solve": "of it, the quadratic programs (where there was one)",
    "verify": "of it, the exact verification of plans",
}
MOST_WORDS, OTHER = 50, "other"
SOLVED = "solved"  # the solver's word for success


Row = tuple[float, ...]  # kind, round trip, queue, decide, verify, solve [ms], iterations, half-width, margin [m]
WIDTH = 9
NOTHING = math.nan  # in a row, where there was no program or no tube


def _latency() -> dict[int, dict[str, QuantileSketch]]:
    return {kind: {part: QuantileSketch() for part in PARTS} for kind in KINDS}


@dataclass
class DecisionStats:
    """The figures of one actor's exchanges."""

    round_trip_ms: QuantileSketch = field(default_factory=QuantileSketch)
    latency: dict[int, dict[str, QuantileSketch]] = field(default_factory=_latency)
    iterations: QuantileSketch = field(default_factory=QuantileSketch)  # of decisions for which a program was solved
    statuses: Counter[str] = field(default_factory=Counter)  # of these, how the last one ended
    half_width: QuantileSketch = field(default_factory=QuantileSketch)  # m: the largest in a tube
    margin: QuantileSketch = field(default_factory=QuantileSketch)  # m: of a tube to the free space's edge
    unverified: int = 0  # failsafes whose plan could not be verified
    not_finite: int = 0  # decisions on proposals with NaN or infinity
    failures: Counter[str] = field(default_factory=Counter)  # exchanges without a decision, by reason
    waiting: array[float] = field(default_factory=lambda: array("d"))  # rows that are not in the histograms yet

    def exchange(self, exchange: pb.Exchange) -> None:
        """Take an exchange."""
        if failure := exchange.failure:
            count(self.failures, failure.split(":", 1)[0])
            return
        decision = exchange.reply.decision
        solve = iterations = width = margin = NOTHING
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
        waiting = self.waiting
        waiting.extend((decision.kind, *times, solve, iterations, width, margin))
        if len(waiting) >= WIDTH * BATCH:
            self._sort()

    def _sort(self) -> None:
        """Bring the rows that wait into the histograms."""
        rows, self.waiting = np.asarray(self.waiting).reshape(-1, WIDTH), array("d")
        kind, round_trip, queue, decide, verify, solve, iterations, width, margin = rows.T
        self.round_trip_ms.take(round_trip)
        with np.errstate(invalid="ignore"):  # between infinities, which anybody may send, there is no difference
            network = np.maximum(0.0, round_trip - queue - decide)
        values = {
            "round_trip": round_trip, "network": network, "queue": queue, "decide": decide, "solve": solve,
            "verify": verify,
        }  # fmt: skip
        for number, histograms in self.latency.items():
            for part, histogram in histograms.items():
                histogram.take(values[part][kind == number])
        for histogram, column in ((self.iterations, iterations), (self.half_width, width), (self.margin, margin)):
            histogram.take(column)

    def figures(self) -> Figures:
        """Figures of all exchanges; None where nothing was measured."""
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
    """Count a word that somebody else chose: the first `MOST_WORDS` each, the rest together."""
    words[word if word in words or len(words) < MOST_WORDS else OTHER] += 1


def joined(parts: Iterable[DecisionStats]) -> DecisionStats:
    """All exchanges of the parts; the sums are the same whenever the parts come in the same order."""
    parts = [_settled(part) for part in parts]
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


def _settled(part: DecisionStats) -> DecisionStats:
    """A copy with no rows waiting: looking at figures does not change when rows are sorted, and so no sum."""
    copy = deepcopy(part)
    copy._sort()
    return copy
