"""A control barrier function for a vehicle whose velocity follows its inputs, with equations derived by hand.

Wang, Ames and Egerstedt, "Safety barrier certificates for collisions-free multirobot systems", IEEE T-RO 2017: at a
distance d from an obstacle, a vehicle may approach it as fast as it can still stop, with a deceleration a. The velocity
v follows the input u with a lag of τ. With n the direction away from the obstacle, each obstacle gives a row of a QP:

    v' = (u − v) / τ,     h_i = √(2 a (d_i − body − margin)) + n_iᵀ v
    min ‖u − r‖²  s.t.  h_i' >= −α h_i,  low <= u <= high,  |u − u before| <= slew

h_i' leaves out how n_i turns while the vehicle passes an obstacle: that only makes h_i grow faster.
"""

from __future__ import annotations

import math

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.filter.backup_plan import braking_plan
from brakeline.safety.filter.qp_solver import QuadraticProgram, solve
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Decision, Request
from brakeline.safety.model.model_config import CBF
from brakeline.safety.rivals.model_by_hand import RivalByHand, follows_velocities
from brakeline.safety.rivals.pretrained import Pretrained

TOLERANCE = 1e-6  # m/s: a row that is violated by less is met
SETTINGS = ("lag", "deceleration", "rate", "margin")  # τ [s], a [m/s²], α [1/s], margin around obstacles [m]


class VelocityBarrier(RivalByHand):
    """The QP as a method."""

    def __init__(self, model: Pretrained) -> None:
        """Make the method. Raises BadModel if the model is of another method or does not fit the robot."""
        super().__init__(model, CBF, SETTINGS, follows_velocities(model.robot), "velocities")

    def correct(self, request: Request, proposal: Array, started: int) -> Decision:
        """Return the input that is closest to the proposal and meets the barrier's rows; brake if there is none."""
        robot, d = self.robot, self.robot.position_dim
        lag, deceleration, rate, margin = (self.settings[name] for name in SETTINGS)
        lengths, normals = self.distances(request, request.state[None, :d])
        room, n = lengths[:, 0] - margin, normals[:, 0]
        away = n @ request.state[d : 2 * d]
        speed = np.sqrt(2.0 * deceleration * np.maximum(room, 0.0))  # from which it can stop
        # Near an obstacle the speed changes without limit with the distance: there it counts as one period's.
        slowing = deceleration * away / np.maximum(speed, deceleration * robot.period)
        A, b = -n, lag * (rate * (speed + away) + slowing) - away
        least, excess = float(room.min(initial=math.inf)), A @ proposal - b
        if not (excess > TOLERANCE).any():
            return self.decision(ALLOWED, braking_plan(robot, proposal), least, started)
        before, slew = request.input_in_force, np.asarray(robot.action_slew)
        high, low = np.minimum(robot.high(), before + slew), np.maximum(robot.low(), before - slew)
        A, b = np.vstack([A, np.eye(d), -np.eye(d)]), np.concatenate([b, high, -low])
        solution = solve(QuadraticProgram(np.ones(d), -proposal, A, b, always=2 * d))
        if not solution.found or solution.residual > TOLERANCE:
            return self.braking(request, started, "no input meets the barrier")
        action = robot.clip_input(solution.x, before)
        reason = f"obstacle {int(excess.argmax())} would come near faster than the barrier allows"
        about = {"reason": reason, "iterations": solution.iterations}
        return self.decision(ADJUSTED, braking_plan(robot, action), least, started, **about)
