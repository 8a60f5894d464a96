"""The ground robot: a TurtleBot3 Burger in MuJoCo, moved by one input a period."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import robot_named
from brakeline.sim.arena import Arena
from brakeline.sim.ground_estimator import Estimator, NoiseLevels
from brakeline.sim.mujoco_obstacles import MoverBodies, compile_ground_model
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, clip_input

Array = NDArray[np.float64]

GROUND = robot_named("ground")
MODEL = Path(__file__).with_name("ground.xml").read_text()
WHEEL_RADIUS = 0.033  # m
TRACK = 0.160  # m between the wheels
COORDINATES, SPEEDS = 9, 8  # of one robot in a model: a free body and two wheels
SAMPLES = 10  # of encoders and gyro in a period
STANDING = 0.02  # m/s; no faster, and at no input, it stands
PAYLOAD_GYRATION = 0.05  # m, radius of gyration of what is loaded


class TurtleBot:
    """One TurtleBot3 of a world, whoever moves the world on.

    true, measured: states (x [m], y [m], heading [rad], speed [m/s], turn rate [rad/s]) of the axle's midpoint;
    input: what was executed last (speed [m/s], turn rate [rad/s]), after clipping.
    """

    def __init__(self, arena: Arena, data: mujoco.MjData, number: int = 0) -> None:
        """data: of a model whose robots are alike and come first; number: which of them it is."""
        q, v, u = COORDINATES * number, SPEEDS * number, GROUND.action_dim * number
        self.arena = arena
        self._qpos, self._qvel = data.qpos[q : q + COORDINATES], data.qvel[v : v + SPEEDS]  # views of the world's
        self._ctrl = data.ctrl[u : u + GROUND.action_dim]

    def wake(self, noise: NoiseLevels | None, rng: np.random.Generator) -> None:
        """It stands on its wheels: from here on it is measured."""
        self.estimator = Estimator(
            noise or NoiseLevels(), rng, self._true_pose(), self._wheels(), WHEEL_RADIUS, GROUND.period / SAMPLES
        )
        self.true = self._true_state()
        self.measured = np.array([*self.estimator.pose, 0.0, 0.0])
        self.input = np.zeros(GROUND.action_dim)

    def take(self, input: Array) -> None:
        """The next period's input, clipped to the robot's bounds.

        Raises:
            BadInput: when the input is not two finite numbers.
        """
        self.input = clip_input(GROUND, input, self.input)

    def begin(self, input: Array) -> None:
        """A period with this input begins."""
        self._set_wheels(input)
        self._positions, self._angles = np.empty((SAMPLES, 2)), np.empty((SAMPLES, 2))
        self._headings = np.empty(SAMPLES + 1)
        self._headings[0] = self._true_heading()

    def sample(self, i: int) -> None:
        """The period's i-th sample of where it is."""
        self._positions[i], self._angles[i] = self._qpos[:2], self._wheels()
        self._headings[i + 1] = self._true_heading()

    def report(
        self, collision: bool, contact_moving: bool = False, contact_standing: bool = False, contact_robot: bool = False
    ) -> Period:
        """What came of the period: see there."""
        rates = np.diff(np.unwrap(self._headings)) * (SAMPLES / GROUND.period)
        reading = self.estimator.update(self._angles, rates, self._true_pose())
        self.true, self.measured = self._true_state(), reading.measured
        distances = self._clearance(self._positions)
        return Period(
            self.measured,
            self.true,
            collision,
            float(distances.min()),
            float(distances[-1]),
            reading.path,
            reading.turned,
            contact_moving,
            contact_standing,
            contact_robot,
        )

    def initial_period(self) -> Period:
        """The present state as a period in which nothing happened: what there is to say before the first step."""
        clearance = float(self._clearance(self.true[:2]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 2)), 0.0)

    def _clearance(self, positions: Array) -> Array:
        """From the footprint's disc at positions (..., 2) to the nearest obstacle, m."""
        return np.asarray(self.arena.shapes.distance(positions).min(axis=0) - GROUND.footprint)

    def _set_wheels(self, input: Array) -> None:
        """Setpoints of the wheels for an input (speed [m/s], turn rate [rad/s])."""
        speed, turn = input
        self._ctrl[:] = (speed - 0.5 * TRACK * turn) / WHEEL_RADIUS, (speed + 0.5 * TRACK * turn) / WHEEL_RADIUS

    def _wheels(self) -> Array:
        return np.asarray(self._qpos[7:9])

    def _true_heading(self) -> float:
        w, x, y, z = self._qpos[3:7]
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    def _true_pose(self) -> Array:
        return np.array([*self._qpos[:2], self._true_heading()])

    def _true_state(self) -> Array:
        x, y, heading = self._true_pose()
        vx, vy = self._qvel[:2]
        speed = vx * math.cos(heading) + vy * math.sin(heading)
        return np.array([x, y, heading, speed, self._qvel[5]])


