"""PROCESS: drive one or several robots with the loop of `brakeline.actors.episode_runner`, over the bus.

The process adds to that loop: the learner's permission for each step, one query to the safety service about all
robots, waiting for a service that does not answer while the robots stand, and publishing.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np

from brakeline.actors.actor_settings import PhysicsChange
from brakeline.actors.decision_guard import Ask, DecisionOutcome
from brakeline.actors.episode_runner import (
    EPISODE_STRIDE,
    ActorIdentity,
    Environment,
    EpisodeRunner,
    RobotGroup,
    SharedWorld,
    decide,
)
from brakeline.actors.mavlink.frame_recorder import FrameRecorder, MessageSink
from brakeline.actors.proposers import FixedPolicy, LearnedPolicy, PolicyFactory, Proposer, RealTimePolicy, Stop
from brakeline.errors import BadRequest, BusError, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Publisher
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask, check_penalty, robot_with_task
from brakeline.messaging.topics import EPISODE, EXCHANGE, FRAMES, STEP
from brakeline.safety.filter.request import ALLOWED
from brakeline.safety.service.service_query import query_service
from brakeline.safety.service.wire import MAX_REQUESTS

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import FrameTap

log = logging.getLogger("brakeline.actor")

RETRY_INTERVAL = 0.05  # s between two queries about robots that stand and got no answer
MOST_REFUSALS = 200  # queries about standing robots that the service refuses in a row, before the process ends


@dataclass(frozen=True)
class ActorSettings:
    """Settings of an actor process."""

    bus: BusSettings
    robot: str = "ground"
    name: str = "actor-0"
    number: int = 0  # the number of this process's first robot
    robots: int = 1  # number of robots in this process; one query is about all of them
    fleet: bool = False  # whether the robots share a world
    seed: int = 0
    arena: str = "default"
    method: str = "ddpc"
    penalty: float | None = None  # for corrections; None: that of the robot's task
    deadline: float = 0.1  # s in which the safety service must answer
    lockstep: bool = False
    practice: float = 0.0  # probability at each step that a robot begins to follow its committed plan to the stop
    change: PhysicsChange = field(default_factory=PhysicsChange)
    mavlink: bool = False  # whether to log every frame of simulated quadrotors; a real-time flight always logs them
    steps: int = 0  # steps of each robot whose policy does not learn; 0: no end

    def __post_init__(self) -> None:
        if self.penalty is not None:
            check_penalty(self.penalty, robot_with_task(self.robot))
        if not 1 <= self.robots <= MAX_REQUESTS:
            raise ValueError(f"a process has 1 to {MAX_REQUESTS} robots, not {self.robots}: start more actors")


FOR_GOOD = f"{Refused.__name__}: {BadRequest.__name__}"  # how a failure begins that asking again does not mend


class EnvironmentFactory(Protocol):
    """Makes a robot's environment. tap: called with every MAVLink frame, if there are any."""

    def __call__(self, robot: RobotWithTask, arena: str, seed: int, *, tap: FrameTap | None = None) -> Environment: ...


WorldFactory = Callable[[RobotWithTask, str, int, int], SharedWorld]  # (robot, arena, number of robots, seed)

STOP_PRACTICE = "Practised: the stop goes on as it was verified"  # the failure of an outcome during a practised stop
STANDSTILL = 2  # periods that a practised stop lasts after its plan


