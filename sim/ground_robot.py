"""The ground robot: a TurtleBot3 Burger in MuJoCo, with one input a period."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import Robot, robot_named
from brakeline.sim.arena import Arena
from brakeline.sim.delayed_vehicle import check_described
from brakeline.sim.driving_disturbances import DRAWS_AT_START, DRAWS_OF_SAMPLE, DrivingDisturbances
from brakeline.sim.floor_physics import FloorPhysics
from brakeline.sim.ground_estimator import GroundEstimator, NoiseLevels, heading_of
from brakeline.sim.sim_conditions import Conditions, ProcessNoise
from brakeline.sim.vehicle import MakeVehicle, Period, SimulatedVehicle
from brakeline.sim.weak_motor import WeakMotor

GROUND = robot_named("ground")
MODEL = Path(__file__).with_name("ground.xml").read_text("utf-8")
WHEEL_RADIUS = 0.033  # m
TRACK = 0.160  # m between the wheels
COORDINATES, SPEEDS = 9, 8  # of one robot in a model: a free body and two wheels
WHEELS = slice(7, 9)  # the wheels' angles among the coordinates
YAW_RATE = 5  # its index among the speeds
SAMPLES = 10  # of encoders and gyro in a period
SAMPLE_TIME = GROUND.period / SAMPLES  # s
MOST_IN_SAMPLE = 0.03  # m, more than a robot moves in a sample: the fastest one drives 5 mm
CHANGES = ("payload_kg", "floor_friction", "weak_motor")  # of `Conditions`
PAYLOAD_GYRATION = 0.05  # m, radius of gyration of the payload
ONLY = np.zeros(1, dtype=np.intp)  # the rows of disturbances of a single robot


def prefix(number: int) -> str:
    """Return the prefix of the names of a robot's parts in a model of several robots."""
    return f"{number} " if number else ""


def weight(model: mujoco.MjModel, base: int) -> float:
    """Return the weight [N] of the robot, payload included, whose base is this body of a model."""
    return float(model.body_subtreemass[base]) * -float(model.opt.gravity[2])


def wheel_speeds(inputs: Array) -> Array:
    """Return the speeds (..., 2) of the left and the right wheel [rad/s] for inputs (..., 2) [m/s, rad/s]."""
    speed, turn = inputs[..., 0], inputs[..., 1]
    left, right = (speed - 0.5 * TRACK * turn) / WHEEL_RADIUS, (speed + 0.5 * TRACK * turn) / WHEEL_RADIUS
    return np.stack((left, right), axis=-1)


