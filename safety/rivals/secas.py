"""SECAS: correct the proposed action as little as a learned linear model of each constraint requires.

Dalal et al. 2018, "Safe Exploration in Continuous Action Spaces". For constraints c_i(s) ≤ C and networks g_i trained
beforehand on random actions,

    c_i(s') ≈ c_i(s) + g_i(s)ᵀ a                                                                    (their eq. 2)
    min ½‖a − r‖²  s.t.  c_i(s) + g_i(s)ᵀ a ≤ C                                                     (eq. 4)
    λ_i* = [(g_iᵀ r + c_i − C) / (g_iᵀ g_i)]₊,   a* = r − λ* g_{i*},   i* = argmax λ_i*             (eqs. 5 and 6)

The closed form applies if one constraint is active, and the QP with the input's bounds if several are. SECAS verifies
nothing and makes no plan: it predicts the next sample only, with fitting errors that nothing bounds.
"""

from __future__ import annotations

from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadModel
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.robot import Array, Robot, shipped_robots
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.qp_solver import QuadraticProgram, solve
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Decision, Request
from brakeline.safety.model.model_config import SECAS
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.rival import Rival

SECTOR = 0.55  # rad: width of a sector of rays, about
LAG = 0.5  # periods until an input takes effect
NEAR_MARGIN = 0.3  # m: nearby ranges reach this far beyond the footprint and twice the stopping distance
LEAST_GRADIENT = 1e-6  # m² per squared unit of scaled input: below it, the input does not move the constraint
TOLERANCE = 1e-6  # m: a constraint violated by less is met
SLACK_COST = 100.0  # of violating a unit row of the QP by 1; the cost of an input is at most about 4
SLACK_CURVATURE = 1e-3  # of the slack's cost, so that the QP is strictly convex


class Constraints:
    """The constraints c (K,) [m] of a state: for each sector of the lidar, the stopping distance minus the range.

        c_j = max over rays e of sector j:  T (v·e)₊ − min(range_e, near),      T the time in which braking covers v·T

    If a robot stops within a period, c is nearly −range. For a slower robot, the next sample's range alone would react
    too late. Ranges beyond `near` count as equal: obstacles that enter or leave a sector far away do not depend on the
    input and would dominate the fit.
    """

    def __init__(self, robot: Robot, rays: LidarRays) -> None:
        self.robot, self.directions, self.range = robot, rays.directions, rays.range
        self.stopping = robot.period * (0.5 * robot.brake_steps + LAG)  # s
        fastest = float(np.linalg.norm(np.where(robot.translates, robot.high(), 0.0)))
        self.near = min(rays.range, robot.footprint + NEAR_MARGIN + 2.0 * self.stopping * fastest)  # m
        self.sectors = _sectors(rays.directions)

    @property
    def count(self) -> int:
        return len(self.sectors)

    def __call__(self, observation: NDArray[np.floating], state: Array) -> Array:
        """Return c for an observation and the measured state."""
        speeds = state[self.robot.speed_indices]
        velocity = speeds if self.robot.heading is None else np.eye(self.directions.shape[1])[0] * speeds[0]
        ranges = np.minimum(np.asarray(observation[: len(self.directions)], float) * self.range, self.near)
        way = self.stopping * np.maximum(self.directions @ velocity, 0.0) - ranges
        return np.array([way[rays].max() for rays in self.sectors])


def _sectors(directions: Array) -> list[NDArray[np.intp]]:
    """Return the rays of each sector: equal shares of the azimuths and, for a flying robot, of the elevations."""
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    low, high = azimuth.min(), azimuth.max()
    count = max(1, round((high - low) / SECTOR))
    number = np.minimum((count * (azimuth - low) / (high - low) + 1e-9).astype(int), count - 1)
    if directions.shape[1] == 3:
        height = np.sign(np.round(directions[:, 2], 6)).astype(int) + 1
        number = number * 3 + height
    return [np.flatnonzero(number == n) for n in np.unique(number)]


def closed_form(r: Array, G: Array, d: Array) -> Array:
    """Return r (m,) corrected for the most violated of `G a ≤ d`, G (K, m), d (K,), without regard to the others."""
    square = (G * G).sum(axis=1)
    moved = square > LEAST_GRADIENT
    if not moved.any():
        return r
    multiplier = np.where(moved, np.maximum(G @ r - d, 0.0) / np.where(moved, square, 1.0), 0.0)
    most = int(multiplier.argmax())
    return np.asarray(r - multiplier[most] * G[most])


