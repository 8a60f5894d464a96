"""PROCESS: drives one or several robots: observe, propose, ask safety, act, publish."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np

from brakeline.actors.actor_settings import PhysicsChange as PhysicsChange
from brakeline.actors.decision_guard import Ask, DecisionOutcome, request_decisions
from brakeline.actors.episode_runner import EPISODE_STRIDE, ActorIdentity, Environment, EpisodeRunner
from brakeline.actors.joint_episode import RobotGroup, SharedWorld, joint_outcomes
from brakeline.actors.learner_client import LearnerClient
from brakeline.actors.mavlink.frame_recorder import FrameRecorder, MessageSink
from brakeline.actors.policies import FixedPolicy, LearnedPolicy, PolicyFactory, Proposer, RealTimePolicy, check
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, Publisher
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import EPISODE, EXCHANGE, FRAMES, STEP
from brakeline.safety.filter.backup_plan import Array
from brakeline.safety.filter.request import ALLOWED
from brakeline.safety.service.client import query_service

if TYPE_CHECKING:
    from brakeline.actors.mavlink.frame_log import FrameTap

log = logging.getLogger("brakeline.actor")

PATIENCE = 0.05  # s between questions of a standing robot that got no answer


@dataclass(frozen=True)
class ActorSettings:
    bus: BusSettings
    robot: str = "ground"
    name: str = "actor-0"
    number: int = 0  # of the first robot of this process
    robots: int = 1  # in this process; their requests share a question
    fleet: bool = False  # they share a world, too
    seed: int = 0
    arena: str = "default"
    method: str = "ddpc"
    penalty: float = 1.0
    deadline: float = 0.1  # s for an answer of the safety service
    lockstep: bool = False
    practice: float = 0.0  # share of steps at which a robot starts to follow its committed plan to the stop
    change: PhysicsChange = field(default_factory=PhysicsChange)
    mavlink: bool = False  # log every frame of quadrotors in memory; in real time it is always done
    steps: int = 0  # of each robot with a policy that does not learn; 0: no end


class EnvironmentFactory(Protocol):
    """Makes a robot's environment; tap: is to be called with every MAVLink frame, if there are any."""

    def __call__(self, robot: RobotWithTask, arena: str, seed: int, *, tap: FrameTap | None = None) -> Environment: ...


WorldFactory = Callable[
    [RobotWithTask, str, int, int], SharedWorld
]  # of robots of a kind in an arena, so many, from a seed

STOP_PRACTICE = "Practised: the stop goes on as it was verified"  # instead of an answer
STANDING = 2  # periods that a practised stop lasts beyond its plan


class StopPractice:
    """Now and then the committed plan to its end: safe, for it was verified, and the only way to go on recording what
    a stop is like (`brakeline certify LOG`)."""

    def __init__(self, share: float) -> None:
        self.share, self._left = share, 0
        self.running = False  # is the last proposal part of a stop?

    def instead(self, driver: EpisodeRunner, proposal: Array) -> Array:
        """The committed plan's next input while a stop is practised, else the proposal."""
        if self._left == 0 and self.share > 0.0 and driver.rng.random() < self.share:
            self._left = driver.robot.horizon - 1 + STANDING
        self.running = self._left > 0
        if not self.running:
            return proposal
        self._left -= 1
        return np.asarray(driver.backup_plan.plan[driver.robot.committed_steps])

    def kept(self, driver: EpisodeRunner, outcome: DecisionOutcome) -> DecisionOutcome:
        """A stop that was begun goes on as it was verified, also where the filter would do something else by now: it
        keeps more distance than is needed. Not where what was verified does not hold any more."""
        answer = outcome.answer
        if not self.running or answer is None or answer.kind == ALLOWED or not driver.backup_plan.holds:
            return outcome
        return replace(outcome, answer=None, failure=STOP_PRACTICE)


