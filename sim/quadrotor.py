"""The quadrotor: a rigid body with four rotors in MuJoCo, and its flight controller."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from brakeline.messaging.obstacle import Array
from brakeline.messaging.robot import robot_named
from brakeline.sim.arena import Arena
from brakeline.sim.flight_controller import FlightController, Vector
from brakeline.sim.flight_estimator import Estimate, FlightEstimator, QuadrotorNoise, Quaternion, rotate
from brakeline.sim.ground_estimator import heading_of
from brakeline.sim.kernels.flight_kernels import GRAVITY, OUTER_EVERY, STEPS_OF_TICK, TIMESTEP, add_drag, fly
from brakeline.sim.mujoco_obstacles import MoverBodies, add_obstacles
from brakeline.sim.vehicle import Period, SimulatedVehicle
from brakeline.sim.weak_motor import WeakMotor
from brakeline.sim.wind import Wind, WindProcess

QUADROTOR = robot_named("quadrotor")
MODEL = Path(__file__).with_name("quadrotor.xml").read_text("utf-8")
SAMPLES = 5  # of the position in a period
FLOOR_BIT = 1
STANDING = 0.15  # m/s; below this speed, and at the setpoint zero, it hovers in place
MOST_ACCELERATION = 40.0  # m/s²; thrust, weight and drag at full speed give less
CLEAR_OF_FLOOR = 0.5  # m, of the position above a floor on which nothing touches it
SETTLE = 5  # periods of hovering before the episode starts


class Quadrotor(SimulatedVehicle):
    """One quadrotor in one arena, hovering at its start, or standing on the floor with its motors off.

    `controller` holds the heading at zero (east) by default.
    """

    robot, samples = QUADROTOR, SAMPLES

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: QuadrotorNoise | None = None,
        wind: Wind | None = None,
        floor: float | None = None,
        changes: dict[str, float] | None = None,
    ) -> None:
        """Place the vehicle at the start of an arena.

        Args:
            floor: height of a plane to start from and to land on [m]. Without one, the vehicle starts hovering.
            changes: of its physics from the start on, as `alter` takes them.
        """
        self.arena = arena
        self._model = arena_model(arena, floor)
        self._data = mujoco.MjData(self._model)
        self._first_rotor = WeakMotor(self._model, 0)
        self.timestep = TIMESTEP
        self._steps_per_sample = round(QUADROTOR.period / SAMPLES / self.timestep)
        self.controller = FlightController()
        self._body = self.controller.body
        steps = round(QUADROTOR.period / self.timestep / OUTER_EVERY)
        self._estimator = FlightEstimator(noise or QuadrotorNoise(), rng, steps)
        self._rng, self._wind = rng, wind or Wind()
        self._wind_process = None if self._wind.calm else WindProcess(self._wind, rng, self.timestep)
        self._movers = MoverBodies(self._model, self._data, arena.crowd)
        self._time = 0.0  # s
        self._floor = -math.inf if floor is None else floor  # m
        self._room = 0.0  # m that the vehicle can still move before it can touch something
        self._altered = False  # whether its body differs from that of compiled code
        self._moved = False  # whether compiled code moved it since MuJoCo's last step
        self._floor_geom = -1 if floor is None else self._model.geom("floor").id
        # whether the controller drives the rotors; otherwise they stand, idle, or `set_thrusts` drives them
        self.flying = floor is None
        self.collided = False  # whether the vehicle touched a static obstacle since this was last set to False
        self.on_floor = False  # whether the vehicle touched the floor in the last physics step
        self._count = 0
        self._path: deque[list[float]] = deque(maxlen=64)  # true positions after each `advance` of the period
        self._before = np.zeros(3)  # m/s, the velocity before the last physics step
        self._air = np.zeros(3)  # m/s, the velocity of the wind
        self._acceleration: Vector = (0.0, 0.0, 0.0)
        # (3,) velocity setpoint executed last [m/s], after clipping and slew
        self.input = np.zeros(QUADROTOR.action_dim)
        self.alter(**(changes or {}))
        mujoco.mj_forward(self._model, self._data)
        if self.flying:
            self._hover()
        self._time = 0.0
        self._movers.begin_period()
        # true, measured: (9,) states (p [m], v [m/s], a [m/s²]; ENU) of the centre of mass
        self.true, self.measured = self.state(), self.estimated_state(self.estimate())

    def step(self, input: Array) -> Period:
        self.input = QUADROTOR.clip_input(input, self.input)
        x, y, z = self.input.tolist()
        self.controller.setpoint = (x, y, z)
        self.begin_period()
        start, path = self.measured[:3], np.empty((SAMPLES, 3))
        for i in range(SAMPLES):
            self.advance(self._steps_per_sample)
            path[i] = self.position_and_velocity()[0]
        return self.end_period(self.estimated_state(self.estimate()), path - start)

    def begin_period(self) -> None:
        """Begin to record contacts and positions."""
        self.collided = False
        self._movers.begin_period()
        self._path.clear()

    def end_period(self, measured: Array, path: Array) -> Period:
        """Return the report of the period since `begin_period`.

        Args:
            measured: (9,) measured state at the end.
            path: (S, 3) m, estimated positions from the start of the period.
        """
        self.true, self.measured = self.state(), measured
        return self._report(self.collided, np.array(self._path), path, 0.0, *self._movers.contacts)

    def setters(self) -> dict[str, Callable[[float], None]]:
        """Return what `alter` can change: a payload at the centre of mass, the wind [m/s], and one rotor's thrust."""
        speed, gust = partial(self._set_wind, "speed"), partial(self._set_wind, "gust")
        return {
            "payload_kg": self._set_payload,
            "weak_motor": self._weaken_rotor,
            "wind_speed": speed,
            "gust": gust,
        }

    def _weaken_rotor(self, share: float) -> None:
        self._altered = True
        self._first_rotor.set(share)

    def _set_payload(self, kg: float) -> None:
        self._altered = True
        self._model.body_mass[self._model.body("base").id] = self._body.mass + kg
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def _set_wind(self, name: str, value: float) -> None:
        self._wind = replace(self._wind, **{name: value})
        self._wind_process = None if self._wind.calm else WindProcess(self._wind, self._rng, self.timestep)
        self._air[:] = 0.0

    def advance(self, steps: int) -> None:
        """Advance by some physics steps, each with the rotors' thrusts from the controller."""
        if self._can_touch_nothing(steps):
            self._fly_freely(steps)
        else:
            self._fly_among_obstacles(steps)
        self._path.append(self._data.qpos[:3].tolist())

    def _can_touch_nothing(self, steps: int) -> bool:
        """Whether a standard vehicle can fly without MuJoCo: nothing but calm air is within its reach."""
        if not self.flying or self._altered or self._wind_process is not None or self._movers:
            return False
        time = steps * self.timestep
        reach = time * (math.hypot(*self._data.qvel[:3].tolist()) + MOST_ACCELERATION * time)
        if self._room < reach:
            self._room = min(
                float(self.clearance(self._data.qpos[:3])), self._data.qpos[2] - self._floor - CLEAR_OF_FLOOR
            )
        self._room -= reach
        whole = steps % STEPS_OF_TICK == 0 and self._count % OUTER_EVERY == 0
        return whole and self._room > 0.0

    def _fly_freely(self, steps: int) -> None:
        """Advance by compiled code, which gives the motion of MuJoCo in a tenth of the time."""
        data, coordinates, errors = self._data, np.empty((1, 17)), np.empty((1, steps // OUTER_EVERY, 9))
        for k in range(steps // OUTER_EVERY):
            self._estimator.advance()
            errors[0, k] = self._estimator.errors
        coordinates[0, :7], coordinates[0, 7:13], coordinates[0, 13:] = data.qpos, data.qvel, data.act
        acceleration = np.empty((1, 3))
        fly(self.controller.record, coordinates, errors, np.empty((1, steps // STEPS_OF_TICK, 3)), acceleration)
        data.qpos[:], data.qvel[:], data.act[:] = coordinates[0, :7], coordinates[0, 7:13], coordinates[0, 13:]
        x, y, z = acceleration[0].tolist()
        self._acceleration, self.on_floor, self._moved = (x, y, z), False, True

    def _fly_among_obstacles(self, steps: int) -> None:
        """Advance in MuJoCo, which reports contacts."""
        model, data = self._model, self._data
        if self._moved:
            mujoco.mj_step1(model, data)
        self._moved, self._room = False, 0.0
        for _ in range(steps):
            if self._count % OUTER_EVERY == 0:
                self._estimator.advance()
            self._count += 1
            qvel = data.qvel
            self._before[:] = qvel[:3]
            if self.flying:
                self.controller.update(data.qpos, qvel, self._estimator.errors, data.ctrl)
            if self._wind_process is not None:
                self._wind_process.advance()
                self._air[:] = self._wind_process.velocity
            add_drag(qvel, self._air, data.qfrc_applied)
            if self._movers:
                self._time += self.timestep
                self._movers.place(self._time)
            # step2 before step1, so that the contacts belong to the new position
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            if data.ncon:
                self._note_contacts()
            else:
                self.on_floor = False
                self._movers.note_no_contact()
        x, y, z = ((data.qvel[:3] - self._before) / self.timestep).tolist()
        self._acceleration = (x, y, z)

    def cut_rotors(self) -> None:
        """Stop the rotors, or let them idle, until `start_rotors`."""
        self.flying = False
        self._data.ctrl[:] = 0.0

    def set_thrusts(self, thrusts: tuple[float, ...]) -> None:
        """Set the rotors' thrusts [N] instead of the controller, until the next call."""
        self.flying = False
        self._data.ctrl[:] = thrusts  # MuJoCo clips them

    def start_rotors(self) -> None:
        """Let the controller drive the rotors and hold the present heading."""
        self.controller.reset(heading_of(self._data.qpos[3:7].tolist()))
        self.flying = True

    def copy_motion(self, other: Quadrotor) -> None:
        """Copy the attitude, the velocities and the rotors of another quadrotor; keep the position."""
        mine, theirs = self._data, other._data
        mine.qpos[3:], mine.qvel[:] = theirs.qpos[3:], theirs.qvel
        mine.act[:], mine.ctrl[:] = theirs.act, theirs.ctrl
        self.flying, self._acceleration = other.flying, other._acceleration
        mujoco.mj_forward(self._model, mine)

    def position_and_velocity(self) -> tuple[Vector, Vector]:
        """Return the estimated position [m] and velocity [m/s]: the fast part of `estimate`, with the same errors."""
        x, y, z = self._data.qpos[:3].tolist()
        vx, vy, vz = self._data.qvel[:3].tolist()
        e = self._estimator.errors
        return (x + e[0], y + e[1], z + e[2]), (vx + e[3], vy + e[4], vz + e[5])

    def estimate(self) -> Estimate:
        """Return the full estimate now."""
        return self._estimator.read(*self._motion(), self._acceleration)

    def true_reading(self) -> Estimate:
        """Return the estimate that sensors without errors would give now."""
        position, velocity, attitude, rates = self._motion()
        w, x, y, z = attitude
        ax, ay, az = self._acceleration
        return Estimate(position, velocity, attitude, rates, rotate((w, -x, -y, -z), (ax, ay, az + GRAVITY)))

    def _motion(self) -> tuple[Vector, Vector, Quaternion, Vector]:
        """Return the true position, velocity, attitude and body rates."""
        px, py, pz, qw, qx, qy, qz = self._data.qpos.tolist()
        vx, vy, vz, p, q, r = self._data.qvel.tolist()
        return (px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (p, q, r)

    def state(self) -> Array:
        """Return the true state (9,); its acceleration is the mean over the last physics step."""
        return np.array([*self._data.qpos[:3], *self._data.qvel[:3], *self._acceleration])

    @staticmethod
    def estimated_state(estimate: Estimate) -> Array:
        """Return the state (9,) of an estimate."""
        return np.array([*estimate.position, *estimate.velocity, *estimate.acceleration])

    def _hover(self) -> None:
        """Start in steady hover: rotors at hovering thrust, tilted against the mean wind, holding the start."""
        mass = float(self._model.body_mass[self._model.body("base").id])  # a payload included
        self._data.act[:] = 0.25 * mass * GRAVITY
        integral = np.zeros(3)
        if self._wind_process is not None:
            mean = np.array(self._wind_process.mean)
            integral = -mean * (self._body.drag_linear + self._body.drag_quadratic * math.hypot(*mean))
        self.controller.hold(self._data.qpos[:3], integral)
        for _ in range(SETTLE * SAMPLES):
            self.advance(self._steps_per_sample)
        self.collided = False

    def _note_contacts(self) -> None:
        """Note the present contacts. A plane is the lowest type of geom, and comes first in a contact."""
        first = self._data.contact.geom[:, 0]
        floor = self._floor_geom
        if self._movers:
            speed = math.hypot(*self._data.qvel[:3].tolist())
            movers = self._movers.note_contacts(speed > STANDING or any(self.controller.setpoint))
            first = first[~movers]
        self.on_floor = bool((first == floor).any())
        if not self._movers.pushed:
            self.collided = self.collided or bool((first != floor).any())


def arena_model(arena: Arena, floor: float | None) -> mujoco.MjModel:
    """Compile the vehicle and the arena, with the vehicle at the start or on the floor below it."""
    spec = mujoco.MjSpec.from_string(MODEL)
    add_obstacles(spec, arena)
    x, y, z = arena.start[:3]
    if floor is not None:
        plane, place = mujoco.mjtGeom.mjGEOM_PLANE, (0.0, 0.0, floor)
        spec.worldbody.add_geom(
            name="floor", type=plane, size=(0.0, 0.0, 1.0), pos=place, contype=FLOOR_BIT, conaffinity=0
        )
        z = floor + spec.geom("guard").size[1]
    spec.body("base").pos = (x, y, z)
    return spec.compile()
