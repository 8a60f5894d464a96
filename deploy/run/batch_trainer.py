"""Train from many simulated robots in one process: environment, filter and learner in turn, without queries on the bus.

A period: the policy proposes for all robots, the batch filter decides, MuJoCo simulates in a thread while the learner
makes the updates that are due, and then the learner takes the steps. Nothing depends on time, so the same seed gives
the same weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from brakeline.actors.episode_runner import EPISODE_STRIDE, ActorIdentity
from brakeline.deploy.batch_robots import BatchRobots
from brakeline.errors import BadStep, LaunchError
from brakeline.learner.learner import Learner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.batch.row_by_row import BatchMethod
from brakeline.sim.scripted_policies import RandomPolicy

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
        safety: BatchMethod | None,
        size: int,
        name: str,
        sink: Sink,
        seed: int = 0,
        penalty: float | None = None,
        **options: Any,
    ) -> None:
        """Let all robots join the learner, and begin their first episodes.

        Args:
            safety: the filter; without one, each robot executes what it proposes.
            name: of the process, from which `actor_names` makes the robots' names.
            sink: takes all steps and episodes.
            penalty: for a correction by the whole range of an input; None: that of the robot's task.
            options: of `BatchRobots`.

        Raises:
            NoBatch: this robot, arena or perception can only be simulated one by one.
            LaunchError: the learner refuses a robot.
            TooLoose: see `SafetyWrapper`.
        """
        robot: RobotWithTask = learner.robot
        self.learner, self._robot, self._sink, self._size = learner, robot, sink, size
        self.actors, self._rejected = actor_names(name, size), RejectedMessages()
        self._episodes = [self._join(actor) for actor in self.actors]
        self._identities = [ActorIdentity(actor, i, seed) for i, actor in enumerate(self.actors)]
        options = {"seed_key": seed} | options
        penalty = robot.task.reward.correction_penalty if penalty is None else penalty
        self._robots = BatchRobots(robot, self.actors, safety, self._next_episode, penalty=penalty, **options)
        # A resumed run draws other noise than the interrupted one: it begins with other episodes, too.
        self._rng = np.random.default_rng((seed, EPISODE_STRIDE, learner.steps))
        self._random = [RandomPolicy(robot, rng) for rng in self._rng.spawn(size)]
        self._load()
        self._announce(range(size))

    def close(self) -> None:
        """End the threads of the environment."""
        self._robots.close()

    def period(self) -> None:
        """Run one period of all robots, and make the updates that are due. After the last step, only the updates."""
        if self.learner.steps >= self.learner.config.steps:
            self.learner.work(ALL_DUE)
            return
        proposals = self._propose()
        self.learner.flow()  # permits the steps of this period
        self._robots.begin_period(proposals)
        self.learner.work(ALL_DUE)
        if self.learner.weights_due():
            self.learner.publish()
        steps, begun = self._robots.end_period(self.policy.version)
        for i, step in enumerate(steps):
            try:
                self.learner.insert(step)
            except BadStep as error:  # such as a state that is not finite: one lost step, as on the bus
                self._rejected.reject(step.actor, error)
            self._sink(i, step)
        self._announce(begun)
        if self.learner.weights().version != self.policy.version:
            self._load()

    def _propose(self) -> Array:
        """Return the exploring policy's actions (N, m); during warm-up, random ones."""
        now = self._robots.observations
        if self.learner.warming_up:
            inputs = zip(self._random, now, self._robots.steps * self._robot.period, strict=True)
            return np.array([policy(observation, {"time": time}) for policy, observation, time in inputs])
        noise = self.policy.noise * self._rng.standard_normal((self._size, self._robot.action_dim))
        return self.policy.of_many(now, noise)

    def _join(self, actor: str) -> int:
        """Let a robot join. Returns the number of its next episode."""
        robot = self._robot
        reply = self.learner.join(pb.Join(robot=robot.name, actor=actor, layout=robot.learning_layout()))
        if reply.HasField("error"):
            raise LaunchError(f"the learner refuses {actor}: {reply.error.message}")
        return reply.episode

    def _next_episode(self, number: int) -> tuple[int, int]:
        """Return number and seed of a robot's next episode, which begins now."""
        self._episodes[number] += 1
        episode = self._episodes[number] - 1
        return episode, self._identities[number].episode_seed(episode)

    def _announce(self, robots: Iterable[int]) -> None:
        """Publish the episodes that have begun."""
        for i in robots:
            self._sink(i, self._robots.episode_message(i))

    def _load(self) -> None:
        """Take over the learner's weights."""
        self.policy: MLP = decode(self.learner.weights().file, self._robot)


def actor_names(process: str, size: int) -> list[str]:
    """Return the names of the robots of a process on the bus."""
    return [f"{process}.{i}" for i in range(size)]
