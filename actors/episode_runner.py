"""The loop of every robot: observe, propose, ask the safety service, act, and record the step.

An `EpisodeRunner` holds one robot between its resets. A `RobotGroup` holds the robots whose time passes together: one
robot, or a fleet in a shared world. `decide` sends one query about all robots of some groups. `run_episode` is the
whole loop without a bus; `brakeline.actors.actor_process` is the same loop with a learner and publishers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask, DecisionOutcome, at_rest, next_input, request_decisions
from brakeline.actors.slow_down import SlowDown
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.backup_plan import BackupPlan, correction_penalty
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.client import request_message
from brakeline.safety.service.wire import set_decision
from brakeline.sim.scripted_policies import Policy

StepResult = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]  # the result of an environment's `step`
EPISODE_STRIDE = 4096  # robots of one run never share a seed: seed = episode * stride + number of the robot
INFO_FIELDS = (  # values of `info` that a step records under the same name
    *("collision", "contact_moving", "contact_standing", "contact_robot"),
    *("speed", "clearance", "closest", "outside", "turned"),
)


class Environment(Protocol):
    """A Gymnasium environment whose `info` has the keys of `brakeline.sim.navigation_env.NavigationEnv`."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]: ...

    def step(self, action: Array) -> StepResult: ...

    def alter(self, **changes: float) -> None:
        """Change the robot's physics from now on."""


class SharedWorld(Protocol):
    """Several robots in one physics simulation, such as `brakeline.sim.shared_world.FleetEnv`."""

    @property
    def members(self) -> Sequence[Environment]:
        """The environment of each robot, for everything but its steps."""

    def draw(self, episode_seed: int) -> None:
        """Draw a new world; reset every member afterwards."""

    def step(self, inputs: Sequence[Array]) -> list[Any]:
        """Simulate one period of all robots, and return the `StepResult` of each."""


@dataclass(frozen=True)
class ActorIdentity:
    """A robot's name on the bus, its number in the run, and the run's seed."""

    actor: str
    number: int
    seed: int

    def episode_seed(self, episode: int) -> int:
        """Return the seed of an episode's arena."""
        return episode * EPISODE_STRIDE + self.number

    def exploration(self, episode: int) -> np.random.Generator:
        """Return the generator of an episode's exploration. It depends on the episode only, so every run can resume.

        The key ends with 1 because NumPy ignores zeros at the end: (seed, number, 0) would draw the first arena again.
        """
        return np.random.default_rng((self.seed, self.number, episode, 1))


