"""A predictive safety filter with equations of motion that were derived by hand.

Wabersich and Zeilinger, "A predictive safety filter for learning-based control of constrained nonlinear dynamical
systems", Automatica 2021: execute the first input, closest to the proposal, of a plan that meets all constraints and
ends in a safe terminal set. Here the set is standstill, and the horizon that of the filter. The speeds follow their
inputs by a first-order lag of time constant τ; the model is a unicycle, or a vehicle whose inputs are velocities:

    min ‖u_0 − r‖²  s.t.  d_i(p(t; u)) >= body + margin  at all samples t,
                          low <= u_k <= high,  |u_k − u_{k−1}| <= slew,  u_{N−1} = 0
    p' = v (cos θ, sin θ),   θ' = ω,   τ v' = u_v − v,   τ ω' = u_ω − ω        (unicycle)
    p' = v,   τ v' = u − v                                                     (velocities)

Sequential quadratic programming solves it. Each program linearises the predicted positions in the inputs, and each
distance at its closest point. The first attempt starts at the proposal, the second one at the last plan, the third one
at standing. Without a solution, the robot follows its last plan, as in the article. The model is nominal, so the margin
alone allows for its error. The stochastic and robust versions in the article tighten constraints instead. With a hard
margin, a robot that stands a millimetre inside it has no plan any more, not even one that turns away. With a soft
margin (`soft` is 1), a plan of a robot inside it only has to come no nearer than the last plan.
"""

from __future__ import annotations

import math

import numpy as np

from brakeline.errors import BadModel
from brakeline.messaging.robot import Array
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.qp_solver import QuadraticProgram, solve
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Decision, Request
from brakeline.safety.model.model_config import PSF
from brakeline.safety.rivals.model_by_hand import RivalByHand, follows_velocities, is_unicycle
from brakeline.safety.rivals.pretrained import Pretrained

SETTINGS = ("lag", "margin")  # τ [s], margin around obstacles [m]
SOFT = "soft"  # optional, 0 to 1: share of the last plan's violation of the margin that the next plan may repeat
SAMPLES = 4  # of a period
STANDING = 4.0  # time constants after the first zero input until the robot counts as standing
ITERATIONS = 5  # quadratic programs from one start
CONVERGED = 1e-4  # of an input's range
LEAST_SLOPE = 1e-4  # m for an input's whole range: rows with smaller gradients are left out
ACCURACY = 1e-4  # m: a constraint violated by less is met
ACCURACY_OF_SOFT = 1e-5  # m: smaller, because the errors of an episode's steps can add up
LATER = 1e-2  # weight of later inputs in the cost; that of the first one is 1
STEP = 1e-4  # of an input's range, for derivatives


