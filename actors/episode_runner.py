"""One robot through its episodes: what it sees, what it asks, what it does, and the step that comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import DecisionOutcome, at_rest, next_input
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.backup_plan import Array, BackupPlan, Prediction, correction_penalty
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.client import request_message
from brakeline.safety.service.wire import KINDS

StepResult = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]  # of a step
EPISODE_STRIDE = 4096  # episodes of different robots of a run never share a seed: seed = episode · stride + number


class Environment(Protocol):
    """A Gymnasium environment whose `info` has the keys of `brakeline.sim.navigation_env.NavigationEnv`."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]: ...

    def step(self, action: Array) -> StepResult: ...

    def alter(self, **changes: float) -> None:
        """Change the robot's physics, from now on."""


@dataclass(frozen=True)
class ActorIdentity:
    """Who drives: its name on the bus, its number in the run, and the run's seed."""

    actor: str
    number: int
    seed: int

    def episode_seed(self, episode: int) -> int:
        return episode * EPISODE_STRIDE + self.number

    def noise(self, episode: int) -> np.random.Generator:
        """The generator of an episode's exploration: it follows from the episode alone, so any run can resume."""
        return np.random.default_rng((self.seed, self.number, episode))


class EpisodeRunner:
    """Everything about one robot but the bus and the policy."""

    def __init__(
        self,
        robot: RobotWithTask,
        env: Environment,
        identity: ActorIdentity,
        penalty: float = 0.0,
        filtered: bool = True,
        cuts: bool = False,
        goes_on: bool = False,
    ) -> None:
        """penalty: for a correction by the whole range of an input; cuts: instead of a penalty, an intervention ends
        the episode, for the learner as a terminal step with the lowest reward, for the robot as one that was called
        off (SAILR's training; without `cuts` its episodes go on, braked step by step);
        goes_on: a reset gives another goal to a robot that goes on as it was, and so does its committed plan."""
        self.robot, self.env, self.identity, self.penalty, self.filtered = robot, env, identity, penalty, filtered
        self.cuts, self._goes_on = cuts, goes_on
        self.backup_plan = BackupPlan(robot)
        self._memory = memory_of(robot)
        self.index = 0  # steps so far
        self.running = False
        self.size = 0  # robots in its world; 0: it is alone
        self.fleet: tuple[str, ...] = ()  # their actors, if they promise each other something

    def begin(self, episode: int) -> pb.Episode:
        """Reset to an episode of that number."""
        seed = self.identity.episode_seed(episode)
        self.observation, self.info = self.env.reset(options={"episode_seed": seed})
        if not self._goes_on:
            self.backup_plan.reset()
            self._memory.reset()
        self._remember()
        self.episode, self.step, self._number, self.running = episode, 0, 0, True
        self.rng = self.identity.noise(episode)
        arena = self.info["arena"]
        message = pb.Episode(
            robot=self.robot.name,
            actor=self.identity.actor,
            episode=episode,
            arena=arena.name,
            obstacles=obstacle_messages(arena.obstacles),
            goal=arena.goal,
            goal_radius=arena.goal_radius,
            start=self.info["state"].tolist(),
            seed=seed,
        )
        message.header.time = self.info["time"]
        return message

    def request(self, proposal: Array) -> pb.Request:
        """The question about a proposal in the present state."""
        return request_message(
            self.backup_plan,
            self.info["state"],
            proposal,
            self.info["obstacles"],
            scan=self._scan,
            known_free=self._scan is None,  # by the map
            actor=self.identity.actor,
            episode=self.episode,
            step=self.step,
            time=self.info["time"],
            observation=self.observation.tolist(),
            fleet=self.fleet,
        )

    def skip(self) -> None:
        """A period went by unseen: the plan went on, and the steps' numbers show a gap."""
        self.backup_plan.fallback()
        self._memory.later(self.robot.period)
        self.step += 1

    def _remember(self) -> None:
        """Fill in the scan, if there is one, with what was seen free before."""
        self._scan = filled(self._memory, self.info, self.robot.period)

    def may_wait(self, outcome: DecisionOutcome) -> bool:
        """No answer, and nothing moves: better to ask again than to let the episode pass."""
        return outcome.answer is None and at_rest(self.backup_plan)

    def execute(self, proposal: Array, outcome: DecisionOutcome | None, weights_version: int = 0) -> pb.Step:
        """Do what the outcome says (without a filter: the proposal) for one period."""
        action = self.command(proposal, outcome)
        return self.took(proposal, outcome, action, self.env.step(action), weights_version)

    def command(self, proposal: Array, outcome: DecisionOutcome | None) -> Array:
        """The input of the coming period; the committed plan moves on. Without a filter a proposal with NaN or infinity
        counts as standing still."""
        self._number = self.step
        if outcome is None:
            proposal = proposal if np.isfinite(proposal).all() else self.robot.zero_input()
            return np.asarray(np.clip(proposal, self.robot.low(), self.robot.high()))
        return next_input(self.backup_plan, outcome)

    def stood(self, result: StepResult) -> None:
        """A period passed in which it had nothing to do: its episode is over, its world is not."""
        self.observation, _, _, _, self.info = result
        self._remember()
        self.step += 1

    def took(
        self,
        proposal: Array,
        outcome: DecisionOutcome | None,
        action: Array,
        result: StepResult,
        weights_version: int = 0,
    ) -> pb.Step:
        """The step that came of a command."""
        before, held = self.observation, self.info["input_in_force"]
        self.observation, reward, terminated, truncated, self.info = result
        self._remember()
        self.running = not (terminated or truncated)
        if outcome is None:
            action = self.info["input_in_force"]  # the vehicle kept to its slew
        step = self._step(before, proposal, action, reward)
        if self.filtered:
            step.penalty = correction_penalty(self.robot, proposal, held, action, self.penalty)
        step.terminated, step.truncated = terminated, truncated
        step.goal, step.collision = self.info["at_goal"], self.info["collision"]
        step.contact_moving, step.contact_standing = self.info["contact_moving"], self.info["contact_standing"]
        step.contact_robot, step.fleet = self.info["contact_robot"], self.size
        step.weights_version = weights_version
        if outcome is not None:
            self._note(step, outcome)
        return step

    def _step(self, before: NDArray[np.float32], proposal: Array, action: Array, reward: float) -> pb.Step:
        info = self.info
        self.index += 1
        step = pb.Step(
            robot=self.robot.name,
            actor=self.identity.actor,
            episode=self.episode,
            step=self._number,  # periods that pass unseen meanwhile count on
            index=self.index,
            observation=before.tolist(),
            # A learner takes in finite numbers only. The exchange with the safety service has the proposal as it was.
            proposed=(proposal if np.isfinite(proposal).all() else action).tolist(),
            action=action.tolist(),
            next_observation=self.observation.tolist(),
            reward=reward,
            speed=info["speed"],
            clearance=info["clearance"],
            state=info["state"].tolist(),
            true_state=info["true_state"].tolist(),
            outside=info["outside"],
            path=info["subsamples"].ravel().tolist(),
            turned=info["turned"],
        )
        step.header.time = info["time"]
        self.step += 1
        return step

    def _note(self, step: pb.Step, outcome: DecisionOutcome) -> None:
        """What the filter did about this step, and whether the state after it is where the filter said."""
        if outcome.answer is None:
            step.fallback = True
            step.decision = pb.FAILSAFE
            return
        answer = outcome.answer
        step.decision, step.decide_ms, step.broken = KINDS[answer.kind], answer.time_ms, answer.broken
        if answer.for_clearance is not None:
            step.for_clearance = answer.for_clearance
        if self.cuts:
            self._cut(step)
        predicted: Prediction | None = self.backup_plan.predicted
        if predicted is not None:
            step.compared = True
            step.contained = predicted.contains(self.robot, self.info["state"])

    def _cut(self, step: pb.Step) -> None:
        """No penalty, but the end of the episode if there was an intervention. A collision while braking stays one."""
        step.cut = step.decision == pb.FAILSAFE
        step.penalty = max(step.reward - self.robot.task.reward.cut, 0.0) if step.cut else 0.0
        if step.cut and self.running:
            self.running, step.truncated = False, True
