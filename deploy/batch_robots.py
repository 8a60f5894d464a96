"""Drive many simulated robots at once, and describe their steps as messages: for training and for evaluations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.batch.decision_arrays import KINDS
from brakeline.safety.filter.batch.plan_batch import BatchOutcome
from brakeline.safety.filter.batch.row_by_row import BatchMethod
from brakeline.safety.filter.request import FAILSAFE
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.service.wire import KIND_NUMBERS
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.sim_conditions import Conditions

NextEpisode = Callable[[int], tuple[int, int]]  # number and seed of the next episode of robot i


class BatchRobots:
    """N robots, each alone in an arena of its own, whose next episode begins by itself.

    `begin_period` decides and starts the physics in a thread; `end_period` waits for it.

    Attributes:
        names: of the robots.
        observations: (N, o), the latest.
        steps: (N,), the number of the present step of each robot's episode.
    """

    def __init__(
        self,
        robot: RobotWithTask,
        names: Sequence[str],
        safety: BatchMethod | None,
        next_episode: NextEpisode,
        *,
        arena: str = "default",
        seed_key: int = 0,
        penalty: float = 0.0,
        accept_bound: float | None = None,
        conditions: Conditions | None = None,
        ends_on_intervention: bool = False,
        independent: bool = False,
    ) -> None:
        """Begin the first episode of every robot.

        Args:
            safety: the filter; without one, each robot executes what it proposes.
            next_episode: gives number and seed of the episode that a robot begins.
            seed_key, arena, conditions: see `BatchNavigationEnv`.
            penalty, accept_bound: see `BatchSafetyWrapper`.
            ends_on_intervention: see `EpisodeRunner`. independent: see `BackupPlanBatch`.

        Raises:
            NoBatch: this robot, arena or perception can only be simulated one by one.
            TooLoose: see `SafetyWrapper`.
        """
        size = len(names)
        self.names, self._robot, self._next_episode = list(names), robot, next_episode
        self._ends_on_intervention = ends_on_intervention
        self._episodes = np.zeros(size, dtype=np.int64)
        self.steps, self._index = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
        self._env = BatchNavigationEnv(
            robot, size, arena, conditions=conditions, seed_key=seed_key, episode_seeds=self._draw_episode
        )
        self._filtered: BatchSafetyWrapper | None = None
        if safety is not None:
            aside = robot.task.turn_aside
            self._filtered = BatchSafetyWrapper(self._env, safety, penalty, accept_bound, turn_aside=aside)
            self._filtered.plans.independent = independent
        self.observations: NDArray[np.float32]
        self.observations, self._infos = self._env.reset() if self._filtered is None else self._filtered.reset()

    def close(self) -> None:
        """End the threads of the environment."""
        self._env.close()

    def begin_period(self, proposals: Array) -> None:
        """Decide on the proposed inputs (N, m), and start the period."""
        self._before = self.observations, self.steps.copy(), self._index + 1, self._episodes.copy()
        self._proposals, self._finite = proposals, np.isfinite(proposals).all(axis=1, keepdims=True)
        if self._filtered is None:
            self._inputs = np.clip(np.where(self._finite, proposals, 0.0), self._robot.low(), self._robot.high())
            self._outcome = None
            self._env.begin_step(self._inputs)
            return
        self._outcome = self._filtered.begin_step(proposals)
        self._inputs = self._outcome.inputs

    def end_period(self, weights_version: int = 0) -> tuple[list[pb.Step], list[int]]:
        """Wait for the period. Return the step of each robot, and the robots that have begun another episode."""
        seen, steps, index, episodes = self._before
        end_step = self._env.end_step if self._filtered is None else self._filtered.end_step
        self.observations, rewards, terminated, truncated, infos = end_step()
        after, size = infos.get("final_info", infos), len(self.names)
        if self._filtered is None:
            self._inputs = after["input_in_force"]  # the vehicle limited the change of its input
        penalty, cut = infos.get("penalty", np.zeros(size)), np.zeros(size, dtype=bool)
        rewards = rewards + penalty
        if self._ends_on_intervention and self._outcome is not None and self._outcome.answers is not None:
            cut = self._outcome.decided & (self._outcome.answers.kind == KINDS.index(FAILSAFE))
            penalty = np.where(cut, np.maximum(rewards - self._robot.task.reward.cut, 0.0), 0.0)
        ended = terminated | truncated
        columns: dict[str, Any] = {
            "episode": episodes,
            "step": steps,
            "index": index,
            "observation": seen,
            "proposed": np.where(self._finite, self._proposals, self._inputs),
            "action": self._inputs,
            "next_observation": infos.get("final_obs", self.observations),
            "reward": rewards,
            "penalty": penalty,
            "terminated": terminated,
            "truncated": truncated | (cut & ~ended),
            "cut": cut,
            "goal": after["at_goal"],
            "state": after["state"],
            "true_state": after["true_state"],
            "path": after["subsamples"].reshape(size, -1),
            **{name: after[name] for name in ("collision", "speed", "clearance", "closest", "outside", "turned")},
            **{name: infos[name] for name in ("compared", "contained") if name in infos},
            **({} if self._outcome is None else _decisions(self._outcome)),
        }
        messages = list(self._messages(columns, after["time"], weights_version))
        self.steps, self._index, self._infos = self.steps + 1, index, infos
        if self._filtered is not None and (cut & ~ended).any():
            self.observations, self._infos = self._filtered.reset(options={"reset_mask": cut & ~ended})
        self.steps[ended | cut] = 0
        return messages, np.flatnonzero(ended | cut).tolist()

    def episode_message(self, number: int) -> pb.Episode:
        """Describe the episode in which a robot is now."""
        infos, arena = self._infos, self._infos["arena"][number]
        return pb.Episode(
            robot=self._robot.name,
            actor=self.names[number],
            episode=int(self._episodes[number]),
            arena=arena.name,
            obstacles=obstacle_messages(arena.obstacles),
            goal=arena.goal,
            goal_radius=arena.goal_radius,
            start=infos["state"][number].tolist(),
            seed=int(infos["episode_seed"][number]),
        )

    def _messages(self, columns: dict[str, Any], times: Array, version: int) -> Iterator[pb.Step]:
        """Yield the message of each robot's step, from columns with a row for each robot."""
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        common: dict[str, Any] = {"robot": self._robot.name, "weights_version": version}
        for name, time, row in zip(self.names, times.tolist(), rows, strict=True):
            step = pb.Step(actor=name, **common, **dict(zip(columns, row, strict=True)))
            step.header.time = time
            yield step

    def _draw_episode(self, number: int) -> int:
        """Return the seed of a robot's next episode, which begins now."""
        self._episodes[number], seed = self._next_episode(number)
        return seed


def _decisions(outcome: BatchOutcome) -> dict[str, Any]:
    """Return what a step records of its decision. A row without one brakes."""
    answers, decided = outcome.answers, outcome.decided
    if answers is None:
        failsafe = np.full(len(decided), pb.FAILSAFE)
        return {"fallback": ~decided, "decision": failsafe, "decide_ms": np.zeros(len(decided))}
    numbers = np.array([KIND_NUMBERS[kind] for kind in KINDS])
    return {
        "fallback": ~decided,
        "decision": np.where(decided, numbers[answers.kind], pb.FAILSAFE),
        "decide_ms": np.full(len(decided), answers.time_ms),
        "for_clearance": answers.for_clearance,
    }
