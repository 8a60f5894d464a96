"""The search for verified plans near the proposals of a batch: `PlanSearch` for many robots; the batch is last.

It follows the same steps in the same order (docs/method.md §4, §13). Where a comparison is too close to be the same in
another order of the sums, or a QP is not surely solved, the lane is left to the single path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from brakeline.safety.filter.batch.constraint_batch import ConstraintBatch, PlanBatch, SceneBatch, taken
from brakeline.safety.filter.batch.obstacle_arrays import Array
from brakeline.safety.filter.batch.qp_batch import ROUNDING, QPBatch, RowBatch
from brakeline.safety.filter.plan_search import AS_PROPOSED, LINEARIZATIONS

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter

FEW = 12  # lanes, below which the single path is faster than a further step of the search


@dataclass(frozen=True)
class LaneBatch:
    """The inputs of a search, for each robot."""

    scene: SceneBatch  # the surroundings
    z_0: Array  # (known, B): known regressors
    proposal: Array  # (m, B): within bounds and slew
    committed: Array  # (F·m, B): free inputs of the committed plan


@dataclass(frozen=True)
class ProposalBatch:
    """The plans "the proposal, then braking" of a batch."""

    plan: PlanBatch  # with the half-spaces around them
    margin: Array  # (B,) [m]
    allowed: Array  # (B,): the plan keeps the clearance margin
    unsure: Array  # (B,): rounding decides; left to the single path


@dataclass
class CandidateBatch:
    """The results of a search."""

    z: Array  # (nz, B): regressors of the verified plans
    margin: Array  # (B,) [m]: their margins
    # allowed, adjusted, hopeless (B,): the result
    allowed: Array
    adjusted: Array
    hopeless: Array  # no plan near the proposal is verified. A lane with none of the three is left to the single path.
    for_clearance: Array  # (B,): the proposal is verified too
    steps: Array  # (B,): of the solver
    turned: Array  # (B,): 1 or -1: the plan turns a blocked robot aside, to the left or right; else 0


class SearchBatch:
    """Searches with the matrices of a filter, in a namespace and on a device."""

    def __init__(self, safety: Filter, constant: Any, xp: Any) -> None:
        self._xp, inputs = xp, safety.inputs
        self.constraints = ConstraintBatch(safety.constraints, constant, xp)
        self._qp = QPBatch(safety.builder, self.constraints, constant, xp)
        self._clearance, self._tightening = safety.clearance_margin, safety.builder.tightening
        self.known, self._free, self._m = safety.builder.known, safety.builder.free, safety.robot.action_dim
        self._one_input = self._free == self._m
        self._low, self._high = constant(inputs.low[:, None]), constant(inputs.high[:, None])
        self._width = constant(inputs.width[:, None])
        self._slew, self._nothing = constant(inputs.slew[:, None]), constant(inputs.nothing[:, None])
        self._braking = constant(inputs.braking.reshape(-1, 1))
        self._standing = constant(safety.standing[:, None].astype(float)) > 0.5
        self._translating = constant(safety.translating[self.known :, None, None].astype(float))
        self._repeats = len(inputs.braking)
        self._pattern = [constant(share[:, None]) for share in inputs.pattern]

    # --- inputs and regressors -------------------------------------------------------------------------------------

    def limited(self, wanted: Array, before: Array) -> Array:
        """Return the inputs (m, B) closest to the wanted ones within bounds and slew of the inputs `before` (m, B)."""
        xp = self._xp
        least, most = xp.maximum(self._low, before - self._slew), xp.minimum(self._high, before + self._slew)
        return xp.minimum(xp.maximum(wanted, least), most)

    def regressors(self, z_0: Array, action: Array) -> Array:
        """Return the regressors (nz, B) of actions (m, B) followed by braking."""
        xp = self._xp
        return xp.concat([z_0, self._braking * xp.concat([action] * self._repeats)])

    def _within(self, z_0: Array, free: Array) -> Array:
        """Return the regressors (nz, B) of free inputs (F·m, B), clipped to bounds and slew one after the other."""
        m, before, parts = self._m, z_0[self.known - self._m :], [z_0]
        for k in range(free.shape[0] // m):
            before = self.limited(free[k * m : (k + 1) * m], before)
            parts.append(before)
        return self._xp.concat(parts)

    def _as_proposed(self, lanes: LaneBatch, z: Array) -> tuple[Array, Array]:
        """Return regressors (nz, B), with the proposal as first input where it is close; and unsure lanes (B,)."""
        xp, known, m = self._xp, self.known, self._m
        off = (z[known : known + m] - lanes.proposal) / self._width
        off = xp.sqrt(xp.sum(off * off, axis=0))
        if self._one_input:
            return z, xp.zeros_like(off, dtype=xp.bool)
        with_proposal = self._within(lanes.z_0, xp.concat([lanes.proposal, z[known + m :]]))
        return xp.where(off <= AS_PROPOSED, with_proposal, z), xp.abs(off - AS_PROPOSED) < ROUNDING

    # --- the search ------------------------------------------------------------------------------------------------

    def propose(self, lanes: LaneBatch) -> ProposalBatch:
        """Return the plans "the proposal, then braking", and which of them keep the clearance margin."""
        xp, scene, least = self._xp, lanes.scene, self.constraints.least
        plan = self.constraints.around(scene, self.regressors(lanes.z_0, lanes.proposal))
        margin = least(scene, plan.slack, plan.extent)
        empty = scene.near.none(xp, margin)
        kept_off = self.constraints.kept_off(plan.planes)
        with_clearance = least(scene, plan.slack - kept_off, plan.extent, self._clearance)
        room = xp.maximum(margin - max(self._clearance, 0.0), with_clearance)
        allowed = (empty & ~scene.far) | (room >= ROUNDING)
        return ProposalBatch(plan, margin, allowed, ~allowed & ((room > -ROUNDING) | (xp.abs(margin) < ROUNDING)))

    def adjust(self, lanes: LaneBatch, proposed: ProposalBatch) -> CandidateBatch:
        """Search for plans near proposals that are not allowed at once: with the clearance margin, then without."""
        xp, verified = self._xp, proposed.margin > 0.0
        stay = self.staying(lanes)
        z, margin = (xp.asarray(part, copy=True) for part in (proposed.plan.z, proposed.margin))
        allowed, adjusted, hopeless, for_clearance = (xp.zeros_like(verified) for _ in range(4))
        counts = xp.zeros_like(margin), xp.zeros_like(margin, dtype=xp.int64)
        candidates = CandidateBatch(z, margin, allowed, adjusted, hopeless, for_clearance, *counts)
        open_ = self._neither_nearer(lanes, proposed.plan, stay, xp.nonzero(verified)[0], candidates)
        for with_clearance in (True, False):
            if not with_clearance:  # a verified proposal that no input betters
                settled = xp.take(verified, open_, axis=0)
                candidates.allowed[open_[settled]] = True
                open_ = open_[~settled]
            for number in range(1 if self.constraints.tube.linear else 3):
                if open_.shape[0] < (1 if number == 0 and with_clearance else FEW):
                    return candidates
                part, own = taken(xp, lanes, open_), xp.take(stay, open_, axis=-1)
                start = self._starting_point(number, part, taken(xp, proposed.plan, open_))
                z, least, solved, unsure, steps = self._solve(part, start, own, with_clearance)
                candidates.steps[open_] = candidates.steps[open_] + steps
                to = open_[solved]
                candidates.z[:, to], candidates.margin[to] = z[:, solved], least[solved]
                changed = self._changed(part, z)[solved]
                candidates.adjusted[to], candidates.allowed[to] = changed, ~changed
                candidates.for_clearance[to] = xp.take(verified, to, axis=0) & changed
                open_ = open_[~solved & ~unsure]
        candidates.hopeless[open_] = self._none_of_pattern(taken(xp, lanes, open_))
        return candidates

    def _none_of_pattern(self, lanes: LaneBatch) -> Array:
        """Return the lanes (B,) for which no input of `PlanInputs.pattern` is verified; others need the single path."""
        xp, before = self._xp, lanes.z_0[self.known - self._m :]
        none = xp.ones_like(before[0], dtype=xp.bool)
        if self.constraints.tube.linear or not none.shape[0]:
            return none
        middle, change = (part[: self._m] for part in self._qp.reachable(before))
        for share in self._pattern:
            z = self.regressors(lanes.z_0, middle + change * share)
            plan = self.constraints.around(lanes.scene, z)
            none &= self.constraints.least(lanes.scene, plan.slack, plan.extent) < -ROUNDING
        return none

    def _changed(self, lanes: LaneBatch, z: Array) -> Array:
        """Return which plans (B,) begin with another input than the proposal: with one chosen input, all do."""
        first, xp = z[self.known : self.known + self._m], self._xp
        if self._one_input:
            return xp.ones_like(z[0], dtype=xp.bool)
        return xp.any(first != lanes.proposal, axis=0)

    def _neither_nearer(
        self, lanes: LaneBatch, plan: PlanBatch, stay: Array, verified: Array, candidates: CandidateBatch
    ) -> Array:
        """Allow verified proposals that come no nearer where the clearance margin is lost; return the lanes left."""
        xp, open_ = self._xp, self._xp.ones_like(candidates.allowed)
        if verified.shape[0]:
            part, own = taken(xp, lanes, verified), taken(xp, plan, verified)
            rows = self._qp.rows(part.scene, own, part.z_0)
            tight, inside, unsure = self._tightened(part, own, rows, xp.take(stay, verified, axis=-1))
            keeps = self._keeps(part, own, tight, inside)
            candidates.allowed[verified[(keeps >= ROUNDING) & ~unsure]] = True
            open_[verified[unsure | (keeps > -ROUNDING)]] = False
        return xp.nonzero(open_)[0]

    def _starting_point(self, number: int, lanes: LaneBatch, proposed: PlanBatch) -> PlanBatch:
        """Return the plans of the proposal, the committed plans, or the strongest braking."""
        if number == 0:
            return proposed
        z = self._within(lanes.z_0, lanes.committed)
        if number == 2:
            nothing = self._xp.broadcast_to(self._nothing, lanes.proposal.shape)
            z = self.regressors(lanes.z_0, nothing)
        return self.constraints.around(lanes.scene, z)

    def staying(self, lanes: LaneBatch) -> Array:
        """Return the regressors (nz, B) of turning in place."""
        in_place = self._xp.where(self._standing, lanes.proposal, self._nothing)
        return self.regressors(lanes.z_0, self.limited(in_place, lanes.z_0[self.known - self._m :]))

    def _too_near(self, lanes: LaneBatch, plan: PlanBatch, stay: Array) -> tuple[Array, Array]:
        """Return the rows (R, B) for which turning in place would not keep the clearance margin; and unsure lanes."""
        path, sizes = self.constraints.tube.path(stay), self.constraints.tube.sizes(stay, lanes.scene.widening)
        left = self.constraints.slack(plan.planes, path, sizes) - self.constraints.kept_off(plan.planes)
        return left < 0.0, self._xp.any(self._xp.abs(left) < ROUNDING, axis=0)

    def _tightened(
        self, lanes: LaneBatch, plan: PlanBatch, rows: RowBatch, stay: Array
    ) -> tuple[RowBatch, Array, Array]:
        """Return the rows with the clearance margin, where it is lost (R, B), and unsure lanes (B,).

        Where it is lost, a further row forbids inputs that move the robot nearer: `PlanSearch.with_clearance_margin`.
        """
        xp = self._xp
        inside, unsure = self._too_near(lanes, plan, stay)
        bound = xp.where(inside, rows.bound, rows.bound - self.constraints.kept_off(plan.planes))
        which = xp.nonzero(xp.any(inside, axis=1))[0]
        if not which.shape[0]:
            return RowBatch(rows.gradient, rows.spread, bound), inside, unsure
        own = xp.take(inside, which, axis=0)
        closer = xp.where(own, xp.take(rows.gradient, which, axis=1) * self._translating, 0.0)
        most = sum(closer[j] * stay[self.known + j] for j in range(self._free)) + 2.0 * self._tightening
        spread = xp.zeros((rows.spread.shape[0], *own.shape), dtype=bound.dtype, device=bound.device)
        both = xp.concat([rows.gradient, closer], axis=1), xp.concat([rows.spread, spread], axis=1)
        return RowBatch(*both, xp.concat([bound, most])), inside, unsure

    def _keeps(self, lanes: LaneBatch, plan: PlanBatch, tight: RowBatch, inside: Array) -> Array:
        """Return the least slack (B,) of plans in the rows with the clearance margin."""
        xp, count = self._xp, plan.slack.shape[0]
        left = xp.where(inside, plan.slack, plan.slack - self.constraints.kept_off(plan.planes))
        closer = tight.bound[count:]
        for j in range(self._free):
            closer = closer - tight.gradient[j, count:] * plan.z[self.known + j]
        return self.constraints.least(lanes.scene, xp.concat([left, closer]), plan.extent)

    def _solve(
        self, lanes: LaneBatch, plan: PlanBatch, stay: Array, with_clearance: bool
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Solve the QPs around plans, and again where a rollout's answer is not verified.

        Returns:
            Regressors (nz, B), margins (B,), verified lanes (B,), unsure lanes (B,), and steps of the solver (B,).
        """
        xp, c = self._xp, self.constraints
        z, margins = xp.zeros_like(plan.z), xp.zeros_like(plan.extent)
        verified = xp.zeros_like(plan.extent, dtype=xp.bool)
        unsure, steps = xp.asarray(verified, copy=True), xp.zeros_like(plan.extent)
        index = xp.arange(plan.extent.shape[0], device=plan.extent.device)
        for _ in range(1 if c.tube.linear else LINEARIZATIONS):
            rows, inside = self._qp.rows(lanes.scene, plan, lanes.z_0), None
            if with_clearance:
                rows, inside, close = self._tightened(lanes, plan, rows, stay)
                unsure[index[close]] = True
            f, solved, impossible, own_steps = self._qp.solve(rows, lanes.z_0, lanes.proposal)
            steps[index] = steps[index] + xp.astype(own_steps, steps.dtype)
            unsure[index[~solved & ~impossible]] = True
            go = xp.nonzero(solved & ~unsure[index])[0]
            if not go.shape[0]:
                break
            index, lanes, stay = index[go], taken(xp, lanes, go), xp.take(stay, go, axis=-1)
            free, close = self._as_proposed(lanes, self._within(lanes.z_0, xp.take(f, go, axis=-1)))
            unsure[index[close]] = True
            if c.tube.linear:
                plan = c.around(lanes.scene, free, taken(xp, plan.planes, go))
                tight = taken(xp, rows, go)
                inside = None if inside is None else xp.take(inside, go, axis=-1)
            else:
                plan = c.around(lanes.scene, free)
            margin = least = c.least(lanes.scene, plan.slack, plan.extent)
            close = xp.zeros_like(margin, dtype=xp.bool)
            if inside is not None and c.tube.linear:
                least = self._keeps(lanes, plan, tight, inside)
            elif with_clearance:
                inside, close = self._too_near(lanes, plan, stay)
                left = xp.where(inside, plan.slack, plan.slack - c.kept_off(plan.planes))
                least = xp.minimum(margin, c.least(lanes.scene, left, plan.extent))
            good = (least >= ROUNDING) & ~close
            to = index[good]
            z[:, to], margins[to], verified[to] = plan.z[:, good], margin[good], True
            unsure[index[close | (xp.abs(least) < ROUNDING)]] = True
            again = xp.nonzero(~good & ~unsure[index])[0]
            if again.shape[0] < FEW:
                unsure[index[again]] = True
                break
            index, lanes, stay = index[again], taken(xp, lanes, again), xp.take(stay, again, axis=-1)
            plan = taken(xp, plan, again)
        return z, margins, verified, unsure, steps
