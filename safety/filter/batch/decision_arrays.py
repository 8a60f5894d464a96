"""The answers to a batch of requests as arrays, with the batch first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.batch.obstacle_arrays import Array, ObstacleArrays, on_host
from brakeline.safety.filter.blocking_constraint import SIGHT, BlockingConstraint, why_not_allowed
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, RECOVERING, Decision
from brakeline.safety.filter.turning_aside import turns_aside_to

KINDS = (ALLOWED, ADJUSTED, FAILSAFE, RECOVERING)  # `DecisionArrays.kind` holds their indices


@dataclass(frozen=True)
class BlockingArrays:
    """The constraints that proposals violated: `BlockingConstraint` for each adjusted row."""

    obstacle: Array  # (B,): index among the row's obstacles; -1: the tube leaves the visible space
    # room, after (B,): see `BlockingConstraint`
    room: Array
    after: Array
    # normal, at (B, d): likewise; NaN if there is no half-space
    normal: Array
    at: Array


@dataclass(frozen=True)
class DecisionArrays:
    """The answers to a `RequestArrays`, in the namespace and on the device of its arrays.

    >>> from brakeline import Filter, Request, RequestArrays, Shapes
    >>> stand = np.zeros((3, 2))
    >>> request = Request(np.zeros(5), [0.2, 0.0], stand[0], stand, Shapes.of([], dim=2), known_free=True)
    >>> answers = Filter.load("ground").decide_batch(RequestArrays.of([request] * 3))
    >>> [KINDS[kind] for kind in answers.kind], answers.plan[:, 0].tolist()
    (['allowed', 'allowed', 'allowed'], [[0.2, 0.0], [0.2, 0.0], [0.2, 0.0]])
    >>> answers
    DecisionArrays(3 allowed)

    Attributes:
        kind (B,): index in `KINDS`: 0 allowed, 1 adjusted, 2 failsafe, 3 recovering.
        plan (B, N, m): see `Decision`.
        tube_center (B, N, d): see `Decision`.
        tube_half_width (B, N, d): see `Decision`.
        margin (B,): see `Decision`.
        verified (B,): see `Decision`.
        at_least (B,): see `Decision`.
        contained (B,): see `Decision`.
        compared (B,): see `Decision`.
        predicted_center (B, n): center of the set of the next measured state.
        predicted_half_width (B, n): its half-widths.
        predicted_heading (B,): heading of its frame [rad].
        for_clearance (B,): see `Decision`; false where that is None.
        score (B,): see `Decision`.
        plan_score (B,): see `Decision`.
        scored (B,): whether the row has scores.
        steps (B,): number of steps of the solver.
        turned (B,): 1 or -1 where the plan turns a blocked robot aside, to the left or right; else 0.
        proposal_margin (B,): margin of the proposal [m]; NaN where the single path decided.
        too_long_for (B,): how far the filter looks ahead [m], where the proposal's tube leads farther; else infinity.
        blocked: the constraints that the proposals of adjusted rows violated.
        singly: the decisions of the rows that the single path decided, by row.
        obstacles: those of the requests.
        model: see `Decision`.
        bound: see `Decision`.
        judges: see `Decision`.
        outside_share: see `Decision`.
        time_ms: time for the whole batch, divided by its rows.
    """

    kind: Array
    plan: Array
    tube_center: Array
    tube_half_width: Array
    predicted_center: Array
    predicted_half_width: Array
    predicted_heading: Array
    margin: Array
    at_least: Array
    verified: Array
    contained: Array
    compared: Array
    for_clearance: Array
    score: Array
    plan_score: Array
    scored: Array
    steps: Array
    turned: Array
    proposal_margin: Array
    too_long_for: Array
    blocked: BlockingArrays
    singly: Mapping[int, Decision]
    obstacles: ObstacleArrays
    model: str
    bound: float | None
    judges: bool
    outside_share: float
    time_ms: float

    def __len__(self) -> int:
        return int(self.kind.shape[0])

    def __repr__(self) -> str:
        counts = np.bincount(on_host(self.kind), minlength=len(KINDS))
        listed = ", ".join(f"{count} {kind}" for kind, count in zip(KINDS, counts, strict=True) if count)
        return f"DecisionArrays({listed})"

    def row(self, index: int) -> Decision:
        """Return the decision about one robot, as NumPy arrays. A negative index counts from the end."""
        index = range(len(self))[index]
        if index in self.singly:
            return self.singly[index]
        kind = KINDS[int(self.kind[index])]
        adjusted, blocked = kind == ADJUSTED, kind != ALLOWED
        set_ = (on_host(self.predicted_center[index]), on_host(self.predicted_half_width[index]))
        reason = why_not_allowed(float(self.proposal_margin[index]), too_long_for=float(self.too_long_for[index]))
        if not adjusted:
            reason += "; no verified input was found"
        elif turned := int(self.turned[index]):
            reason += turns_aside_to(turned)
        return Decision(
            kind=kind,
            plan=on_host(self.plan[index]),
            tube_center=on_host(self.tube_center[index]),
            tube_half_width=on_host(self.tube_half_width[index]),
            predicted=Prediction(*set_, float(self.predicted_heading[index])),
            margin=float(self.margin[index]),
            at_least=bool(self.at_least[index]),
            model=self.model,
            reason=reason if blocked else "",
            verified=bool(self.verified[index]),
            contained=bool(self.contained[index]),
            compared=bool(self.compared[index]),
            time_ms=self.time_ms,
            verify_ms=self.time_ms,
            solver="solved" if adjusted else "infeasible" if blocked else "",
            iterations=int(self.steps[index]),
            blocked_by=self._blocking(index) if blocked else None,
            for_clearance=bool(self.for_clearance[index]) if adjusted else None,
            bound=self.bound,
            judges=self.judges,
            outside_share=self.outside_share,
            score=float(self.score[index]) if bool(self.scored[index]) else None,
            plan_score=float(self.plan_score[index]) if bool(self.scored[index]) else None,
        )

    def _blocking(self, index: int) -> BlockingConstraint:
        """Return the constraint that the proposal of an adjusted row violated."""
        blocked = self.blocked
        obstacle, room, after = (part[index] for part in (blocked.obstacle, blocked.room, blocked.after))
        by = SIGHT if int(obstacle) < 0 else self.obstacles.of_row(index).kind(int(obstacle))
        normal, at = on_host(blocked.normal[index]), on_host(blocked.at[index])
        if not np.isfinite(normal).all():
            return BlockingConstraint.nowhere(by, float(room), float(after))
        return BlockingConstraint(by, float(room), float(after), normal, at)
