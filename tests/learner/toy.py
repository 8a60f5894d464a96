"""A toy to learn, and an actor in lockstep with a `Learner`: no bus, no physics."""

from __future__ import annotations

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
NAME, LENGTH = "actor-0", 20  # of the actor, and of its episodes [steps]


@dataclass
class ToyActor:
    """A point that is pushed along a line, 1 m/s downstream all the time, and shall stay at a goal.

    Each episode draws from its own number and from nothing else, as the real actors' do.
    """

    learner: Learner
    index: int = 0
    episode: int = 0
    rewards: list[float] = field(default_factory=list)  # of the episodes, per step

    def join(self) -> pb.JoinReply:
        place = {"index": self.index, "episode": self.episode}
        reply = self.learner.join(pb.Join(robot="toy", actor=NAME, layout=TOY.learning_layout(), **place))
        self.episode = reply.episode
        return reply

    def play(self) -> bool:
        """One episode; before each step, the learner does its part. False: the run is over."""
        generator = np.random.default_rng([5, self.episode])
        position, goal = generator.uniform(-1, 1, 2)
        total = 0.0
        for number in range(LENGTH):
            settle(self.learner)
            flow = self.learner.flow()
            if flow.done:
                return False
            assert flow.limit[NAME] > self.index
            message = self.learner.weights()
            assert message.version == flow.weights_version
            policy = policy_weights.decode(message.file, TOY)
            before = [position, goal]
            action = generator.uniform(0, 2, 1) if flow.warmup else policy.explore(np.array(before), generator)
            position = float(np.clip(position + 0.2 * (action[0] - 1.0), -2, 2))
            reward = -abs(position - goal)
            total += reward
            self.index += 1
            step = pb.Step(robot="toy", actor=NAME, episode=self.episode, step=number, index=self.index)
            step.observation[:], step.next_observation[:] = before, [position, goal]
            step.proposed[:] = step.action[:] = action
            step.reward, step.penalty = reward + 0.5, 0.5
            step.truncated, step.weights_version = number == LENGTH - 1, flow.weights_version
            self.learner.insert(step)
        self.rewards.append(total / LENGTH)
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
        if not actor.play():
            return
    settle(learner)
