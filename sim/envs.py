"""The Gymnasium environment of the ground robot: reach the goal, touch nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from messaging.robots import GROUND, RAYS, Robot
from sim.estimator import NoiseLevels, cut_normal, wrap
from sim.ground import GroundRobot, Period
from sim.lidar import MAX_RANGE, cast
from sim.world import draw_arena

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
Info = dict[str, Any]

LIDAR_MOUNT = -0.032  # m along the robot's x axis from the axle's midpoint
DISTANCE_SCALE = 5.0  # m, the goal distance that is observed as 1
OBSERVED_LIMIT = 1.5  # every coordinate of the observation is clipped to ± this
REACH = 1.0  # m from the measured position to the surfaces of the obstacles in `info`


@dataclass(frozen=True)
class Reward:
    """What an episode pays. Progress adds up to the way made towards the goal, whichever way was taken."""

    progress: float = 20.0  # a metre nearer to the goal
    goal: float = 100.0
    collision: float = -100.0


@dataclass
class TurnMemory:
    """Measured turn rate through a first-order low pass, rad/s: the observation's one coordinate of memory.

    A policy without memory dithers in front of an obstacle that can be passed on both sides: as soon as it has turned
    a little to one side, noise makes the other look better. Seeing which way it has been turning for about
    `TIME` seconds it can go on turning that way.
    """

    TIME = 2.0  # s
    value: float = 0.0

    def update(self, turn_rate: float, period: float) -> None:
        self.value += (1.0 - math.exp(-period / self.TIME)) * (turn_rate - self.value)


class NavigationEnv(gymnasium.Env[Observation, Any]):
    """One robot, a fresh random arena each episode.

    Action: the robot's input in physical units, clipped to its bounds. Observation: `robot.observation`, float32.
    Terminated on reaching the goal or touching an obstacle (both judged on the true position), truncated at the arena's
    step limit. An episode is determined by `seed_key` and its episode seed alone; `reset(seed=…)` fixes the sequence of
    episode seeds, `reset(options={"episode_seed": …})` a single one; `options={"arena": …}` changes the arena's name,
    for good.

    `info`, after reset and after step, has these keys:

    =================  =================================================================================
    robot              name of the robot
    state              (5,) measured state, as `robot.state` names it
    true_state         (5,) the same without measurement error; nothing that drives may look at it
    outside            the true state is farther from the measured one than `robot.measurement_bound`
    input_in_force     (2,) the input executed last, within bounds; zero at the start
    obstacles          list[Obstacle]: those with their surface within 1 m of the measured position
    arena              Arena: the whole map
    goal               (x, y), m
    time               s since the episode's start
    collision          some part of the robot touched an obstacle during the last period
    at_goal            the goal is reached
    clearance          m from the robot's footprint disc to the nearest obstacle, true
    speed              m/s, true
    subsamples         (10, 2) m: dead-reckoned positions within the last period, in the robot's frame at its start
    turned             rad: dead-reckoned change of heading over the last period
    episode_seed       what `options` takes to get this episode again
    =================  =================================================================================
    """

    def __init__(
        self,
        robot: Robot = GROUND,
        arena: str = "default",
        noise: NoiseLevels | None = None,
        seed_key: int = 0,
        reward: Reward | None = None,
        payload_kg: float = 0.0,
        floor_friction: float = 1.0,
    ) -> None:
        """seed_key: sets apart the episodes of two environments whose episode seeds are the same; 0 or more."""
        self.robot, self.arena_name, self.noise, self.seed_key = robot, arena, noise or NoiseLevels(), seed_key
        self.reward = reward or Reward()
        self.action_space = Box(robot.low().astype(np.float32), robot.high().astype(np.float32), dtype=np.float32)
        limit = np.full(robot.observation_dim, OBSERVED_LIMIT, dtype=np.float32)
        self.observation_space = Box(-limit, limit, dtype=np.float32)
        self._payload_kg, self._floor_friction = payload_kg, floor_friction
        self._vehicle: GroundRobot | None = None

    @property
    def vehicle(self) -> GroundRobot:
        """The robot of the running episode."""
        if self._vehicle is None:
            raise gymnasium.error.ResetNeeded("reset the environment before anything else")
        return self._vehicle

    def alter(self, payload_kg: float, floor_friction: float) -> None:
        """Load the robot [kg] and change the friction of its wheels on the floor (1 at first), from now on."""
        self._payload_kg, self._floor_friction = payload_kg, floor_friction
        if self._vehicle is not None:
            self._vehicle.set_payload(payload_kg)
            self._vehicle.set_friction(floor_friction)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        options = options or {}
        self.arena_name = options.get("arena", self.arena_name)
        drawn = int(self.np_random.integers(2**31)) if "episode_seed" not in options else options["episode_seed"]
        self._episode_seed = int(drawn)
        self._rng = np.random.default_rng((self.seed_key, self._episode_seed))
        self._arena = draw_arena(self.arena_name, self._rng, self.robot)
        self._vehicle = GroundRobot(self._arena, self._rng, self.noise, self._payload_kg, self._floor_friction)
        self._steps = 0
        self._input = np.zeros(self.robot.action_dim)
        self._memory = TurnMemory()
        self._distance = self._goal_distance(self._vehicle.true)
        return self._observe(), self._info(self._vehicle.standing())

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, Info]:
        vehicle = self.vehicle
        period = vehicle.step(action)
        self._steps += 1
        self._input = vehicle.input
        self._memory.update(float(period.measured[4]), self.robot.period)
        distance = self._goal_distance(period.true)
        at_goal = distance <= self._arena.goal_radius and not period.collision
        reward = self.reward.progress * (self._distance - distance)
        reward += self.reward.goal * at_goal + self.reward.collision * period.collision
        self._distance = distance
        terminated = at_goal or period.collision
        truncated = not terminated and self._steps >= self._arena.step_limit
        return self._observe(), float(reward), terminated, truncated, self._info(period)

    def _goal_distance(self, state: Array) -> float:
        return math.hypot(self._arena.goal[0] - state[0], self._arena.goal[1] - state[1])

    def _observe(self) -> Observation:
        """The observation in the order of `robot.observation`."""
        vehicle, top = self.vehicle, self.robot.high()
        x, y, heading, speed, turn_rate = vehicle.measured
        bearing = math.atan2(self._arena.goal[1] - y, self._arena.goal[0] - x) - heading
        own = (
            self._goal_distance(vehicle.measured) / DISTANCE_SCALE,
            math.sin(bearing),
            math.cos(bearing),
            speed / top[0],
            turn_rate / top[1],
            *(self._input / top),
            self._memory.value / top[1],
        )
        observation = np.concatenate((self._ranges() / MAX_RANGE, own))
        return np.clip(observation, -OBSERVED_LIMIT, OBSERVED_LIMIT).astype(np.float32)

    def _ranges(self) -> Array:
        """What the lidar reports, (RAYS,) m; a ray that hits nothing reports the full range."""
        x, y, heading = self.vehicle.true[:3]
        mount = np.array([x + LIDAR_MOUNT * math.cos(heading), y + LIDAR_MOUNT * math.sin(heading)])
        ranges = cast(self._arena.shapes, mount, heading)
        noisy = ranges + cut_normal(self._rng, self.noise.scale * self.noise.lidar, (RAYS,))
        return np.where(ranges < MAX_RANGE, np.clip(noisy, 0.0, MAX_RANGE), MAX_RANGE)

    def _info(self, period: Period) -> Info:
        error = np.abs(period.measured - period.true)
        error[2] = abs(wrap(period.measured[2] - period.true[2]))
        near = self._arena.shapes.distance(period.measured[:2]) <= REACH
        return {
            "robot": self.robot.name,
            "state": period.measured,
            "true_state": period.true,
            "outside": bool((error > self.robot.measurement_bound).any()),
            "input_in_force": self._input,
            "obstacles": [self._arena.obstacles[i] for i in np.flatnonzero(near)],
            "arena": self._arena,
            "goal": self._arena.goal,
            "time": self._steps * self.robot.period,
            "collision": period.collision,
            "at_goal": self._distance <= self._arena.goal_radius and not period.collision,
            "clearance": period.clearance,
            "speed": float(period.true[3]),
            "subsamples": period.subsamples,
            "turned": period.turned,
            "episode_seed": self._episode_seed,
        }
