"""The Gymnasium environment: reach the goal, touch nothing. Robot, arena and vehicle are arguments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.task import Reward, RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.observations import LIDAR_NOISE, ObservationModel
from brakeline.sim.range_sensors import Perception, make_scanner
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.traffic import Crowd, CrowdSensor
from brakeline.sim.vehicle import MakeVehicle, Period, Vehicle

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
Info = dict[str, Any]
DrawArena = Callable[[str, np.random.Generator, RobotWithTask], Arena]

OBSERVED_LIMIT = 1.5  # every coordinate of the observation is clipped to ± this


class NavigationEnv(gymnasium.Env[Observation, Any]):
    """One robot, a fresh random arena each episode.

    Action: the robot's input in physical units, clipped to its bounds and slew. Observation: `task.observed`,
    float32. Terminated on reaching the goal or touching anything (both judged on the true position), truncated at
    the arena's step limit. An episode is determined by `seed_key` and its episode seed alone; `reset(seed=…)` fixes the
    sequence of episode seeds, `reset(options={"episode_seed": …})` a single one; `options={"arena": …}` changes the
    arena's name, for good.

    `info`, after reset and after step, has these keys (n state coordinates, d of them the position, m inputs, S samples
    in a period):

    =================  =================================================================================
    robot              name of the robot
    state              (n,) measured state, as `robot.state` names it
    true_state         (n,) the same without measurement error; nothing that drives may look at it
    outside            the true state is farther from the measured one than `robot.measurement_bound`
    input_in_force     (m,) the input executed last, within bounds and slew; zero at the start
    obstacles          list[Obstacle]: those with their surface within `robot.sight` of the measured position; those
                       that move, as measured, with their motion, if they may come as near within a plan;
                       none where free space comes from scans
    scan               Scan | RangeImage | None: the newest there is, where free space comes from scans
    arena              Arena: the whole map
    goal               (d,) m
    time               s since the episode's start
    collision          some part of the robot touched an obstacle that stands during the last period
    contact_moving     it touched something that moves, and was moving itself when that began
    contact_standing   it was run into while it stood
    contact_robot      it touched another robot of its world (`brakeline.sim.shared_world`)
    at_goal            the goal is reached
    clearance          m from the nearest disc (sphere) of the body to the nearest obstacle, true
    speed              m/s, true
    subsamples         (S, d) m: estimated positions within the last period, in the robot's frame at its start
    turned             rad: estimated change of heading over the last period
    episode_seed       what `options` takes to get this episode again
    =================  =================================================================================
    """

    def __init__(
        self,
        robot: RobotWithTask,
        arena: str = "default",
        make_vehicle: MakeVehicle | None = None,
        lidar_noise: float = LIDAR_NOISE,
        seed_key: int = 0,
        reward: Reward | None = None,
        draw: DrawArena = draw_arena,
        perception: Perception | None = None,
    ) -> None:
        """make_vehicle: puts a vehicle of that robot kind at an arena's start, for one episode (None: the task's
        own, under usual conditions); lidar_noise: m, sigma
        of a range; seed_key: sets apart the episodes of two environments whose episode seeds are the same, 0 or more;
        draw: makes an episode's arena; perception: where free space comes from; from the map, unless given.
        """
        self.robot, self.arena_name, self.seed_key = robot, arena, seed_key
        self.task = robot.task
        self.reward = reward or self.task.reward
        self.action_space = Box(robot.low().astype(np.float32), robot.high().astype(np.float32), dtype=np.float32)
        limit = np.full(self.task.observation_dim, OBSERVED_LIMIT, dtype=np.float32)
        self.observation_space = Box(-limit, limit, dtype=np.float32)
        self._make_senses = self.task.code(self.task.senses)
        self._make_vehicle: MakeVehicle = make_vehicle or self.task.code(self.task.simulator)(Conditions(), None)
        self._lidar_noise, self._draw = lidar_noise, draw
        self._bound = np.asarray(robot.measurement_bound)
        self._perception = perception or Perception()
        self._changes: dict[str, float] = {}
        self._vehicle: Vehicle | None = None

    @property
    def vehicle(self) -> Vehicle:
        """The robot of the running episode."""
        if self._vehicle is None:
            raise gymnasium.error.ResetNeeded("reset the environment before anything else")
        return self._vehicle

    def alter(self, **changes: float) -> None:
        """Change the vehicle's physics from now on, this episode and later ones, as `Vehicle.alter` does."""
        self._changes |= changes
        if self._vehicle is not None:
            self._vehicle.alter(**changes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        options = options or {}
        self.arena_name = options.get("arena", self.arena_name)
        drawn = int(self.np_random.integers(2**31)) if "episode_seed" not in options else options["episode_seed"]
        self._episode_seed = int(drawn)
        rng = np.random.default_rng((self.seed_key, self._episode_seed))
        self._arena = self._draw(self.arena_name, rng, self.robot)
        self._vehicle = self._make_vehicle(self._arena, rng)
        if self._changes:
            self._vehicle.alter(**self._changes)
        self._senses: ObservationModel = self._make_senses(self.robot, self._arena, rng, self._lidar_noise)
        self._scanner = None
        if self._perception.kind == "scan":
            self._scanner = make_scanner(self.robot, self._arena, rng, self._lidar_noise, self._perception)
        crowd = self._arena.crowd
        self._pushed = crowd is not None and crowd.pushes  # by whoever runs into it
        self._watch = (
            CrowdSensor(crowd, rng) if isinstance(crowd, Crowd) else None
        )  # other robots promise where they will be
        self._steps = 0
        self._distance = self._goal_distance(self._vehicle.true)
        return self._observe(), self._info(self._vehicle.initial_period())

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, Info]:
        return self.after(self.vehicle.step(action))

    def after(self, period: Period) -> tuple[Observation, float, bool, bool, Info]:
        """What `step` returns of a period that was driven."""
        self._steps += 1
        before, self._distance = self._distance, self._goal_distance(period.true)
        at_goal = self._at_goal(period)
        reward = self.reward.progress * (before - self._distance)
        hit = period.collision or period.contact_moving or period.contact_robot
        reward += self.reward.goal * at_goal + self.reward.collision * hit
        reward += self.reward.run_into * period.contact_standing
        terminated = at_goal or hit or (period.contact_standing and self._pushed)
        truncated = not terminated and self._steps >= self._arena.step_limit
        return self._observe(), float(reward), terminated, truncated, self._info(period)

    def _goal_distance(self, state: Array) -> float:
        return math.dist(self._arena.goal, state[: self.robot.position_dim])

    def _at_goal(self, period: Period) -> bool:
        return self._distance <= self._arena.goal_radius and not (
            period.collision or period.contact_moving or period.contact_standing or period.contact_robot
        )

    def _observe(self) -> Observation:
        vehicle = self.vehicle
        observation = self._senses.observe(
            vehicle.true, vehicle.measured, vehicle.input, self._steps * self.robot.period
        )
        return np.clip(observation, -OBSERVED_LIMIT, OBSERVED_LIMIT).astype(np.float32)

    def _outside(self, period: Period) -> bool:
        """Whether the measurement is farther from the truth than it may be."""
        error = np.abs(period.measured - period.true)
        if (heading := self.robot.heading) is not None:
            error[heading] = abs(wrap(period.measured[heading] - period.true[heading]))
        return bool((error > self._bound).any())

    def _moving(self, position: Array) -> list[Obstacle]:
        """What moves and may come within sight before a plan ends, as measured now."""
        if self._watch is None:
            return []
        seen = self._watch.look(self._steps * self.robot.period)
        within = self.robot.horizon * self.robot.period
        nearest = MovingObstacles.of(seen, self.robot.position_dim).least_distance(position, within)
        return [seen[i] for i in np.flatnonzero(nearest <= self.robot.sight)]

    def _info(self, period: Period) -> Info:
        position, time = period.measured[: self.robot.position_dim], self._steps * self.robot.period
        obstacles, sensed = [], {}
        if self._scanner is not None:
            sensed["scan"] = self._scanner.scan(period.true, period.measured, time)
        else:
            near = self._arena.shapes.distance(position) <= self.robot.sight
            obstacles = [self._arena.obstacles[i] for i in np.flatnonzero(near)] + self._moving(position)
        return {
            "robot": self.robot.name,
            "state": period.measured,
            "true_state": period.true,
            "outside": self._outside(period),
            "input_in_force": self.vehicle.input,
            "obstacles": obstacles,
            **sensed,
            "arena": self._arena,
            "goal": self._arena.goal,
            "time": time,
            "collision": period.collision,
            "contact_moving": period.contact_moving,
            "contact_standing": period.contact_standing,
            "contact_robot": period.contact_robot,
            "at_goal": self._at_goal(period),
            "clearance": period.clearance,
            "speed": self._senses.speed(period.true),
            "subsamples": period.subsamples,
            "turned": period.turned,
            "episode_seed": self._episode_seed,
        }
