"""A base class for robots on the floor in MuJoCo: a subclass defines how inputs drive it, and returns its speeds."""

from __future__ import annotations

import mujoco
import numpy as np

from brakeline.messaging.obstacle import Array, rotate
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.floor_physics import FloorPhysics
from brakeline.sim.ground_estimator import NoiseLevels, cut_normal, heading_of, wrap
from brakeline.sim.vehicle import Period, SimulatedVehicle

SAMPLES = 10  # of the position in a period
SCALE_ERROR = 0.003  # standard deviation of odometry's relative error, constant over an episode
HEADING_ERROR = 0.002  # rad, standard deviation of odometry's error of the change of heading in a period


class PlanarRobot(SimulatedVehicle):
    """One robot in one arena; see `FloorPhysics` for its model.

    The state is (x [m], y [m], heading [rad]) of the base's origin, then `speeds()`. The measured state has a normal
    error, cut off at the bounds of the robot's description.
    """

    samples = SAMPLES

    def __init__(
        self, robot: Robot, model: str, height: float, arena: Arena, rng: np.random.Generator, noise: NoiseLevels
    ) -> None:
        """Place the robot at the start of an arena.

        Args:
            model: MJCF of the robot.
            height: height of the base's origin above the floor [m].
            noise: only its `scale` has an effect.
        """
        self.robot, self.arena = robot, arena
        self._physics = FloorPhysics(model, height, arena, robot.period / SAMPLES, robot.period)
        # model, data: MuJoCo's
        self.model, self.data = self._physics.model, self._physics.data
        self._bound = np.asarray(robot.measurement_bound)
        self._rng, self._noise = rng, noise.scale
        self._odometry_scale = 1.0 + float(cut_normal(rng, self._noise * SCALE_ERROR, ()))
        self.input = np.zeros(robot.action_dim)  # (m,) input executed last
        mujoco.mj_forward(self.model, self.data)
        self._run()  # settle on the wheels
        # true, measured: (n,) states
        self.true = self._state()
        self.measured = self._measure()

    def drive(self) -> None:
        """Set the actuators in `data.ctrl` for one physics step of `self.input`. Each robot implements it."""
        raise NotImplementedError

    def speeds(self) -> Array:
        """Return the true coordinates of the state after the pose. Each robot implements it."""
        raise NotImplementedError

    def step(self, input: Array) -> Period:
        self.input = self.robot.clip_input(input, self.input)
        before = self.true
        poses, collision = self._run()
        self.true = self._state()
        self.measured = self._measure()
        path = self._odometry_scale * rotate(poses[:, :2] - before[:2], -float(before[2]))
        turned = wrap(float(self.true[2] - before[2])) + float(cut_normal(self._rng, self._noise * HEADING_ERROR, ()))
        return self._report(collision, poses, path, turned, *self._physics.movers.contacts)

    def body_velocity(self) -> Array:
        """Return the velocity (2,) of the base's origin in its own frame, m/s."""
        return np.asarray(rotate(self.data.qvel[:2], -self.heading()))

    def heading(self) -> float:
        """Return the true heading [rad]."""
        return heading_of(self.data.qpos[3:7])

    def _run(self) -> tuple[Array, bool]:
        """Run the physics of one period; return the poses (S, 3) at the samples, and whether the robot collided."""
        poses, collision = np.empty((SAMPLES, 3)), False
        self._physics.movers.begin_period()
        at_rest = bool(self.robot.is_stop_input(self.input))
        for i in range(SAMPLES):
            collision |= self._physics.advance(at_rest, self.drive)
            poses[i] = *self.data.qpos[:2], self.heading()
        return poses, collision

    def _state(self) -> Array:
        return np.array([*self.data.qpos[:2], self.heading(), *self.speeds()])

    def _measure(self) -> Array:
        """Return the true state with normal errors, truncated at their bounds of two standard deviations."""
        measured = self.true + cut_normal(self._rng, 0.5 * self._noise, self._bound.shape) * self._bound
        measured[2] = wrap(float(measured[2]))
        return np.asarray(measured)
