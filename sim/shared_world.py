"""Several ground robots in one world: one physics, and for each robot an environment of its own to look out of."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena, same_room
from brakeline.sim.arena_generator import arena_kind, draw_fleet
from brakeline.sim.ground_robot import GROUND, MODEL, PAYLOAD_GYRATION, SAMPLES, WHEEL_RADIUS, TurtleBot
from brakeline.sim.mujoco_obstacles import add_obstacles
from brakeline.sim.navigation_env import Info, NavigationEnv, Observation
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.traffic import OtherRobots
from brakeline.sim.vehicle import Period

Array = NDArray[np.float64]
Result = tuple[Observation, float, bool, bool, Info]

ROBOT_BIT = 4  # the contact bit of robots for each other
FLOOR, STILL = -1, -2  # in place of a robot's number: whose a geom is


class NoFleet(ValueError):
    """There is no world for several robots of this kind."""


def check_fleet(robot: RobotWithTask, arena: str, size: int, conditions: Conditions) -> None:
    """
    Raises:
        NoFleet: there is no such world, for robots of this kind, in that arena, under these conditions; UnknownArena.
    """
    if robot.layout() != GROUND.layout():
        raise NoFleet(f"several {robot.name} robots in one world are not there: ground robots are")
    if arena_kind(robot, arena).movers is not None:
        raise NoFleet(f"{arena} has things that move: a fleet's arena has none but its robots")
    if size < 1:
        raise NoFleet("a fleet has a robot at least")
    if conditions.perception.kind != "map":
        raise NoFleet("a fleet drives by the map: a scan shows other robots as walls")


class FleetRobot(TurtleBot):
    """One of a world; only the world can move time on."""

    def step(self, input: Array) -> Period:
        """Raises RuntimeError: step the world."""
        raise RuntimeError("a fleet's robots are driven together: step their world")

    def alter(self, **changes: float) -> None:
        """Raises ValueError: what a fleet is like is said before it is made."""
        if changes:
            raise ValueError(f"a robot of a fleet has no {', '.join(sorted(changes))} to be changed")


class GroundWorld:
    """The robots at the starts of arenas that differ in start and goal alone.

    touches: how often two of them began to touch, each pair and time counted once.
    """

    def __init__(self, arenas: Sequence[Arena], rngs: Sequence[np.random.Generator], conditions: Conditions) -> None:
        self._model = _build(arenas, conditions)
        self._data = mujoco.MjData(self._model)
        self.robots = [FleetRobot(arena, self._data, i) for i, arena in enumerate(arenas)]
        self._owner = _owners(self._model, len(arenas))
        self._physics_steps = round(GROUND.period / SAMPLES / self._model.opt.timestep)
        self._touching: set[tuple[int, int]] = set()
        self.touches = 0
        mujoco.mj_forward(self._model, self._data)
        self._run([np.zeros(GROUND.action_dim)] * len(arenas))  # sink onto the wheels
        for robot, rng in zip(self.robots, rngs, strict=True):
            robot.wake(conditions.noise, rng)

    def step(self, inputs: Sequence[Array]) -> list[Period]:
        """One period of all robots, each with its input.

        Raises:
            BadInput: one is not two finite numbers.
        """
        for robot, input in zip(self.robots, inputs, strict=True):
            robot.take(input)
        collided, met = self._run([robot.input for robot in self.robots])
        return [robot.report(i in collided, contact_robot=i in met) for i, robot in enumerate(self.robots)]

    def _run(self, inputs: Sequence[Array]) -> tuple[set[int], set[int]]:
        """Who touched what stands still, and who began to touch another robot."""
        collided, met = set[int](), set[int]()
        for robot, input in zip(self.robots, inputs, strict=True):
            robot.begin(input)
        for i in range(SAMPLES):
            for _ in range(self._physics_steps):
                # step2 before step1: contacts are then those of the position just reached
                mujoco.mj_step2(self._model, self._data)
                mujoco.mj_step1(self._model, self._data)
                self._note(collided, met)
            for robot in self.robots:
                robot.sample(i)
        return collided, met

    def _note(self, collided: set[int], met: set[int]) -> None:
        """Take in the contacts that there are now."""
        low, high = np.sort(self._owner[self._data.contact.geom], axis=1).T
        collided.update(high[low == STILL].tolist())
        pairs = (low >= 0) & (low != high)
        touching = set(zip(low[pairs].tolist(), high[pairs].tolist(), strict=True)) if pairs.any() else set()
        for pair in touching - self._touching:
            self.touches += 1
            met.update(pair)
        self._touching = touching


class FleetEnv:
    """A world of `size` robots, drawn anew by each reset; `members` are the robots' own environments."""

    def __init__(
        self, robot: RobotWithTask, arena: str, size: int, seed: int, conditions: Conditions | None = None
    ) -> None:
        """seed: sets its episodes apart from those of another seed.

        Raises:
            NoFleet: for robots of this kind, or in that arena, there is no such world; UnknownArena.
        """
        self.robot, self.arena_name, self.size, self.seed = robot, arena, size, seed
        self.conditions = conditions or Conditions()
        check_fleet(robot, arena, size, self.conditions)
        noise = self.conditions.lidar_noise(flies=False)
        self.members = [_Member(self, i, noise) for i in range(size)]
        self.touches = 0  # over all worlds

    def draw(self, episode_seed: int) -> None:
        """A fresh world; then each member is to be reset."""
        rng = np.random.default_rng((self.seed, episode_seed))
        arenas = draw_fleet(self.arena_name, rng, self.robot, self.size)
        self.world = GroundWorld(arenas, rng.spawn(self.size), self.conditions)

    def step(self, inputs: Sequence[Array]) -> list[Result]:
        """One period of all; what each member's `step` would return."""
        before = self.world.touches
        periods = self.world.step(inputs)
        self.touches += self.world.touches - before
        return [member.after(period) for member, period in zip(self.members, periods, strict=True)]

    def others(self, i: int) -> Array:
        """(size - 1, n) measured states of all robots but the i-th."""
        states = [robot.measured for j, robot in enumerate(self.world.robots) if j != i]
        return np.array(states).reshape(-1, self.robot.state_dim)