class GroundRobot(TurtleBot):
    """One TurtleBot3 in one arena of its own."""

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: NoiseLevels | None = None,
        payload_kg: float = 0.0,
        floor_friction: float = 1.0,
    ) -> None:
        self._model = compile_ground_model(MODEL, arena, WHEEL_RADIUS)
        self._data = mujoco.MjData(self._model)
        super().__init__(arena, self._data)
        base = self._model.body("base").id
        self._base = base
        self._bare_mass = float(self._model.body_mass[base])
        self._bare_inertia = self._model.body_inertia[base].copy()
        self._moving = MoverBodies(self._model, self._data, arena.crowd)
        self._time = -GROUND.period  # s; the episode's first is 0
        self._wheel_geoms = [self._model.geom(name).id for name in ("left wheel", "right wheel")]
        self._physics_steps = round(GROUND.period / SAMPLES / self._model.opt.timestep)
        self.set_payload(payload_kg)
        self.set_friction(floor_friction)
        mujoco.mj_forward(self._model, self._data)
        self._run(np.zeros(2))  # sink onto the wheels
        self.wake(noise, rng)

    def alter(self, **changes: float) -> None:
        """Change `payload_kg`, `floor_friction` or both, from now on. Raises ValueError for any other name."""
        setters = {"payload_kg": self.set_payload, "floor_friction": self.set_friction}
        if unknown := changes.keys() - setters.keys():
            raise ValueError(f"a ground robot has no {', '.join(sorted(unknown))}; it has: {', '.join(setters)}")
        for name, value in changes.items():
            setters[name](value)

    def set_payload(self, kg: float) -> None:
        """Load that many kg on top of the bare robot's mass, at its centre of mass; at any time."""
        if not (math.isfinite(kg) and kg >= 0.0):
            raise ValueError(f"a payload is 0 kg or more, not {kg}")
        self._model.body_mass[self._base] = self._bare_mass + kg
        self._model.body_inertia[self._base] = self._bare_inertia + kg * PAYLOAD_GYRATION**2
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def set_friction(self, coefficient: float) -> None:
        """Friction between wheels and floor (1: rubber on a dry floor; 0.1: ice); at any time."""
        if not (math.isfinite(coefficient) and coefficient > 0.0):
            raise ValueError(f"a friction coefficient is positive, not {coefficient}")
        self._model.geom_friction[self._wheel_geoms, 0] = coefficient

    def step(self, input: Array) -> Period:
        """Drive one period at (speed [m/s], turn rate [rad/s]), clipped to the robot's bounds.

        Raises:
            BadInput: when the input is not two finite numbers.
        """
        self.take(input)
        return self.report(self._run(self.input), *self._moving.contacts)

    def _run(self, input: Array) -> bool:
        """One period of physics; any collision."""
        self.begin(input)
        self._moving.begin()
        collision = False
        driven = bool(input.any())
        for i in range(SAMPLES):
            collision |= self._run_sample(driven)
            self.sample(i)
        return collision

    def _run_sample(self, driven: bool) -> bool:
        """Physics up to the next sample; any collision. driven: the input is not zero."""
        model, data, collision = self._model, self._data, False
        for _ in range(self._physics_steps):
            moving = driven or math.hypot(*data.qvel[:2].tolist()) > STANDING
            if self._moving:
                self._time += model.opt.timestep
                self._moving.place(self._time)
            # step2 before step1: contacts are then those of the position just reached
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            collision = self._touching(moving) or collision
        return collision

    def _touching(self, moving: bool) -> bool:
        """Whether any contact now is with an obstacle that stands; what moves is noted apart. Else it touches only the
        floor, which is geom 0.

        A plane is the lowest type of geom, and a contact names the geom of lower type first.
        """
        first = self._data.contact.geom[:, 0]
        if self._moving:
            first = first * ~self._moving.meet(moving)
        return bool(np.count_nonzero(first)) and not self._moving.pushed


def simulated(conditions: Conditions, tap: object = None) -> MakeVehicle:
    """Makes the task's vehicles: see `brakeline.messaging.task.Task.simulator`."""
    c = conditions
    return partial(GroundRobot, noise=c.noise, payload_kg=c.payload_kg, floor_friction=c.floor_friction)
