"""Decide on a proposed action: return a verified plan (paper, algorithms 1 and 2; docs/method.md §4).

The filter allows a proposal whose tube keeps the clearance margin to every obstacle. Where turning in place does not
keep that margin, the proposal must not drive nearer. The filter replaces every other proposal by the closest input
that meets this rule, even if the proposal's own tube is verified: a robot that stops nearer than the clearance margin
may not be able to turn there. Such decisions are `for_clearance`. If no input meets the rule, the filter allows a
verified proposal. It replaces any other proposal by the closest input whose tube stays in free space.

A decision is a pure function of the request and the model set. The filter stores nothing about a robot, so any replica
can answer, and a log can be replayed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from time import perf_counter_ns
from typing import TYPE_CHECKING

import numpy as np

from brakeline.errors import BadRequest
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import MAX_SCAN_AGE
from brakeline.safety.filter.clearance_margin import ClearanceMargin
from brakeline.safety.filter.constraints import TubeConstraints
from brakeline.safety.filter.kernels import tube_kernels
from brakeline.safety.filter.local_map import LocalMap
from brakeline.safety.filter.plan_inputs import PlanInputs, recorded_inputs
from brakeline.safety.filter.plan_search import DecisionRecord, PlanCandidate, PlanSearch
from brakeline.safety.filter.qp import QPBuilder
from brakeline.safety.filter.recovery_search import RecoverySearch
from brakeline.safety.filter.request import (
    ADJUSTED,
    ALLOWED,
    FAILSAFE,
    NOT_FINITE,
    Decision,
    FastRequestCheck,
    Request,
    check_for_filter,
    check_surroundings,
)
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.filter.standing import DRIVES_ALREADY, may_drive_already, stands
from brakeline.safety.filter.turning_aside import find_plan
from brakeline.safety.filter.window_score import WindowScore
from brakeline.safety.model.model_loading import load_model
from brakeline.safety.model.model_set import ModelSet, extra_coordinates
from brakeline.safety.model.stated_bound import stated_bound
from brakeline.safety.model.turning_in_place import widened
from brakeline.safety.perception.image_coverage import unseen_poles

if TYPE_CHECKING:
    from brakeline.safety.filter.batch.batch_filter import BatchFilter
    from brakeline.safety.filter.batch.decision_arrays import DecisionArrays
    from brakeline.safety.filter.batch.request_arrays import RequestArrays


WORTH_A_BATCH = 20  # requests for each period of a plan; fewer are decided sooner one by one
NOT_RECORDED = "the proposed action is outside the inputs that were recorded"
UNRECORDED = "the state is outside the domain that was recorded"
BROKEN = "an obstacle was seen outside of what its bounds allow: nothing is known of where it will be"


class Filter:
    """The safety filter of one model set.

    Attributes:
        tube: the exact tube, for the final check. The QP uses an outer tube (docs/method.md §2).
        constraints: compares the tube of any plan with a map of the surroundings.
        in_place: bounds of z (2, nz), and the constraints for plans in place within them; None without such plans.
        standing (m,): inputs that leave the robot in place.
        translating (nz,): the regressors that are free inputs and move it.
        domain (2, known): recorded range of [x_0; input in force; inputs that are decided], with room for rounding.
        inputs: the plans that the filter may verify, of recorded inputs. executable: all that the robot may follow.
        clearance_margin: distance to obstacles that the QP keeps, in the direction in which it is largest [m].
        reach: an obstacle farther away than this cannot change a decision [m]. If the request widens the sets, one
            within the robot's `sight` can.
        bound: the share of plans outside their tubes that the model set states.
        outside_share: see `Decision`.
        start: factor on the sets of a request without past window (see `OneStep.start`).
        acceleration_age: age of the horizontal acceleration in the states of the recorded data [s].
    """

    observed = 0  # the filter reads no observation

    def __init__(self, model: ModelSet, clearance_margin: float | None = None) -> None:
        """Prepare a model set. clearance_margin [m]: by default what turning in place needs (see `ClearanceMargin`).

        Raises:
            TypeError: `model` is no model set.
            ValueError: the clearance margin is negative or not finite.
        """
        if not isinstance(model, ModelSet):
            raise TypeError(f"Filter takes a ModelSet, not a {type(model).__name__}: give Filter.load(NAME_OR_PATH)")
        self.model = model
        self.version = model.version
        self.bound = stated_bound(model.about)
        self.robot = robot = model.robot
        self.tube, outer = model.tube(), model.outer_tube()
        recorded = widened(model.domain)
        of_inputs = recorded_inputs(model)
        self.inputs, self.executable = PlanInputs(robot, of_inputs), PlanInputs(robot)
        self.builder = QPBuilder(self.inputs, outer)
        self.domain = np.hstack([recorded, np.tile(of_inputs, robot.committed_steps)])
        turning = model.turning()
        in_place = self.tube if turning is None else turning.tube()
        margin = ClearanceMargin.of(model, in_place, clearance_margin)
        self.constraints = TubeConstraints(model, self.tube, outer, recorded, margin)
        self.in_place: tuple[Array, TubeConstraints] | None = None
        if turning is not None and model.in_place is not None:
            box = np.ascontiguousarray(model.in_place.domain(in_place.position.shape[2], robot.regressor_dim))
            known = box[:, : robot.regressor_dim]
            own = TubeConstraints(turning, in_place, in_place, known, margin, self.constraints.reach)
            self.in_place = box, own
        self.ordinary = FastRequestCheck(robot)
        self.standing = np.array([not moves for moves in robot.translates])
        driven = np.tile(robot.translates, robot.free_steps)
        self.translating = np.concatenate([np.zeros(robot.regressor_dim, dtype=bool), driven])
        self.regressor = np.array(robot.regressor, dtype=np.intp)
        self._score = None if model.one_step is None else WindowScore(model, model.one_step)
        self.outside_share = 0.0 if model.one_step is None else model.model_config.outside
        self.acceleration_age = model.acceleration_age
        self.start = 1.0 if model.one_step is None else model.one_step.start
        self.clearance_margin, self.reach = margin.largest, self.constraints.reach  # m

    @classmethod
    def load(
        cls, source: Path | str, robot: Robot | Path | str | None = None, *, accept_bound: float | None = None
    ) -> Filter:
        """Return a filter with the model set in a file, or with the one that comes with a shipped robot.

        Args:
            source: the path of a model set, or the name of a shipped robot (`"ground"`, `"quadrotor"`).
            robot: your robot's description (`"my.toml"`), to refuse a model set of an earlier one. Always give it.
            accept_bound: the largest accepted share of plans outside their tubes. Defaults to the description's limit.

        Raises:
            BadModel: the file holds no model set, no shipped robot has that name, or the description is another one.
            TooLoose: the model set states a larger share than is accepted.

        >>> Filter.load("ground").robot.name
        'ground'
        """
        return cls(load_model(source, robot, accept_bound))

    def half_width(self, speed: Array) -> float:
        """Return the largest half-width [m] of the last set of the tube for a full stop from inputs `speed` (m,).

        In joint space it is the largest half-width of a limit's value, in units of `Robot.limit_scales`.
        """
        z = np.concatenate([self.model.measured_at(speed), speed, np.tile(speed, self.robot.free_steps)])
        tube = self.constraints_for(z).tube
        if not self.robot.position_dim:
            half = np.zeros(self.robot.state_dim)
            half[list(extra_coordinates(self.robot))] = tube.more_half_widths(z)[-1]
            return float((np.abs(self.robot.limit_weights) @ half / self.robot.limit_scales).max())
        return float(tube.half_widths(z)[-1].max())

    def turns_in_place(self, z: Array) -> bool:
        """Return whether the plan with regressors z belongs to those in place, which have their own tube."""
        return self.in_place is not None and tube_kernels.within(z, self.in_place[0])

    def constraints_for(self, z: Array, widening: float = 1.0) -> TubeConstraints:
        """Return the constraints for the plan with regressors z: of plans in place, or of all plans; exact for z."""
        own = self.in_place[1] if self.in_place is not None and self.turns_in_place(z) else self.constraints
        return own.at(z, widening)

    # --- one decision ------------------------------------------------------------------------------------------

    def decide(self, request: Request) -> Decision:
        """Decide on one request: the proposal itself, else the closest safe input, else the committed backup plan.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size; the error names the field.
        """
        record = DecisionRecord(perf_counter_ns())
        self._check_age(request.acceleration_age)
        if self.ordinary(request):
            check_surroundings(self.robot, request)
        else:
            check_for_filter(self.robot, request)
        if self.start > 1.0 and request.past is None:  # an episode has begun
            factors = {name: self.start * getattr(request, name) for name in ("widening", "state_widening")}
            request = replace(request, **factors)
        record.contained = request.predicted is None or request.predicted.contains(self.robot, request.state)
        record.broken = 0 if request.movers is None else int((~request.movers.consistent).sum())
        blind = "" if not record.broken else BROKEN
        if request.scan is not None and request.scan.age > MAX_SCAN_AGE:
            blind = f"the scan is {request.scan.age:.3g} s old, over {MAX_SCAN_AGE:g}: it shows no free space any more"
            request = replace(request, scan=replace(request.scan, ranges=np.zeros_like(request.scan.ranges)))
        if not request.finite:
            blind = NOT_FINITE
            request = replace(request, action=request.input_in_force)  # a finite value in its place; nothing uses it
        given = request.plan[: self.robot.committed_steps].ravel()
        z_0 = np.concatenate([request.state[self.regressor], request.input_in_force, given])
        proposal = self.inputs.limited(request.action, z_0[-self.robot.action_dim :])
        local_map = self.constraints.local_map(request, z_0, self.builder.reachable(z_0[-self.robot.action_dim :]))
        unsure = "" if tube_kernels.within(z_0, self.domain) else UNRECORDED
        if not unsure and may_drive_already(request, self.robot):
            _, constraints, stay = self._rest_of_plan(request, local_map, z_0)
            unsure = "" if stands(request, local_map, constraints, stay, self.start) else DRIVES_ALREADY
        candidate = None
        if blind or unsure:
            record.reason = blind or unsure
        else:
            committed = request.plan[self.robot.committed_steps : self.robot.free_steps].ravel()
            search = PlanSearch(self, local_map, z_0, proposal, record)
            candidate = find_plan(search, committed, request.turn_aside)
            self._note_unrecorded(request.action, search, candidate)
        if candidate is None:
            candidate = self._committed(request, local_map, z_0, record, not unsure)
            if not (blind or unsure):
                candidate = RecoverySearch(self, request, local_map, z_0).candidate() or candidate
            if isinstance(request.scan, RangeImage) and (lacking := unseen_poles(request.scan)):
                record.reason += f"; {lacking}"
        return self._decision(request, local_map, candidate, record)

    @cached_property
    def _batch(self) -> BatchFilter:
        from brakeline.safety.filter.batch.batch_filter import BatchFilter  # few callers need it

        return BatchFilter(self)

    def decide_batch(self, requests: RequestArrays) -> DecisionArrays:
        """Decide on many requests at once: arrays in, arrays out, with the batch first.

        Every decision is of the kind that `decide` gives, and its inputs differ by less than 1e-6. The batch verifies
        its plans with the same tubes and half-spaces. It leaves to `decide` the rows that it does not cover, or whose
        result rounding could change (docs/performance.md). The arrays may be NumPy's, or torch tensors on any device;
        the answers are of the same namespace and on the same device.

        >>> from brakeline import Filter, Obstacle, ObstacleArrays, RequestArrays, Shapes
        >>> ground, rows = Filter.load("ground"), 2
        >>> wall = Shapes.of([Obstacle("box", (0.25, 0.0), (0.2, 2.0))], dim=2)
        >>> answers = ground.decide_batch(RequestArrays(
        ...     state=np.zeros((rows, 5)), action=np.tile([0.25, 0.0], (rows, 1)), input_in_force=np.zeros((rows, 2)),
        ...     plan=np.zeros((rows, 3, 2)), obstacles=ObstacleArrays.of([wall, Shapes.of([], dim=2)]),
        ...     known_free=np.ones(rows, dtype=bool)))
        >>> [answers.row(row).kind for row in range(rows)], answers.plan.shape
        (['adjusted', 'allowed'], (2, 3, 2))

        Raises:
            BadRequest: an array has the wrong shape, or a row is not valid; the error names the field and the row.
        """
        self._check_age(requests.acceleration_age)
        return self._batch.decide(requests)

    def decide_all(self, requests: Sequence[Request]) -> list[Decision]:
        """Decide on several requests, in their order: many at once if there are enough of them, else one by one.

        Raises:
            BadRequest: as `decide`.
        """
        from brakeline.safety.filter.batch.request_arrays import RequestArrays

        fitting = [i for i, request in enumerate(requests) if RequestArrays.fits(request, self.ordinary)]
        few = len(fitting) < WORTH_A_BATCH * self.robot.horizon
        if few or self.acceleration_age or not self._batch.covers:
            return [self.decide(request) for request in requests]
        for i in fitting:
            check_surroundings(self.robot, requests[i])
        answers = self.decide_batch(RequestArrays.of([requests[i] for i in fitting]))
        decided = {i: answers.row(row) for row, i in enumerate(fitting)}
        return [decided[i] if i in decided else self.decide(request) for i, request in enumerate(requests)]

    def _check_age(self, age: float) -> None:
        """Raise BadRequest if the states hold accelerations of another age than those of the recording."""
        if age != self.acceleration_age:
            raise BadRequest(
                "acceleration_age",
                f"the model set was recorded with the horizontal acceleration of {self.acceleration_age:g} s ago; this "
                f"state has that of {age:g} s ago: report the same `acceleration_age`",
            )

    def _note_unrecorded(self, wanted: Array, search: PlanSearch, candidate: PlanCandidate | None) -> None:
        """If the proposal itself (m,) is outside the recorded range, say that the candidate adjusts it."""
        recorded = not self.inputs.narrower or (search.proposal == self.executable.limited(wanted, search.before)).all()
        if candidate is None or recorded:
            return
        candidate.for_clearance = False  # the filter can verify no such proposal
        if candidate.kind == ALLOWED:
            candidate.kind, search.record.reason, search.record.find_blocking = ADJUSTED, NOT_RECORDED, None

    def _committed(
        self, request: Request, local_map: LocalMap, z_0: Array, record: DecisionRecord, in_domain: bool
    ) -> PlanCandidate:
        """Return the committed backup plan, or a plan that is verified anew, or one that is not verified.

        The committed plan still counts as verified if the measured state is in the predicted set, this model set
        verified the plan or the robot stands, no obstacle broke its bounds (docs/method.md §4), and the robot is in its
        reservation, which touches no other (§9). Otherwise, the
        filter verifies the rest of that plan and then the strongest braking from the new measurement, each followed by
        the robot's stop rule. If neither is verified, the one with the larger margin is executed: a plan that evades an
        obstacle may need no more than some millimetres, while braking leads straight into it. Outside the recorded
        domain nothing is verified, but the margins still tell which of the two is better.
        """
        if not record.contained:
            record.reason += "; the measured state was outside the predicted set"
        before = z_0[-self.robot.action_dim :]
        tail, constraints, as_committed = self._rest_of_plan(request, local_map, z_0)
        was_verified = request.model == self.version and not record.broken
        was_verified |= stands(request, local_map, constraints, as_committed, self.start)
        for fault in request.reservation_faults(self.robot):
            record.reason += f"; {fault}"
            was_verified = False
        if record.contained and was_verified:
            margin = constraints.margin_in(local_map, as_committed)
            return PlanCandidate(FAILSAFE, tail, as_committed, margin, True, constraints, continues=True)
        brake = self.inputs.regressors(z_0, self.executable.stop(request.state, before))
        as_committed[len(z_0) :] = self.executable.within(as_committed[len(z_0) :], before)
        candidates = list[PlanCandidate]()
        for z in (brake, as_committed):
            constraints = self.constraints_for(z, local_map.widening)
            margin = constraints.margin_in(local_map, z)
            verified = in_domain and self.inputs.allows(z[len(z_0) :]) and margin >= 0.0
            candidates.append(PlanCandidate(FAILSAFE, self.inputs.plan(z), z, margin, verified, constraints))
        if candidates[-1].verified:
            return candidates[-1]
        return max(candidates, key=lambda candidate: np.nan_to_num(candidate.margin, nan=-np.inf))

    def _rest_of_plan(self, request: Request, local_map: LocalMap, z_0: Array) -> tuple[Array, TubeConstraints, Array]:
        """Return the inputs (N, m) of the committed backup plan from now on, its constraints and its regressors."""
        tail = request.plan
        if self.robot.feedback:  # a feedback decides this period's input from the measured state
            before = z_0[-self.robot.action_dim :]
            tail = np.vstack([self.robot.stop_by_feedback(tail[:1], request.state, before), tail[1:]])
        z = np.concatenate([z_0, tail[self.robot.committed_steps : self.robot.free_steps].ravel()])
        return tail, self.constraints_for(z, local_map.widening), z

    def _decision(
        self, request: Request, local_map: LocalMap, candidate: PlanCandidate, record: DecisionRecord
    ) -> Decision:
        z, constraints = candidate.z, candidate.constraints
        centers, half = constraints.sets(local_map.start, local_map.turn, z)
        reservation = request.reservation
        if reservation is not None and not candidate.continues:
            reservation = self.reserve(constraints, local_map.start, local_map.turn, z)
        predicted = constraints.predict(local_map, z)
        margin, at_least = constraints.clear(request, local_map, z, candidate.margin)
        scores = self.scores(request) or (None, None)
        total, solved = (perf_counter_ns() - record.started) * 1e-6, record.solve_ns * 1e-6
        return Decision(
            kind=candidate.kind,
            plan=candidate.plan,
            tube_center=centers,
            tube_half_width=half,
            predicted=predicted,
            margin=margin,
            at_least=at_least,
            model=self.version,
            reason="" if candidate.kind == ALLOWED else record.reason,
            verified=candidate.verified,
            contained=record.contained,
            compared=request.predicted is not None,
            time_ms=total,
            solve_ms=solved,
            verify_ms=total - solved,
            solver=record.solver,
            iterations=record.iterations,
            broken=record.broken,
            blocked_by=None if candidate.kind == ALLOWED else record.blocked_by,
            for_clearance=candidate.for_clearance if candidate.kind == ADJUSTED else None,
            reservation=reservation,
            bound=self.bound,
            judges=self.model.one_step is not None,
            outside_share=self.outside_share,
            score=scores[0],
            plan_score=scores[1],
        )

    def scores(self, request: Request) -> tuple[float, float] | None:
        """Return `score` and `plan_score` of a decision (docs/method.md §15); None if it has none."""
        if self._score is None or request.past is None or not request.finite:
            return None
        return self._score(request.past, request.state)

    def standing_reservation(self, state: Array, widening: float = 1.0) -> Reservation:
        """Return the reservation of a robot that stands in a measured state (n,) and goes on standing.

        widening: the factor on every set that its request asks for.
        """
        widening = self.constraints.plan_widening(widening * self.start)
        z = np.concatenate([state[self.regressor], np.tile(self.inputs.nothing, 1 + self.robot.free_steps)])
        heading = float(state[self.robot.heading]) if self.robot.heading is not None else 0.0
        start, constraints = state[: self.robot.position_dim], self.constraints_for(z, widening)
        return self.reserve(constraints, start, constraints.turn(heading), z)

    def reserve(self, constraints: TubeConstraints, start: Array, turn: Array, z: Array) -> Reservation:
        """Return the reservation of the plan with regressors z from a start (d,); turn (d, d): robot to world."""
        centers, half = constraints.sets(start, turn, z)
        lengths = constraints.widening * constraints.tube.magnitudes(z)[constraints.tube.generators :]
        *chord_deviations, stopping_distance = lengths
        chord_deviations[-1] = max(chord_deviations[-1], stopping_distance)
        centers, half = np.vstack([start, centers]), np.vstack([constraints.measured, half])
        return Reservation.of(centers, half, self.robot.footprint + np.array(chord_deviations))