class StopPractice:
    """Stops that a robot makes from time to time by following its committed plan to the end.

    Such a stop is safe, since the plan was verified. It is the only way to go on recording real stops, which
    `brakeline certify ROBOT --data LOG` needs. The proposals are the inputs of the plan with which the stop began. An
    answer that allows one commits a new plan, which again brakes over as many periods as any: a robot that followed it
    would become slower in each period, but would not stop.
    """

    def __init__(self, probability: float) -> None:
        """probability: of beginning a stop, at each step."""
        self.probability, self._inputs = probability, deque[Array]()
        self.running = False  # whether the last proposal was part of a stop

    def proposal(self, runner: EpisodeRunner, proposal: Array) -> Array:
        """Return the next input of the stop during a stop, otherwise the proposal."""
        if not self._inputs and self.probability > 0.0 and runner.rng.random() < self.probability:
            plan = runner.backup_plan.plan
            self._inputs.extend([*plan[runner.robot.committed_steps :].copy(), *[plan[-1].copy()] * STANDSTILL])
        self.running = bool(self._inputs)
        return self._inputs.popleft() if self.running else proposal

    def outcome(self, runner: EpisodeRunner, outcome: DecisionOutcome) -> DecisionOutcome:
        """Return the outcome to act on: during a stop, one without an answer, so that the committed plan goes on.

        The filter may prefer another input during a stop, to keep more clearance than the plan needs. Its answer
        counts only if it allows the input, or if the verification of the plan does not hold any more.
        """
        answer = outcome.answer
        if not self.running or answer is None or answer.kind == ALLOWED or not runner.backup_plan.still_verified:
            return outcome
        return replace(outcome, answer=None, failure=STOP_PRACTICE)


class ActorRunner:
    """One robot with its proposer and its publishers."""

    waits = True  # whether a standing robot waits for the safety service instead of letting time pass

    def __init__(
        self,
        process: Process,
        settings: ActorSettings,
        offset: int,
        make: EnvironmentFactory,
        propose: PolicyFactory | None = None,
        *,
        continuous: bool = False,
        env: Environment | None = None,
    ) -> None:
        """Connect one robot of this process.

        Args:
            offset: the robot's number in this process.
            propose: makes the policy; None: the robot learns.
            continuous: see `EpisodeRunner`.
            env: the robot's environment in a shared world; None: `make` makes one.
        """
        robot = robot_with_task(settings.robot)
        actor = settings.name if settings.robots == 1 else f"{settings.name}.{offset}"
        identity = ActorIdentity(actor, settings.number + offset, settings.seed)
        # A vehicle in real time publishes little, and the last period before a crash must not wait.
        publisher: Callable[..., Publisher] = partial(process.bus.publisher, bundled=not continuous)
        self.frames = FrameRecorder(publisher(FRAMES, robot=robot.name, source=actor), robot.name, actor)
        env = env or make(robot, settings.arena, settings.seed, tap=self.frames.record if settings.mavlink else None)
        self.runner = EpisodeRunner(
            robot,
            env,
            identity,
            penalty=robot.task.reward.correction_penalty if settings.penalty is None else settings.penalty,
            filtered=settings.method != "none",
            ends_on_intervention=settings.method == "sailr",
            continuous=continuous,
        )
        if propose is None:
            learned = RealTimePolicy if continuous else LearnedPolicy
            self.proposer: Proposer = learned(process.bus, robot, actor, settings.lockstep)
        else:
            self.proposer = FixedPolicy(propose, settings.seed + identity.number, settings.steps)
        self.next_episode = 0
        self.waiting = False  # whether the robot stands and waits for the safety service
        self.proposal = np.zeros(robot.action_dim)  # the last one
        self.braking = False  # whether the robot brakes because there was no decision
        self.practice, self.change = StopPractice(settings.practice), settings.change
        self._changed = False  # whether the physics have changed
        self.steps: MessageSink = publisher(STEP, robot=robot.name, source=actor)
        self.episodes: MessageSink = publisher(EPISODE, robot=robot.name, source=actor)
        self.exchanges: MessageSink = publisher(EXCHANGE, robot=robot.name, source=actor)

    def join(self, stop: Stop) -> bool:
        """Wait until the proposer is ready. Return False if `stop` returned true."""
        episode = self.proposer.join(self.runner.index, self.next_episode, stop)
        self.next_episode = max(self.next_episode, episode or 0)
        return episode is not None

    def may_step(self, stop: Stop) -> bool:
        """Wait for permission for the next step. Return False at the end of the run."""
        driven = self.runner.index + self.proposer.earlier_steps
        if not self._changed and 0 <= self.change.after <= driven:
            self.runner.env.alter(**self.change.changes())
            self._changed = True
        return self.proposer.ready(self.runner.index + 1, self.next_episode, stop)

    def begin(self, episode: pb.Episode) -> None:
        self.episodes.put(episode)
        self.next_episode = episode.episode + 1
        self.proposer.begin(self.runner.rng)

    def propose(self) -> Array:
        """Return the proposal (m,): the proposer's, or that of a practised stop.

        A robot that stands and waits keeps its proposal: the number of queries must not advance the generator.
        """
        runner = self.runner
        if not runner.running:
            return runner.robot.zero_input()
        if not self.waiting:
            proposal = self.proposer.propose(runner.observation, runner.info)
            if not np.isfinite(proposal).all():
                log.error("the policy with weights %d proposes %s", self.proposer.version, proposal)
            self.proposal = self.practice.proposal(runner, runner.slow_down.proposal(proposal))
        return self.proposal

    def settle(self, outcome: DecisionOutcome) -> DecisionOutcome:
        """Return the outcome to act on, and publish it."""
        if not self.runner.fleet_size:  # in a fleet, one robot without an answer would take the others' answers away
            outcome = self.practice.outcome(self.runner, outcome)
        outcome = self.commit(outcome)
        if (outcome.answer is None) != self.braking:
            self.braking = outcome.answer is None
            if self.braking and not self.practice.running:
                log.warning("no decision, braking along the committed plan: %s", outcome.failure)
        self.exchanges.put(outcome.exchange(self.runner.info["time"]))
        return outcome

    def commit(self, outcome: DecisionOutcome) -> DecisionOutcome:
        """Return the outcome to act on; in real time the plan may come too late."""
        return outcome

    def publish(self, step: pb.Step) -> None:
        """Publish a step, and the MAVLink frames of its period."""
        self.steps.put(step)
        self.frames.publish()


