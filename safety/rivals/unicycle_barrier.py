"""A control barrier function with a unicycle that somebody derived by hand.

Ames et al., "Control barrier functions: theory and applications", ECC 2019: keep h >= 0 by ḣ >= −α h. The unicycle's
inputs, speed v and turn rate ω, act at once. A point q = p + ℓ (cos θ, sin θ) ahead of its centre can move in every
direction, q̇ = G(θ) [v; ω], so that each obstacle gives a row of a QP in the inputs. With d the distance of the point
from the obstacle and n the direction away:

    h_i = d_i(q) − (body + ℓ + margin),     min ‖u − r‖²  s.t.  n_iᵀ G u >= −α h_i,  low <= u <= high
"""

from __future__ import annotations

import math

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.qp_solver import QuadraticProgram, solve
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Decision, Request
from brakeline.safety.model.model_config import CBF
from brakeline.safety.rivals.model_by_hand import RivalByHand, is_unicycle
from brakeline.safety.rivals.pretrained import Pretrained

TOLERANCE = 1e-6  # of a scaled row: violated by less, it is met
SETTINGS = ("ahead", "rate", "margin")  # ℓ [m], α [1/s], margin around obstacles [m]


class UnicycleBarrier(RivalByHand):
    """The QP as a method."""

    def __init__(self, model: Pretrained) -> None:
        """Make the method. Raises BadModel if the model is of another method or does not fit the robot."""
        super().__init__(model, CBF, SETTINGS, is_unicycle(model.robot), "speed and turn rate")

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the input that is closest to the proposal and meets the barrier's rows; brake if there is none."""
        robot = self.robot
        ahead, rate, margin = (self.settings[name] for name in SETTINGS)
        heading = float(request.state[robot.heading or 0])
        along = np.array([math.cos(heading), math.sin(heading)])
        across = np.array([-along[1], along[0]])
        lengths, normals = self.distances(request, (request.state[:2] + ahead * along)[None])
        h, n = lengths[:, 0] - ahead - margin, normals[:, 0]
        scale = robot.high() - robot.low()
        rows = -np.column_stack([n @ along, ahead * n @ across]) * scale
        sizes = np.maximum(np.linalg.norm(rows, axis=1), TOLERANCE)
        A, b = rows / sizes[:, None], rate * h / sizes
        wanted, least = proposal / scale, float(h.min(initial=math.inf))
        if not (A @ wanted > b + TOLERANCE).any():
            return self.decision(ALLOWED, braking_plan(robot, proposal), least, started)
        bounds = np.concatenate([robot.high() / scale, -robot.low() / scale])
        A, b = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([b, bounds])
        solution = solve(QuadraticProgram(np.ones(2), -wanted, A, b, always=4))
        if not solution.found or solution.residual > TOLERANCE:
            return self.braking(request, started, "no input meets the barrier")
        action = robot.clip_input(solution.x * scale, request.input_in_force)
        reason = f"obstacle {int(h.argmin())} would come near faster than the barrier allows"
        about = {"reason": reason, "iterations": solution.iterations}
        return self.decision(ADJUSTED, braking_plan(robot, action), least, started, **about)