class EpisodeRunner:
    """One robot in its environment, with its backup plan; it knows neither the bus nor the policy.

    `observation` and `info` are the latest ones of the environment, `step` is the number of the current period.
    """

    def __init__(
        self,
        robot: RobotWithTask,
        env: Environment,
        identity: ActorIdentity,
        *,
        penalty: float = 0.0,
        filtered: bool = True,
        ends_on_intervention: bool = False,
        continuous: bool = False,
    ) -> None:
        """Create the runner of one robot.

        Args:
            penalty: the penalty for a correction by the whole range of an input.
            filtered: whether the safety service decides about the proposals.
            ends_on_intervention: an intervention ends the episode instead of costing a penalty (SAILR's training).
                The learner receives a terminal step with the lowest reward.
            continuous: a reset sets a new goal, leaves the robot where it is and keeps its backup plan in force.
        """
        self.robot, self.env, self.identity, self.penalty, self.filtered = robot, env, identity, penalty, filtered
        self.ends_on_intervention, self._continuous = ends_on_intervention, continuous
        self.backup_plan = BackupPlan(robot, robot.task.turn_aside)
        self.slow_down = SlowDown(robot, identity.actor)
        self._memory = memory_of(robot)
        self.index = 0  # steps recorded so far, over all episodes
        self.running = False  # whether an episode is running
        self.fleet_size = 0  # robots in the shared world; 0: the robot is alone
        self.fleet: tuple[str, ...] = ()  # names of the robots that reserve space for each other

    def begin(self, episode: int) -> pb.Episode:
        """Reset the environment to the episode of this number, and return the message that describes it."""
        seed = self.identity.episode_seed(episode)
        self.observation, self.info = self.env.reset(options={"episode_seed": seed})
        if not self._continuous:
            self.backup_plan.reset()
            self._memory.reset()
        self.backup_plan.acceleration_age = self.info.get("acceleration_age", self.backup_plan.acceleration_age)
        self._fill_scan()
        self.episode, self.step, self._decided_step, self.running = episode, 0, 0, True
        self.rng = self.identity.exploration(episode)
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
        """Return the request about a proposal (m,) in the current state."""
        message = request_message(
            self.backup_plan,
            self.info["state"],
            proposal,
            self.info["obstacles"],
            scan=self._scan,
            known_free=self._scan is None,  # without a scan the obstacles come from the complete map
            actor=self.identity.actor,
            episode=self.episode,
            step=self.step,
            time=self.info["time"],
            observation=self.observation.tolist(),
            fleet=self.fleet,
        )
        message.slow = self.slow_down.share
        return message

    def decide(self, proposal: Array, ask: Ask | None) -> DecisionOutcome | None:
        """Ask for a decision on a proposal (m,). Return None if there is no filter (`ask` is None)."""
        return None if ask is None else request_decisions(ask, [self.request(proposal)], self.robot)[0]

    def execute(self, proposal: Array, outcome: DecisionOutcome | None, weights_version: int = 0) -> pb.Step:
        """Act on an outcome for one period; without an outcome, execute the proposal. Return the step."""
        action = self.command(proposal, outcome)
        return self.record(proposal, outcome, action, self.env.step(action), weights_version)

    def command(self, proposal: Array, outcome: DecisionOutcome | None) -> Array:
        """Return the input (m,) of the coming period, and advance the backup plan.

        Without an outcome this is the proposal, clipped to bounds; a proposal with NaN or infinity becomes zero.
        """
        self._decided_step = self.step
        if outcome is None:
            proposal = proposal if np.isfinite(proposal).all() else self.robot.zero_input()
            return np.asarray(np.clip(proposal, self.robot.low(), self.robot.high()))
        action = next_input(self.backup_plan, outcome)
        if outcome.answer is not None:
            self.slow_down.update(self.backup_plan.widening.left, outcome.answer.bound)
        return action

    def may_wait(self, outcome: DecisionOutcome) -> bool:
        """Return whether the robot stands and got no answer: it can then ask again before the episode goes on."""
        return outcome.answer is None and at_rest(self.backup_plan)

    def skip(self) -> None:
        """Account for a period that passed without an observation: the backup plan advanced by one input."""
        self.backup_plan.fallback()
        self._memory.later(self.robot.period)
        self.step += 1

    def idle(self, result: StepResult) -> None:
        """Take in a period after the end of this robot's episode, while others in its world still drive."""
        self.observation, _, _, _, self.info = result
        self._fill_scan()
        self.step += 1

    def record(
        self,
        proposal: Array,
        outcome: DecisionOutcome | None,
        action: Array,
        result: StepResult,
        weights_version: int = 0,
    ) -> pb.Step:
        """Take in the result of a command, and return the step."""
        before, input_before = self.observation, self.info["input_in_force"]
        self.observation, reward, terminated, truncated, info = result
        self.info = info
        self._fill_scan()
        self.running = not (terminated or truncated)
        if outcome is None:
            action = info["input_in_force"]  # the vehicle limited the change of its input
        self.index += 1
        step = pb.Step(
            robot=self.robot.name,
            actor=self.identity.actor,
            episode=self.episode,
            step=self._decided_step,  # skipped periods have raised `self.step` meanwhile
            index=self.index,
            observation=before.tolist(),
            # A learner accepts finite numbers only. The exchange with the safety service has the original proposal.
            proposed=(proposal if np.isfinite(proposal).all() else action).tolist(),
            action=action.tolist(),
            next_observation=self.observation.tolist(),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            goal=info["at_goal"],
            fleet=self.fleet_size,
            state=info["state"].tolist(),
            true_state=info["true_state"].tolist(),
            path=info["subsamples"].ravel().tolist(),
            weights_version=weights_version,
            acceleration_age=self.backup_plan.acceleration_age,
            **{name: info[name] for name in INFO_FIELDS},
        )
        step.header.time = info["time"]
        self.step += 1
        if self.filtered:
            step.penalty = correction_penalty(self.robot, proposal, input_before, action, self.penalty)
        if outcome is not None:
            self._record_decision(step, outcome)
        return step

    def _record_decision(self, step: pb.Step, outcome: DecisionOutcome) -> None:
        """Record the decision, and whether the new state is in the set that the filter predicted."""
        answer = outcome.answer
        if answer is None:
            step.fallback = True
            step.decision = pb.FAILSAFE
            return
        set_decision(step, answer)
        if self.ends_on_intervention:
            self._end_on_intervention(step)
        if self.backup_plan.predicted is not None:
            step.compared = True
            step.contained = self.backup_plan.predicted.contains(self.robot, self.info["state"])

    def _end_on_intervention(self, step: pb.Step) -> None:
        """End the episode if there was an intervention, without a penalty. A collision while braking stays one."""
        step.cut = step.decision == pb.FAILSAFE
        step.penalty = max(step.reward - self.robot.task.reward.cut, 0.0) if step.cut else 0.0
        if step.cut and self.running:
            self.running, step.truncated = False, True

    def _fill_scan(self) -> None:
        """Complete the scan, if there is one, with the space that earlier scans showed to be free."""
        self._scan = filled(self._memory, self.info, self.robot.period)


