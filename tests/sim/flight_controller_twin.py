"""The twin of the flight controller in `sim/kernels/flight_kernels.py`, with vectors, matrices and queues.

ENU, SI units; body axes x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation

from brakeline.messaging.obstacle import Array
from brakeline.sim.kernels import flight_kernels as kernels

MIXER = np.array([[-1, -1, -1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])  # torques of each rotor about x, y and z


def push(samples: deque[Array], value: Array) -> Array:
    """Replace the oldest sample of a moving average, and return the change of the average."""
    change: Array = (value - samples[0]) / len(samples)
    samples.append(value)
    return change


class FlightController:
    """The controller at rest. `setpoint`: m/s; `yaw` (its reference), `yaw_goal`: rad; `yaw_rate`: rad/s."""

    def __init__(self) -> None:
        self.setpoint, self.target, self.reference, self.velocity, self.integral = np.zeros((5, 3))
        self.allowance, self.hold = np.full(3, kernels.GAINS.jump), None
        self.yaw = self.yaw_goal = self.yaw_rate = self.turn = 0.0
        self.ramped, self.rounded, self.eased, self.jerk = (
            deque(np.zeros((size, 3)), size) for size in (kernels.RAMP, kernels.ROUND, kernels.EASE, kernels.EASE)
        )
        self.delayed = [deque([0.0] * size) for size in kernels.LAGS]
        self.updates = 0

    def update(self, position: Array, velocity: Array, attitude: Array, rates: Array) -> Array:
        """Return the rotors' thrusts (4,) [N] for an estimated state; attitude: (w, x, y, z), world from body."""
        if self.updates % kernels.OUTER_EVERY == 0:
            self._velocity_loop(position, velocity)
        self.updates += 1
        return self._attitude_loop(Rotation.from_quat(attitude, scalar_first=True).as_matrix(), rates)

    def _velocity_loop(self, position: Array, velocity: Array) -> None:
        """Update the wanted specific force and its first two derivatives, and the reference of the heading."""
        g, body = kernels.GAINS, kernels.AIRFRAME
        allowance = np.minimum(self.allowance + g.acceleration * kernels.OUTER, g.jump)
        change = np.clip(self.setpoint - self.target, -allowance, allowance)
        self.target, self.allowance = self.target + change, allowance - np.abs(change)
        slope = push(self.ramped, self.target) / kernels.OUTER
        jerk = push(self.rounded, slope) / kernels.OUTER
        push(self.eased, np.mean(self.rounded, axis=0))
        snap = push(self.jerk, jerk) / kernels.OUTER
        feedforward = np.mean(self.eased, axis=0)
        self.reference = self.reference + feedforward * kernels.OUTER
        for axis, delayed in enumerate(self.delayed):
            delayed.append(self.reference[axis])
            self.velocity[axis] = delayed.popleft()

        if self.setpoint.any():
            self.hold = None
        elif self.hold is None and (np.abs(self.velocity) < kernels.STOPPED).all():
            self.hold = position
        wanted = self.velocity + (0.0 if self.hold is None else g.position * (self.hold - position))
        integral = self.integral + g.integral * kernels.OUTER * (wanted - velocity)
        self.integral = np.clip(integral, -g.integral_limit, g.integral_limit)
        drag = g.known_drag * (body.drag_linear + body.drag_quadratic * np.linalg.norm(self.velocity))
        force = feedforward + g.velocity * (wanted - velocity) + self.integral + drag * self.velocity
        force[2] = max(force[2] + kernels.GRAVITY, 0.2 * kernels.GRAVITY)
        force[:2] *= min(math.tan(g.tilt_limit) * force[2] / math.hypot(*force[:2], 1e-9), 1.0)
        self.force = force, np.mean(self.jerk, axis=0), snap

        if self.yaw_rate:
            self.yaw_goal = self.yaw + self.yaw_rate * kernels.OUTER
        remaining = math.remainder(self.yaw_goal - self.yaw, math.tau)
        self.turn = min(max(remaining / kernels.OUTER, -g.yaw_rate_limit), g.yaw_rate_limit)
        self.yaw += self.turn * kernels.OUTER

    def _attitude_loop(self, axes: Array, rates: Array) -> Array:
        """Return the thrusts that turn the body, whose axes are the columns of `axes`, towards the wanted force."""
        g, body = kernels.GAINS, kernels.AIRFRAME
        force, jerk, snap = (vector @ axes for vector in self.force)
        size = np.linalg.norm(force)
        tilt = np.clip((g.attitude * force + jerk)[:2] / size, -g.rate_limit, g.rate_limit)
        heading = math.atan2(axes[1, 0], axes[0, 0])
        wanted = np.array([-tilt[1], tilt[0], g.yaw * math.remainder(self.yaw - heading, math.tau) + self.turn])
        towards = np.array([-snap[1] / size, snap[0] / size, 0.0])
        leverage = 4.0 * np.array([body.arm, body.arm, body.rotor_torque])
        torques = body.inertia * (g.rate * np.array([1.0, 1.0, 0.3]) * (wanted - rates) + towards) / leverage
        torques[2] = min(max(torques[2], -1.0), 1.0)
        lift = 0.25 * body.mass * self.force[0][2] / max(axes[2, 2], 0.3)
        lift = min(max(lift, body.least_thrust + 0.5), body.most_thrust - 1.0)  # height has priority
        room = min(lift - body.least_thrust, body.most_thrust - lift)
        thrusts: Array = lift + MIXER @ torques * min(room / np.abs(torques).sum(), 1.0)
        return thrusts
