"""A toy to learn, and an actor in lockstep with a `Learner`: no bus, no physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging import policy_weights
from brakeline.messaging.task import with_task
from tests.robots import GROUND

TOY = replace(
    GROUND,
    name="toy",
    action=("push [m/s]",),
    action_low=(0.0,),
    action_high=(2.0,),
    action_slew=(2.0,),
    translates=(True,),
    stop=("ramp",),
    follows=(3,),
)
TOY = with_task(TOY, replace(GROUND.task, lidar=None, observation=("position [m]", "goal [m]")))
CONFIG = LearnerConfig(
    td3=TD3Config(hidden=(32, 32), batch=32, n_step=2, warmup=60, actor_rate=1e-3, critic_rate=1e-3, reward_scale=1.0),
    capacity=200,
    steps=240,
    lockstep=True,
)


@dataclass
class ToyActor:
    """A point that is pushed along a line, 1 m/s downstream all the time, and shall stay at a goal.

    Episode e draws from SeedSequence(seed, actor, e) and from nothing else, as the real actors' do.
    """

    learner: Learner
    name: str = "actor-0"
    seed: int = 5
    index: int = 0
    episode: int = 0
    rewards: list[float] = field(default_factory=list)  # of the episodes, per step

    def join(self) -> pb.JoinReply:
        reply = self.learner.join(
            pb.Join(robot="toy", actor=self.name, layout=TOY.learning_layout(), index=self.index, episode=self.episode)
        )
        self.episode = reply.episode
        return reply

    def play(self, give_way: Callable[[], None], length: int = 20) -> bool:
        """One episode; `give_way` lets the learner do its part. False: the run is over."""
        key = [self.seed, int(self.name[-1]), self.episode]
        generator = np.random.default_rng(np.random.SeedSequence(key))
        position, goal = generator.uniform(-1, 1, 2)
        total = 0.0
        for number in range(length):
            give_way()
            flow = self.learner.flow()
            if flow.done:
                return False
            assert flow.limit[self.name] > self.index
            message = self.learner.weights()
            assert message.version == flow.weights_version
            policy = policy_weights.decode(message.file, TOY)
            before = [position, goal]
            action = generator.uniform(0, 2, 1) if flow.warmup else policy.explore(np.array(before), generator)
            position = float(np.clip(position + 0.2 * (action[0] - 1.0), -2, 2))
            reward = -abs(position - goal)
            total += reward
            self.index += 1
            step = pb.Step(
                robot="toy",
                actor=self.name,
                episode=self.episode,
                step=number,
                index=self.index,
                observation=before,
                proposed=action,
                action=action,
                next_observation=[position, goal],
                reward=reward + 0.5,
                penalty=0.5,
                truncated=number == length - 1,
                weights_version=flow.weights_version,
            )
            self.learner.insert(step)
        self.rewards.append(total / length)
        self.episode += 1
        return True


def settle(learner: Learner) -> None:
    """What the process does between two steps in lockstep."""
    while learner.work(3):
        pass
    if learner.weights_due():
        learner.publish()


def run(learner: Learner, actor: ToyActor, episodes: int = 10**6) -> None:
    """`episodes` of them, or up to the end of the run."""
    for _ in range(episodes):
        if not actor.play(lambda: settle(learner)):
            return
    settle(learner)
