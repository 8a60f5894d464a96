"""A robot on the floor in MuJoCo, whatever moves it: what is left to say of one is how its inputs drive it."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import NoiseLevels, cut_normal, wrap
from brakeline.sim.mujoco_obstacles import MoverBodies, compile_ground_model
from brakeline.sim.vehicle import Period, clip_input

Array = NDArray[np.float64]

SAMPLES = 10  # of the position in a period
SLIP = 0.003  # 1, sigma of the share of a way that odometry gets wrong, constant over an episode
DRIFT = 0.002  # rad, sigma of the error of a period's change of heading
STANDING = 0.02  # m/s; no faster, and at a stop's input, it stands


class PlanarRobot:
    """One robot in one arena, whose model (MJCF) has a body `base` with a free joint, and a floor as its first geom.

    State: (x [m], y [m], heading [rad]) of the base's origin, then `speeds()`. A collision is any contact, at any
    physics step, with anything but the floor. The model's geoms answer to contact bit 1 (floor) and 2 (obstacles) and
    offer none themselves. Measurements are off by a normal error cut off at the bounds of the description.
    """

    def __init__(
        self, robot: Robot, model: str, height: float, arena: Arena, rng: np.random.Generator, noise: NoiseLevels
    ) -> None:
        """model: MJCF; height [m]: of the base's origin above the floor; noise: its `scale` counts."""
        self.robot, self.arena = robot, arena
        self.model = compile_ground_model(model, arena, height)
        self.data = mujoco.MjData(self.model)
        self._moving = MoverBodies(self.model, self.data, arena.crowd)
        self._time = -robot.period  # s; the episode's first is 0
        self._steps = round(robot.period / SAMPLES / self.model.opt.timestep)
        self._bound = np.asarray(robot.measurement_bound)
        self._discs = np.array([disc.at[:2] for disc in robot.body])  # in the robot's frame
        self._radii = np.array([disc.radius for disc in robot.body])
        self._rng, self._noise = rng, noise.scale
        self._scale = 1.0 + float(cut_normal(rng, self._noise * SLIP, ()))
        self.input = np.zeros(robot.action_dim)
        mujoco.mj_forward(self.model, self.data)
        self._run()  # sink onto the wheels
        self.true = self._state()
        self.measured = self._measure()

    # --- of each robot ------------------------------------------------------------------------------------------

    def drive(self) -> None:
        """Set the actuators for one physics step of `self.input`."""
        raise NotImplementedError

    def speeds(self) -> Array:
        """The state's coordinates after the pose, as they are."""
        raise NotImplementedError

    # --- of all of them (`brakeline.sim.vehicle.Vehicle`)
    # -----------------------------------------------------------------

    def step(self, input: Array) -> Period:
        """Carry out an input for one period.

        Raises:
            BadInput: when it is not as many finite numbers as the robot has inputs.
        """
        robot = self.robot
        self.input = clip_input(robot, input, self.input)
        before = self.true
        poses, collision = self._run()
        self.true = self._state()
        self.measured = self._measure()
        distances = self._clearance(poses)
        path = self._scale * _turned(poses[:, :2] - before[:2], -float(before[2]))
        turned = wrap(float(self.true[2] - before[2])) + float(cut_normal(self._rng, self._noise * DRIFT, ()))
        return Period(
            self.measured,
            self.true,
            collision,
            float(distances.min()),
            float(distances[-1]),
            path,
            turned,
            *self._moving.contacts,
        )

    def initial_period(self) -> Period:
        """The present state as a period in which nothing happened: what there is to say before the first step."""
        clearance = float(self._clearance(self.true[:3]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 2)), 0.0)

    def alter(self, **changes: float) -> None:
        """Raises ValueError: there is nothing to change, unless a robot says so."""
        if changes:
            raise ValueError(f"a {self.robot.kind} has no {', '.join(sorted(changes))}")

    def body_velocity(self) -> Array:
        """Velocity of the base's origin in its own frame, (2,) m/s."""
        return _turned(self.data.qvel[:2], -self.heading())

    def heading(self) -> float:
        """rad"""
        w, x, y, z = self.data.qpos[3:7].tolist()
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    def _run(self) -> tuple[Array, bool]:
        """One period of physics: poses (S, 3) at the samples; any collision."""
        model, data = self.model, self.data
        poses = np.empty((SAMPLES, 3))
        self._moving.begin()
        collision = False
        rests = bool(self.robot.is_stop_input(self.input))
        for i in range(SAMPLES):
            for _ in range(self._steps):
                moving = not rests or math.hypot(*data.qvel[:2].tolist()) > STANDING
                if self._moving:
                    self._time += model.opt.timestep
                    self._moving.place(self._time)
                self.drive()
                # step2 before step1: contacts are then those of the position just reached
                mujoco.mj_step2(model, data)
                mujoco.mj_step1(model, data)
                collision = self._touches(moving) or collision
            poses[i] = *data.qpos[:2], self.heading()
        return poses, collision

    def _touches(self, moving: bool) -> bool:
        """Whether any contact now is with an obstacle that stands; what moves is noted apart.

        A plane is the lowest type of geom, and a contact names the geom of lower type first.
        """
        first = self.data.contact.geom[:, 0]
        if self._moving:
            first = first * ~self._moving.meet(moving)
        return bool(np.count_nonzero(first)) and not self._moving.pushed

    def _state(self) -> Array:
        return np.array([*self.data.qpos[:2], self.heading(), *self.speeds()])

    def _measure(self) -> Array:
        """The true state, each coordinate off by half its bound (sigma; cut off at the bound)."""
        measured = self.true + cut_normal(self._rng, 0.5 * self._noise, self._bound.shape) * self._bound
        measured[2] = wrap(float(measured[2]))
        return np.asarray(measured)

    def _clearance(self, poses: Array) -> Array:
        """From the nearest of the body's discs at poses (..., 3) to the nearest obstacle, m."""
        turned = rotate(np.broadcast_to(self._discs, (*poses.shape[:-1], *self._discs.shape)), poses[..., 2, None])
        centres = poses[..., None, :2] + turned
        return np.asarray((self.arena.shapes.distance(centres).min(axis=0) - self._radii).min(axis=-1))


def _turned(vectors: Array, angle: float) -> Array:
    """Vectors (..., 2) turned by an angle, rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