@dataclass
class ActorStats:
    """Counts of a process, over all its robots."""

    steps: int = 0
    fallbacks: int = 0
    waits: int = 0  # queries without an answer while robots stood
    waited_s: float = 0.0  # duration of these, with the time before the next query; sum over the groups
    round_trip_ms: float = 0.0  # sum over the steps
    collisions: int = 0
    contacts_robots: int = 0

    def count(self, step: pb.Step) -> None:
        self.steps += 1
        self.fallbacks += step.fallback
        self.collisions += step.collision
        self.contacts_robots += step.contact_robot

    def figures(self, seconds: float) -> dict[str, float]:
        """Return the figures for Health after this many seconds."""
        round_trip_ms = self.round_trip_ms / max(self.steps, 1)
        return asdict(self) | {"steps_per_s": self.steps / max(seconds, 1e-9), "round_trip_ms": round_trip_ms}


class ActorGroup(RobotGroup):
    """The robots whose time passes together, with their proposers and publishers."""

    def __init__(self, actors: Sequence[ActorRunner], world: SharedWorld | None = None, reserving: bool = True) -> None:
        super().__init__([actor.runner for actor in actors], world, reserving)
        self.actors = list(actors)
        self._refusals = 0  # queries in a row that the service refused as a whole, while all robots stood

    def ready(self, stop: Stop) -> bool:
        """Wait for permission to step, and begin an episode if none is running. Return False at the end of the run."""
        driving = [actor for actor in self.actors if actor.runner.running]
        episode = max(actor.next_episode for actor in self.actors)
        for actor in driving or self.actors:
            actor.next_episode = episode
            if not actor.may_step(stop):
                return False
        if not driving:
            for actor, message in zip(self.actors, self.begin(episode), strict=True):
                actor.begin(message)
        return True

    def act(self, proposals: Sequence[Array], outcomes: Sequence[DecisionOutcome | None], stats: ActorStats) -> None:
        """Act on the outcomes for one period, or wait if there are none and all robots stand.

        Raises:
            BusError: the service refuses every query about the standing robots, such as one with too many obstacles.
        """
        waits = self._wait(outcomes)
        refusals = {outcome.failure for outcome in outcomes if outcome and outcome.failure.startswith(FOR_GOOD)}
        self._refusals = self._refusals + 1 if waits and refusals else 0
        if self._refusals > MOST_REFUSALS:
            raise BusError(f"the safety service refuses every query about these robots: {refusals.pop()}")
        if waits:
            stats.waits += 1
            stats.waited_s += RETRY_INTERVAL + 1e-3 * max(outcome.round_trip_ms for outcome in outcomes if outcome)
            time.sleep(RETRY_INTERVAL)
            return
        turns = zip(self.actors, outcomes, strict=True)
        settled = [None if outcome is None else actor.settle(outcome) for actor, outcome in turns]
        stats.round_trip_ms += sum(outcome.round_trip_ms for outcome in settled if outcome is not None)
        versions = [actor.proposer.version for actor in self.actors]
        for actor, step in zip(self.actors, self.execute(proposals, settled, versions), strict=True):
            if step is not None:
                stats.count(step)
                actor.publish(step)

    def _wait(self, outcomes: Sequence[DecisionOutcome | None]) -> bool:
        turns = list(zip(self.actors, outcomes, strict=True))
        waits = all(outcome and actor.waits and actor.runner.may_wait(outcome) for actor, outcome in turns)
        for actor, outcome in turns:
            if waits and outcome and not actor.waiting:
                name = actor.runner.identity.actor
                log.warning("%s: standing and waiting for the safety service: %s", name, outcome.failure)
            actor.waiting = waits
        return waits