class _Member(NavigationEnv):
    """The environment of the i-th robot: `info` gains `others`, their measured states (size - 1, n)."""

    def __init__(self, fleet: FleetEnv, i: int, lidar_noise: float) -> None:
        def draw(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
            there = fleet.world.robots

            def now() -> Array:
                return np.array([other.true[:2] for j, other in enumerate(there) if j != i])

            def told() -> tuple[Array, Array]:
                states = fleet.others(i)
                return states[:, :2], states[:, 3:4] * np.column_stack([np.cos(states[:, 2]), np.sin(states[:, 2])])

            return same_room(there[i].arena, crowd=OtherRobots(now, robot.footprint, told))

        def make(arena: Arena, rng: np.random.Generator) -> FleetRobot:
            return fleet.world.robots[i]

        super().__init__(fleet.robot, fleet.arena_name, make, lidar_noise, fleet.seed, draw=draw)
        self._fleet, self._number = fleet, i

    def _info(self, period: Period) -> Info:
        return super()._info(period) | {"others": self._fleet.others(self._number)}


def _build(arenas: Sequence[Arena], conditions: Conditions) -> mujoco.MjModel:
    """Compile the world; robots first, so that their coordinates are one after the other."""
    spec = mujoco.MjSpec.from_string(MODEL)
    for i in range(1, len(arenas)):
        other = mujoco.MjSpec.from_string(MODEL)
        other.delete(other.geom("floor"))
        spec.attach(other, prefix=f"{i} ", frame=spec.worldbody.add_frame())
    for i, arena in enumerate(arenas):
        base = spec.body("base" if i == 0 else f"{i} base")
        x, y, heading = arena.start
        base.pos = (x, y, WHEEL_RADIUS)
        base.quat = (np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading))
    for geom in spec.geoms:
        if geom.name != "floor":
            geom.contype, geom.conaffinity = ROBOT_BIT, geom.conaffinity | ROBOT_BIT
    add_obstacles(spec, arenas[0])
    model = spec.compile()
    for i in range(len(arenas)):
        name = "base" if i == 0 else f"{i} base"
        base = model.body(name).id
        model.body_mass[base] += conditions.payload_kg
        model.body_inertia[base] += conditions.payload_kg * PAYLOAD_GYRATION**2
        wheels = [model.geom(name.replace("base", f"{side} wheel")).id for side in ("left", "right")]
        model.geom_friction[wheels, 0] = conditions.floor_friction
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _owners(model: mujoco.MjModel, size: int) -> NDArray[np.int_]:
    """Whose each geom is: a robot's number, `FLOOR` or `STILL`."""
    owner = np.full(model.ngeom, STILL)
    owner[model.geom("floor").id] = FLOOR
    for i in range(size):
        base = model.body("base" if i == 0 else f"{i} base").id
        owner[model.body_rootid[model.geom_bodyid] == base] = i
    return owner
