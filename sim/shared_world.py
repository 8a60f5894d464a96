"""Several ground robots in one physics, with a Gymnasium environment for each of them."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.errors import NoFleet
from brakeline.messaging.obstacle import Array
from brakeline.messaging.task import RobotWithTask, arena_kind
from brakeline.sim.arena import Arena, same_room
from brakeline.sim.arena_generator import draw_fleet
from brakeline.sim.floor_physics import place_base
from brakeline.sim.ground_robot import GROUND, MODEL, SAMPLE_TIME, SAMPLES, WHEEL_RADIUS, TurtleBot, changes_of, prefix
from brakeline.sim.mujoco_obstacles import add_obstacles
from brakeline.sim.navigation_env import Info, NavigationEnv, StepResult
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.traffic import OtherRobots
from brakeline.sim.vehicle import Period

ROBOT_BIT = 4  # the contact bit with which robots touch each other
FLOOR, OBSTACLE = -1, -2  # owners of a geom that belongs to no robot


def check_fleet(robot: RobotWithTask, arena: str, size: int, conditions: Conditions) -> None:
    """Check that `size` robots can share a world.

    Raises:
        NoFleet: the robot's kind, the arena, the size or the conditions do not allow it.
        UnknownName: the robot has no arena of that name.
    """
    if robot.layout() != GROUND.layout():
        raise NoFleet(f"only ground robots can share a world, not {robot.name}")
    if arena_kind(robot, arena).movers is not None:
        raise NoFleet(f"the arena {arena} has obstacles that move; a fleet needs an arena without them")
    if size < 1:
        raise NoFleet(f"a fleet has at least one robot, not {size}")
    if conditions.perception.kind != "map":
        raise NoFleet("a fleet drives by the map (--perception map): a scan shows other robots as walls")


class GroundWorld:
    """Several robots in one room, each at the start of its arena."""

    def __init__(self, arenas: Sequence[Arena], rngs: Sequence[np.random.Generator], conditions: Conditions) -> None:
        """Place a robot at the start of each arena: the same room with different starts and goals."""
        self._model = _build(arenas)
        self._data = mujoco.MjData(self._model)
        # one for each arena
        self.robots = [TurtleBot(arena, self._model, self._data, i) for i, arena in enumerate(arenas)]
        changes = changes_of(conditions)
        for robot, rng in zip(self.robots, rngs, strict=True):
            robot.alter(**changes)
            robot.start_disturbances(conditions.process_noise, rng)
        self._owner = _owners(self._model, len(arenas))
        self._physics_steps = round(SAMPLE_TIME / self._model.opt.timestep)
        self._touching: set[tuple[int, int]] = set()
        self.robot_contacts = 0  # how often two robots began to touch each other
        mujoco.mj_forward(self._model, self._data)
        self._run([np.zeros(GROUND.action_dim)] * len(arenas))  # settle on the wheels
        for robot, rng in zip(self.robots, rngs, strict=True):
            robot.start_estimation(conditions.noise, rng)

    def step(self, inputs: Sequence[Array]) -> list[Period]:
        """Advance all robots by one period, each with its input (2,). Raises as `TurtleBot.set_input`."""
        for robot, input in zip(self.robots, inputs, strict=True):
            robot.set_input(input)
        collided, met = self._run([robot.input for robot in self.robots])
        return [robot.end_period(i in collided, False, False, i in met) for i, robot in enumerate(self.robots)]

    def _run(self, inputs: Sequence[Array]) -> tuple[set[int], set[int]]:
        """Run one period; return which robots touched an obstacle, and which began to touch another robot."""
        collided, met = set[int](), set[int]()
        for robot, input in zip(self.robots, inputs, strict=True):
            robot.begin_period(input)
        for i in range(SAMPLES):
            for robot in self.robots:
                robot.begin_sample(i)
            for _ in range(self._physics_steps):
                # step2 before step1, so that the contacts belong to the new position
                mujoco.mj_step2(self._model, self._data)
                mujoco.mj_step1(self._model, self._data)
                self._note_contacts(collided, met)
            for robot in self.robots:
                robot.record_sample(i)
        return collided, met

    def _note_contacts(self, collided: set[int], met: set[int]) -> None:
        """Add the robots in the present contacts to the sets."""
        low, high = np.sort(self._owner[self._data.contact.geom], axis=1).T
        collided.update(high[low == OBSTACLE].tolist())
        pairs = (low >= 0) & (low != high)
        touching = set(zip(low[pairs].tolist(), high[pairs].tolist(), strict=True)) if pairs.any() else set()
        for pair in touching - self._touching:
            self.robot_contacts += 1
            met.update(pair)
        self._touching = touching


class FleetEnv:
    """A world of `size` robots. `draw` makes a fresh one; `members` are the robots' own environments."""

    def __init__(
        self, robot: RobotWithTask, arena: str, size: int, seed: int, conditions: Conditions | None = None
    ) -> None:
        """seed: environments with different seeds have different episodes. Raises as `check_fleet`."""
        self.robot, self.arena_name, self.size, self.seed = robot, arena, size, seed
        self.conditions = conditions or Conditions()
        check_fleet(robot, arena, size, self.conditions)
        self.members = [_Member(self, i) for i in range(size)]
        self.touches = 0  # how often two robots began to touch each other, over all worlds

    def draw(self, episode_seed: int) -> None:
        """Draw a fresh world. Reset each member afterwards."""
        rng = np.random.default_rng((self.seed, episode_seed))
        arenas = draw_fleet(self.arena_name, rng, self.robot, self.size)
        self.world = GroundWorld(arenas, rng.spawn(self.size), self.conditions)

    def step(self, inputs: Sequence[Array]) -> list[StepResult]:
        """Advance all robots by one period; return what the `step` of each member would return."""
        before = self.world.robot_contacts
        periods = self.world.step(inputs)
        self.touches += self.world.robot_contacts - before
        return [member.finish_step(period) for member, period in zip(self.members, periods, strict=True)]

    def other_states(self, i: int) -> Array:
        """Return the measured states (size - 1, n) of all robots but the i-th."""
        states = [robot.measured for j, robot in enumerate(self.world.robots) if j != i]
        return np.array(states).reshape(-1, self.robot.state_dim)