class PredictiveFilter(RivalByHand):
    """The predictive safety filter as a method of the comparison."""

    def __init__(self, model: Pretrained) -> None:
        """Make the method. Raises BadModel: the model is of another method, or does not fit."""
        fits = is_unicycle(model.robot) or follows_velocities(model.robot)
        super().__init__(model, PSF, SETTINGS, fits, "speed and turn rate, or velocities")
        robot = self.robot
        self._scale, self._free = robot.high() - robot.low(), robot.horizon - 1
        stopping = math.ceil(STANDING * self.settings["lag"] / robot.period)
        self._after = np.zeros((stopping - 1, robot.action_dim))  # inputs after the plan, until the robot stands
        self._soft = model.settings.get(SOFT, 0.0)
        if not 0.0 <= self._soft <= 1.0:
            raise BadModel(f"soft is {self._soft:g}: give 0 for a hard margin, 1 for a soft one, or a number between")
        self._accuracy = ACCURACY_OF_SOFT if self._soft else ACCURACY
        self._cost = np.tile([1.0, *[LATER] * (self._free - 1)], (robot.action_dim, 1)).T.ravel()

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the closest plan of the nominal model that is clear; without one, go on with the last plan."""
        wanted = braking_plan(self.robot, proposal)
        margin = self.settings["margin"]
        if self._soft:
            margin += self._soft * min(self._room(request, request.plan, margin), 0.0)
        room = self._room(request, wanted, margin)
        if room >= -self._accuracy:
            return self.decision(ALLOWED, wanted, room, started)
        starts = (wanted, request.plan, np.zeros_like(request.plan))
        solved = (self._solve(request, proposal, start, margin) for start in starts)
        plan = next((plan for plan in solved if plan is not None), None)
        if plan is None:
            reason = "the nominal model has no clear plan: the last one goes on"
            last = self._room(request, request.plan, margin)
            return self.decision(FAILSAFE, request.plan, last, started, reason=reason)
        reason = f"the proposal comes {-room:.3g} m too near by the nominal model"
        return self.decision(ADJUSTED, plan, self._room(request, plan, margin), started, reason=reason)

    def positions(self, state: Array, plans: Array) -> Array:
        """Return the positions (P, T, d) that the nominal model predicts for plans (P, N, m) until the robot stands."""
        robot, count = self.robot, len(plans)
        inputs = np.concatenate([plans, np.tile(self._after, (count, 1, 1))], axis=1)
        dt = robot.period / SAMPLES
        decay = math.exp(-dt / self.settings["lag"])
        lag = (1.0 - decay) * self.settings["lag"] / dt  # share of the old speed in the mean of a sample
        speeds = np.tile(state[robot.speed_indices], (count, 1))
        travelled = np.empty((count, inputs.shape[1] * SAMPLES, robot.action_dim))
        for i in range(travelled.shape[1]):
            u = inputs[:, i // SAMPLES]
            travelled[:, i] = dt * (u + (speeds - u) * lag)
            speeds = u + (speeds - u) * decay
        if robot.heading is not None:
            turned = travelled[..., 1]
            middle = state[robot.heading] + np.cumsum(turned, axis=1) - 0.5 * turned
            travelled = travelled[..., :1] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
        positions: Array = state[: robot.position_dim] + np.cumsum(travelled, axis=1)
        return positions

    def _room(self, request: Request, plan: Array, margin: float) -> float:
        """Return the least distance from the path of a plan to an obstacle, less a margin [m]."""
        path = self.positions(request.state, plan[None])[0]
        lengths, _ = self.distances(request, path)
        return float(lengths.min(initial=math.inf)) - margin

    def _solve(self, request: Request, proposal: Array, start: Array, margin: float) -> Array | None:
        """Return the plan (N, m) to which the programs converge from a start, if the nominal model is clear on it."""
        robot, free = self.robot, self._free
        limits, most = self._limits(request.input_in_force)
        wanted = (braking_plan(robot, proposal)[:free] / self._scale).ravel()
        z = (start[:free] / self._scale).ravel()
        for _ in range(ITERATIONS):
            A, b = self._rows(request, z, margin)
            program = QuadraticProgram(
                self._cost, -self._cost * wanted, np.vstack([A, limits]), np.concatenate([b, most]), len(limits)
            )
            solution = solve(program)
            if not solution.found or solution.residual > CONVERGED:
                return None
            moved, z = float(np.abs(solution.x - z).max()), solution.x
            if moved < CONVERGED:
                break
        plan = self._plan(z, request.input_in_force)
        return plan if self._room(request, plan, margin) >= -self._accuracy else None

    def _limits(self, before: Array) -> tuple[Array, Array]:
        """Return the bounds and the slew as rows A z <= b. before: the input in force."""
        robot, free, n = self.robot, self._free, self._free * self.robot.action_dim
        high, low = np.tile(robot.high() / self._scale, free), np.tile(robot.low() / self._scale, free)
        slew = np.tile(np.asarray(robot.action_slew) / self._scale, free + 1)
        within, none = np.eye(n), np.zeros((robot.action_dim, n))
        change = np.vstack([within, none]) - np.vstack([none, within])  # the last input, which is zero, changes too
        first = np.concatenate([before / self._scale, np.zeros(n)])
        rows = np.vstack([within, -within, change, -change])
        most = np.concatenate([high, -low, slew + first, slew - first])
        return rows[np.isfinite(most)], most[np.isfinite(most)]

    def _plan(self, z: Array, before: Array) -> Array:
        """Return the plan of scaled free inputs: clipped to the bounds and to the first slew, and zero at the end."""
        inputs = np.clip(z.reshape(self._free, -1) * self._scale, self.robot.low(), self.robot.high())
        inputs[0] = self.robot.clip_input(inputs[0], before)
        return np.vstack([inputs, np.zeros((1, self.robot.action_dim))])

    def _rows(self, request: Request, z: Array, margin: float) -> tuple[Array, Array]:
        """Return the distances that the inputs can change, linearised, as rows A z <= b of unit length."""
        steps = np.vstack([np.zeros_like(z), STEP * np.eye(len(z))])
        path = self.positions(request.state, np.stack([self._unclipped(z + step) for step in steps]))
        slopes = (path[1:] - path[0]) / STEP  # (free inputs, samples, d)
        lengths, normals = self.distances(request, path[0])
        rows = -np.einsum("isd,fsd->isf", normals, slopes).reshape(-1, len(z))
        level = (lengths - margin).ravel() + rows @ z
        sizes = np.linalg.norm(rows, axis=1)
        changes = sizes > LEAST_SLOPE
        return rows[changes] / sizes[changes, None], level[changes] / sizes[changes]

    def _unclipped(self, z: Array) -> Array:
        return np.vstack([z.reshape(self._free, -1) * self._scale, np.zeros((1, self.robot.action_dim))])
