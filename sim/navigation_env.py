"""The Gymnasium environment: reach the goal without touching anything. Robot, arena and vehicle are arguments."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from numbers import Integral
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from brakeline.errors import UnknownTask
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.number_checks import check_numbers
from brakeline.messaging.obstacle import Array, Obstacle
from brakeline.messaging.task import Reward, RobotWithTask, arena_kind, robot_with_task
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.delayed_vehicle import acceleration_age_of, simulated_vehicle
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.observations import ObservationModel
from brakeline.sim.range_sensors import make_scanner
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.top_view import Image, TopView, Window
from brakeline.sim.traffic import Crowd, CrowdSensor
from brakeline.sim.vehicle import MakeVehicle, Period, Vehicle

Observation = NDArray[np.float32]
Info = dict[str, Any]
StepResult = tuple[Observation, float, bool, bool, Info]
DrawArena = Callable[[str, np.random.Generator, RobotWithTask], Arena]

REPORTED = (  # fields of a `Period` that `info` has too
    *("collision", "contact_moving", "contact_standing", "contact_robot"),
    *("clearance", "closest", "subsamples", "turned"),
)
OBSERVED_LIMIT = 1.5  # every coordinate of the observation is clipped to ± this


def check_observation(robot: RobotWithTask, size: int) -> None:
    """Check the size of an observation. Raises UnknownTask: the task names more coordinates, or fewer."""
    if size != (named := robot.task.observation_dim):
        raise UnknownTask(
            f"observed are {size} numbers, but the task names {named}: {len(robot.task.rays.directions)} rays, and "
            f"{len(robot.task.observation)} coordinates in `observation`"
        )


def check_options(options: Mapping[str, Any], *known: str) -> None:
    """Check the names of the options of a `reset`. Raises ValueError."""
    if unknown := options.keys() - known:
        names = ", ".join(map(repr, sorted(unknown)))
        raise ValueError(f"a reset has no option {names}; there are: {', '.join(known)}")


def check_settings(conditions: Any, reward: Any, seed_key: Any) -> None:
    """Check arguments of an environment. Raises TypeError: one has another type; ValueError: there is no such key."""
    kinds = (("conditions", conditions, Conditions, "sim.sim_conditions"), ("reward", reward, Reward, "messaging.task"))
    for name, value, kind, module in kinds:
        if value is not None and not isinstance(value, kind):
            raise TypeError(f"{name} is a {type(value).__name__}: give a {kind.__name__} of brakeline.{module}")
    if not isinstance(seed_key, Integral) or seed_key < 0:
        raise ValueError(f"seed_key is an integer, 0 or more, not {seed_key!r}")


def action_and_observation_space(robot: RobotWithTask) -> tuple[Box[np.float32], Box[np.float32]]:
    """Return the space of a robot's inputs within their bounds, and the space of its observations."""
    limit = np.full(robot.task.observation_dim, OBSERVED_LIMIT, dtype=np.float32)
    low, high = robot.low().astype(np.float32), robot.high().astype(np.float32)
    return Box(low, high, dtype=np.float32), Box(-limit, limit, dtype=np.float32)


def episode_seed(value: Any) -> int:
    """Return the seed of an episode. Raises ValueError: it is no integer, or negative."""
    if not isinstance(value, Integral) or value < 0:
        raise ValueError(f"an episode's seed is an integer, 0 or more, not {value!r}")
    return int(value)