class _Member(NavigationEnv):
    """The environment of the i-th robot. `info` also has `others`, their measured states (size - 1, n)."""

    def __init__(self, fleet: FleetEnv, i: int) -> None:
        self._fleet, self._number = fleet, i
        super().__init__(
            fleet.robot,
            fleet.arena_name,
            lambda arena, rng: fleet.world.robots[i],
            conditions=fleet.conditions,
            seed_key=fleet.seed,
            draw=lambda name, rng, robot: same_room(fleet.world.robots[i].arena, crowd=self._others()),
        )

    def _others(self) -> OtherRobots:
        """Return the other robots of the present world as moving obstacles."""
        robots = [robot for j, robot in enumerate(self._fleet.world.robots) if j != self._number]

        def reported() -> tuple[Array, Array]:
            states = self._fleet.other_states(self._number)
            return states[:, :2], states[:, 3:4] * np.column_stack([np.cos(states[:, 2]), np.sin(states[:, 2])])

        return OtherRobots(lambda: np.array([robot.true[:2] for robot in robots]), self.robot.footprint, reported)

    def _info(self, period: Period) -> Info:
        return super()._info(period) | {"others": self._fleet.other_states(self._number)}


def _build(arenas: Sequence[Arena]) -> mujoco.MjModel:
    """Compile the world, robots first, so that their coordinates follow each other."""
    spec = mujoco.MjSpec.from_string(MODEL)
    for i in range(1, len(arenas)):
        other = mujoco.MjSpec.from_string(MODEL)
        other.delete(other.geom("floor"))
        spec.attach(other, prefix=prefix(i), frame=spec.worldbody.add_frame())
    for i, arena in enumerate(arenas):
        place_base(spec.body(f"{prefix(i)}base"), arena, WHEEL_RADIUS)
    for geom in spec.geoms:
        if geom.name != "floor":
            geom.contype, geom.conaffinity = ROBOT_BIT, geom.conaffinity | ROBOT_BIT
    add_obstacles(spec, arenas[0])
    return spec.compile()


def _owners(model: mujoco.MjModel, size: int) -> NDArray[np.int_]:
    """Return the owner of each geom: the number of a robot, `FLOOR` or `OBSTACLE`."""
    owner = np.full(model.ngeom, OBSTACLE)
    owner[model.geom("floor").id] = FLOOR
    for i in range(size):
        owner[model.body_rootid[model.geom_bodyid] == model.body(f"{prefix(i)}base").id] = i
    return owner