class RobotGroup:
    """The robots whose time passes together: one robot alone, or a fleet in a shared world.

    A robot whose episode is over stands until the others' episodes are over. The filter still decides about it, since
    the others have to know where it is.
    """

    def __init__(
        self, runners: Sequence[EpisodeRunner], world: SharedWorld | None = None, reserving: bool = True
    ) -> None:
        """Group the robots of a shared world, or one robot without a shared world.

        reserving: whether the robots reserve space for each other. Without reservations the filter of each robot does
        not know about the others.
        """
        assert world is not None or len(runners) == 1, "robots without a shared world have groups of their own"
        self.runners, self.world = list(runners), world
        names = tuple(runner.identity.actor for runner in runners)
        for runner in self.runners if world is not None else ():
            runner.fleet_size, runner.fleet = len(names), names if reserving else ()

    @property
    def running(self) -> bool:
        return any(runner.running for runner in self.runners)

    def begin(self, episode: int) -> list[pb.Episode]:
        """Begin an episode with all robots at their starts."""
        if self.world is not None:
            self.world.draw(self.runners[0].identity.episode_seed(episode))
        return [runner.begin(episode) for runner in self.runners]

    def requests(self, proposals: Sequence[Array]) -> list[pb.Request]:
        """Return the request about each robot's proposal (m,)."""
        return [runner.request(proposal) for runner, proposal in zip(self.runners, proposals, strict=True)]

    def execute(
        self,
        proposals: Sequence[Array],
        outcomes: Sequence[DecisionOutcome | None],
        versions: Sequence[int] | None = None,
    ) -> list[pb.Step | None]:
        """Act on the outcomes for one period. Return the step of each robot; None if its episode was over."""
        versions = versions or [0] * len(self.runners)
        turns = list(zip(self.runners, proposals, outcomes, versions, strict=True))
        inputs = [runner.command(proposal, outcome) for runner, proposal, outcome, _ in turns]
        results = [self.runners[0].env.step(inputs[0])] if self.world is None else self.world.step(inputs)
        steps: list[pb.Step | None] = []
        for (runner, proposal, outcome, version), action, result in zip(turns, inputs, results, strict=True):
            if runner.running:
                steps.append(runner.record(proposal, outcome, action, result, version))
            else:
                runner.idle(result)
                steps.append(None)
        return steps


def decide(
    groups: Sequence[RobotGroup], proposals: Sequence[Sequence[Array]], ask: Ask | None
) -> list[list[DecisionOutcome | None]]:
    """Send one query about all robots of groups of one kind.

    Args:
        proposals: the proposal (m,) of each robot of each group.
        ask: sends the requests; None: there is no filter.

    Returns:
        The outcome of each robot of each group; None without a filter.
    """
    if ask is None:
        return [[None] * len(group.runners) for group in groups]
    requests = [r for group, inputs in zip(groups, proposals, strict=True) for r in group.requests(inputs)]
    outcomes = iter(request_decisions(ask, requests, groups[0].runners[0].robot))
    return [joint_outcomes(list(islice(outcomes, len(group.runners)))) for group in groups]


def joint_outcomes(outcomes: Sequence[DecisionOutcome]) -> list[DecisionOutcome | None]:
    """Discard all answers of a group if one is missing: the other robots' new plans may rest on that robot's plan."""
    missing = next((outcome for outcome in outcomes if outcome.answer is None), None)
    if missing is None:
        return list(outcomes)
    why = f"no answer about {missing.request.actor}, so none about its fleet: {missing.failure}"
    return [o if o.answer is None else replace(o, answer=None, reply=None, failure=why) for o in outcomes]


def run_episode(
    group: RobotGroup, policies: Sequence[Policy], ask: Ask | None, episode: int
) -> Iterator[list[pb.Step]]:
    """Run one episode, and yield the steps of each period. policies: one for each robot; ask: see `decide`."""
    group.begin(episode)
    while group.running:
        proposals = [
            runner.slow_down.proposal(np.asarray(policy(runner.observation, runner.info), dtype=float))
            if runner.running
            else runner.robot.zero_input()
            for runner, policy in zip(group.runners, policies, strict=True)
        ]
        (outcomes,) = decide([group], [proposals], ask)
        yield [step for step in group.execute(proposals, outcomes) if step is not None]
