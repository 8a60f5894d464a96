"""A control barrier function with a unicycle that somebody derived by hand: a peer of the filter for decisions.

Ames et al., "Control barrier functions: theory and applications", ECC 2019: keep h >= 0 by ḣ >= −α h. The unicycle's
inputs, speed v and turn rate ω, act at once. A point q = p + ℓ (cos θ, sin θ) ahead of its centre can move in every
direction, q̇ = G(θ) [v; ω], so that each obstacle gives a row of a QP in the inputs:

    h_i = |q − c_i| − (ρ_i + body + ℓ + margin),     min ‖u − r‖²  s.t.  n_iᵀ G u >= −α h_i,  low <= u <= high
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import NO_PREDICTION
from brakeline.safety.filter.braking import braking_decision, braking_plan
from brakeline.safety.filter.qp_solver import QuadraticProgram, solve
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Decision, Request

Array = NDArray[np.float64]

TOLERANCE = 1e-6  # of a scaled row: violated by less, it is met


@dataclass(frozen=True)
class Tuning:
    """The settings of a barrier: ahead ℓ [m], rate α [1/s], margin [m] around obstacles."""

    ahead: float
    rate: float
    margin: float


@dataclass(frozen=True)
class UnicycleBarrier:
    """The QP as a method of `InProcess`: a robot with the inputs [speed; turn rate] among cylinders."""

    robot: Robot
    tuning: Tuning
    version: str = "unicycle"
    observed: int = 0

    def decide(self, request: Request) -> Decision:
        """Return the input that is closest to the proposal and meets the barrier's rows; brake if there is none."""
        started = perf_counter_ns()
        robot, tuning = self.robot, self.tuning
        proposal = robot.clip_input(request.action, request.input_in_force)
        heading = float(request.state[2])
        ahead = np.array([math.cos(heading), math.sin(heading)])
        aside = np.array([-ahead[1], ahead[0]])
        gaps = request.state[:2] + tuning.ahead * ahead - request.obstacles.center
        lengths = np.linalg.norm(gaps, axis=1)
        h = lengths - (request.obstacles.rho + robot.footprint + tuning.ahead + tuning.margin)
        normals = gaps / lengths[:, None]
        scale = robot.high() - robot.low()
        rows = -np.column_stack([normals @ ahead, tuning.ahead * normals @ aside]) * scale
        sizes = np.maximum(np.linalg.norm(rows, axis=1), TOLERANCE)
        A, b = rows / sizes[:, None], tuning.rate * h / sizes
        wanted, action = proposal / scale, proposal
        if (A @ wanted > b + TOLERANCE).any():
            bounds = np.concatenate([robot.high() / scale, -robot.low() / scale])
            A, b = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([b, bounds])
            solution = solve(QuadraticProgram(np.ones(2), -wanted, A, b, always=4))
            if not solution.found or solution.residual > TOLERANCE:
                total = (perf_counter_ns() - started) * 1e-6
                return braking_decision(robot, request, self.version, "no input meets the barrier", total)
            action = robot.clip_input(solution.x * scale, request.input_in_force)
        nothing = np.zeros((0, robot.position_dim))
        return Decision(
            kind=ALLOWED if action is proposal else ADJUSTED,
            plan=braking_plan(robot, action),
            tube_center=nothing,
            tube_half_width=nothing,
            predicted=NO_PREDICTION,
            margin=float(h.min(initial=np.inf)),
            model=self.version,
            verified=False,
            time_ms=(perf_counter_ns() - started) * 1e-6,
        )
