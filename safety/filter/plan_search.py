"""Search for a verified plan near a proposal (paper, algorithm 2; docs/method.md §4, §13).

The search stops at the first verified plan of: the proposal with the clearance margin, the QP's answer, the proposal.
If a robot chooses several inputs of a plan, the QP's answer may begin with the proposal and go on otherwise than by
braking. The proposal is then allowed. If the QPs of a rollout find nothing, the search tries inputs of a fixed pattern.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from time import perf_counter_ns
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Array
from brakeline.safety.filter.blocking_constraint import BlockingConstraint, Planes, why_not_allowed
from brakeline.safety.filter.constraints import TubeConstraints
from brakeline.safety.filter.kernels import qp_kernels, tube_kernels
from brakeline.safety.filter.local_map import LocalMap
from brakeline.safety.filter.qp import ConstraintRows
from brakeline.safety.filter.qp_solver import INFEASIBLE, solve
from brakeline.safety.filter.reachable_tube import RolloutTube
from brakeline.safety.filter.request import ADJUSTED, ALLOWED

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter

NO_ROWS = np.zeros(0)
LINEARIZATIONS = 4  # of a rollout, for one decision and starting point
AS_PROPOSED = 2e-3  # of an input's range: a QP's answer that is so close to the proposal becomes the proposal


@dataclass
class DecisionRecord:
    """The values that the filter collects during one decision, for its report.

    find_blocking: finds the constraint that the proposal violates; only the report needs it.
    """

    started: int
    solver: str = ""
    iterations: int = 0
    solve_ns: int = 0
    reason: str = ""
    contained: bool = True
    broken: int = 0
    find_blocking: Callable[[], BlockingConstraint] | None = None

    @property
    def blocked_by(self) -> BlockingConstraint | None:
        return None if self.find_blocking is None else self.find_blocking()


@dataclass
class PlanCandidate:
    """A plan that the filter may answer with."""

    kind: str
    # plan (N, m), z (nz,): the inputs, and the regressors of their tube
    plan: Array
    z: Array
    margin: float  # [m]: distance of the tube to the nearest half-space (docs/method.md §3)
    verified: bool
    constraints: TubeConstraints  # the constraints whose tube belongs to the plan
    continues: bool = False  # the plan is the committed backup plan, and its earlier verification holds
    for_clearance: bool = False  # the proposal's tube is verified too, but comes nearer than the clearance margin


class Linearized:
    """A tube and the half-spaces around one plan, as rows that are affine in the regressors.

    Attributes:
        constraints: the tube. planes: the half-spaces.
        slack (rows,): bound minus support of each row for the plan.
        kept_off (rows,) [m]: the clearance margin of each row.
        tightened: the rows with the clearance margin, once they are known.
    """

    def __init__(
        self, constraints: TubeConstraints, local_map: LocalMap, z: Array, planes: list[Planes], slack: Array
    ) -> None:
        self.constraints, self.planes, self.slack, self._local_map, self._z = constraints, planes, slack, local_map, z
        self.kept_off = constraints.kept_off(planes, len(slack))
        self.tightened: ConstraintRows | None = None

    @cached_property
    def rows(self) -> ConstraintRows:
        return self.constraints.rows(self._local_map, self._z, self.planes)


class PlanSearch:
    """The search for one decision.

    Attributes:
        safety: the filter. record: the values for its report.
        local_map: the surroundings. z_0 (known,): regressors that are known. proposal (m,): the proposed input.
        before (m,): the input in force.
    """

    def __init__(
        self, safety: Filter, local_map: LocalMap, z_0: Array, proposal: Array, record: DecisionRecord
    ) -> None:
        self.safety, self.local_map, self.z_0, self.proposal, self.record = safety, local_map, z_0, proposal, record
        self.before = z_0[-len(proposal) :]

    def candidate(self, committed: Array) -> PlanCandidate | None:
        """Return the first verified plan. committed: free inputs of the committed plan."""
        safety, local_map, record = self.safety, self.local_map, self.record
        z = safety.inputs.regressors(self.z_0, self.proposal)
        everywhere = local_map.empty and safety.constraints.limits is None
        constraints = safety.constraints_for(z, local_map.widening)
        if everywhere and not constraints.far and local_map.widening == 1.0:
            return PlanCandidate(ALLOWED, safety.inputs.plan(z), z, safety.reach, True, constraints)
        enough = max(safety.clearance_margin, 0.0)
        if everywhere and (margin := constraints.least(NO_ROWS, z)) >= enough:
            return PlanCandidate(ALLOWED, safety.inputs.plan(z), z, margin, True, constraints)
        planes, in_place = constraints.planes(local_map, z), safety.turns_in_place(z)
        slack = constraints.slack(local_map, z, planes)
        margin = constraints.least(slack, z)
        allowed = PlanCandidate(ALLOWED, safety.inputs.plan(z), z, margin, True, constraints)
        # The clearance margin keeps room to turn. A plan in place does not move the robot, so it needs no margin.
        if margin >= (0.0 if in_place else enough):
            return allowed
        general = safety.constraints.at(z, local_map.widening) if in_place else constraints
        proposed = Linearized(general, local_map, z, planes, slack)
        if constraints.least(slack - proposed.kept_off, z, safety.clearance_margin) >= 0.0:
            return allowed
        if margin >= 0.0 and general.margin(self.with_clearance_margin(proposed), z) >= 0.0:
            return allowed
        of_space = safety.robot.position_dim > 0
        too_long = constraints.far and not constraints.extent(z) < constraints.reach  # of a rollout that diverges: NaN
        record.reason = why_not_allowed(margin, of_space, constraints.reach if too_long else np.inf)
        record.find_blocking = partial(constraints.worst_of, local_map, z, slack, planes, margin >= 0.0)
        # First with the clearance margin, or at least no nearer; then free space alone, where not even standing would
        # meet the first rows.
        adjusted = None
        for with_clearance in (True, False):
            if not with_clearance and margin >= 0.0:
                return allowed
            candidates = (self._solve(start, with_clearance) for start in self._starting_points(proposed, committed))
            adjusted = next((candidate for candidate in candidates if candidate is not None), None)
            if adjusted is not None:
                break
        for_clearance = margin >= 0.0 and adjusted is not None
        adjusted = self._turned_only(adjusted) or adjusted or self._of_pattern()
        if adjusted is not None:
            adjusted.for_clearance = for_clearance
        else:
            record.reason += "; no verified input was found"
        return adjusted

    def _starting_points(self, proposed: Linearized, committed: Array) -> Iterator[Linearized]:
        """Yield the proposal; for a rollout also the committed plan and the strongest braking, linearised.

        A linear tube has the same rows everywhere.
        """
        yield proposed
        if not isinstance(self.safety.tube, RolloutTube):
            return
        inputs = self.safety.inputs
        yield self._around(np.concatenate([self.z_0, inputs.within(committed, self.before)]))
        yield self._around(inputs.regressors(self.z_0, inputs.nothing))

    @property
    def standing(self) -> Linearized:
        """The plan of turning in place, or of standing if turns have their own tube, linearised."""
        return self._around(self._staying[0])

    def _around(self, z: Array) -> Linearized:
        """Linearise around the plan with regressors z."""
        constraints = self.safety.constraints.at(z, self.local_map.widening)
        planes = constraints.planes(self.local_map, z)
        return Linearized(constraints, self.local_map, z, planes, constraints.slack(self.local_map, z, planes))

    def _solve(self, start: Linearized, with_clearance: bool) -> PlanCandidate | None:
        """Return the verified plan closest to the proposal, or None (docs/method.md §4, §13).

        The QP is linear in the inputs; a rollout is not. If its answer is not verified, the filter linearises the
        rollout there and solves the QP again.
        """
        at, safety = start, self.safety
        for _ in range(LINEARIZATIONS):
            choice = self.with_clearance_margin(at) if with_clearance else at.rows
            if not np.isfinite(choice.bound).all():
                return None
            z = self._closest(choice)
            if z is None:
                return None
            z, kind = self._as_proposed(z)
            exact = at.constraints
            if not isinstance(safety.tube, RolloutTube):  # the rows hold everywhere
                if exact.margin(choice, z) < 0.0:
                    return None
                margin = exact.margin(at.rows, z)
                return PlanCandidate(kind, safety.inputs.plan(z), z, margin, True, exact)
            at = self._around(z)
            exact, needed = at.constraints, 0.0
            margin = exact.least(at.slack, z)
            if margin >= 0.0 and with_clearance:
                needed = exact.least(at.slack - np.where(self._too_near_to_turn(at), 0.0, at.kept_off), z)
            if margin >= 0.0 and needed >= 0.0:
                return PlanCandidate(kind, safety.inputs.plan(z), z, margin, True, exact)
        return None

    def _as_proposed(self, z: Array) -> tuple[Array, str]:
        """Return the regressors z of a QP's answer with the proposal as first input, if they are close; and the kind.

        The QP's other terms (`REGULARIZATION`) move its answer away from a proposal that meets the rows. A robot that
        chooses one input only would get the proposal followed by braking, which the filter has refused already.
        """
        m, known = len(self.proposal), len(self.z_0)
        if len(z) == known + m or self._off(z) > AS_PROPOSED:
            return z, ADJUSTED
        free = np.concatenate([self.proposal, z[known + m :]])
        return np.concatenate([self.z_0, self.safety.inputs.within(free, self.before)]), ALLOWED

    def _turned_only(self, adjusted: PlanCandidate | None) -> PlanCandidate | None:
        """Return the proposal without the inputs that move the position, if it is the better candidate.

        It is better if its plan is verified and closer to the proposal than the QP's answer.
        """
        safety, local_map = self.safety, self.local_map
        if safety.in_place is None:
            return None
        (box, constraints), m = safety.in_place, len(self.proposal)
        turn = np.where(safety.standing, self.proposal.clip(*box[:, -m:]), safety.inputs.nothing)
        z = safety.inputs.regressors(self.z_0, safety.inputs.limited(turn, self.before))
        if not tube_kernels.within(z, box) or (adjusted is not None and self._off(adjusted.z) <= self._off(z)):
            return None
        constraints = constraints.at(z, local_map.widening)
        margin = constraints.margin_in(local_map, z)
        return PlanCandidate(ADJUSTED, safety.inputs.plan(z), z, margin, True, constraints) if margin >= 0.0 else None

    def _of_pattern(self) -> PlanCandidate | None:
        """Return a verified plan from one of the inputs of `PlanInputs.pattern`, where a rollout's QPs found none.

        A QP is as good as its linearisation. In a flight of an ArduCopter among dense obstacles, 9 of 60 decisions to
        brake had a verified alternative on a grid of 125 inputs. The pattern finds 7 of them.
        """
        inputs, m = self.safety.inputs, len(self.proposal)
        if not isinstance(self.safety.tube, RolloutTube):
            return None
        middle, change = (part[:m] for part in self.safety.builder.reachable(self.before))
        tried = (inputs.regressors(self.z_0, middle + change * share) for share in inputs.pattern)
        for z in sorted(tried, key=self._off):
            at = self._around(z)
            margin = at.constraints.least(at.slack, z)
            if margin >= 0.0:
                found = PlanCandidate(ADJUSTED, inputs.plan(z), z, margin, True, at.constraints)
                closer = self._solve(at, with_clearance=False)
                return found if closer is None or self._off(closer.z) > self._off(z) else closer
        return None

    def _off(self, z: Array) -> float:
        """Return the distance of the first free input in z from the proposal, in units of the inputs' ranges."""
        inputs, m = self.safety.inputs, len(self.proposal)
        first = z[len(self.z_0) : len(self.z_0) + m]
        return float(np.linalg.norm((first - self.proposal) / inputs.width))

    def _closest(self, rows: ConstraintRows) -> Array | None:
        """Solve the QP; return its answer, clipped to bounds and slew, as regressors, or None without an answer."""
        before, builder, record = perf_counter_ns(), self.safety.builder, self.record
        program = builder.program(rows, self.z_0, self.proposal)
        solution = solve(program) if program is not None else INFEASIBLE
        record.solve_ns += perf_counter_ns() - before
        record.solver, record.iterations = solution.status, record.iterations + solution.iterations
        if not solution.found:
            return None
        free = self.safety.inputs.within(builder.inputs(solution.x), self.before)
        return np.concatenate([self.z_0, free])

    @cached_property
    def _staying(self) -> tuple[Array, TubeConstraints]:
        """The regressors of turning in place, or of standing where turns have their own tube; and the constraints."""
        safety = self.safety
        in_place = np.where(safety.standing, self.proposal, safety.inputs.nothing)
        stay = safety.inputs.regressors(self.z_0, safety.inputs.limited(in_place, self.before))
        if safety.turns_in_place(stay):  # turns have their own tube: room to stand is enough
            stay = safety.inputs.regressors(self.z_0, safety.inputs.limited(safety.inputs.nothing, self.before))
        return stay, safety.constraints.at(stay, self.local_map.widening)

    def _too_near_to_turn(self, at: Linearized) -> NDArray[np.bool_]:
        """Return the rows (rows,) for which turning in place would not keep the clearance margin."""
        stay, staying = self._staying
        return np.asarray(staying.slack(self.local_map, stay, at.planes) < at.kept_off)

    def with_clearance_margin(self, at: Linearized) -> ConstraintRows:
        """Return the rows, tightened by the clearance margin.

        Where turning in place would not keep the margin, two rows take the place of one: the row for free space alone,
        and a row that forbids inputs that move the robot nearer than the strongest braking does.
        """
        if at.tightened is None:
            rows, too_near = at.rows, self._too_near_to_turn(at)
            stay, room = self._staying[0], 2.0 * self.safety.builder.tightening
            parts = rows.gradient, rows.spread, rows.bound, at.kept_off, too_near, self.safety.translating, stay, room
            at.tightened = ConstraintRows(*qp_kernels.tightened(*parts))
        return at.tightened