def quadratic(r: Array, G: Array, d: Array, low: Array, high: Array) -> tuple[Array, str, int]:
    """Return the a closest to r with `G a ≤ d` and `low ≤ a ≤ high`, the solver's status and its iterations.

    If no a meets all constraints, the worst violation is the least possible. If the solver fails, a is r.
    """
    size = np.sqrt((G * G).sum(axis=1))
    moved = size**2 > LEAST_GRADIENT
    rows, m = G[moved] / size[moved, None], len(r)
    k = len(rows)
    A = np.vstack([np.hstack([rows, -np.ones((k, 1))]), np.eye(m + 1)[:m], -np.eye(m + 1)])
    b = np.concatenate([d[moved] / size[moved], high, -low, [0.0]])
    program = QuadraticProgram(np.append(np.ones(m), SLACK_CURVATURE), np.append(-r, SLACK_COST), A, b)
    solution = solve(program)
    a = solution.x[:m] if solution.found else r
    return a, solution.status, solution.iterations


def _usual_rays(robot: Robot) -> LidarRays:
    """Return the rays of a robot's usual task, for older files without rays. Raises BadModel if there is none."""
    if robot.kind not in shipped_robots():
        raise BadModel(f"the model of {robot.name} does not hold the lidar's rays: pretrain it again")
    return robot_with_task(robot.kind).task.rays


class Secas(Rival):
    """The rule of SECAS with trained networks. Inputs are scaled by their upper bounds."""

    def __init__(self, model: Pretrained) -> None:
        """Make the method. Raises BadModel if the model is of another method or does not fit the robot."""
        super().__init__(model)
        rays = model.rays or _usual_rays(self.robot)
        self.constraints = Constraints(model.robot, rays)
        try:
            self.g, clearance = model.networks["g"], model.settings["clearance"]
        except KeyError as error:
            raise BadModel(f"no model of SECAS: {error} is missing") from error
        self.observed = self.g.inputs  # the size of an observation
        sized = (self.g.count, self.g.outputs) == (self.constraints.count, self.robot.action_dim)
        if model.method != SECAS or not sized or self.observed < len(rays.directions):
            sizes = self.g.count, self.g.inputs, self.g.outputs
            raise BadModel(f"no model of SECAS for {self.robot.name}: {model.method}, networks {sizes}")
        self.bound = -clearance
        self.scale = self.robot.high()

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the corrected proposal; brake if the linear model is not finite."""
        robot = self.robot
        c = self.constraints(request.observation, request.state)
        G, d = np.asarray(self.g(request.observation), float), self.bound - c
        if not (np.isfinite(G).all() and np.isfinite(d).all()):
            return self.braking(request, started, "the linear model of the constraints is not finite")
        action, solver, iterations, solve_ns = proposal, "", 0, 0
        r = proposal / self.scale
        if (G @ r - d > TOLERANCE).any():
            corrected = robot.clip_input(closed_form(r, G, d) * self.scale, request.input_in_force)
            if (G @ (corrected / self.scale) - d > TOLERANCE).any():  # several are active, or a bound is
                before = perf_counter_ns()
                low, high = self._bounds(request.input_in_force)
                a, solver, iterations = quadratic(r, G, d, low, high)
                solve_ns = perf_counter_ns() - before
                corrected = robot.clip_input(a * self.scale, request.input_in_force)
            action = corrected
        worst = float((d - G @ (action / self.scale)).min())
        changed = bool((np.abs(action - proposal) > TOLERANCE * self.scale).any())
        return self.decision(
            ADJUSTED if changed else ALLOWED,
            braking_plan(robot, action),
            worst,
            started,
            reason=f"sector {int((c + G @ r).argmax())} would come too near" if changed else "",
            solve_ms=solve_ns * 1e-6,
            solver=solver,
            iterations=iterations,
        )

    def _bounds(self, before: Array) -> tuple[Array, Array]:
        """Return the lowest and the highest scaled input that the slew allows after the one in force."""
        robot = self.robot
        return robot.clip_input(robot.low(), before) / self.scale, robot.clip_input(robot.high(), before) / self.scale
