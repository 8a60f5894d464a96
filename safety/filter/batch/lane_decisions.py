"""Decide many rows of a batch at once. Each row is a *lane*, a place on the last axis of every array.

`Filter.decide` decides the other rows one by one: those that need a search which lanes do not make.
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from brakeline.safety.filter.backup_plan import SAME_SET
from brakeline.safety.filter.batch.aside_batch import AsideBatch
from brakeline.safety.filter.batch.constraint_batch import ConstraintBatch, PlanBatch, SceneBatch, taken
from brakeline.safety.filter.batch.decision_arrays import KINDS
from brakeline.safety.filter.batch.obstacle_arrays import (
    Array,
    ObstacleArrays,
    TurnBatch,
    mapped,
    on_host,
    plausible,
    within_reach,
)
from brakeline.safety.filter.batch.qp_batch import ROUNDING
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.batch.score_batch import ScoreBatch
from brakeline.safety.filter.batch.search_batch import LaneBatch, SearchBatch
from brakeline.safety.filter.batch.set_batch import SetBatch
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.request import ADJUSTED, FAILSAFE, STOPPED, FastRequestCheck

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter

# Numbers that a processor's cache can hold: a plan's rows for one obstacle, and for all near ones, of all lanes at once
PLAN_ROWS, ROWS = 1 << 14, 1 << 17
FEWEST = 32  # lanes at once, whatever the number of obstacles
MANY = 4  # times the lanes: rows whose near obstacles are found at once, and which are then sorted by their number
LANES_ON_DEVICE, ROWS_ON_DEVICE = 1 << 18, 1 << 26
HUGE = 1e100  # `Filter.decide` decides rows with larger numbers


class LaneDecisions:
    """Decides with the arrays of a filter, in a namespace and on a device."""

    def __init__(self, safety: Filter, xp: Any, device: Any) -> None:
        self._xp, self._device, self._robot, self._version = xp, device, safety.robot, safety.version
        constant = as_constant(xp, device)
        robot, base = safety.robot, safety.constraints
        self._search = SearchBatch(safety, constant, xp)
        self._constraints = self._search.constraints
        self._clearance, self._reach = safety.clearance_margin, base.reach
        self._start, self._growth = safety.start, safety.constraints.growth
        self._aside = AsideBatch(safety, self._search, constant, xp)
        self._furthest = max(robot.sight, base.reach)
        self._regressor = constant(np.array(robot.regressor))
        self._error = constant(np.array(robot.measurement_bound)[list(robot.regressor)])
        self._at_rest = constant(robot.zero_at_rest.astype(float))
        self._bounds = constant(FastRequestCheck(robot).bounds[:, :, None])
        self._domain = constant(safety.domain[:, :, None])
        ends = robot.low(), robot.high(), safety.inputs.low, safety.inputs.high
        self._recorded = tuple(constant(end[None]) for end in ends) if safety.inputs.narrower else ()
        self._schedule = constant(safety.inputs.schedule)
        self._general = SetBatch(self._constraints, safety.model, safety.tube, constant, xp)
        self._box, self._turning = None, self._general
        turning = safety.model.turning()
        if safety.in_place is not None and turning is not None:
            box, own = safety.in_place
            self._box = constant(box[:, :, None])
            self._turning = SetBatch(ConstraintBatch(own, constant, xp), turning, own.tube, constant, xp)
        rollout = self._constraints.tube.rollout
        self._score = None if rollout is None else ScoreBatch(safety.model, rollout, constant, xp)
        self._lanes, self._rows = LANES_ON_DEVICE, ROWS_ON_DEVICE
        if str(device) == "cpu":
            self._lanes, self._rows = PLAN_ROWS // rows_per_obstacle(self._constraints.N), ROWS

    def decide(self, requests: RequestArrays, answers: dict[str, Any]) -> Array:
        """Write the decisions that the batch can make into `answers`; return which rows (B,) they are."""
        xp, B = self._xp, len(requests)
        decided = xp.zeros(B, dtype=xp.bool, device=self._device)
        rows = xp.nonzero(self._usable(requests))[0]
        for first in range(0, rows.shape[0], MANY * self._lanes):
            many = rows[first : first + MANY * self._lanes]
            lanes, left = self._lanes_of(requests, many), []
            for part, own in self._sorted(lanes):
                to = xp.take(many, own, axis=0)
                done, rest = self._allow(requests, part, to, answers)
                decided[to[done]] = True
                left.append(own[rest])
            open_ = xp.concat(left)
            if open_.shape[0]:
                for part, own in self._sorted(taken(xp, lanes, open_)):
                    to = xp.take(many, xp.take(open_, own, axis=0), axis=0)
                    decided[to[self._adjust(requests, part, to, answers)]] = True
        return decided

    def _usable(self, requests: RequestArrays) -> Array:
        """Return which rows (B,) a batch may decide: valid, finite, with known surroundings."""
        xp, B = self._xp, len(requests)
        whole = xp.concat(
            [requests.state, requests.action, requests.input_in_force, xp.reshape(requests.plan, (B, -1))], axis=1
        )
        whole = xp.permute_dims(whole, (1, 0))
        good = xp.all((whole >= self._bounds[0]) & (whole <= self._bounds[1]), axis=0)
        good &= xp.all(xp.abs(requests.action) < HUGE, axis=1)
        if self._recorded:  # a proposal that was never recorded is not allowed as it stands
            low, high, least, most = self._recorded
            wanted = xp.minimum(xp.maximum(requests.action, low), high)
            good &= xp.all((wanted >= least) & (wanted <= most), axis=1)
        good &= plausible(xp, requests.obstacles)
        obstacles = requests.obstacles
        parts = obstacles.center, obstacles.axes, obstacles.half, obstacles.rho, obstacles.round, obstacles.margin
        for part in parts:
            finite = xp.abs(xp.reshape(part, (B, -1))) < HUGE
            good &= xp.all(finite, axis=1)
        good &= (obstacles.count > 0) | requests.known_free
        for factor in (requests.widening, requests.state_widening):
            if factor is not None:
                good &= (factor >= 1.0) & (factor < HUGE)
        if (predicted := requests.predicted) is not None:
            sets = xp.concat([predicted.center, predicted.half_width, predicted.heading[:, None]], axis=1)
            valid = xp.all(xp.abs(sets) < HUGE, axis=1) & xp.all(predicted.half_width >= 0.0, axis=1)
            good &= valid | ~predicted.given
        if (past := requests.past) is not None:
            window = xp.concat([xp.reshape(past.states, (B, -1)), xp.reshape(past.inputs, (B, -1))], axis=1)
            good &= xp.all(xp.abs(window) < HUGE, axis=1) | ~past.given
        return good & ~self._may_drive_already(requests)

    def _may_drive_already(self, requests: RequestArrays) -> Array:
        """Return the rows (B,) of `standing.may_drive_already`, and perhaps more: all of them are decided singly."""
        xp, model = self._xp, requests.model
        names = [model] * len(requests) if isinstance(model, str) else model
        first = xp.asarray(np.array([not name for name in names], dtype=bool), device=self._device)
        first &= xp.any(xp.abs(xp.take(requests.state, self._regressor, axis=1)) > self._error, axis=1)
        first &= xp.all(xp.abs(requests.input_in_force) * self._at_rest < STOPPED, axis=1)
        return first if requests.predicted is None else first & ~requests.predicted.given

    def _lanes_of(self, requests: RequestArrays, rows: Array) -> LaneBatch:
        """Return the lanes of some rows, with the obstacles within reach."""
        xp, robot, d, m = self._xp, self._robot, self._robot.position_dim, self._robot.action_dim

        def columns(part: Array) -> Array:
            part = xp.reshape(xp.take(part, rows, axis=0), (rows.shape[0], -1))
            return xp.asarray(xp.permute_dims(part, (1, 0)), copy=True)

        state, action, before = (columns(part) for part in (requests.state, requests.action, requests.input_in_force))
        plan = columns(requests.plan)
        given = robot.committed_steps * m
        z_0 = xp.concat([xp.take(state, self._regressor, axis=0), before, plan[:given]])
        proposal = self._search.limited(action, z_0[z_0.shape[0] - m :])
        asked = self._factor(requests.widening, requests, rows)
        state_widening = xp.maximum(asked, self._factor(requests.state_widening, requests, rows))
        widening = xp.where(asked > 1.0, asked * self._growth, asked)
        reach = xp.minimum(self._reach * widening, xp.full_like(widening, self._furthest))
        start = [state[i] for i in range(d)]
        obstacles = ObstacleArrays(*(xp.take(part, rows, axis=0) for part in vars(requests.obstacles).values()))
        near, beyond = within_reach(xp, obstacles, start, reach, robot.least_margin)
        beyond = xp.minimum(beyond, xp.full_like(beyond, robot.sight))
        far = (widening > 1.0) | self._constraints.base_far
        scene = SceneBatch(start, self._turn(state), near, beyond, widening, reach, far, asked, state_widening)
        return LaneBatch(scene, z_0, proposal, plan[given : robot.free_steps * m])

    def _factor(self, given: Array | None, requests: RequestArrays, rows: Array) -> Array:
        """Return given factors (B,) on the sets of rows: larger where an episode has begun, as in `Filter.decide`."""
        xp, past = self._xp, requests.past
        factor = xp.ones_like(rows, dtype=xp.float64) if given is None else xp.take(given, rows, axis=0)
        begun = xp.ones_like(rows, dtype=xp.bool) if past is None else ~xp.take(past.given, rows, axis=0)
        return xp.where(begun, factor * self._start, factor)

    def _turn(self, state: Array) -> TurnBatch:
        """Return the rotations from the robots' frames to the world."""
        if (heading := self._robot.heading) is None:
            return TurnBatch(None, None)
        return TurnBatch(self._xp.cos(state[heading]), self._xp.sin(state[heading]))

    def _sorted(self, lanes: LaneBatch) -> Any:
        """Yield lanes with about the same number of near obstacles, and their indices."""
        xp, near = self._xp, lanes.scene.near
        count = xp.sum(xp.astype(near.used, xp.int64), axis=0) if near.used.shape[0] else xp.zeros_like(lanes.z_0[0])
        order = xp.argsort(count, stable=True)
        first, rows = 0, rows_per_obstacle(self._constraints.N)
        while first < order.shape[0]:
            own = order[first : first + self._lanes]
            most = int(xp.max(xp.take(count, own, axis=0)))
            own = own[: max(FEWEST, self._rows // (rows * max(most, 1)))]
            first += own.shape[0]
            part = taken(xp, lanes, own)
            near = mapped(part.scene.near, itemgetter(slice(most)))
            yield replace(part, scene=replace(part.scene, near=near)), own

    def _allow(
        self, requests: RequestArrays, lanes: LaneBatch, rows: Array, answers: dict[str, Any]
    ) -> tuple[Array, Array]:
        """Decide lanes whose proposals are allowed at once; return their indices, and those of lanes to adjust."""
        xp, k = self._xp, self._domain.shape[1]
        in_domain = xp.all((lanes.z_0[:k] >= self._domain[0]) & (lanes.z_0[:k] <= self._domain[1]), axis=0)
        leave = in_place = xp.zeros_like(in_domain)
        if self._box is not None:
            z = self._search.regressors(lanes.z_0, lanes.proposal)
            within = (z >= self._box[0]) & (z <= self._box[1])
            leave = xp.all(within[: self._search.known], axis=0)  # a robot that stands may turn in place
            in_place = xp.all(within, axis=0)
        proposed = self._search.propose(lanes)
        done = xp.nonzero(proposed.allowed & in_domain & ~in_place)[0]
        if done.shape[0]:
            part, margin = taken(xp, proposed.plan, done), xp.take(proposed.margin, done, axis=-1)
            scene, to = taken(xp, lanes.scene, done), xp.take(rows, done, axis=0)
            self._write(self._general, requests, scene, part, margin, to, answers)
        rest = xp.nonzero(~proposed.allowed & ~proposed.unsure & ~leave & in_domain)[0]
        turning = xp.nonzero(in_place & in_domain)[0]
        if turning.shape[0]:
            done = xp.concat([done, self._allow_in_place(requests, lanes, turning, rows, answers)])
        return done, rest

    def _allow_in_place(
        self, requests: RequestArrays, lanes: LaneBatch, turning: Array, rows: Array, answers: dict[str, Any]
    ) -> Array:
        """Decide lanes whose proposals turn in place, if they are allowed at once; return the indices of these."""
        xp, constraints = self._xp, self._turning.constraints
        lanes = taken(xp, lanes, turning)
        scene = replace(lanes.scene, far=(lanes.scene.widening > 1.0) | constraints.base_far)
        plan = constraints.around(scene, self._search.regressors(lanes.z_0, lanes.proposal))
        margin = constraints.least(scene, plan.slack, plan.extent)
        # A plan in place needs no clearance margin.
        allowed = xp.nonzero((scene.near.none(xp, margin) & ~scene.far) | (margin >= ROUNDING))[0]
        if allowed.shape[0]:
            scene, plan, margin = taken(xp, scene, allowed), taken(xp, plan, allowed), taken(xp, margin, allowed)
            to = xp.take(rows, turning[allowed], axis=0)
            self._write(self._turning, requests, scene, plan, margin, to, answers)
        return turning[allowed]

    def _adjust(self, requests: RequestArrays, lanes: LaneBatch, rows: Array, answers: dict[str, Any]) -> Array:
        """Decide lanes whose proposals are not allowed at once; return the indices of those that are decided."""
        xp, c = self._xp, self._constraints
        proposed = self._search.propose(lanes)
        candidates = self._search.adjust(lanes, proposed)
        goes_on = candidates.hopeless & self._goes_on(requests, rows)
        self._aside.turn(lanes, candidates, self._asks_to_turn(requests, rows))
        done = xp.nonzero(candidates.allowed | candidates.adjusted | goes_on)[0]
        if not done.shape[0]:
            return done
        to, scene = xp.take(rows, done, axis=0), taken(xp, lanes.scene, done)
        margin = xp.take(proposed.margin, done, axis=-1)
        answers["proposal_margin"][to], plan = margin, taken(xp, proposed.plan, done)
        too_long = scene.far & ~(plan.extent < scene.reach)  # of a rollout that diverges: NaN
        answers["too_long_for"][to] = xp.where(too_long, scene.reach, xp.inf)
        for name, value in self._blocking(plan, scene, margin).items():
            getattr(answers["blocked"], name)[to] = value
        z = xp.where(goes_on, xp.concat([lanes.z_0, lanes.committed]), candidates.z)
        plan = c.around(scene, xp.take(z, done, axis=-1))
        least, own = c.least(scene, plan.slack, plan.extent), xp.take(candidates.margin, done, axis=0)
        margin = xp.where(xp.take(goes_on, done, axis=0), least, own)
        self._write(self._general, requests, scene, plan, margin, to, answers)
        braking = xp.take(rows, xp.nonzero(goes_on)[0], axis=0)
        answers["plan"][braking] = xp.take(requests.plan, braking, axis=0)
        kind = xp.where(goes_on, KINDS.index(FAILSAFE), xp.where(candidates.adjusted, KINDS.index(ADJUSTED), 0))
        answers["kind"][to] = xp.astype(xp.take(kind, done, axis=0), xp.int64)
        answers["for_clearance"][to] = xp.take(candidates.for_clearance & ~goes_on, done, axis=0)
        answers["turned"][to] = xp.take(candidates.turned, done, axis=0)
        answers["steps"][to] = xp.astype(xp.take(candidates.steps, done, axis=0), xp.int64)
        return done

    def _asks_to_turn(self, requests: RequestArrays, rows: Array) -> Array:
        """Return which of some rows let the filter turn a blocked robot aside (B,)."""
        xp, aside = self._xp, requests.turn_aside
        if isinstance(aside, bool):
            return xp.full_like(rows, aside, dtype=xp.bool)
        return xp.take(aside, rows, axis=0)

    def _goes_on(self, requests: RequestArrays, rows: Array) -> Array:
        """Return whether the committed plans of some rows still count as verified (B,): see `Filter.decide`.

        This model set verified the plan, and the measured state is in its predicted set. Such a robot recovers nowhere.
        """
        xp, model = self._xp, requests.model
        if isinstance(model, str):
            verified = xp.full_like(rows, model == self._version, dtype=xp.bool)
        else:
            own = [model[row] == self._version for row in on_host(rows).tolist()]
            verified = xp.asarray(np.array(own, dtype=bool), device=self._device)
        return verified & self._contained(requests, xp.take(requests.state, rows, axis=0), rows)

    def _write(
        self,
        sets: SetBatch,
        requests: RequestArrays,
        scene: SceneBatch,
        plan: PlanBatch,
        margin: Array,
        to: Array,
        answers: dict[str, Any],
    ) -> None:
        """Write the verified plans of the rows `to` as allowed ones. sets, scene, plan, margin: of these rows."""
        xp, robot = self._xp, self._robot
        centers, half = sets.constraints.sets(scene, plan)
        state = xp.take(requests.state, to, axis=0)
        predicted, predicted_half = sets.of_next_state(scene, plan)
        heading = xp.zeros_like(margin)
        if robot.heading is not None:
            heading = state[:, robot.heading]
            predicted[robot.heading] += heading
        margin, at_least = sets.constraints.clear(scene, plan, margin, scene.near.none(xp, margin))
        inputs = xp.permute_dims(self._schedule @ plan.z[robot.regressor_dim :], (1, 0))
        values = {
            "kind": xp.zeros_like(to),
            "plan": xp.reshape(inputs, (-1, robot.horizon, robot.action_dim)),
            "tube_center": xp.permute_dims(centers, (2, 0, 1)),
            "tube_half_width": xp.permute_dims(half, (2, 0, 1)),
            "predicted_center": xp.permute_dims(predicted, (1, 0)),
            "predicted_half_width": xp.permute_dims(predicted_half, (1, 0)),
            "predicted_heading": heading,
            "margin": margin,
            "at_least": at_least,
            "verified": xp.ones_like(at_least),
            "contained": self._contained(requests, state, to),
        }
        if requests.predicted is not None:
            values["compared"] = xp.take(requests.predicted.given, to, axis=0)
        for name, value in values.items():
            answers[name][to] = value
        self._write_scores(requests, state, to, answers)

    def _contained(self, requests: RequestArrays, state: Array, rows: Array) -> Array:
        """Return whether the measured states (B, n) of rows lie in their predicted sets: `Prediction.contains`."""
        xp, predicted, heading = self._xp, requests.predicted, self._robot.heading
        if predicted is None:
            return xp.ones_like(rows, dtype=xp.bool)
        own = mapped(predicted, lambda part: xp.take(part, rows, axis=0))
        return xp.all(own.errors(xp, state, heading) <= own.half_width + SAME_SET, axis=1) | ~own.given

    def _write_scores(self, requests: RequestArrays, state: Array, to: Array, answers: dict[str, Any]) -> None:
        """Write the scores of past windows."""
        xp, past = self._xp, requests.past
        if past is None or self._score is None:
            return
        given = xp.nonzero(xp.take(past.given, to, axis=0))[0]
        if not given.shape[0]:
            return
        to = xp.take(to, given, axis=0)
        states, inputs = (
            xp.asarray(xp.permute_dims(xp.take(part, to, axis=0), (1, 2, 0)), copy=True)
            for part in (past.states, past.inputs)
        )
        now = xp.asarray(xp.permute_dims(xp.take(state, given, axis=0), (1, 0)), copy=True)
        begun = xp.take(past.from_start, to, axis=0)
        for name, score in zip(("score", "plan_score"), self._score(states, inputs, now), strict=True):
            answers[name][to] = xp.where(begun, score / self._start, score)
        answers["scored"][to] = True

    def _blocking(self, plan: PlanBatch, scene: SceneBatch, margin: Array) -> dict[str, Array]:
        """Return the arrays of a `BlockingArrays` for proposals: `TubeConstraints.worst_of`."""
        xp, c = self._xp, self._constraints
        count, (K, B) = rows_per_obstacle(c.N), scene.near.rho.shape
        for_clearance = margin >= 0.0
        blocking = xp.where(for_clearance, self._clearance, 0.0)
        beyond = xp.where(scene.far, scene.reach - plan.extent, xp.inf)
        nowhere = xp.full((c.d, B), xp.nan, dtype=margin.dtype, device=self._device)
        period = xp.full_like(margin, self._robot.period * c.N)
        if not K:
            alone = xp.full(B, -1, dtype=xp.int64, device=self._device)
            places = xp.permute_dims(nowhere, (1, 0))
            return {"obstacle": alone, "room": beyond, "after": period, "normal": places, "at": places}
        # In the order of the single path's rows: disc, obstacle, end.
        short = xp.where(for_clearance, plan.slack - c.kept_off(plan.planes), plan.slack)
        slack, short = (
            xp.reshape(xp.permute_dims(xp.reshape(part, (len(c.discs), count, K, B)), (0, 2, 1, 3)), (-1, B))
            for part in (plan.slack, short)
        )
        row = xp.argmin(short, axis=0)
        least, shortest = (xp.take_along_axis(part, row[None], axis=0)[0] for part in (slack, short))
        sight = beyond - blocking < shortest
        sight = sight | ~scene.near.used[0]
        disc, which, end = row // (count * K), row // count % K, row % count
        when = xp.where(end < c.N, end, xp.minimum(end - c.N + 1, xp.full_like(end, c.N)))
        after = xp.where(sight, period, self._robot.period * xp.astype(when, margin.dtype))
        normal, at = c.surface(scene, plan, disc, which, end, when)
        gone = sight | ~xp.all(xp.isfinite(at), axis=0)
        return {
            "obstacle": xp.where(sight, -1, xp.take_along_axis(scene.near.slot, which[None], axis=0)[0]),
            "room": xp.where(sight, beyond, xp.maximum(least, -scene.reach)),
            "after": after,
            "normal": xp.permute_dims(xp.where(gone, xp.nan, normal), (1, 0)),
            "at": xp.permute_dims(xp.where(gone, xp.nan, at), (1, 0)),
        }


def as_constant(xp: Any, device: Any) -> Any:
    """Return a function that brings NumPy arrays to a namespace and a device: floats as float64, indices as int64."""

    def constant(array: Any) -> Array:
        kind = xp.int64 if np.asarray(array).dtype.kind in "iu" else xp.float64
        return xp.asarray(np.ascontiguousarray(array), dtype=kind, device=device)

    return constant