class NavigationEnv(gymnasium.Env[Observation, Any]):
    """One robot in a fresh random arena each episode.

    Action: the robot's input in physical units; the vehicle clips it to the robot's bounds and slew.
    Observation: the coordinates that `task.observed` names, float32, clipped to ±`OBSERVED_LIMIT`.
    Reward: `task.reward`.

    An episode terminates when the robot reaches the goal or touches anything; both follow the true position. It is
    truncated at the arena's step limit. `seed_key` and the episode seed alone determine an episode. `reset(seed=...)`
    fixes the sequence of episode seeds, `reset(options={"episode_seed": ...})` a single one.
    `reset(options={"arena": ...})` changes the arena's name for this and all later episodes.

    `render()` returns a view from above: an image (H, W, 3) with `render_mode="rgb_array"`. With
    `render_mode="human"`, `reset` and `step` show it in a window.

    `reset` and `step` return an `info` with these keys. Dimensions: n coordinates of the state, d of the position,
    m inputs, S samples in a period.

    =================  =================================================================================
    robot              the robot's name
    state              (n,) measured state; `robot.state` names its coordinates
    true_state         (n,) true state; only for evaluation, a policy must not read it
    outside            whether the measurement error exceeds `robot.measurement_bound`
    input_in_force     (m,) input executed last, within bounds and slew; zero at the start
    obstacles          list[Obstacle]: the static obstacles within `robot.sight` of the measured position, and the
                       moving ones that can come within it before a plan ends, as measured; empty if free space
                       comes from scans
    scan               Scan | RangeImage: the newest scan; only if free space comes from scans
    arena              Arena: the whole map
    goal               (d,) m
    time               s since the start of the episode
    collision          the robot touched a static obstacle during the last period
    contact_moving     the robot touched a moving obstacle while it was moving itself
    contact_standing   a moving obstacle touched the robot while the robot stood
    contact_robot      the robot touched another robot (`brakeline.sim.shared_world`)
    at_goal            the robot is at the goal, without a contact
    clearance          m from the nearest disc (sphere) of the body to the nearest obstacle, true
    closest            m, the least clearance at the samples of the last period
    speed              m/s, true
    subsamples         (S, d) m: estimated positions within the last period, in the robot's frame at its start
    turned             rad: estimated change of heading over the last period
    episode_seed       the value that `options` takes to repeat this episode
    acceleration_age   s, age of the horizontal acceleration in the measured state
    =================  =================================================================================
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        robot: RobotWithTask | str,
        arena: str | None = None,
        make_vehicle: MakeVehicle | None = None,
        *,
        conditions: Conditions | None = None,
        lidar_noise: float | None = None,
        seed_key: int = 0,
        reward: Reward | None = None,
        draw: DrawArena = draw_arena,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment; `reset` draws the first episode.

        Args:
            robot: a robot with its task, or its name (`"ground"`), or the path of its file.
            arena: the name of one of the task's arenas. Defaults to `default`, or to the task's first one.
            make_vehicle: puts a vehicle at the start of an arena. Defaults to the task's simulator under `conditions`.
            lidar_noise: standard deviation of a range [m]. Defaults to the conditions' value for this robot.
            conditions: noise, wind, payload and sensors. Defaults to those of the recorded data.
            seed_key: an integer, 0 or more; environments with different keys have different episodes.
            reward: replaces the task's reward.
            draw: draws the arena of an episode.

        Raises:
            UnknownRobot: no robot has this name.
            UnknownTask: the robot has no task.
            UnknownName: the robot has no arena of this name.
            TypeError: the conditions or the reward have another type.
            ValueError: the render mode is none of `metadata["render_modes"]`, there is no such key, the noise
                is negative, or the simulator of this robot has no such conditions.
        """
        check_settings(conditions, reward, seed_key)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is None, 'rgb_array' or 'human', not {render_mode!r}")
        self.robot = robot_with_task(robot) if isinstance(robot, str) else robot
        arena = self.robot.task.default_arena if arena is None else arena
        if draw is draw_arena:
            arena_kind(self.robot, arena)
        self.arena_name, self.seed_key, self.render_mode = arena, seed_key, render_mode
        self.task = self.robot.task
        self.reward = reward or self.task.reward
        self.conditions = conditions or Conditions()
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.robot.period)}
        self.action_space, self.observation_space = action_and_observation_space(self.robot)
        self._make_observation_model = self.task.code(self.task.senses)
        self._make_vehicle = make_vehicle or simulated_vehicle(self.robot, self.conditions)
        if lidar_noise is None:
            lidar_noise = self.conditions.lidar_noise(flies=self.robot.position_dim == 3)
        check_numbers(SimpleNamespace(lidar_noise=lidar_noise), "lidar_noise", least=0.0)
        self._lidar_noise = lidar_noise
        self._draw = draw
        self._measurement_bound = np.asarray(self.robot.measurement_bound)
        self._changes: dict[str, float] = {}
        self._vehicle: Vehicle | None = None
        self._view: TopView | None = None
        self._window: Window | None = None

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of the present episode. Raises gymnasium.error.ResetNeeded: no episode has started yet."""
        if self._vehicle is None:
            raise gymnasium.error.ResetNeeded("call reset() before step() and render()")
        return self._vehicle

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy. Raises TypeError: a copied simulation would not go on as this one."""
        if self._vehicle is not None:
            raise TypeError(
                "an environment whose episode has begun cannot be copied: copy it before the first reset, or make "
                'another and repeat the episode by reset(options={"episode_seed": ...}) and its actions'
            )
        return self.__dict__

    def alter(self, **changes: float) -> None:
        """Change the vehicle's physics in this and all later episodes (`Vehicle.alter`)."""
        self._changes |= changes
        if self._vehicle is not None:
            self._vehicle.alter(**changes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        options = options or {}
        check_options(options, "arena", "episode_seed")
        super().reset(seed=seed)
        name, given = options.get("arena", self.arena_name), "episode_seed" in options
        episode = episode_seed(options["episode_seed"] if given else self.np_random.integers(2**31))
        rng = np.random.default_rng((self.seed_key, episode))
        arena = self._draw(name, rng, self.robot)
        self.arena_name, self._episode_seed, self._arena = name, episode, arena
        self._shapes = deepcopy(arena.shapes)  # a policy may overwrite those of the arena in its info
        self._vehicle = self._make_vehicle(self._arena, rng)
        if self._changes:
            self._vehicle.alter(**self._changes)
        self._observation_model: ObservationModel = self._make_observation_model(
            self.robot, self._arena, rng, self._lidar_noise
        )
        self._scanner = None
        if self.conditions.perception.kind == "scan":
            self._scanner = make_scanner(self.robot, self._arena, rng, self._lidar_noise, self.conditions.perception)
        crowd = self._arena.crowd
        self._crowd_pushes = crowd is not None and crowd.pushes
        # Other robots announce their plans: only people and aircraft are measured.
        self._crowd_sensor = CrowdSensor(crowd, rng) if isinstance(crowd, Crowd) else None
        self._steps = 0
        self._distance = self._goal_distance(self._vehicle.true)
        self._view = None
        result = self._observe(), self._info(self._vehicle.initial_period())
        check_observation(self.robot, len(result[0]))
        self._show()
        return result

    def step(self, action: Array) -> StepResult:
        return self.finish_step(self.vehicle.step(action))

    def finish_step(self, period: Period) -> StepResult:
        """Return what `step` returns, for a period that the vehicle has carried out."""
        self._steps += 1
        before, self._distance = self._distance, self._goal_distance(period.true)
        at_goal = self._at_goal(period)
        reward = self.reward.progress * (before - self._distance)
        reward += self.reward.goal * at_goal + self.reward.collision * period.at_fault
        reward += self.reward.run_into * period.contact_standing
        terminated = at_goal or period.at_fault or (period.contact_standing and self._crowd_pushes)
        truncated = not terminated and self._steps >= self._arena.step_limit
        result = self._observe(), float(reward), terminated, truncated, self._info(period)
        self._show()
        return result

    def render(self) -> Image | None:
        """Return the view from above (H, W, 3) in the mode "rgb_array"; show it in the mode "human"."""
        if self.render_mode == "human":
            self._show()
        return self._image() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        if self.render_mode == "human":
            image = self._image()
            self._window = self._window or Window(f"{self.robot.name}: {self.arena_name}")
            self._window.show(image)

    def _image(self) -> Image:
        true = self.vehicle.true
        self._view = self._view or TopView(self.robot, self._arena)
        return self._view.draw(true, self._time)

    @property
    def _time(self) -> float:
        """Time since the start of the episode [s]."""
        return self._steps * self.robot.period

    def _goal_distance(self, state: Array) -> float:
        return math.dist(self._arena.goal, state[: self.robot.position_dim])

    def _at_goal(self, period: Period) -> bool:
        return self._distance <= self._arena.goal_radius and not (period.at_fault or period.contact_standing)

    def _observe(self) -> Observation:
        vehicle = self.vehicle
        observation = self._observation_model.observe(vehicle.true, vehicle.measured, vehicle.input, self._time)
        return np.clip(observation, -OBSERVED_LIMIT, OBSERVED_LIMIT).astype(np.float32)

    def _outside(self, period: Period) -> bool:
        """Whether the measurement error exceeds the bound of the robot's description."""
        error = np.abs(period.measured - period.true)
        if (heading := self.robot.heading) is not None:
            error[heading] = abs(wrap(period.measured[heading] - period.true[heading]))
        return bool((error > self._measurement_bound).any())

    def _moving_obstacles(self, position: Array) -> list[Obstacle]:
        """Return the measured moving obstacles that can come within sight before a plan ends."""
        if self._crowd_sensor is None:
            return []
        measured = self._crowd_sensor.measure(self._time)
        horizon = self.robot.horizon * self.robot.period
        moving = MovingObstacles.of(measured, self.robot.position_dim)
        nearest = moving.least_distance(position, horizon, self.robot.least_margin)
        return [measured[i] for i in np.flatnonzero(nearest <= self.robot.sight)]

    def _info(self, period: Period) -> Info:
        obstacles, scan = [], {}
        if self._scanner is not None:
            scan["scan"] = self._scanner.scan(period.true, period.measured, self._time)
        else:
            position = period.measured[: self.robot.position_dim]
            near = self._shapes.distance(position) <= self.robot.sight
            obstacles = [self._arena.obstacles[i] for i in np.flatnonzero(near)] + self._moving_obstacles(position)
        return {
            "robot": self.robot.name,
            "state": period.measured,
            "true_state": period.true,
            "outside": self._outside(period),
            "input_in_force": self.vehicle.input.copy(),  # a policy may overwrite it, and the slew begins at it
            "obstacles": obstacles,
            **scan,
            "arena": self._arena,
            "goal": self._arena.goal,
            "time": self._time,
            **{name: getattr(period, name) for name in REPORTED},
            "at_goal": self._at_goal(period),
            "speed": self._observation_model.speed(period.true),
            "episode_seed": self._episode_seed,
            "acceleration_age": acceleration_age_of(self.vehicle),
        }
