"""The quadrotor: a rigid body with four rotors in MuJoCo, its flight controller, and the vehicle that they make."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import robot_named
from brakeline.sim.arena import Arena
from brakeline.sim.flight_controller import GRAVITY, Airframe, FlightController, Gains, Vector
from brakeline.sim.flight_estimator import Estimate, FlightEstimator, QuadrotorNoise, rotate
from brakeline.sim.mujoco_obstacles import MoverBodies, add_movers, add_obstacles
from brakeline.sim.vehicle import Period, clip_input
from brakeline.sim.wind import Wind, WindProcess

Array = NDArray[np.float64]

QUADROTOR = robot_named("quadrotor")
MODEL = Path(__file__).with_name("quadrotor.xml").read_text()
SAMPLES = 5  # of the position in a period
OUTER_EVERY = 2  # physics steps for one of the velocity loop
FLOOR_BIT = 1
STANDING = 0.15  # m/s; no faster, and at no setpoint, it stands in the air
SETTLE = 5  # periods of hovering before the start


class Quadrotor:
    """One quadrotor in one arena, hovering at its start, or standing on the floor with its motors off.

    true, measured: states (p [m], v [m/s], a [m/s²]; ENU) of the centre of mass; input: the velocity setpoint executed
    last, after clipping and slew. The heading is kept at zero, east, unless `controller` is told otherwise.
    """

    def __init__(
        self,
        arena: Arena,
        rng: np.random.Generator,
        noise: QuadrotorNoise | None = None,
        wind: Wind | None = None,
        gains: Gains | None = None,
        floor: float | None = None,
    ) -> None:
        """floor: height of a plane to start from and to land on, m; None: there is none, and it starts hovering."""
        self.arena = arena
        self._model = _build(arena, floor)
        self._data = mujoco.MjData(self._model)
        self.timestep: float = self._model.opt.timestep
        self._ticks = round(QUADROTOR.period / SAMPLES / self.timestep)  # in a sample
        self._body = Airframe()
        self.controller = FlightController(self.timestep, OUTER_EVERY, gains, self._body)
        steps = round(QUADROTOR.period / self.timestep / OUTER_EVERY)
        self._estimator = FlightEstimator(noise or QuadrotorNoise(), rng, steps)
        self._rng, self._wind = rng, wind or Wind()
        self._air = None if self._wind.calm else WindProcess(self._wind, rng, self.timestep)
        self._moving = MoverBodies(self._model, self._data, arena.crowd)
        self._time = 0.0  # s
        self._floor_geom = -1 if floor is None else self._model.geom("floor").id
        self.flying = floor is None  # the controller has the rotors; else they stand or idle
        self.collided = False  # an obstacle was touched since it was last set to False
        self.on_floor = False  # the floor was touched in the last tick
        self._count = 0
        self._track: deque[list[float]] = deque(maxlen=64)  # positions at the end of each `fly` since `watch`
        self._acceleration = (0.0, 0.0, 0.0)
        self.input = np.zeros(QUADROTOR.action_dim)
        mujoco.mj_forward(self._model, self._data)
        if self.flying:
            self._hover()
        self._time = 0.0
        self._moving.begin()
        self.true, self.measured = self.state(), self.estimated_state(self.estimate())

    def step(self, input: Array) -> Period:
        """Fly one period at a velocity setpoint (3,) [m/s], clipped to bounds and to the slew from the one before.

        Raises:
            BadInput: when the input is not three finite numbers.
        """
        self.input = clip_input(QUADROTOR, input, self.input)
        x, y, z = self.input.tolist()
        self.controller.setpoint = (x, y, z)
        self.begin_period()
        start, seen = self.measured[:3], np.empty((SAMPLES, 3))
        for i in range(SAMPLES):
            self.fly(self._ticks)
            seen[i] = self.position_and_velocity()[0]
        self.measured = self.estimated_state(self.estimate())
        return self.end_period(self.measured, seen - start)

    def begin_period(self) -> None:
        """A period begins: note from now on what is touched, and where it has been."""
        self.collided = False
        self._moving.begin()
        self._track.clear()

    def end_period(self, measured: Array, path: Array) -> Period:
        """The period since `watch`, as it was; measured (9,) and path (S, 3) are what others made of it."""
        self.true = self.state()
        distances = self.clearance(np.array(self._track))
        closest, clearance = float(distances.min()), float(distances[-1])
        return Period(measured, self.true, self.collided, closest, clearance, path, 0.0, *self._moving.contacts)

    def initial_period(self) -> Period:
        """The present state as a period in which nothing happened: what there is to say before the first step."""
        clearance = float(self.clearance(self.true[:3]))
        return Period(self.measured, self.true, False, clearance, clearance, np.zeros((SAMPLES, 3)), 0.0)

    def alter(self, **changes: float) -> None:
        """Change `payload_kg` (at the centre of mass), `wind_speed` or `gust` [m/s], from now on.

        Raises:
            ValueError: it has no such thing, or it cannot have this value.
        """
        for name, value in changes.items():
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is 0 or more, not {value}")
            if name == "payload_kg":
                self._model.body_mass[self._model.body("base").id] = self._body.mass + value
                mujoco.mj_setConst(self._model, mujoco.MjData(self._model))
            elif name in ("wind_speed", "gust"):
                self._wind = replace(self._wind, **{"speed" if name == "wind_speed" else name: value})
                self._air = None if self._wind.calm else WindProcess(self._wind, self._rng, self.timestep)
            else:
                raise ValueError(f"a quadrotor has no {name}; it has: payload_kg, wind_speed, gust")

    def fly(self, ticks: int) -> None:
        """Let that many physics steps pass, each with the rotors' thrusts from the controller."""
        model, data, estimator, controller = self._model, self._data, self._estimator, self.controller
        qpos, qvel, control = data.qpos, data.qvel, data.ctrl
        position, velocity = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        before = (0.0, 0.0, 0.0)
        for _ in range(ticks):
            px, py, pz, qw, qx, qy, qz = qpos.tolist()
            vx, vy, vz, p, q, r = qvel.tolist()
            before = (vx, vy, vz)
            if self._count % OUTER_EVERY == 0:
                estimator.advance()
                e = estimator.errors
                position = (px + e[0], py + e[1], pz + e[2])
                velocity = (vx + e[3], vy + e[4], vz + e[5])
            self._count += 1
            if self.flying:
                control[:] = controller.update(position, velocity, (qw, qx, qy, qz), (p, q, r))
            self._blow(vx, vy, vz)
            if self._moving:
                self._time += self.timestep
                self._moving.place(self._time)
            # step2 before step1: contacts are then those of the position just reached
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            if data.ncon:
                self._touch()
            else:
                self.on_floor = False
                self._moving.part()
        vx, vy, vz = qvel[:3].tolist()
        dt = self.timestep
        self._track.append(qpos[:3].tolist())
        self._acceleration = ((vx - before[0]) / dt, (vy - before[1]) / dt, (vz - before[2]) / dt)

    def cut_rotors(self) -> None:
        """Rotors at rest, or idling: no thrust to speak of, until `launch`."""
        self.flying = False
        self._data.ctrl[:] = 0.0

    def set_thrusts(self, thrusts: tuple[float, ...]) -> None:
        """Another controller has the rotors: thrusts [N] in the order of the model's, until told otherwise."""
        self.flying = False
        self._data.ctrl[:] = thrusts  # clipped to what a rotor can give

    def start_rotors(self) -> None:
        """The controller takes the rotors, holding the heading as it is."""
        w, x, y, z = self._data.qpos[3:7].tolist()
        self.controller.reset(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        self.flying = True

    def copy_motion(self, other: Quadrotor) -> None:
        """Go on as another one flies, but from here: its attitude, speeds and rotors."""
        mine, theirs = self._data, other._data
        mine.qpos[3:], mine.qvel[:] = theirs.qpos[3:], theirs.qvel
        mine.act[:], mine.ctrl[:] = theirs.act, theirs.ctrl
        self.flying, self._acceleration = other.flying, other._acceleration
        mujoco.mj_forward(self._model, mine)

    def position_and_velocity(self) -> tuple[Vector, Vector]:
        """Position [m] and velocity [m/s] as estimated now: the cheap part of `estimate`, with the same errors."""
        x, y, z = self._data.qpos[:3].tolist()
        vx, vy, vz = self._data.qvel[:3].tolist()
        e = self._estimator.errors
        return (x + e[0], y + e[1], z + e[2]), (vx + e[3], vy + e[4], vz + e[5])

    def estimate(self) -> Estimate:
        """What the vehicle knows of itself now."""
        px, py, pz, qw, qx, qy, qz = self._data.qpos.tolist()
        vx, vy, vz, p, q, r = self._data.qvel.tolist()
        return self._estimator.read((px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (p, q, r), self._acceleration)

    def true_reading(self) -> Estimate:
        """What sensors without any error would say now."""
        px, py, pz, qw, qx, qy, qz = self._data.qpos.tolist()
        vx, vy, vz, p, q, r = self._data.qvel.tolist()
        ax, ay, az = self._acceleration
        felt = rotate((qw, -qx, -qy, -qz), (ax, ay, az + GRAVITY))
        return Estimate((px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (p, q, r), felt)

    def state(self) -> Array:
        """The true state (9,); its acceleration is the mean over the last physics step."""
        return np.array([*self._data.qpos[:3], *self._data.qvel[:3], *self._acceleration])

    @staticmethod
    def estimated_state(estimate: Estimate) -> Array:
        """The state (9,) of an estimate."""
        return np.array([*estimate.position, *estimate.velocity, *estimate.acceleration])

    def clearance(self, positions: Array) -> Array:
        """From the footprint's sphere at positions (..., 3) to the nearest obstacle, m; inf without any."""
        if not len(self.arena.shapes):
            return np.full(positions.shape[:-1], math.inf)
        return np.asarray(self.arena.shapes.distance(positions).min(axis=0) - QUADROTOR.footprint)

    def _hover(self) -> None:
        """Be in the air for long: rotors at hovering thrust, the mean wind leant against, the start held."""
        self._data.act[:] = 0.25 * self._body.mass * GRAVITY
        controller = self.controller
        controller.x.hold, controller.y.hold, controller.z.hold = self._data.qpos[:3].tolist()
        if self._air is not None:
            for axis, wind in zip((controller.x, controller.y, controller.z), self._air.mean, strict=True):
                axis.integral = -wind * (
                    self._body.drag_linear + self._body.drag_quadratic * math.hypot(*self._air.mean)
                )
        self.fly(SETTLE * SAMPLES * self._ticks)
        self.collided = False

    def _blow(self, vx: float, vy: float, vz: float) -> None:
        """The air's drag on the body moving at a velocity, m/s."""
        if self._air is not None:
            self._air.advance()
            wx, wy, wz = self._air.velocity
            vx, vy, vz = vx - wx, vy - wy, vz - wz
        body = self._body
        drag = body.mass * (body.drag_linear + body.drag_quadratic * math.sqrt(vx * vx + vy * vy + vz * vz))
        self._data.qfrc_applied[:3] = (-drag * vx, -drag * vy, -drag * vz)

    def _touch(self) -> None:
        """Note what the vehicle touches: a plane is the lowest type of geom, and comes first in a contact."""
        first = self._data.contact.geom[:, 0]
        floor = self._floor_geom
        if self._moving:
            speed = math.hypot(*self._data.qvel[:3].tolist())
            movers = self._moving.meet(speed > STANDING or any(self.controller.setpoint))
            first = first[~movers]
        self.on_floor = bool((first == floor).any())
        if not self._moving.pushed:
            self.collided = self.collided or bool((first != floor).any())


def _build(arena: Arena, floor: float | None) -> mujoco.MjModel:
    """Compile vehicle and arena, the vehicle at the start, or on the floor below it."""
    spec = mujoco.MjSpec.from_string(MODEL)
    add_obstacles(spec, arena)
    add_movers(spec, arena.crowd)
    x, y, z = arena.start[:3]
    if floor is not None:
        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(0.0, 0.0, 1.0),
            pos=(0.0, 0.0, floor),
            contype=FLOOR_BIT,
            conaffinity=0,
        )
        z = floor + spec.geom("guard").size[1]
    spec.body("base").pos = (x, y, z)
    return spec.compile()