class ActorRunner:
    """A driver with its link to the learner and its publishers."""

    waits = True  # standing, for the safety service, instead of letting time pass

    def __init__(
        self,
        process: Process,
        settings: ActorSettings,
        offset: int,
        make: EnvironmentFactory,
        propose: PolicyFactory | None = None,
        goes_on: bool = False,
        env: Environment | None = None,
    ) -> None:
        """propose: instead of learning; goes_on: see Driver; env: its place in a world that others share."""
        robot = robot_with_task(settings.robot)
        actor = settings.name if settings.robots == 1 else f"{settings.name}.{offset}"
        identity = ActorIdentity(actor, settings.number + offset, settings.seed)
        publisher: Callable[..., Publisher] = process.bus.publisher
        frames = publisher(FRAMES, robot=robot.name, source=actor)
        self.tape = FrameRecorder(frames, robot.name, actor)
        tap = self.tape.take if settings.mavlink else None
        env = env or make(robot, settings.arena, settings.seed, tap=tap)
        filtered, cuts = settings.method != "none", settings.method == "sailr"
        self.driver = EpisodeRunner(robot, env, identity, settings.penalty, filtered, cuts, goes_on)
        if propose is None:
            student = LearnerClient(process.bus, robot, actor, settings.lockstep)
            self.proposer: Proposer = RealTimePolicy(student) if goes_on else LearnedPolicy(student)
        else:
            self.proposer = FixedPolicy(propose, settings.seed + identity.number, settings.steps)
        self.next_episode = 0
        self.waiting = False  # for the safety service, standing
        self.proposal = np.zeros(robot.action_dim)  # the last one
        self.braking = False  # for want of a decision
        self.practice, self.change = StopPractice(settings.practice), settings.change
        self.steps: MessageSink = publisher(STEP, robot=robot.name, source=actor)
        self.episodes: MessageSink = publisher(EPISODE, robot=robot.name, source=actor)
        self.exchanges: MessageSink = publisher(EXCHANGE, robot=robot.name, source=actor)

    def join(self, stop: Callable[[], bool]) -> bool:
        """Wait until there are proposals; False: told to stop."""
        episode = self.proposer.join(self.driver.index, self.next_episode, stop)
        self.next_episode = max(self.next_episode, episode or 0)
        return episode is not None

    def ready(self, stop: Callable[[], bool]) -> bool:
        """Wait for permission to step, and begin an episode if none is running; False: the end."""
        if self.driver.index == self.change.after:
            self.driver.env.alter(**self.change.changes())
        if not self.proposer.ready(self.driver.index + 1, self.next_episode, stop):
            return False
        if not self.driver.running:
            self.episodes.put(self.driver.begin(self.next_episode))
            self.next_episode += 1
            self.proposer.begin(self.driver.rng)
        return True

    def propose(self) -> Array:
        """The proposer's action; now and then a practised stop's.

        Who stands and waits goes on proposing the same: how often it has to ask must not move the random generator.
        """
        driver = self.driver
        if not self.waiting:
            proposal = self.proposer.propose(driver.observation, driver.info)
            check(proposal, self.proposer.version)
            self.proposal = self.practice.instead(driver, proposal)
        return self.proposal

    def settle(self, outcome: DecisionOutcome) -> DecisionOutcome:
        """The last word on an outcome, when it is to be put into action."""
        if (outcome.answer is None) != self.braking:
            self.braking = outcome.answer is None
            if self.braking and not self.practice.running:
                log.warning("no decision, braking along the committed plan: %s", outcome.failure)
        return outcome

    def act(self, proposal: Array, outcome: DecisionOutcome | None) -> pb.Step:
        if outcome is not None:
            outcome = self.settle(self.practice.kept(self.driver, outcome))
            self.exchanges.put(outcome.exchange(self.driver.info["time"]))
        step = self.driver.execute(proposal, outcome, self.proposer.version)
        self.steps.put(step)
        self.tape.publish()
        return step


@dataclass
class ActorStats:
    steps: int = 0
    fallbacks: int = 0
    waits: int = 0
    round_trip_ms: float = 0.0  # sum
    collisions: int = 0
    contacts_robots: int = 0

    def count(self, step: pb.Step) -> None:
        self.steps += 1
        self.fallbacks += step.fallback
        self.collisions += step.collision
        self.contacts_robots += step.contact_robot

    def figures(self, seconds: float) -> dict[str, float]:
        """For Health."""
        return {
            "steps": self.steps,
            "steps_per_s": self.steps / max(seconds, 1e-9),
            "fallbacks": self.fallbacks,
            "waits": self.waits,
            "collisions": self.collisions,
            "contacts_robots": self.contacts_robots,
            "round_trip_ms": self.round_trip_ms / max(self.steps, 1),
        }


