"""Train from many simulated robots in one process: environment, filter and learner in turn, without questions by bus.

A period: the policy proposes for all robots, the batch filter decides, MuJoCo simulates in a thread while the learner
makes the updates that are due, and then the learner takes the steps. Nothing depends on time, so the same seed gives
the same weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.episode_runner import EPISODE_STRIDE, ActorIdentity
from brakeline.errors import LaunchError
from brakeline.learner.learner import Learner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.batch.decision_arrays import KINDS
from brakeline.safety.filter.batch.plan_batch import BatchOutcome
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.service.wire import KIND_NUMBERS
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.scripted_policies import RandomPolicy
from brakeline.sim.sim_conditions import Conditions

Array = NDArray[np.float64]
Sink = Callable[[int, pb.Step | pb.Episode], None]  # takes what robot i publishes

ALL_DUE = 1 << 30  # updates


class BatchTrainer:
    """N robots that learn together.

    Attributes:
        learner: the learner, which has accepted all robots.
        policy: the weights that act.
    """

    def __init__(
        self,
        learner: Learner,
        safety: Filter,
        size: int,
        name: str,
        sink: Sink,
        *,
        arena: str = "default",
        seed: int = 0,
        penalty: float = 1.0,
        accept_bound: float | None = None,
        conditions: Conditions | None = None,
    ) -> None:
        """Let all robots join the learner, and begin their first episodes.

        Args:
            name: of the process, from which `actor_names` makes the robots' names.
            sink: takes all steps and episodes.
            penalty: for a correction by the whole range of an input.

        Raises:
            NoBatch: this robot, arena or perception can only be simulated one by one.
            LaunchError: the learner refuses a robot.
            TooLoose: see `SafetyWrapper`.
        """
        robot: RobotWithTask = learner.robot
        self.learner, self._robot, self._sink, self._size = learner, robot, sink, size
        self.actors = actor_names(name, size)
        self._episodes = [self._join(actor) for actor in self.actors]
        self._identities = [ActorIdentity(actor, i, seed) for i, actor in enumerate(self.actors)]
        env = BatchNavigationEnv(
            robot, size, arena, conditions=conditions, seed_key=seed, episode_seeds=self._next_episode_seed
        )
        self._env = BatchSafetyWrapper(env, safety, penalty, accept_bound)
        self._steps, self._index = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
        # A resumed run draws other noise than the interrupted one: it begins with other episodes, too.
        self._rng = np.random.default_rng((seed, EPISODE_STRIDE, learner.steps))
        self._random = [RandomPolicy(robot, rng) for rng in self._rng.spawn(size)]
        self._load()
        self._now, infos = self._env.reset()
        self._announce(range(size), infos)

    def close(self) -> None:
        """End the threads of the environment."""
        self._env.close()

    def period(self) -> None:
        """Run one period of all robots, and make the updates that are due. After the last step, only the updates."""
        if self.learner.steps >= self.learner.config.steps:
            self.learner.work(ALL_DUE)
            return
        proposals = self._propose()
        self.learner.flow()  # permits the steps of this period
        seen, steps, index, episodes = self._now, self._steps.copy(), self._index + 1, self._now_in()
        outcome = self._env.begin_step(proposals)
        self.learner.work(ALL_DUE)
        if self.learner.weights_due():
            self.learner.publish()
        version = self.policy.version
        self._now, rewards, terminated, truncated, infos = self._env.end_step()
        after = infos.get("final_info", infos)
        columns = {
            "episode": episodes,
            "step": steps,
            "index": index,
            "observation": seen,
            "proposed": np.where(outcome.decided[:, None] | np.isfinite(proposals), proposals, outcome.inputs),
            "action": outcome.inputs,
            "next_observation": infos.get("final_obs", self._now),
            "reward": rewards + infos["penalty"],
            "penalty": infos["penalty"],
            "terminated": terminated,
            "truncated": truncated,
            "goal": after["at_goal"],
            "state": after["state"],
            "true_state": after["true_state"],
            "path": after["subsamples"].reshape(self._size, -1),
            **{name: after[name] for name in ("collision", "speed", "clearance", "outside", "turned")},
            **{name: infos[name] for name in ("compared", "contained")},
            **_decisions(outcome),
        }
        for i, step in enumerate(self._messages(columns, after["time"], version)):
            self.learner.insert(step)
            self._sink(i, step)
        self._steps, self._index = self._steps + 1, index
        ended = np.flatnonzero(terminated | truncated)
        self._steps[ended] = 0
        self._announce(ended.tolist(), infos)
        if self.learner.weights().version != self.policy.version:
            self._load()

    def _propose(self) -> Array:
        """Return the exploring policy's actions (N, m); during warm-up, random ones."""
        if self.learner.warming_up:
            inputs = zip(self._random, self._now, self._steps * self._robot.period, strict=True)
            return np.array([policy(observation, {"time": time}) for policy, observation, time in inputs])
        noise = self.policy.noise * self._rng.standard_normal((self._size, self._robot.action_dim))
        return self.policy.of_many(self._now, noise)

    def _messages(self, columns: dict[str, Any], times: Array, version: int) -> Iterator[pb.Step]:
        """Yield the message of each robot's step, from columns with a row for each robot."""
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        common: dict[str, Any] = {"robot": self._robot.name, "weights_version": version}
        for actor, time, row in zip(self.actors, times.tolist(), rows, strict=True):
            step = pb.Step(actor=actor, **common, **dict(zip(columns, row, strict=True)))
            step.header.time = time
            yield step

    def _join(self, actor: str) -> int:
        """Let a robot join. Returns the number of its next episode."""
        robot = self._robot
        reply = self.learner.join(pb.Join(robot=robot.name, actor=actor, layout=robot.learning_layout()))
        if reply.HasField("error"):
            raise LaunchError(f"the learner refuses {actor}: {reply.error.message}")
        return reply.episode

    def _now_in(self) -> NDArray[np.int64]:
        """Return the number (N,) of each robot's present episode. The environment begins the next one by itself."""
        return np.array(self._episodes) - 1

    def _next_episode_seed(self, number: int) -> int:
        """Return the seed of a robot's next episode, which begins now."""
        self._episodes[number] += 1
        return self._identities[number].episode_seed(self._episodes[number] - 1)

    def _announce(self, rows: Any, infos: dict[str, Any]) -> None:
        """Publish the episodes that have begun."""
        for i in rows:
            arena = infos["arena"][i]
            message = pb.Episode(
                robot=self._robot.name,
                actor=self.actors[i],
                episode=self._episodes[i] - 1,
                arena=arena.name,
                obstacles=obstacle_messages(arena.obstacles),
                goal=arena.goal,
                goal_radius=arena.goal_radius,
                start=infos["state"][i].tolist(),
                seed=int(infos["episode_seed"][i]),
            )
            self._sink(i, message)

    def _load(self) -> None:
        """Take over the learner's weights."""
        self.policy: MLP = decode(self.learner.weights().file, self._robot)


def actor_names(process: str, size: int) -> list[str]:
    """Return the names of the robots of a process on the bus."""
    return [f"{process}.{i}" for i in range(size)]


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
