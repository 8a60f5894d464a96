"""`NavigationEnv` for many robots: a `gymnasium.vector` environment that simulates a period of all of them at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from numbers import Integral
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from brakeline.errors import BadInput
from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.obstacle import Array
from brakeline.messaging.task import Reward, RobotWithTask, arena_kind, robot_with_task
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.batch.batch_support import check_batch
from brakeline.sim.batch.ground_batch import GroundBatch
from brakeline.sim.batch.normal_streams import NormalStreams
from brakeline.sim.batch.observation_batch import GroundObservationBatch, ObservationBatch, QuadrotorObservationBatch
from brakeline.sim.batch.quadrotor_batch import QuadrotorBatch
from brakeline.sim.batch.vehicle_batch import PeriodBatch, VehicleBatch
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.navigation_env import (
    OBSERVED_LIMIT,
    action_and_observation_space,
    check_observation,
    check_options,
    check_settings,
    episode_seed,
)
from brakeline.sim.sim_conditions import Conditions

Infos = dict[str, Any]
Flags = NDArray[np.bool_]
Observations = NDArray[np.float32]
StepBatch = tuple[Observations, Array, Flags, Flags, Infos]
EpisodeSeeds = Callable[[int], int]  # the seed of the next episode of a robot, by its number


class BatchNavigationEnv(VectorEnv[Observations, Array, Any]):
    """N robots, each alone in an arena of its own.

    Robot i sees what a `NavigationEnv` with the same seed gives, up to rounding: arenas, noise, rewards, ends. One
    thread pool simulates the physics, and arrays hold all other quantities. `infos` has the arrays of `NavigationEnv`'s
    `info` with the robot first, and `obstacles` instead of lists: a dict of the arrays of
    `brakeline.safety.filter.batch.obstacle_arrays.ObstacleArrays` with every static obstacle of each arena.

    `begin_step` starts the physics in a thread and `end_step` waits for it, so that you can compute between them.

    >>> env = BatchNavigationEnv("ground", 4)
    >>> observations, infos = env.reset(seed=0)
    >>> observations.shape, infos["state"].shape
    ((4, 26), (4, 5))
    >>> env.close()

    In the mode SAME_STEP, `infos` has `final_obs` (N, o) and `final_info` (arrays) of the robots whose episode ended.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        robot: RobotWithTask | str,
        num_envs: int,
        arena: str | None = None,
        *,
        conditions: Conditions | None = None,
        seed_key: int = 0,
        reward: Reward | None = None,
        threads: int = 1,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        episode_seeds: EpisodeSeeds | None = None,
    ) -> None:
        """Make the environment; `reset` draws the first episodes.

        Args:
            robot, arena, conditions, seed_key, reward: see `NavigationEnv`.
            num_envs: number of robots.
            threads: number of threads for the physics.
            episode_seeds: gives the seed of each further episode. Defaults to each robot's own generator, which
                `reset(seed=...)` seeds as `SyncVectorEnv` does.

        Raises:
            NoBatch: this robot, arena or perception can only be simulated one by one.
            UnknownRobot, UnknownTask, UnknownName, TypeError: see `NavigationEnv`.
            ValueError: there is no robot, or no simulator of this robot has such conditions.
        """
        check_settings(conditions, reward, seed_key)
        if num_envs < 1:
            raise ValueError(f"a batch has at least one robot, not {num_envs}")
        self.robot = robot_with_task(robot) if isinstance(robot, str) else robot
        arena = self.robot.task.default_arena if arena is None else arena
        self.conditions, self.num_envs, self.arena_name = conditions or Conditions(), num_envs, arena
        check_batch(self.robot, arena, self.conditions)
        self.reward, self.seed_key = reward or self.robot.task.reward, seed_key
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.single_action_space, self.single_observation_space = action_and_observation_space(self.robot)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._episode_seeds = episode_seeds or (lambda i: int(self._generators[i].integers(2**31)))
        kind = arena_kind(self.robot, arena)
        self._streams = NormalStreams(num_envs)
        flies = self.robot.position_dim == 3
        self._robots = vehicle_batch(self.robot, num_envs, kind, self.conditions, threads, self._streams)
        observed = QuadrotorObservationBatch if flies else GroundObservationBatch
        self._observations: ObservationBatch = observed(
            num_envs, self.robot, self._robots.obstacles, self._streams, self.conditions.lidar_noise(flies)
        )
        self._bound = np.asarray(self.robot.measurement_bound)
        self._goal_radius, self._step_limit = kind.goal_radius, kind.step_limit
        self._arenas, self._names = np.empty(num_envs, dtype=object), np.full(num_envs, self.robot.name)
        self._seeds, self._steps = np.zeros(num_envs, dtype=np.int64), np.zeros(num_envs, dtype=np.int64)
        self._goals, self._distance = np.zeros((num_envs, self.robot.position_dim)), np.zeros(num_envs)
        self._ended: Flags = np.zeros(num_envs, dtype=bool)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="physics")
        self._stepping: tuple[NDArray[np.intp], Future[Any]] | None = None
        self._now: tuple[Observations, Infos] | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Begin an episode of every robot, or of those in `options["reset_mask"]`.

        options["episode_seeds"] (N,) determines the episodes, as `episode_seed` does for `NavigationEnv`.

        Raises:
            ValueError: there is no such option, or not a seed or flag for each robot.
            gymnasium.error.ClosedEnvironmentError: the threads have ended.
            gymnasium.error.AlreadyPendingCallError: a period is under way.
        """
        self._check_idle("reset")
        options = options or {}
        check_options(options, "episode_seeds", "reset_mask")
        rows = self._rows_of(options.get("reset_mask"))
        seeds, given = self._seeds_of(seed), options.get("episode_seeds")
        if given is not None:
            given = [episode_seed(one) for one in self._one_each(given)]
        for i in rows.tolist():
            if (one := seeds[i]) is not None:
                self._generators[i], _ = seeding.np_random(one)
        episodes = [self._episode_seeds(i) if given is None else given[i] for i in rows.tolist()]
        self._now = self._join(rows, *self._begin(rows, episodes))
        check_observation(self.robot, self._now[0].shape[1])
        return _own(self._now[0]), _own(self._now[1])

    def __getstate__(self) -> dict[str, Any]:
        """Refuse a copy. Raises TypeError: the threads and the physics of many robots cannot be copied."""
        raise TypeError(
            "a batch of robots cannot be copied or sent to another process: make another one there, and repeat the "
            'episodes by reset(options={"episode_seeds": infos["episode_seed"]}) and their actions'
        )

    def _check_idle(self, call: str) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("this environment is closed: make another one")
        if self._stepping is not None:
            raise gymnasium.error.AlreadyPendingCallError("a period is under way: call end_step first", call)

    def _rows_of(self, mask: Any) -> NDArray[np.intp]:
        """Return the robots of a mask (N,), or all of them without one; the first reset is of all."""
        flags = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if flags.shape != (self.num_envs,) or flags.dtype != np.bool_:
            raise ValueError(f"reset_mask must be {self.num_envs} flags, True or False")
        return np.arange(self.num_envs) if self._now is None else np.flatnonzero(flags)

    def _seeds_of(self, seed: Any) -> Sequence[int | None]:
        """Return the seed of each robot's generator, as `SyncVectorEnv` does."""
        if seed is None:
            return [None] * self.num_envs
        return [int(seed) + i for i in range(self.num_envs)] if isinstance(seed, Integral) else self._one_each(seed)

    def _one_each(self, seeds: Sequence[Any]) -> Sequence[Any]:
        """Return seeds of which each robot has one. Raises ValueError."""
        if len(seeds) != self.num_envs:
            raise ValueError(f"{self.num_envs} robots take so many seeds, not {len(seeds)}")
        return seeds

    def step(self, actions: Array) -> StepBatch:
        self.begin_step(actions)
        return self.end_step()

    def begin_step(self, actions: Array) -> None:
        """Start a period with the robots' inputs (N, m), which are clipped to their bounds and slew.

        Raises:
            BadInput: an input is not finite.
            gymnasium.error.ResetNeeded: no episode has begun.
            gymnasium.error.ClosedEnvironmentError: the threads have ended.
            gymnasium.error.AlreadyPendingCallError: a period is under way.
        """
        self._check_idle("begin_step")
        if self._now is None:
            raise gymnasium.error.ResetNeeded("call reset() before the first step")
        inputs = np.asarray(actions, dtype=float)
        if inputs.shape != (self.num_envs, self.robot.action_dim) or not np.isfinite(inputs).all():
            raise BadInput(f"the inputs of {self.num_envs} robots must be {self.robot.action_dim} finite numbers each")
        resting = self._ended if self.autoreset_mode == AutoresetMode.NEXT_STEP else np.zeros_like(self._ended)
        rows = np.flatnonzero(~resting)
        self._robots.set_input(rows, inputs[rows])
        self._stepping = rows, self._worker.submit(self._robots.advance, rows)

    def end_step(self) -> StepBatch:
        """Wait for the period that `begin_step` started, and return what `step` returns."""
        assert self._stepping is not None, "begin_step comes first"
        rows, motion = self._stepping
        self._stepping = None
        period = self._robots.finish(rows, motion.result())
        self._steps[rows] += 1
        before = self._distance[rows]
        self._measure_distance(rows)
        at_goal = self._at_goal(rows, period)
        rewards, terminated, truncated = np.zeros(self.num_envs), *np.zeros((2, self.num_envs), dtype=bool)
        reward = self.reward.progress * (before - self._distance[rows])
        rewards[rows] = reward + self.reward.goal * at_goal + self.reward.collision * period.collision
        terminated[rows] = at_goal | period.collision
        truncated[rows] = ~terminated[rows] & (self._steps[rows] >= self._step_limit)
        observations, infos = self._join(rows, self._observe(rows), self._infos(rows, period))
        resets = np.flatnonzero(self._ended) if self.autoreset_mode == AutoresetMode.NEXT_STEP else rows[:0]
        self._ended = terminated | truncated
        final: Infos = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            resets = np.flatnonzero(self._ended)
            # The episodes that begin below overwrite the arrays of the obstacles, and of the flags.
            obstacles = {name: array.copy() for name, array in infos["obstacles"].items()}
            final |= {"final_obs": observations.copy(), "_final_obs": self._ended.copy()}
            final |= {"final_info": infos | {"obstacles": obstacles}, "_final_info": self._ended.copy()}
        if len(resets):
            self._now = observations, infos
            episodes = [self._episode_seeds(i) for i in resets.tolist()]
            observations, infos = self._join(resets, *self._begin(resets, episodes))
        self._now = observations, infos
        return _own(observations), rewards, terminated, truncated, _own(infos) | final

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._worker.shutdown()
        self._robots.close()

    def _begin(self, rows: NDArray[np.intp], episodes: list[int]) -> tuple[Observations, Infos]:
        """Begin episodes with these seeds; return the observations and infos of the rows."""
        arenas: list[Arena] = []
        generators = [np.random.default_rng((self.seed_key, episode)) for episode in episodes]
        for row, episode, generator in zip(rows.tolist(), episodes, generators, strict=True):
            arenas.append(draw_arena(self.arena_name, generator, self.robot))
            self._streams.begin(row, generator)
            self._arenas[row], self._seeds[row], self._goals[row] = arenas[-1], episode, arenas[-1].goal
        self._robots.begin(rows, arenas, generators)
        self._observations.begin(rows)
        self._steps[rows], self._ended[rows] = 0, False
        self._measure_distance(rows)
        return self._observe(rows), self._infos(rows, self._robots.initial_period(rows))

    def _join(self, rows: NDArray[np.intp], observations: Observations, infos: Infos) -> tuple[Observations, Infos]:
        """Return the latest observations and infos of all robots, with new ones in some rows."""
        if self._now is None or len(rows) == self.num_envs:
            return observations, infos
        now, before = self._now[0].copy(), self._now[1]
        now[rows] = observations
        joined: Infos = {}
        for name, values in infos.items():
            if isinstance(values, np.ndarray):
                joined[name] = before[name].copy()
                joined[name][rows] = values
            else:
                joined[name] = values
        return now, joined

    def _measure_distance(self, rows: NDArray[np.intp]) -> None:
        away = self._goals[rows] - self._robots.true[rows, : self.robot.position_dim]
        self._distance[rows] = np.sqrt((away * away).sum(axis=1))

    def _at_goal(self, rows: NDArray[np.intp], period: PeriodBatch) -> Flags:
        return np.asarray((self._distance[rows] <= self._goal_radius) & ~period.collision)

    def _observe(self, rows: NDArray[np.intp]) -> Observations:
        robots = self._robots
        seen = self._observations.observe(
            rows, robots.true[rows], robots.measured[rows], robots.input[rows], self._goals[rows]
        )
        return np.clip(seen, -OBSERVED_LIMIT, OBSERVED_LIMIT).astype(np.float32)

    def _outside(self, period: PeriodBatch) -> Flags:
        """Return whether each measurement error exceeds the bound of the robot's description."""
        error = period.measured - period.true
        if (heading := self.robot.heading) is not None:
            error[:, heading] = wrap(error[:, heading])
        return np.asarray((np.abs(error) > self._bound).any(axis=1))

    def _infos(self, rows: NDArray[np.intp], period: PeriodBatch) -> Infos:
        obstacles, none = self._robots.obstacles, np.zeros(len(rows), dtype=bool)
        return {
            "robot": self._names[rows],
            "state": period.measured,
            "true_state": period.true,
            "outside": self._outside(period),
            "input_in_force": self._robots.input[rows],
            "obstacles": obstacles.shapes | {"count": obstacles.count},
            "arena": self._arenas[rows],
            "goal": self._goals[rows],
            "time": self._steps[rows] * self.robot.period,
            "collision": period.collision,
            **dict.fromkeys(("contact_moving", "contact_standing", "contact_robot"), none),
            "clearance": period.clearance,
            "closest": period.closest,
            "subsamples": period.subsamples,
            "turned": period.turned,
            "at_goal": self._at_goal(rows, period),
            "speed": self._observations.speeds(period.true),
            "episode_seed": self._seeds[rows],
        }


def _own(values: Any) -> Any:
    """Return a copy of an array, or of the arrays of infos: a policy may overwrite what it gets."""
    if isinstance(values, dict):
        return {name: _own(part) if isinstance(part, np.ndarray | dict) else part for name, part in values.items()}
    return values.copy()


def vehicle_batch(
    robot: RobotWithTask, size: int, kind: ArenaKind, conditions: Conditions, threads: int, streams: NormalStreams
) -> VehicleBatch:
    """Return `size` robots, each for an arena of this kind. threads: for the physics. streams: of all sensor errors."""
    if robot.position_dim == 3:
        return QuadrotorBatch(size, kind, conditions, streams)
    return GroundBatch(size, kind, conditions, threads if threads > 1 else 0, streams)