class TurtleBot(SimulatedVehicle):
    """One TurtleBot3 of a world that somebody else advances.

    Attributes:
        true, measured: (5,) states (x [m], y [m], heading [rad], speed [m/s], turn rate [rad/s]) of the middle of the
            axle.
        input: (2,) input executed last (speed [m/s], turn rate [rad/s]).
    """

    robot, samples = GROUND, SAMPLES

    def __init__(self, arena: Arena, model: mujoco.MjModel, data: mujoco.MjData, number: int = 0) -> None:
        """Use robot `number` of a compiled model whose first bodies are TurtleBots, named with `prefix`."""
        q, v, u = COORDINATES * number, SPEEDS * number, GROUND.action_dim * number
        self.arena, self._model = arena, model
        self._base = model.body(f"{prefix(number)}base").id
        self._bare_mass, self._bare_inertia = float(model.body_mass[self._base]), model.body_inertia[self._base].copy()
        self._left_motor = WeakMotor(model, u)
        self._wheel_geoms = [model.geom(f"{prefix(number)}{side} wheel").id for side in ("left", "right")]
        self._qpos, self._qvel = data.qpos[q : q + COORDINATES], data.qvel[v : v + SPEEDS]  # views of the world's
        self._ctrl = data.ctrl[u : u + GROUND.action_dim]
        self._force = data.xfrc_applied[self._base, :2]

    def setters(self) -> dict[str, Callable[[float], None]]:
        """Return what `alter` can change: a payload, the floor, and the force of the left wheel's motor."""
        return {
            "payload_kg": self.set_payload,
            "floor_friction": self.set_friction,
            "weak_motor": self._left_motor.set,
        }

    def set_payload(self, kg: float) -> None:
        """Add a payload [kg] to the bare robot, at its centre of mass."""
        self._model.body_mass[self._base] = self._bare_mass + kg
        self._model.body_inertia[self._base] = self._bare_inertia + kg * PAYLOAD_GYRATION**2
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def set_friction(self, coefficient: float) -> None:
        """Set the friction between wheels and floor (1: rubber on a dry floor; 0.1: ice).

        Raises:
            ValueError: the coefficient is zero.
        """
        if coefficient == 0.0:
            raise ValueError("floor_friction is positive, not 0")
        self._model.geom_friction[self._wheel_geoms, 0] = coefficient

    def start_disturbances(self, noise: ProcessNoise | None, rng: np.random.Generator) -> None:
        """Begin an episode's disturbances, before the robot settles on its wheels.

        They come from a generator spawned from the episode's, so the episode's other random numbers do not change.
        """
        self._draws = rng.spawn(1)[0]
        self._disturbances = DrivingDisturbances(noise or ProcessNoise(), 1, SAMPLE_TIME)
        self._disturbances.begin(ONLY, self._draws.standard_normal((1, DRAWS_AT_START)))

    def start_estimation(self, noise: NoiseLevels | None, rng: np.random.Generator) -> None:
        """Start to measure, once the robot has settled on its wheels."""
        noise = noise or NoiseLevels()
        self.estimator = GroundEstimator(noise, rng, self._true_pose(), self._wheels(), WHEEL_RADIUS, SAMPLE_TIME)
        self.true = self._true_state()
        self.measured = np.array([*self.estimator.pose, 0.0, 0.0])
        self.input = np.zeros(GROUND.action_dim)

    def step(self, input: Array) -> Period:
        """Refuse to step one robot alone.

        Raises:
            RuntimeError: always; the robot's world advances all robots together.
        """
        raise RuntimeError("step the robot's world: it advances all robots together")

    def set_input(self, input: Array) -> None:
        """Set the input (2,) of the next period, clipped to the robot's bounds.

        Raises:
            BadInput: the input is not two finite numbers.
        """
        self.input = GROUND.clip_input(input, self.input)

    def begin_period(self, input: Array) -> None:
        """Draw the disturbances of the period, and begin to record samples."""
        self._controls, self._forces = self._disturbed(input, SAMPLES)
        self._positions, self._angles = np.empty((SAMPLES, 2)), np.empty((SAMPLES, 2))
        self._headings = np.empty(SAMPLES + 1)
        self._headings[0] = self._true_heading()

    def begin_sample(self, i: int) -> None:
        """Set the wheels' speeds, and the force of the floor's tilt, of the i-th sample of the period."""
        self._ctrl[:], self._force[:] = self._controls[i], self._forces[i]

    def record_sample(self, i: int) -> None:
        """Record the i-th sample of the period."""
        self._positions[i], self._angles[i] = self._qpos[:2], self._wheels()
        self._headings[i + 1] = self._true_heading()

    def end_period(self, collision: bool, *contacts: bool) -> Period:
        """Return the report of the period. contacts: moving, standing and with another robot, as in `Period`."""
        turns = np.diff(self._headings)
        if (np.abs(turns) >= math.pi).any():  # across the direction west
            turns = np.diff(np.unwrap(self._headings))
        rates = turns * (SAMPLES / GROUND.period)
        reading = self.estimator.update(self._angles, rates, self._true_pose())
        self.true, self.measured = self._true_state(), reading.measured
        return self._report(collision, self._positions, reading.path, reading.turned, *contacts)

    def _disturbed(self, input: Array, samples: int) -> tuple[Array, Array]:
        """Return the wheels' speeds (samples, 2) [rad/s] for an input (2,), and forces (samples, 2) on the base [N]."""
        draws = self._draws.standard_normal((1, samples, DRAWS_OF_SAMPLE))
        factors, tilts = self._disturbances.advance(ONLY, np.array([input.any()]), draws)
        return wheel_speeds(input) * factors[0], weight(self._model, self._base) * tilts[0]

    def _wheels(self) -> Array:
        return np.asarray(self._qpos[WHEELS])

    def _true_heading(self) -> float:
        return heading_of(self._qpos[3:7].tolist())

    def _true_pose(self) -> Array:
        return np.array([*self._qpos[:2], self._true_heading()])

    def _true_state(self) -> Array:
        x, y, heading = self._true_pose()
        vx, vy = self._qvel[:2]
        speed = vx * math.cos(heading) + vy * math.sin(heading)
        return np.array([x, y, heading, speed, self._qvel[YAW_RATE]])


class GroundRobot(TurtleBot):
    """One TurtleBot3 alone in one arena."""

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: NoiseLevels | None = None,
        payload_kg: float = 0.0,
        floor_friction: float = 1.0,
        process_noise: ProcessNoise | None = None,
        weak_motor: float = 1.0,
    ) -> None:
        """Place the robot at the start of an arena and let it settle on its wheels."""
        self._physics = FloorPhysics(MODEL, WHEEL_RADIUS, arena, SAMPLE_TIME, GROUND.period)
        super().__init__(arena, self._physics.model, self._physics.data)
        self.alter(payload_kg=payload_kg, floor_friction=floor_friction, weak_motor=weak_motor)
        self.start_disturbances(process_noise, rng)
        mujoco.mj_forward(self._model, self._physics.data)
        self._room = 0.0  # m, free space around the footprint at the end of the last period; 0: not known
        self._run(np.zeros(GROUND.action_dim))
        self.start_estimation(noise, rng)

    def step(self, input: Array) -> Period:
        self.set_input(input)
        period = self.end_period(self._run(self.input), *self._physics.movers.contacts)
        self._room = 0.0 if self._physics.movers else period.clearance
        return period

    def _run(self, input: Array) -> bool:
        """Run the physics of one period; return whether the robot collided."""
        self.begin_period(input)
        self._physics.movers.begin_period()
        collision, at_rest, start = False, not input.any(), self._qpos[:2].tolist()
        for i in range(SAMPLES):
            self.begin_sample(i)
            apart = math.dist(start, self._qpos[:2].tolist()) + MOST_IN_SAMPLE < self._room
            collision |= self._physics.advance(at_rest, apart=apart)
            self.record_sample(i)
        return collision


def simulated(conditions: Conditions, tap: object = None, robot: Robot = GROUND) -> MakeVehicle:
    """Return a function that makes this task's vehicles (`brakeline.messaging.task.Task.simulator`).

    Raises ValueError as `changes_of`, and Mismatch as `check_described`.
    """
    check_described(robot, GROUND)
    changes = changes_of(conditions)
    return partial(GroundRobot, noise=conditions.noise, process_noise=conditions.process_noise, **changes)


def changes_of(conditions: Conditions) -> dict[str, Any]:
    """Return what `TurtleBot.alter` has to change for these conditions.

    Raises:
        ValueError: the conditions have something that no ground robot has.
    """
    conditions.check(*CHANGES, "process_noise")
    return {name: getattr(conditions, name) for name in CHANGES}
