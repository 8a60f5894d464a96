"""`decide`: a proposed action in, a verified plan out (paper, algorithm 1 lines 5-9 and algorithm 2; method §4).

A pure function of the request and the model set: no state is kept about a robot, so that any replica can answer and a
log can be replayed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from messaging.movers import Movers
from messaging.robots import Robot
from messaging.scans import Scan
from messaging.shapes import Shapes
from safety import scan as seen
from safety.commitment import UNVERIFIED, Prediction
from safety.explain import SIGHT, Around, Stopped, worst
from safety.freespace import half_spaces
from safety.limits import Limits, stacked
from safety.model_set import ModelSet, needed
from safety.program import SHARPEN, Builder, Layout, Rows
from safety.promise import Boxes, Promise, Promises, promised_half_spaces
from safety.recovery import SLOW, least_violating, slow_inputs, turn_towards
from safety.request import ADJUSTED, ALLOWED, FAILSAFE, RECOVERING, Decision, Request, check_for_filter
from safety.solver import INFEASIBLE, solve
from safety.sweep import swept_half_spaces
from safety.tube import Tube

Array = NDArray[np.float64]

OUTSIDE_DOMAIN = 0.02  # of the recorded range: how far beyond it a regressor may lie (rounding, not extrapolation)
SAME_INPUT = 1e-6  # of the input's range: an answer this close to the proposal is the proposal


@dataclass(frozen=True)
class _Disc:
    """A disc of the body with the tube of its centre. at (d,): in the robot's frame; swing [m]: what an error of the
    measured heading adds to where it is."""

    at: Array
    radius: float
    swing: float
    position: Array
    layout: Layout


def _discs(robot: Robot, tube: Tube) -> list[_Disc]:
    d, found = robot.position_dim, []
    after = len(needed(robot)) - d * sum(disc.arm > 0.0 for disc in robot.body)
    for disc in robot.body:
        position, directions, swing = tube.position, tube.directions, 0.0
        if disc.arm and robot.heading is not None:
            position, directions = tube.more[:, after : after + d], tube.more_directions[:, after : after + d]
            swing = disc.arm * robot.measurement_bound[robot.heading]
            after += d
        found.append(_Disc(np.asarray(disc.at), disc.radius, swing, position, Layout(position, directions)))
    return found


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
    stopped: Stopped | None = None


@dataclass(frozen=True)
class _Scene:
    """start (d,): the measured position; turn (d, d): world from the frame of now; near: the obstacles that
    count; away (n,): how far [m] all that were told of are."""

    start: Array
    heading: float
    turn: Array
    near: Shapes
    away: Array
    moving: Movers | None = None  # that may meet the tube
    unseen: seen.Cells | None = None  # what a scan does not show to be free
    promised: Promises | None = None  # to other robots

    @property
    def empty(self) -> bool:
        return not len(self.near) and self.moving is None and self.unseen is None and self.promised is None


@dataclass(frozen=True)
class _Found:
    """A plan (N, m) and the regressors z of its tube."""

    kind: str
    plan: Array
    z: Array
    margin: float
    verified: bool
    kept: bool = False  # the committed plan goes on as it was verified before


class Filter:
    """A model set made ready for decisions."""

    def __init__(self, model: ModelSet, comfort: float | None = None) -> None:
        """`comfort` [m]: what is kept to obstacles beyond the tube; as wide as it needs be, unless given."""
        self.model = model
        self.version = model.version
        self.robot = robot = model.robot
        self.tube, outer = model.tube(), model.outer_tube()
        self.discs = _discs(robot, self.tube)
        self.boxes = Boxes(self.tube.position, self.tube.directions)
        self.limits = Limits(robot, self.tube) if robot.limits else None
        self.builder = Builder(robot, outer)
        self.schedule = robot.schedule()
        self.measured = np.asarray(robot.measurement_bound[: robot.position_dim])
        spread = OUTSIDE_DOMAIN * (model.domain[1] - model.domain[0])
        self.domain = np.stack([model.domain[0] - spread, model.domain[1] + spread])
        self.standing = np.array([not moves for moves in robot.translates])
        driven = np.tile(robot.translates, robot.free_steps)
        self.translating = np.concatenate([np.zeros(robot.regressor_dim), driven])
        self.low, self.high, self.slew = robot.low(), robot.high(), np.asarray(robot.action_slew)
        self.nothing = robot.at_zero()
        self.braking = robot.fractions()[: robot.free_steps - robot.given]
        self.regressor = list(robot.regressor)
        self.comfort = self._comfort() if comfort is None else comfort
        self.widest = self._widest()
        wanted = self.widest + self.comfort
        self.reach = min(wanted, robot.sight)  # m from the measured position: an obstacle beyond it decides nothing
        self.far = wanted > robot.sight  # a tube may leave what can be seen: every candidate must be looked at

    # --- what is known before any request ---------------------------------------------------------------------

    def _comfort(self) -> float:
        """[m]: as wide as the tube of moving in place ever gets, so that wherever the robot stopped it can still turn.

        Without it a robot may stop so close to an obstacle that no motion can be verified from there, for good.
        """
        robot = self.robot
        in_place = np.where(self.standing, self.high, 0.0)
        state = robot.driving(in_place)
        z = np.concatenate([state[self.regressor], in_place, np.tile(in_place, robot.free_steps)])
        sizes = self.tube.magnitudes(z)
        L, d = self.tube.generators, robot.position_dim
        directions = np.random.default_rng(0).normal(size=(64, d))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        width = np.abs(directions[:, None, None, :] @ self.tube.directions)[:, :, 0] @ sizes[:L]
        drift = np.abs((directions[:, None, None, :] @ self.tube.position)[:, :, 0] @ z)
        return float((width + drift).max() + sizes[L:].max())

    def _widest(self) -> float:
        """[m] from the robot's measured position: no plan's tube, with the body about it, goes beyond.

        By interval arithmetic over the box of all regressors, so wide for certificates whose atoms mix them.
        """
        robot, tube = self.robot, self.builder.tube
        F = robot.free_steps
        low = np.concatenate([self.domain[0], np.tile(self.low, F)])
        high = np.concatenate([self.domain[1], np.tile(self.high, F)])
        z = np.maximum(np.abs(low), np.abs(high))
        sizes = tube.M @ (np.abs(tube.W) @ z) + tube.m_0
        way = np.abs(tube.position) @ z + np.abs(tube.directions) @ sizes[: tube.generators]
        body = robot.footprint + np.linalg.norm(self.measured) + sizes[tube.generators :].max()
        return float(np.linalg.norm(way, axis=1).max() + body)

    def _extent(self, z: Array) -> float:
        """[m] from the measured position to the farthest point that the body may reach under regressors z."""
        sizes = self.tube.magnitudes(z)
        L = self.tube.generators
        way = np.abs(self.tube.centers(z)) + np.abs(self.tube.directions) @ sizes[:L]
        body = self.robot.footprint + np.linalg.norm(self.measured) + sizes[L:].max()
        return float(np.linalg.norm(way, axis=1).max() + body)

    def half_width(self, speed: Array) -> float:
        """[m] of the full stop's set, largest axis, from driving at inputs `speed` (m,) with that input once more."""
        state = self.robot.driving(speed)
        z = np.concatenate([state[self.regressor], speed, np.tile(speed, self.robot.free_steps)])
        return float(self.tube.half_widths(z)[-1].max())

    # --- one decision ------------------------------------------------------------------------------------------

    def decide(self, request: Request) -> Decision:
        """The decision on one request, in this order: the proposal itself, the closest safe input, the committed plan.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size, with the field's name.
        """
        attempt = _Attempt(perf_counter_ns())
        check_for_filter(self.robot, request)
        attempt.contained = request.predicted is None or request.predicted.contains(self.robot, request.state)
        attempt.broken = 0 if request.movers is None else int((~request.movers.kept).sum())
        given = request.plan[: self.robot.given].ravel()
        z_0 = np.concatenate([request.state[self.regressor], request.input_in_force, given])
        proposal = self._limited(request.action, z_0[-self.robot.action_dim :])
        scene = self._scene(request)
        recorded = z_0[: self.robot.regressor_dim]
        in_domain = bool(((recorded >= self.domain[0]) & (recorded <= self.domain[1])).all())
        found = None
        if attempt.broken:
            attempt.reason = (
                "an obstacle was seen outside of what its bounds allow: nothing is known of where it will be"
            )
        elif in_domain:
            found = self._search(scene, z_0, proposal, attempt)
        else:
            attempt.reason = "the state is outside the domain that was recorded"
        if found is None:
            found = self._committed(request, scene, z_0, attempt, in_domain)
            if in_domain and not attempt.broken and request.promise is None:  # others rely on a promise
                found = self._recovered(request, scene, z_0) or found
        return self._decision(request, scene, found, attempt)

    def _search(self, scene: _Scene, z_0: Array, proposal: Array, attempt: _Attempt) -> _Found | None:
        """The proposal if its tube is verified, else the QP's answer if that is, else nothing."""
        known, m = len(z_0), len(proposal)
        z = self._regressors(z_0, proposal)
        if scene.empty and not self.far and self.limits is None:
            return _Found(ALLOWED, self._plan(z), z, self.reach, True)
        rows = self._rows(scene, z)
        slack = rows.bound - rows.support(self.tube, z)
        margin = self._least(slack, z)
        if self._least(slack - self.comfort * rows.keep, z, self.comfort) >= 0.0:
            return _Found(ALLOWED, self._plan(z), z, margin, True)
        kept = self._comfortable(rows, z_0, proposal)
        if margin >= 0.0 and self._margin(kept, z) >= 0.0:
            return _Found(ALLOWED, self._plan(z), z, margin, True)
        attempt.reason = f"the proposal's tube comes within {margin:.3g} m of the free space's edge"
        attempt.stopped = self._worst(scene, z, slack)
        # Keeping the comfort margin, or at least not driving into it; else free space alone: from here even standing
        # still would not do.
        for choice in (kept, rows):
            if not np.isfinite(choice.bound).all():
                break
            candidate = self._closest(choice, z_0, proposal, attempt)
            if candidate is None or self._margin(choice, candidate) < 0.0:
                continue
            near_enough = np.abs(candidate[known : known + m] - proposal) <= SAME_INPUT * (self.high - self.low)
            if near_enough.all() and self._margin(choice, z) >= 0.0:
                return _Found(ALLOWED, self._plan(z), z, margin, True)
            return _Found(ADJUSTED, self._plan(candidate), candidate, self._margin(rows, candidate), True)
        attempt.reason += "; no verified input was found"
        return None

    def _worst(self, scene: _Scene, z: Array, slack: Array) -> Stopped:
        """What the proposal, regressors z, comes nearest to."""
        beyond = self.reach - self._extent(z) if self.far else np.inf
        if not len(slack) or beyond < slack.min():
            return Stopped.nowhere(SIGHT, beyond, self.robot.period * self.robot.horizon)
        nominal = []
        for disc in self.discs:
            start = scene.start + scene.turn @ disc.at
            nominal.append((start, start + disc.position @ z @ scene.turn.T))
        row = int(np.argmin(slack))
        around = Around(scene.near, scene.moving, scene.unseen, scene.promised)
        return worst(row, max(float(slack[row]), -self.reach), self.robot, around, nominal)

    def _closest(self, rows: Rows, z_0: Array, proposal: Array, attempt: _Attempt) -> Array | None:
        """The QP's answer, clipped to bounds and slew, as regressors; None if there is no number in it."""
        before = perf_counter_ns()
        program = self.builder.program(rows, z_0, proposal)
        solution = solve(program) if program is not None else INFEASIBLE
        attempt.solve_ns += perf_counter_ns() - before
        attempt.solver, attempt.iterations = solution.status, attempt.iterations + solution.iterations
        if not solution.found:
            return None
        free = self._within(self.builder.inputs(solution.x), z_0[-self.robot.action_dim :])
        return np.concatenate([z_0, free])

    def _comfortable(self, rows: Rows, z_0: Array, proposal: Array) -> Rows:
        """Rows with the comfort margin. Where moving in place would not keep it, the tube may stay as near as the
        free space allows, but no input may translate the robot nearer (one that can't stop at once: not more than
        the strongest braking does): two rows instead of one."""
        in_place = self._limited(np.where(self.standing, proposal, self.nothing), z_0[-len(proposal) :])
        stay = self._regressors(z_0, in_place)
        comfort = self.comfort * rows.keep
        inside = rows.support(self.tube, stay) > rows.bound - comfort
        bound = np.where(inside, rows.bound, rows.bound - comfort)
        if not inside.any():
            return replace(rows, bound=bound)
        closer = rows.gradient[inside] * self.translating
        return Rows(
            np.vstack([rows.gradient, closer]),
            np.vstack([rows.spread, np.zeros((len(closer), rows.spread.shape[1]))]),
            np.concatenate([bound, closer @ stay + 2.0 * SHARPEN]),
            np.concatenate([rows.keep, np.zeros(len(closer))]),
        )

    def _margin(self, rows: Rows, z: Array) -> float:
        """Smallest distance [m] of the exact tube to a half-space (of a limit: in its own units)."""
        return self._least(rows.bound - rows.support(self.tube, z), z)

    def _least(self, slack: Array, z: Array, comfort: float = 0.0) -> float:
        """The smallest slack, within ± the reach (less the comfort); NaN never counts as inside."""
        most = self.reach - comfort
        margin = float(slack.min(initial=most))
        if self.far:
            margin = min(margin, most - self._extent(z))
        return max(margin, -self.reach) if margin == margin else -self.reach

    def _rows(self, scene: _Scene, z: Array) -> Rows:
        """Half-spaces about the rollout of regressors z, as rows of the tube (and of the QP's: its generators are the
        same, only their magnitudes are not)."""
        parts = []
        for disc in self.discs:
            start, measured = scene.start + scene.turn @ disc.at, self.measured + disc.swing
            nominal = start + disc.position @ z @ scene.turn.T
            normals, offsets = half_spaces(scene.near, start, nominal, disc.radius, measured)
            if scene.moving is not None:
                swept = swept_half_spaces(scene.moving, start, nominal, disc.radius, measured, self.robot.period)
                normals, offsets = np.concatenate([normals, swept[0]]), np.concatenate([offsets, swept[1]])
            if scene.unseen is not None:
                beside = seen.half_spaces(scene.unseen, start, nominal, disc.radius, measured, self.robot.period)
                normals, offsets = np.concatenate([normals, beside[0]]), np.concatenate([offsets, beside[1]])
            parts.append(disc.layout.rows(normals @ scene.turn, offsets))
        if scene.promised is not None:
            nominal = scene.start + self.tube.centers(z) @ scene.turn.T
            body = self.robot.footprint
            kept = promised_half_spaces(scene.promised, scene.start, nominal, body, self.measured)
            parts.append(self.boxes.rows(*kept, scene.turn))
        if self.limits is not None:
            parts.append(self.limits.rows(scene.start, scene.heading, scene.turn))
        return stacked(parts)

    def _committed(self, request: Request, scene: _Scene, z_0: Array, attempt: _Attempt, in_domain: bool) -> _Found:
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
            tail = np.vstack([self.robot.braked(tail[:1], request.state, before), tail[1:]])
        chosen = tail[self.robot.given : self.robot.free_steps].ravel()
        as_committed = np.concatenate([z_0, chosen])
        if attempt.contained and vouched:
            margin = self._margin(self._rows(scene, as_committed), as_committed)
            return _Found(FAILSAFE, tail, as_committed, margin, True, kept=True)
        brake = self._regressors(z_0, self._stop(request.state, before))
        as_committed[len(z_0) :] = self._within(chosen, before)
        for z in (as_committed, brake):
            margin = self._margin(self._rows(scene, z), z)
            if in_domain and margin >= 0.0:
                return _Found(FAILSAFE, self._plan(z), z, margin, True)
        return _Found(FAILSAFE, self._plan(brake), brake, margin, False)

    def _recovered(self, request: Request, scene: _Scene, z_0: Array) -> _Found | None:
        """A slow way out, if it stands (or is on such a way) where not even standing can be verified: by more than
        the errors of two measurements could make it seem so."""
        robot, m = self.robot, self.robot.action_dim
        slow = np.where(robot.translates, SLOW + 0.05, 1.0) * np.maximum(self.high, -self.low)
        going = request.input_in_force
        on_a_way = request.model == UNVERIFIED and bool(going.any() and (np.abs(going) <= slow).all())
        if not (request.still(robot) or on_a_way):
            return None
        before = z_0[-m:]
        stand = self._regressors(z_0, self._stop(request.state, before))
        parked = replace(scene, moving=None)  # what moves may stand by: that is its affair
        seeming = 0.0 if on_a_way else 2.0 * float(np.linalg.norm(self.measured)) + self.comfort
        if self._margin(self._rows(parked, stand), stand) >= -seeming:
            return None
        rows = self._rows(scene, stand)
        if not np.isfinite(rows.bound).all():  # of one that is touched, or is no number, no side is known
            return None
        standing = rows.support(self.tube, stand) - rows.bound
        inputs = np.array([self._limited(wanted, before) for wanted in slow_inputs(robot)])
        plans = [self._regressors(z_0, action) for action in inputs]
        violated = np.array([rows.support(self.tube, z) - rows.bound for z in plans])
        ends = np.zeros(len(rows.bound), dtype=bool)
        obstacles = len(scene.near) + (len(scene.moving) if scene.moving is not None else 0)
        obstacles += len(scene.unseen) if scene.unseen is not None else 0
        each = 2 * robot.horizon + 1
        ends[each - 1 : len(self.discs) * obstacles * each : each] = True
        best = least_violating(violated, standing, ends, self.comfort)
        if best is not None:
            z = plans[best]
        elif robot.heading is not None and len(scene.near):
            ways = scene.near.towards(scene.start)
            away = -ways[np.argmin(np.einsum("nd,nd->n", ways, ways))]
            z = self._regressors(z_0, self._limited(turn_towards(robot, scene.heading, away), before))
        else:
            return None
        return _Found(RECOVERING, self._plan(z), z, self._margin(rows, z), False)

    def _decision(self, request: Request, scene: _Scene, found: _Found, attempt: _Attempt) -> Decision:
        z = found.z
        centers = scene.start + self.tube.centers(z) @ scene.turn.T
        sizes = self.tube.magnitudes(z)[: self.tube.generators]
        half = np.abs(scene.turn @ self.tube.directions) @ sizes + self.measured
        promise = request.promise
        if promise is not None and not found.kept:
            promise = self._promise(scene.start, centers, half, z)
        predicted = self._predict(scene, z)
        margin, at_least = self._clear(request, scene, found)
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
            stopped=None if found.kind == ALLOWED else attempt.stopped,
            promise=promise,
        )

    def rest(self, state: Array) -> Promise:
        """What a robot promises that stands, and goes on standing, in a measured state (n,)."""
        z = np.concatenate([state[self.regressor], np.tile(self.nothing, 1 + self.robot.free_steps)])
        heading = float(state[self.robot.heading]) if self.robot.heading is not None else 0.0
        turn, start = self._turn(heading), state[: self.robot.position_dim]
        sizes = self.tube.magnitudes(z)[: self.tube.generators]
        half = np.abs(turn @ self.tube.directions) @ sizes + self.measured
        return self._promise(start, start + self.tube.centers(z) @ turn.T, half, z)

    def _promise(self, start: Array, centers: Array, half: Array, z: Array) -> Promise:
        """Of a tube with these sets (N, d), world, and regressors z."""
        about = self.tube.magnitudes(z)[self.tube.generators : -1]
        about[-1] = max(about[-1], float(self.tube.magnitudes(z)[-1]))
        centers, half = np.vstack([start, centers]), np.vstack([self.measured, half])
        return Promise.of(centers, half, self.robot.footprint + about)

    def _clear(self, request: Request, scene: _Scene, found: _Found) -> tuple[float, bool]:
        """Smallest distance [m] of the tube to what is in sight; True: nothing is, the end of sight is as near.

        What is beyond the reach decides nothing, but it may be what is nearest to the tube.
        """
        if self.far:
            return found.margin, found.margin >= self.reach - self._extent(found.z)
        if found.margin + self.widest <= self.reach:
            return found.margin, False
        most = self.robot.sight - self.widest
        in_sight = request.obstacles.take(~(scene.away > self.robot.sight))
        if not len(in_sight) and request.movers is None and scene.unseen is None and request.promised is None:
            return most, True
        rows = self._rows(replace(scene, near=in_sight, moving=request.movers, promised=request.promised), found.z)
        margin = float((rows.bound - rows.support(self.tube, found.z)).min(initial=most))
        return margin, margin == most

    def _predict(self, scene: _Scene, z: Array) -> Prediction:
        """The set of the next measured state, all coordinates."""
        robot, first, d = self.robot, self.model.first, self.robot.position_dim
        regressor = self.model.first_regressor(z)
        center = (first.C @ regressor)[: robot.state_dim]
        center[:d] = scene.start + scene.turn @ center[:d]
        if robot.heading is not None:
            center[robot.heading] += scene.heading
        return Prediction(center, first.half_widths(regressor)[: robot.state_dim], scene.heading)

    def _stop(self, state: Array, before: Array) -> Array:
        """The strongest braking's next input: to zero, held, or what the feedback makes of the state."""
        wanted = np.where(self.robot.stopping, self.nothing, before)
        return self._limited(self.robot.braked(wanted, state, before), before)

    # --- small steps -------------------------------------------------------------------------------------------

    def _limited(self, wanted: Array, before: Array) -> Array:
        """The input closest to the wanted one within bounds and slew."""
        low, high = np.maximum(self.low, before - self.slew), np.minimum(self.high, before + self.slew)
        return np.asarray(np.minimum(np.maximum(wanted, low), high))

    def _within(self, free: Array, before: Array) -> Array:
        """Free inputs (F·m,) brought within bounds and slew, one after the other."""
        inputs = free.reshape(-1, self.robot.action_dim).copy()
        for k in range(len(inputs)):
            before = inputs[k] = self._limited(inputs[k], before)
        return inputs.ravel()

    def _regressors(self, z_0: Array, action: Array) -> Array:
        """z of an action followed by braking."""
        return np.concatenate([z_0, (self.braking * action).ravel()])

    def _plan(self, z: Array) -> Array:
        """The inputs (N, m) that regressors z speak of."""
        return (self.schedule @ z[self.robot.regressor_dim :]).reshape(self.robot.horizon, -1)

    def _scene(self, request: Request) -> _Scene:
        d, robot = self.robot.position_dim, self.robot
        start, near = request.state[:d], request.obstacles
        heading = float(request.state[robot.heading]) if robot.heading is not None else 0.0
        turn = self._turn(heading)
        away = near.distance(start) - near.margin if len(near) else np.zeros(0)
        if len(near):
            # One whose distance is no number stays.
            near = near.take(~(away > self.reach))
        moving = request.movers
        if moving is not None:
            within = robot.horizon * robot.period
            moving = moving.take(~(moving.least_distance(start, within) > self.reach))
            moving = moving if len(moving) else None
        unseen = None if request.scan is None else self._unseen(request.scan, start)
        promised = None if request.promised is None else request.promised.within(start, self.reach)
        return _Scene(start, heading, turn, near, away, moving, unseen, promised)

    def _turn(self, heading: float) -> Array:
        """(d, d), world from the frame of now."""
        turn = np.eye(self.robot.position_dim)
        cos, sin = math.cos(heading), math.sin(heading)
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = cos, -sin, sin, cos
        return turn

    def _unseen(self, scan: Scan, start: Array) -> seen.Cells | None:
        """What is not known to be free within reach, or may come there before a plan ends."""
        within = self.reach + scan.speed * (scan.age + self.robot.horizon * self.robot.period)
        within += float(np.linalg.norm(scan.sensor()[0] - start)) + scan.position_error
        cells = seen.cells(scan, within + scan.heading_error * within)
        return cells if len(cells) else None
