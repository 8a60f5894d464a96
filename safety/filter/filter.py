"""`decide`: a proposed action in, a verified plan out (paper, algorithms 1 and 2; docs/method.md §4).

The filter allows a proposal whose tube keeps the clearance margin to every obstacle. Where turning in place does not
keep that margin, the proposal must not drive nearer. The filter replaces every other proposal by the closest input
that keeps to this, even if the proposal's own tube is verified: a robot that stops nearer than the clearance margin
may not be able to turn there. Such decisions are `for_clearance`. If no input keeps to it, the filter allows a
verified proposal, and adjusts others to free space alone.

A pure function of the request and the model set: no state is kept about a robot, so that any replica can answer and a
log can be replayed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.scan import OLDEST, Scan
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.blocking_constraint import BlockingConstraint
from brakeline.safety.filter.constraints import LocalMap, TubeConstraints, turning_extent
from brakeline.safety.filter.kernels import tube_kernels
from brakeline.safety.filter.plan_inputs import PlanInputs
from brakeline.safety.filter.qp import SHARPEN, ConstraintRows, QPBuilder
from brakeline.safety.filter.qp_solver import INFEASIBLE, solve
from brakeline.safety.filter.recovery import SLOW, harmless, least_violating, slow_inputs, turn_towards
from brakeline.safety.filter.request import (
    ADJUSTED,
    ALLOWED,
    FAILSAFE,
    NOT_FINITE,
    RECOVERING,
    Decision,
    FastRequestCheck,
    Request,
    check_for_filter,
    check_surroundings,
)
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.stated_bound import check_bound, stated_bound
from brakeline.safety.model.turning_in_place import widened
from brakeline.safety.perception.scan_free_space import shows_free

Array = NDArray[np.float64]

BROKEN = "an obstacle was seen outside of what its bounds allow: nothing is known of where it will be"


@dataclass
class _Attempt:
    """What has been found out during one decision."""

    started: int
    solver: str = ""
    iterations: int = 0
    solve_ns: int = 0
    reason: str = ""
    contained: bool = True
    broken: int = 0
    blocked_by: BlockingConstraint | None = None


@dataclass(frozen=True)
class _Found:
    """A plan (N, m) and the regressors z of its tube."""

    kind: str
    plan: Array
    z: Array
    margin: float
    verified: bool
    around: TubeConstraints  # whose tube is that of the plan
    kept: bool = False  # the committed plan goes on as it was verified before
    for_clearance: bool = False  # the proposal's tube is verified too, and is nearer than the clearance margin


class Filter:
    """A model set made ready for decisions."""

    observed = 0  # it reads no observation

    def __init__(self, model: ModelSet, clearance_margin: float | None = None) -> None:
        """clearance_margin [m]: the distance from the tube to obstacles that the QP keeps; by default as wide as
        turning in place needs."""
        self.model = model
        self.version = model.version
        self.bound = stated_bound(model.about)
        self.robot = robot = model.robot
        self.tube, outer = model.tube(), model.outer_tube()
        self.builder = QPBuilder(robot, outer)
        self.domain = widened(model.domain)
        turning = model.turning()
        in_place = self.tube if turning is None else turning.tube()
        margin = turning_extent(robot, in_place) if clearance_margin is None else clearance_margin
        self.around = TubeConstraints(model, self.tube, outer, self.domain, margin)
        self.in_place: tuple[Array, TubeConstraints] | None = None  # and for which regressors (2, nz)
        if turning is not None and model.in_place is not None:
            box = np.ascontiguousarray(model.in_place.domain(in_place.position.shape[2], robot.regressor_dim))
            known = box[:, : robot.regressor_dim]
            own = TubeConstraints(turning, in_place, in_place, known, margin, self.around.reach)
            self.in_place = box, own
        self.inputs = PlanInputs(robot)
        self.ordinary = FastRequestCheck(robot)
        self.standing = np.array([not moves for moves in robot.translates])
        driven = np.tile(robot.translates, robot.free_steps)
        self.first_free = robot.regressor_dim + robot.committed_steps * robot.action_dim  # of regressors
        self.translating = np.concatenate([np.zeros(robot.regressor_dim), driven])
        self.regressor = np.array(robot.regressor, dtype=np.intp)
        self.clearance_margin, self.reach = self.around.clearance_margin, self.around.reach  # m

    @classmethod
    def load(cls, source: Path | str, *, accept_bound: float | None = None) -> Filter:
        """Return a filter with the model set in a file, or with the one that comes with a shipped robot.

        Args:
            source: the path of a model set, or the name of a shipped robot (`"ground"`, `"quadrotor"`).
            accept_bound: the largest stated share of plans outside their tubes that you accept; by default the limit
                in the robot's description.

        Raises:
            BadModel: the file holds no model set, or no shipped robot has that name.
            TooLoose: the model set states a larger share than is accepted.

        >>> Filter.load("ground").robot.name
        'ground'
        """
        model = ModelSet.load(source)
        check_bound(model, model.robot, accept_bound)
        return cls(model)

    def half_width(self, speed: Array) -> float:
        """[m] of the full stop's set, largest axis, from driving at inputs `speed` (m,) with that input once more."""
        state = self.robot.state_at_inputs(speed)
        z = np.concatenate([state[self.regressor], speed, np.tile(speed, self.robot.free_steps)])
        return float(self._around(z).tube.half_widths(z)[-1].max())

    def _around(self, z: Array) -> TubeConstraints:
        """What holds the tube of regressors z against scenes: the tube of plans in place, or that of all plans."""
        if self.in_place is not None and tube_kernels.within(z, self.in_place[0]):
            return self.in_place[1]
        return self.around

    # --- one decision ------------------------------------------------------------------------------------------

    def decide(self, request: Request) -> Decision:
        """The decision on one request, in this order: the proposal itself, the closest safe input, the committed plan.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size, with the field's name.
        """
        attempt = _Attempt(perf_counter_ns())
        if self.ordinary(request):
            check_surroundings(self.robot, request)
        else:
            check_for_filter(self.robot, request)
        attempt.contained = request.predicted is None or request.predicted.contains(self.robot, request.state)
        attempt.broken = 0 if request.movers is None else int((~request.movers.kept).sum())
        blind = "" if not attempt.broken else BROKEN
        if request.scan is not None and request.scan.age > OLDEST:
            blind = f"the scan is {request.scan.age:.3g} s old, over {OLDEST:g}: it shows nothing to be free any more"
            request = replace(request, scan=replace(request.scan, ranges=np.zeros_like(request.scan.ranges)))
        if not request.finite:
            blind = NOT_FINITE
            request = replace(request, action=request.input_in_force)  # it is not looked at
        given = request.plan[: self.robot.committed_steps].ravel()
        z_0 = np.concatenate([request.state[self.regressor], request.input_in_force, given])
        proposal = self.inputs.limited(request.action, z_0[-self.robot.action_dim :])
        scene = self.around.scene(request, z_0, self.builder.reachable(z_0[-self.robot.action_dim :]))
        in_domain = tube_kernels.within(z_0, self.domain)
        found = None
        if blind:
            attempt.reason = blind
        elif in_domain:
            found = self._search(scene, z_0, proposal, attempt)
        else:
            attempt.reason = "the state is outside the domain that was recorded"
        if found is None:
            found = self._committed(request, scene, z_0, attempt, in_domain)
            if in_domain and not blind and request.reservation is None:  # others rely on a promise
                found = self._recovered(request, scene, z_0) or found
        return self._decision(request, scene, found, attempt)

    def _search(self, scene: LocalMap, z_0: Array, proposal: Array, attempt: _Attempt) -> _Found | None:
        """The proposal if it is verified and keeps the clearance margin, else the QP's answer if that is verified, else
        the proposal if it is verified, else nothing."""
        z = self.inputs.regressors(z_0, proposal)
        if scene.empty and not self.around.far and self.around.limits is None:
            return _Found(ALLOWED, self.inputs.plan(z), z, self.reach, True, self._around(z))
        around = self._around(z)
        planes = around.planes(scene, z)
        slack = around.slack(scene, z, planes)
        margin = around.least(slack, z)
        # The clearance margin keeps room to turn in; a plan in place, which moves the robot nowhere, may use it up.
        if margin >= (max(self.clearance_margin, 0.0) if around is self.around else 0.0):
            return _Found(ALLOWED, self.inputs.plan(z), z, margin, True, around)
        rows = self.around.rows(scene, z, planes)
        if around.least(slack - self.clearance_margin * rows.keep, z, self.clearance_margin) >= 0.0:
            return _Found(ALLOWED, self.inputs.plan(z), z, margin, True, around)
        kept = self._with_clearance_margin(rows, z_0, proposal)
        if margin >= 0.0 and self.around.margin(kept, z) >= 0.0:
            return _Found(ALLOWED, self.inputs.plan(z), z, margin, True, around)
        attempt.reason = f"the proposal's tube comes within {margin:.3g} m of the free space's edge"
        kept_off = self.clearance_margin * rows.keep if margin >= 0.0 else np.zeros(len(slack))
        attempt.blocked_by = around.worst_of(scene, z, slack, planes, kept_off)
        # Keeping the clearance margin, or at least not driving into it; else free space alone: from here even standing
        # still would not do.
        adjusted = None
        for choice in (kept, rows):
            if choice is rows and margin >= 0.0:
                return _Found(ALLOWED, self.inputs.plan(z), z, margin, True, around)
            if not np.isfinite(choice.bound).all():
                break
            candidate = self._closest(choice, z_0, proposal, attempt)
            if candidate is not None and self.around.margin(choice, candidate) >= 0.0:
                plan, room = self.inputs.plan(candidate), self.around.margin(rows, candidate)
                adjusted = _Found(ADJUSTED, plan, candidate, room, True, self.around, for_clearance=margin >= 0.0)
                break
        adjusted = self._turned_only(scene, z_0, proposal, adjusted) or adjusted
        if adjusted is None:
            attempt.reason += "; no verified input was found"
        return adjusted

    def _turned_only(self, scene: LocalMap, z_0: Array, proposal: Array, adjusted: _Found | None) -> _Found | None:
        """The proposal without the inputs that move the position, if that is a plan in place with a verified tube, and
        closer to the proposal than what the QP found."""
        if self.in_place is None:
            return None
        (box, around), m = self.in_place, len(proposal)
        turn = np.where(self.standing, np.clip(proposal, *box[:, -m:]), self.inputs.nothing)
        z = self.inputs.regressors(z_0, self.inputs.limited(turn, z_0[-m:]))
        if not tube_kernels.within(z, box) or (
            adjusted is not None and self._off(adjusted.z, proposal) <= self._off(z, proposal)
        ):
            return None
        margin, for_clearance = around.margin_in(scene, z), adjusted is not None and adjusted.for_clearance
        if margin < 0.0:
            return None
        return _Found(ADJUSTED, self.inputs.plan(z), z, margin, True, around, for_clearance=for_clearance)

    def _off(self, z: Array, proposal: Array) -> float:
        """How far the first free input of regressors z is from the proposal, in units of the inputs' ranges."""
        first = z[self.first_free : self.first_free + len(proposal)]
        return float(np.linalg.norm((first - proposal) / (self.inputs.high - self.inputs.low)))

    def _closest(self, rows: ConstraintRows, z_0: Array, proposal: Array, attempt: _Attempt) -> Array | None:
        """The QP's answer, clipped to bounds and slew, as regressors; None if there is no number in it."""
        before = perf_counter_ns()
        program = self.builder.program(rows, z_0, proposal)
        solution = solve(program) if program is not None else INFEASIBLE
        attempt.solve_ns += perf_counter_ns() - before
        attempt.solver, attempt.iterations = solution.status, attempt.iterations + solution.iterations
        if not solution.found:
            return None
        free = self.inputs.within(self.builder.inputs(solution.x), z_0[-self.robot.action_dim :])
        return np.concatenate([z_0, free])

    def _with_clearance_margin(self, rows: ConstraintRows, z_0: Array, proposal: Array) -> ConstraintRows:
        """Rows with the clearance margin. Where moving in place would not keep it, the tube may stay as near as the
        free space allows, but no input may translate the robot nearer (one that can't stop at once: not more than
        the strongest braking does): two rows instead of one."""
        before = z_0[-len(proposal) :]
        in_place = self.inputs.limited(np.where(self.standing, proposal, self.inputs.nothing), before)
        stay = self.inputs.regressors(z_0, in_place)
        if self._around(stay) is not self.around:  # turning has a tube of its own: here room to stand is enough
            stay = self.inputs.regressors(z_0, self.inputs.limited(self.inputs.nothing, before))
        kept_off = self.clearance_margin * rows.keep
        inside = rows.support(self.tube, stay) > rows.bound - kept_off
        bound = np.where(inside, rows.bound, rows.bound - kept_off)
        if not inside.any():
            return ConstraintRows(rows.gradient, rows.spread, bound, rows.keep)
        closer = rows.gradient[inside] * self.translating
        return ConstraintRows(
            np.vstack([rows.gradient, closer]),
            np.vstack([rows.spread, np.zeros((len(closer), rows.spread.shape[1]))]),
            np.concatenate([bound, closer @ stay + 2.0 * SHARPEN]),
            np.concatenate([rows.keep, np.zeros(len(closer))]),
        )

    def _committed(self, request: Request, scene: LocalMap, z_0: Array, attempt: _Attempt, in_domain: bool) -> _Found:
        """The committed plan; if it no longer counts as verified, braking that is verified anew; else just braking.

        It counts if the measured state is where it was predicted, and this model set verified it against obstacles
        that have kept to their bounds since, or it is standing still. A tube from outside the recorded domain verifies
        nothing. Anew are looked at: the committed plan's next inputs and the strongest braking, both followed by the
        schedule's ramp, for tubes speak of nothing else.
        """
        if not attempt.contained:
            attempt.reason += "; the measured state was outside the predicted set"
        vouched = (request.model == self.version and not attempt.broken) or request.still(self.robot)
        before = z_0[-self.robot.action_dim :]
        tail = request.plan
        if self.robot.feedback:  # what the tail's inputs are follows from the measured state, this period's at once
            tail = np.vstack([self.robot.stop_by_feedback(tail[:1], request.state, before), tail[1:]])
        chosen = tail[self.robot.committed_steps : self.robot.free_steps].ravel()
        as_committed = np.concatenate([z_0, chosen])
        if attempt.contained and vouched:
            around = self._around(as_committed)
            margin = around.margin_in(scene, as_committed)
            return _Found(FAILSAFE, tail, as_committed, margin, True, around, kept=True)
        brake = self.inputs.regressors(z_0, self.inputs.stop(request.state, before))
        as_committed[len(z_0) :] = self.inputs.within(chosen, before)
        for z in (as_committed, brake):
            around = self._around(z)
            margin = around.margin_in(scene, z)
            if in_domain and margin >= 0.0:
                return _Found(FAILSAFE, self.inputs.plan(z), z, margin, True, around)
        return _Found(FAILSAFE, self.inputs.plan(brake), brake, margin, False, around)

    def _recovered(self, request: Request, scene: LocalMap, z_0: Array) -> _Found | None:
        """A slow way out, if it stands (or is on such a way) where not even standing can be verified: by more than
        the errors of two measurements could make it seem so; of who stays where it stands, and than that its stop was
        verified to end nearer."""
        robot, m = self.robot, self.robot.action_dim
        slow = np.where(robot.translates, SLOW + 0.05, 1.0) * np.maximum(self.inputs.high, -self.inputs.low)
        going = np.vstack([request.input_in_force, request.plan[: robot.committed_steps]])
        on_a_way = request.model == UNVERIFIED and bool(going.any() and (np.abs(going) <= slow).all())
        if not (request.still(robot) or on_a_way):
            return None
        if isinstance(request.scan, Scan) and not shows_free(request.scan, scene.start):  # no way out of there is known
            return None
        before = z_0[-m:]
        stand = self.inputs.regressors(z_0, self.inputs.stop(request.state, before))
        parked = scene.parked
        seeming = 0.0
        if not on_a_way:  # who does not stay where it stands will be as near as it seems, before long
            seeming = 2.0 * float(np.linalg.norm(self.around.measured)) + (
                self.clearance_margin if self.around.stays else 0.0
            )
        if self._around(stand).margin_in(parked, stand) >= -seeming:
            return None
        planes = self.around.planes(scene, stand, leaving=True)
        rows = self.around.rows(scene, stand, planes)
        if not np.isfinite(rows.bound).all():  # of one that is just touched, or is no number, no side is known
            return None
        standing = rows.support(self.tube, stand) - rows.bound
        # What is carried out late is taken back late: no faster then than it gets within a period.
        most = np.asarray(robot.action_slew) if robot.committed_steps else np.full(m, np.inf)
        inputs = np.array([self.inputs.limited(np.clip(u, -most, most), before) for u in slow_inputs(robot)])
        plans = [self.inputs.regressors(z_0, action) for action in inputs]
        # Each as sure of where it goes as standing is: who knows little of its own motion would else be led to where
        # that is known best, which is not out.
        violated = standing + (np.array(plans) - stand) @ rows.gradient.T
        ends = np.zeros(len(rows.bound), dtype=bool)
        each = 2 * robot.horizon + 1
        ends[each - 1 : sum(len(of.normals) for of in planes) * each : each] = True
        best = least_violating(violated, standing, ends)
        if best is not None:
            z = plans[best]
        elif robot.heading is not None and (away := scene.away) is not None:
            z = self.inputs.regressors(z_0, self.inputs.limited(turn_towards(robot, scene.heading, away), before))
            # Turning leaves a disc in the middle where it is, but swings one aside: never nearer to anything.
            aside = np.repeat([disc.aside for disc in self.around.discs], [len(of.normals) * each for of in planes])
            swung = np.flatnonzero(aside)
            turned = standing[swung] + rows.gradient[swung] @ (z - stand)
            if not harmless(turned[None], standing[swung])[0]:
                return None
        else:
            return None
        return _Found(RECOVERING, self.inputs.plan(z), z, self.around.margin(rows, z), False, self.around)

    def _decision(self, request: Request, scene: LocalMap, found: _Found, attempt: _Attempt) -> Decision:
        z, around = found.z, found.around
        centers, half = around.sets(scene.start, scene.turn, z)
        reservation = request.reservation
        if reservation is not None and not found.kept:
            reservation = self._promise(around, scene.start, centers, half, z)
        predicted = around.predict(scene, z)
        margin, at_least = around.clear(request, scene, z, found.margin)
        total, solved = (perf_counter_ns() - attempt.started) * 1e-6, attempt.solve_ns * 1e-6
        return Decision(
            kind=found.kind,
            plan=found.plan,
            tube_center=centers,
            tube_half_width=half,
            predicted=predicted,
            margin=margin,
            at_least=at_least,
            model=self.version,
            reason="" if found.kind == ALLOWED else attempt.reason,
            verified=found.verified,
            contained=attempt.contained,
            compared=request.predicted is not None,
            time_ms=total,
            solve_ms=solved,
            verify_ms=total - solved,
            solver=attempt.solver,
            iterations=attempt.iterations,
            broken=attempt.broken,
            blocked_by=None if found.kind == ALLOWED else attempt.blocked_by,
            for_clearance=found.for_clearance if found.kind == ADJUSTED else None,
            reservation=reservation,
            bound=self.bound,
        )

    def standing_reservation(self, state: Array) -> Reservation:
        """What a robot promises that stands, and goes on standing, in a measured state (n,)."""
        z = np.concatenate([state[self.regressor], np.tile(self.inputs.nothing, 1 + self.robot.free_steps)])
        heading = float(state[self.robot.heading]) if self.robot.heading is not None else 0.0
        start, around = state[: self.robot.position_dim], self._around(z)
        return self._promise(around, start, *around.sets(start, around.turn(heading), z), z)

    def _promise(self, around: TubeConstraints, start: Array, centers: Array, half: Array, z: Array) -> Reservation:
        """Of a tube with these sets (N, d), world, and regressors z."""
        about = around.tube.magnitudes(z)[around.tube.generators :]
        about[-2] = max(about[-2], about[-1])
        centers, half = np.vstack([start, centers]), np.vstack([around.measured, half])
        return Reservation.of(centers, half, self.robot.footprint + about[:-1])
