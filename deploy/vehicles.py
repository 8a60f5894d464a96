"""Which simulator belongs to which robot: the one place to add a robot's."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial

import numpy as np

from actors.flying import MavlinkVehicle
from actors.mavlink import Tap
from messaging.robots import GROUND, QUADROTOR, Robot, robot_named
from sim.arenas import arena_kind, draw_arena
from sim.autopilot.endpoint import Autopilot
from sim.autopilot.rules import SETPOINT_TIMEOUT
from sim.envs import NavigationEnv
from sim.estimator import NoiseLevels
from sim.flight_estimator import QuadrotorNoise
from sim.ground import GroundRobot
from sim.late import late
from sim.quadrotor import Quadrotor
from sim.vehicle import MakeVehicle, Vehicle
from sim.wind import Wind
from sim.world import Arena, closing, room_bounds

YARD = {2: 50.0, 3: 500.0}  # m to the walls of the place where data are recorded: farther than a trajectory can go


@dataclass(frozen=True)
class Conditions:
    """What may differ between the robot that was recorded and the one that drives, of every robot kind."""

    noise: NoiseLevels = field(default_factory=NoiseLevels)
    payload_kg: float = 0.0
    floor_friction: float = 1.0
    flight_noise: QuadrotorNoise = field(default_factory=QuadrotorNoise)
    wind: Wind = field(default_factory=Wind)

    def describe(self) -> dict[str, str]:
        """For metadata and printed results: every level with its value."""
        values = asdict(self.noise) | {"payload_kg": self.payload_kg, "floor_friction": self.floor_friction}
        values |= {f"flight_{name}": value for name, value in asdict(self.flight_noise).items()}
        values |= {f"wind_{name}": value for name, value in asdict(self.wind).items()}
        return {name: "drawn" if value is None else f"{value:g}" for name, value in values.items()}

    def factory(self, robot: Robot, tap: Tap | None = None) -> MakeVehicle:
        """What makes a vehicle of that kind under these conditions; tap: see `environment`.

        Raises:
            ValueError: there is none.
        """
        if robot.late:
            return late(self.factory(robot_named(robot.kind), tap), robot)
        if robot is GROUND:
            return partial(
                GroundRobot, noise=self.noise, payload_kg=self.payload_kg, floor_friction=self.floor_friction
            )
        if robot is QUADROTOR:
            return partial(embedded_quadrotor, noise=self.flight_noise, wind=self.wind, tap=tap)
        raise ValueError(f"no simulator for {robot.name}")

    def lidar_noise(self, robot: Robot) -> float:
        """Sigma of a range, m."""
        noise = self.noise if robot.kind == GROUND.name else self.flight_noise
        return noise.scale * noise.lidar


def embedded_quadrotor(
    arena: Arena,
    rng: np.random.Generator,
    noise: QuadrotorNoise | None = None,
    wind: Wind | None = None,
    rules: str = "px4",
    *,
    tap: Tap | None = None,
) -> MavlinkVehicle:
    """A quadrotor behind its own autopilot, over MAVLink in memory.

    It brakes by itself when a setpoint is overdue by a period. tap: is called with every MAVLink frame.
    """
    parameters = {SETPOINT_TIMEOUT[rules]: QUADROTOR.period}
    return MavlinkVehicle(Autopilot(Quadrotor(arena, rng, noise, wind), rules, parameters=parameters, quiet=True), tap)


def flight_arena(name: str, seed: int) -> Arena:
    """The one arena of a flight in real time: the autopilot's world, and the actor's map."""
    return draw_arena(name, np.random.default_rng(seed), QUADROTOR)


def environment(
    robot: Robot, arena: str, seed: int, conditions: Conditions | None = None, *, tap: Tap | None = None
) -> NavigationEnv:
    """A Gymnasium environment; `seed` sets its episodes apart from those of another seed; tap: is called with every
    MAVLink frame of a robot that has any.

    Raises:
        ValueError: no simulator for this robot; UnknownArena: no such arena for it.
    """
    c = conditions or Conditions()
    make = c.factory(robot, tap)
    arena_kind(robot, arena)
    return NavigationEnv(robot, arena, make, c.lidar_noise(robot), seed_key=seed)


def vehicle_in_yard(robot: Robot, rng: np.random.Generator, conditions: Conditions) -> Vehicle:
    """The bare vehicle with nothing near it, heading at random."""
    yard = YARD[robot.position_dim]
    height = None if robot.position_dim == 2 else 2.0 * yard
    start = (0.0, 0.0, float(rng.uniform(-np.pi, np.pi)) if height is None else yard)
    goal = (0.5 * yard, 0.0) if height is None else (0.5 * yard, 0.0, yard)
    arena = Arena("yard", closing(yard, height), start, goal, 0.25, 10**9, room_bounds(yard, height))
    return conditions.factory(robot)(arena, rng)