def cycle(riders: list[ActorRunner], question: Ask | None, tally: ActorStats, stop: Callable[[], bool]) -> bool:
    """One period of all robots of the process; False: the end."""
    for rider in riders:
        if not rider.ready(stop):
            return False
    proposals = [rider.propose() for rider in riders]
    outcomes: list[DecisionOutcome | None] = [None] * len(riders)
    if question is not None:
        requests = [rider.driver.request(p) for rider, p in zip(riders, proposals, strict=True)]
        outcomes = list(request_decisions(question, requests, riders[0].driver.robot))
    for rider, proposal, outcome in zip(riders, proposals, outcomes, strict=True):
        if outcome is not None:
            tally.round_trip_ms += outcome.round_trip_ms
            if rider.waits and rider.driver.may_wait(outcome):
                if not rider.waiting:
                    log.warning("standing and waiting for the safety service: %s", outcome.failure)
                rider.waiting = True
                tally.waits += 1
                time.sleep(PATIENCE)
                continue
            rider.waiting = False
        tally.count(rider.act(proposal, outcome))
    return True


def cycle_together(
    fleet: RobotGroup, riders: list[ActorRunner], question: Ask | None, tally: ActorStats, stop: Callable[[], bool]
) -> bool:
    """One period of the robots of one world; False: the end. Time passes for all of them or for none."""
    if not fleet.running:
        episode = max(rider.next_episode for rider in riders)
        if not all(rider.proposer.ready(rider.driver.index + 1, episode, stop) for rider in riders):
            return False
        for rider, message in zip(riders, fleet.begin(episode), strict=True):
            rider.episodes.put(message)
            rider.next_episode = episode + 1
            rider.proposer.begin(rider.driver.rng)
    if not all(rider.ready(stop) for rider in riders if rider.driver.running):
        return False
    proposals = [rider.propose() if rider.driver.running else rider.driver.robot.zero_input() for rider in riders]
    outcomes: list[DecisionOutcome | None] = [None] * len(riders)
    if question is not None:
        outcomes = joint_outcomes(request_decisions(question, fleet.requests(proposals), riders[0].driver.robot))
    told = list(zip(riders, outcomes, strict=True))
    waits = all(outcome is not None and rider.driver.may_wait(outcome) for rider, outcome in told)
    for rider in riders:
        if waits and not rider.waiting:
            log.warning("%s: standing and waiting for the safety service", rider.driver.identity.actor)
        rider.waiting = waits
    if waits:
        tally.waits += 1
        time.sleep(PATIENCE)
        return True
    for rider, outcome in told:
        if outcome is not None:
            tally.round_trip_ms += outcome.round_trip_ms
            rider.exchanges.put(rider.settle(outcome).exchange(rider.driver.info["time"]))
    versions = [rider.proposer.version for rider in riders]
    for rider, step in zip(riders, fleet.execute(proposals, outcomes, versions), strict=True):
        if step is not None:
            rider.steps.put(step)
            tally.count(step)
    return True


def run(
    settings: ActorSettings,
    make: EnvironmentFactory,
    propose: PolicyFactory | None = None,
    make_world: WorldFactory | None = None,
) -> bool:
    """Drive until the learner says the run is done (True), or SIGINT or SIGTERM. propose: a policy instead of learning,
    for as many steps as the settings say (of a fleet: until one robot has taken them); make_world: of a fleet.

    Raises:
        RefusedByLearner, Unreachable: with what to do.
    """
    tally = ActorStats()
    with Process(settings.bus, settings.name) as process:
        stop = process.stop.is_set
        world = None
        if settings.fleet and make_world is not None:
            number = settings.seed * EPISODE_STRIDE + settings.number
            world = make_world(robot_with_task(settings.robot), settings.arena, settings.robots, number)
        places: Sequence[Environment | None] = [None] * settings.robots if world is None else world.members
        riders = [ActorRunner(process, settings, i, make, propose, env=env) for i, env in enumerate(places)]
        one_period: Callable[[list[ActorRunner], Ask | None, ActorStats, Callable[[], bool]], bool] = cycle
        if world is not None:
            fleet = RobotGroup(world, [rider.driver for rider in riders], settings.method != "none")
            one_period = partial(cycle_together, fleet)
        started = time.monotonic()

        process.refresh = lambda: process.figures.update(tally.figures(time.monotonic() - started))
        process.announce()
        question: Ask | None = None
        if settings.method != "none":
            question = lambda requests: query_service(process.bus, requests, settings.deadline)  # noqa: E731
        if all(rider.join(stop) for rider in riders):
            while not stop() and one_period(riders, question, tally, stop):
                pass
        log.info("%s: %d steps, %d fallbacks, %d waits", settings.name, tally.steps, tally.fallbacks, tally.waits)
        return not stop()
