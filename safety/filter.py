"""`decide`: a proposed action in, a verified plan out (paper, algorithm 1 lines 5-9 and algorithm 2; method §4).

A pure function of the request and the model set: no state is kept about a robot, so that any replica can answer and a
log can be replayed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from messaging.shapes import Shapes, rotate
from safety.commitment import Prediction
from safety.freespace import half_spaces
from safety.model_set import ModelSet
from safety.program import SHARPEN, Builder, Layout, Rows
from safety.solver import solve

Array = NDArray[np.float64]

ALLOWED, ADJUSTED, FAILSAFE = "allowed", "adjusted", "failsafe"
OUTSIDE_DOMAIN = 0.02  # of the recorded range: how far beyond it a regressor may lie (rounding, not extrapolation)
SAME_INPUT = 1e-6  # of the input's range: an answer this close to the proposal is the proposal


class BadRequest(ValueError):
    """A request that can't be decided on: `field` names what is wrong."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


class StaleModel(BadRequest):
    """The committed plan was verified by a model set that this filter never had."""


@dataclass(frozen=True)
class Request:
    """state (n,) measured; action (m,) proposed; input_in_force (m,) of the period before; plan (N, m): the committed
    plan's tail, verified by model set `model` (empty: standing still); obstacles: at least those within
    `Filter.reach`; predicted: what the last decision said of this state, if there was one."""

    state: Array
    action: Array
    input_in_force: Array
    plan: Array
    obstacles: Shapes
    model: str = ""
    predicted: Prediction | None = None
    observation: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))


@dataclass(frozen=True)
class Decision:
    """kind: allowed | adjusted | failsafe; plan (N, m), its first row is for now; tube: true positions at the N
    periods' ends, centers and half-widths (N, d), world; margin [m] to the nearest half-space, capped at the reach."""

    kind: str
    plan: Array
    tube_center: Array
    tube_half_width: Array
    predicted: Prediction
    margin: float
    model: str
    reason: str = ""
    verified: bool = True
    contained: bool = True
    compared: bool = False
    time_ms: float = 0.0
    solve_ms: float = 0.0
    verify_ms: float = 0.0
    solver: str = ""
    iterations: int = 0

    @property
    def action(self) -> Array:
        return np.asarray(self.plan[0])


@dataclass
class _Attempt:
    """What has been found out during one decision."""

    started: int
    solver: str = ""
    iterations: int = 0
    solve_ns: int = 0
    reason: str = ""