def run_period(groups: Sequence[ActorGroup], ask: Ask | None, stats: ActorStats, stop: Stop) -> bool:
    """Run one period of all robots of the process. Return False at the end of the run."""
    if not all(group.ready(stop) for group in groups):
        return False
    proposals = [[actor.propose() for actor in group.actors] for group in groups]
    outcomes = decide(groups, proposals, ask)
    for group, inputs, answers in zip(groups, proposals, outcomes, strict=True):
        group.act(inputs, answers, stats)
    return True


def run(
    settings: ActorSettings,
    make: EnvironmentFactory,
    propose: PolicyFactory | None = None,
    make_world: WorldFactory | None = None,
) -> bool:
    """Drive until the run is over (True), or until SIGINT or SIGTERM (False).

    Args:
        make: makes the environment of a robot that is alone.
        propose: makes each robot's policy, which acts for `settings.steps` steps, in a fleet until one robot has taken
            them; None: the robots learn until the learner ends the run.
        make_world: makes the world of a fleet.

    Raises:
        RefusedByLearner, Unreachable: with what to do.
        BusError: the safety service refuses every query about the robots.
    """
    stats = ActorStats()
    with Process(settings.bus, settings.name) as process:
        stop, started = process.stop.is_set, time.monotonic()
        groups = _groups(process, settings, make, propose, make_world)
        process.refresh = lambda: process.figures.update(stats.figures(time.monotonic() - started))
        process.announce()
        filtered = settings.method != "none"
        ask: Ask | None = partial(query_service, process.bus, deadline=settings.deadline) if filtered else None
        if all(actor.join(stop) for group in groups for actor in group.actors):
            while not stop() and run_period(groups, ask, stats, stop):
                pass
        log.info("%s: %d steps, %d fallbacks, %d waits", settings.name, stats.steps, stats.fallbacks, stats.waits)
        return not stop()


def _groups(
    process: Process,
    settings: ActorSettings,
    make: EnvironmentFactory,
    propose: PolicyFactory | None,
    make_world: WorldFactory | None,
) -> list[ActorGroup]:
    """Make the robots of a process: a fleet in one world, or robots that are alone."""
    if not settings.fleet or make_world is None:
        return [ActorGroup([ActorRunner(process, settings, i, make, propose)]) for i in range(settings.robots)]
    seed = settings.seed * EPISODE_STRIDE + settings.number
    world = make_world(robot_with_task(settings.robot), settings.arena, settings.robots, seed)
    actors = [ActorRunner(process, settings, i, make, propose, env=env) for i, env in enumerate(world.members)]
    return [ActorGroup(actors, world, settings.method != "none")]