class Filter:
    """A model set made ready for decisions."""

    def __init__(self, model: ModelSet) -> None:
        self.model = model
        self.version = model.version
        self.robot = robot = model.robot
        self.tube, outer = model.tube(), model.outer_tube()
        self.layout = Layout(self.tube)
        self.outer_layout = self.layout if outer.generators == self.tube.generators else Layout(outer)
        self.builder = Builder(robot, outer)
        self.schedule = robot.schedule()
        self.measured = np.asarray(robot.measurement_bound[: robot.position_dim])
        spread = OUTSIDE_DOMAIN * (model.domain[1] - model.domain[0])
        self.domain = np.stack([model.domain[0] - spread, model.domain[1] + spread])
        self.standing = np.array([not moves for moves in robot.translates])
        driven = np.tile(robot.translates, robot.free_steps)
        self.translating = np.concatenate([np.zeros(robot.regressor_dim), driven])
        self.low, self.high, self.slew = robot.low(), robot.high(), np.asarray(robot.action_slew)
        self.regressor = list(robot.regressor)
        self.comfort = self._comfort()
        wanted = self._reach()
        self.reach = min(wanted, robot.sight)
        self.far = wanted > robot.sight  # a tube may leave what can be seen: every candidate must be looked at

    # --- what is known before any request ---------------------------------------------------------------------

    def _comfort(self) -> float:
        """[m]: as wide as the tube of moving in place ever gets, so that wherever the robot stopped it can still turn.

        Without it a robot may stop so close to an obstacle that no motion can be verified from there, for good.
        """
        robot, m = self.robot, self.robot.action_dim
        in_place = np.where(self.standing, self.high, 0.0)
        state = np.zeros(robot.state_dim)
        state[-m:] = in_place  # its speeds follow its inputs
        z = np.concatenate([state[self.regressor], in_place, np.tile(in_place, robot.free_steps)])
        sizes = self.tube.magnitudes(z)
        L, d = self.tube.generators, robot.position_dim
        directions = np.random.default_rng(0).normal(size=(64, d))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        width = np.abs(directions[:, None, None, :] @ self.tube.directions)[:, :, 0] @ sizes[:L]
        drift = np.abs((directions[:, None, None, :] @ self.tube.position)[:, :, 0] @ z)
        return float((width + drift).max() + sizes[L:].max())

    def _reach(self) -> float:
        """[m] from the robot's measured position: an obstacle beyond it can't meet any plan's tube.

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
        return float(np.linalg.norm(way, axis=1).max() + body + self.comfort)

    def _extent(self, z: Array) -> float:
        """[m] from the measured position to the farthest point that the body may reach under regressors z."""
        sizes = self.tube.magnitudes(z)
        L = self.tube.generators
        way = np.abs(self.tube.centers(z)) + np.abs(self.tube.directions) @ sizes[:L]
        body = self.robot.footprint + np.linalg.norm(self.measured) + sizes[L:].max()
        return float(np.linalg.norm(way, axis=1).max() + body)

    def half_width(self, speed: Array) -> float:
        """[m] of the full stop's set, largest axis, from driving at inputs `speed` (m,) with that input once more."""
        state = np.zeros(self.robot.state_dim)
        state[-len(speed) :] = speed
        z = np.concatenate([state[self.regressor], speed, np.tile(speed, self.robot.free_steps)])
        return float(self.tube.half_widths(z)[-1].max())

    # --- one decision ------------------------------------------------------------------------------------------

    def decide(self, request: Request) -> Decision:
        """The decision on one request, in this order: the proposal itself, the closest safe input, the committed plan.

        Raises:
            BadRequest: a value is missing, not finite or of the wrong size, with the field's name.
        """
        attempt = _Attempt(perf_counter_ns())
        self._check(request)
        compared = request.predicted is not None
        contained = request.predicted is None or request.predicted.contains(self.robot, request.state.copy())
        proposal = self._clipped(request)
        z_0 = np.concatenate([request.state[self.regressor], request.input_in_force])
        near = self._near(request)
        z = self._regressors(z_0, proposal)
        in_domain = bool((z_0 >= self.domain[0]).all() and (z_0 <= self.domain[1]).all())
        kind, free, margin, verified = FAILSAFE, None, self.reach, False
        if not in_domain:
            attempt.reason = "the state is outside the domain that was recorded"
        elif not len(near) and not (self.far and self._extent(z) > self.reach):
            kind, free, verified = ALLOWED, z[len(z_0) :], True
        else:
            kind, free, margin, verified = self._search(request, near, z_0, z, proposal, attempt)
        if free is not None:
            plan = (self.schedule @ free).reshape(self.robot.horizon, -1)
            if kind == ALLOWED:
                plan[0] = proposal
        else:
            trusted = contained and request.model in ("", self.version)
            plan, free, margin, verified = self._committed(request, near, z_0, trusted and in_domain)
            if not contained:
                attempt.reason += "; the measured state was outside the predicted set"
        decision = self._decision(request, kind, plan, np.concatenate([z_0, free]), margin, attempt)
        return replace(decision, verified=verified, contained=contained, compared=compared)

    def _search(
        self, request: Request, near: Shapes, z_0: Array, z: Array, proposal: Array, attempt: _Attempt
    ) -> tuple[str, Array | None, float, bool]:
        """The proposal if its tube is verified, else the QP's answer if that is, else nothing."""
        known = len(z_0)
        rows, outer = self._rows(request, near, z)
        stay = self._regressors(z_0, np.where(self.standing, proposal, np.clip(0.0, self.low, self.high)))
        kept = self._comfortable(rows, stay)
        margin = self._margin(kept, z)
        if margin >= 0.0:
            return ALLOWED, z[known:], margin, True
        attempt.reason = f"the proposal's tube leaves the free space by {-margin:.3g} m"
        for choice, outer_choice in (
            (kept, self._comfortable(outer, stay)),  # comfort margin kept, or at least not driven into
            (rows, outer),  # free space alone: from here even standing still would not keep the comfort margin
        ):
            if not np.isfinite(choice.bound).all():
                break
            candidate = self._closest(outer_choice, z_0, proposal, attempt)
            if candidate is None:
                continue
            margin = self._margin(choice, candidate)
            if margin >= 0.0:
                near_enough = np.abs(candidate[known : known + len(proposal)] - proposal) <= SAME_INPUT * self.high
                if near_enough.all() and self._margin(choice, z) >= 0.0:
                    return ALLOWED, z[known:], margin, True
                return ADJUSTED, candidate[known:], margin, True
        attempt.reason += "; no verified input was found"
        return FAILSAFE, None, margin, False

    def _closest(self, rows: Rows, z_0: Array, proposal: Array, attempt: _Attempt) -> Array | None:
        """The QP's answer, clipped, as regressors; None if there is no number in it."""
        before = perf_counter_ns()
        solution = solve(self.builder.program(rows, z_0, proposal))
        attempt.solve_ns += perf_counter_ns() - before
        attempt.solver, attempt.iterations = solution.status, attempt.iterations + solution.iterations
        if not solution.found:
            return None
        F = self.robot.free_steps
        free = np.clip(self.builder.inputs(solution.x), np.tile(self.low, F), np.tile(self.high, F))
        return np.concatenate([z_0, free])

    def _comfortable(self, rows: Rows, stay: Array) -> Rows:
        """Rows with the comfort margin. Where moving in place would not keep it, the tube may stay as near as the
        free space allows, but no input may translate the robot nearer: two rows instead of one."""
        tube = self.tube if rows.spread.shape[1] == len(self.tube.m_0) else self.builder.tube
        inside = rows.support(tube, stay) > rows.bound - self.comfort
        bound = np.where(inside, rows.bound, rows.bound - self.comfort)
        if not inside.any():
            return Rows(rows.gradient, rows.spread, bound)
        closer = rows.gradient[inside] * self.translating
        return Rows(
            np.vstack([rows.gradient, closer]),
            np.vstack([rows.spread, np.zeros((len(closer), rows.spread.shape[1]))]),
            np.concatenate([bound, closer @ stay + 2.0 * SHARPEN]),
        )

    def _margin(self, rows: Rows, z: Array) -> float:
        """Smallest distance [m] of the exact tube to a half-space; NaN never counts as inside."""
        margin = float((rows.bound - rows.support(self.tube, z)).min(initial=self.reach))
        if self.far:
            margin = min(margin, self.reach - self._extent(z))
        return margin if np.isfinite(margin) else -np.inf

    def _rows(self, request: Request, near: Shapes, z: Array) -> tuple[Rows, Rows]:
        """Rows of the exact tube and of the QP's, about the rollout of regressors z."""
        d, robot = self.robot.position_dim, self.robot
        start = request.state[:d]
        heading = request.state[robot.heading] if robot.heading is not None else 0.0
        nominal = start + rotate(self.tube.centers(z), heading)
        normals, offsets = half_spaces(near, start, nominal, robot.footprint, self.measured)
        local = rotate(normals, -heading)
        rows = self.layout.rows(local, offsets)
        return rows, rows if self.outer_layout is self.layout else self.outer_layout.rows(local, offsets)

    def _committed(self, request: Request, near: Shapes, z_0: Array, trusted: bool) -> tuple[Array, Array, float, bool]:
        """The committed plan, verified anew if it is not trusted; braking if it can't be. (plan, free, margin, ok)"""
        robot = self.robot
        free = request.plan[: robot.free_steps].ravel()
        represented = np.abs(self.schedule @ free - request.plan.ravel()).max() < 1e-9
        margin = self.reach
        if len(near):
            z = np.concatenate([z_0, free])
            margin = self._margin(self._rows(request, near, z)[0], z)
        if trusted or (represented and margin >= 0.0):
            return request.plan, free, margin, True
        left = np.maximum(1.0 - (np.arange(robot.horizon) + 1.0) / robot.brake_steps, 0.0)
        plan = left[:, None] * request.input_in_force
        return plan, plan[: robot.free_steps].ravel(), margin, False

    def _decision(
        self, request: Request, kind: str, plan: Array, z: Array, margin: float, attempt: _Attempt
    ) -> Decision:
        robot, d = self.robot, self.robot.position_dim
        heading = float(request.state[robot.heading]) if robot.heading is not None else 0.0
        centers = request.state[:d] + rotate(self.tube.centers(z), heading)
        turned = self.tube.directions if robot.heading is None else self._turned(heading)
        half = np.abs(turned) @ self.tube.magnitudes(z)[: self.tube.generators] + self.measured
        finished = perf_counter_ns()
        total, solved = (finished - attempt.started) * 1e-6, attempt.solve_ns * 1e-6
        return Decision(
            kind=kind,
            plan=plan,
            tube_center=centers,
            tube_half_width=half,
            predicted=self._predict(request, z, heading),
            margin=min(margin, self.reach),
            model=self.version,
            reason="" if kind == ALLOWED else attempt.reason,
            time_ms=total,
            solve_ms=solved,
            verify_ms=total - solved,
            solver=attempt.solver,
            iterations=attempt.iterations,
        )

    def _turned(self, heading: float) -> Array:
        cos, sin = np.cos(heading), np.sin(heading)
        turn = np.eye(self.robot.position_dim)
        turn[:2, :2] = (cos, -sin), (sin, cos)
        return np.asarray(turn @ self.tube.directions)

    def _predict(self, request: Request, z: Array, heading: float) -> Prediction:
        """The set of the next measured state, all coordinates."""
        robot, first = self.robot, self.model.first
        regressor = self.model.first_regressor(z)
        center = first.C @ regressor
        position = center[: robot.position_dim]
        center[: robot.position_dim] = request.state[: robot.position_dim] + rotate(position, heading)
        if robot.heading is not None:
            center[robot.heading] += heading
        return Prediction(center, first.half_widths(regressor), heading)

    # --- small steps -------------------------------------------------------------------------------------------

    def _clipped(self, request: Request) -> Array:
        low = np.maximum(self.low, request.input_in_force - self.slew)
        high = np.minimum(self.high, request.input_in_force + self.slew)
        return np.asarray(np.clip(request.action, low, high))

    def _regressors(self, z_0: Array, action: Array) -> Array:
        """z of an action followed by braking."""
        robot = self.robot
        left = np.maximum(1.0 - np.arange(robot.free_steps) / robot.brake_steps, 0.0)
        return np.concatenate([z_0, (left[:, None] * action).ravel()])

    def _near(self, request: Request) -> Shapes:
        if not len(request.obstacles):
            return request.obstacles
        distance = request.obstacles.distance(request.state[: self.robot.position_dim])
        return request.obstacles.take(distance <= self.reach)

    def _check(self, request: Request) -> None:
        robot = self.robot
        sizes = {
            "state": (robot.state_dim,),
            "action": (robot.action_dim,),
            "input_in_force": (robot.action_dim,),
            "plan": (robot.horizon, robot.action_dim),
        }
        for name, size in sizes.items():
            value = getattr(request, name)
            if value.shape != size:
                raise BadRequest(name, f"{name} has shape {value.shape}, a {robot.name} robot's has {size}")
            if not np.isfinite(value).all():
                raise BadRequest(name, f"{name} holds NaN or infinity")
        if (request.plan < self.low - 1e-9).any() or (request.plan > self.high + 1e-9).any():
            raise BadRequest("plan", "the committed plan has an input out of the robot's bounds")
        if request.predicted is not None and not (
            request.predicted.center.shape == request.predicted.half_width.shape == (robot.state_dim,)
        ):
            raise BadRequest("predicted_center", f"a prediction has {robot.state_dim} coordinates")


__all__ = ["ADJUSTED", "ALLOWED", "FAILSAFE", "BadRequest", "Decision", "Filter", "Prediction", "Request", "StaleModel"]
