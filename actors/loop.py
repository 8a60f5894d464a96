"""PROCESS: drives one or several robots: observe, propose, ask safety, act, publish."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from actors.driver import Driver, Environment, Identity
from actors.guard import Ask, Outcome, consult
from actors.student import Student
from messaging import brakeline_pb2 as pb
from messaging.bus import BusSettings, Publisher
from messaging.process import Process
from messaging.robots import Robot, robot_named
from messaging.topics import EPISODE, EXCHANGE, STEP
from safety.client import ask
from safety.commitment import Array
from sim.policies import scripted

log = logging.getLogger("brakeline.actor")

PATIENCE = 0.05  # s between questions of a standing robot that got no answer


@dataclass(frozen=True)
class Change:
    """What becomes of each robot after so many steps: the robot that was recorded is not the one that drives on.

    What is None stays as it is; a robot kind refuses what it does not have.
    """

    after: int = -1  # -1: never
    payload_kg: float | None = None
    floor_friction: float | None = None
    wind_speed: float | None = None  # m/s
    gust: float | None = None  # m/s

    def changes(self) -> dict[str, float]:
        """What a vehicle's `alter` takes."""
        values = {name: value for name, value in asdict(self).items() if name != "after"}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class ActorSettings:
    bus: BusSettings
    robot: str = "ground"
    name: str = "actor-0"
    number: int = 0  # of the first robot of this process
    robots: int = 1  # in this process; their requests share a question
    seed: int = 0
    arena: str = "default"
    method: str = "ddpc"
    penalty: float = 1.0
    deadline: float = 0.1  # s for an answer of the safety service
    lockstep: bool = False
    practice: float = 0.0  # share of steps at which a robot starts to follow its committed plan to the stop
    change: Change = field(default_factory=Change)


Make = Callable[[Robot, str, int], Environment]  # robot, arena, seed
STANDING = 2  # periods that a practised stop lasts beyond its plan


class Practice:
    """Now and then the committed plan to its end: safe, for it was verified, and the only way to go on recording what
    a stop is like (`brakeline certify LOG`)."""

    def __init__(self, share: float) -> None:
        self.share, self._left = share, 0

    def instead(self, driver: Driver, proposal: Array) -> Array:
        """The committed plan's next input while a stop is practised, else the proposal."""
        if self._left == 0 and self.share > 0.0 and driver.rng.random() < self.share:
            self._left = driver.robot.horizon - 1 + STANDING
        elif self._left == 0:
            return proposal
        self._left -= 1
        return np.asarray(driver.commitment.plan[0])


class Rider:
    """A driver with its link to the learner and its publishers."""

    def __init__(self, process: Process, settings: ActorSettings, offset: int, make: Make) -> None:
        robot = robot_named(settings.robot)
        actor = settings.name if settings.robots == 1 else f"{settings.name}.{offset}"
        identity = Identity(actor, settings.number + offset, settings.seed)
        env = make(robot, settings.arena, settings.seed)
        filtered, cuts = settings.method != "none", settings.method == "sailr"
        self.driver = Driver(robot, env, identity, settings.penalty, filtered, cuts)
        self.student = Student(process.bus, robot, actor, settings.lockstep)
        self.next_episode = 0
        self.waiting = False  # for the safety service, standing
        self.practice, self.change = Practice(settings.practice), settings.change
        publisher: Callable[..., Publisher] = process.bus.publisher
        self.steps = publisher(STEP, robot=robot.name, source=actor)
        self.episodes = publisher(EPISODE, robot=robot.name, source=actor)
        self.exchanges = publisher(EXCHANGE, robot=robot.name, source=actor)

    def join(self, stop: Callable[[], bool]) -> bool:
        """Join the learner; False: told to stop."""
        episode = self.student.join(self.driver.index, self.next_episode, stop)
        self.next_episode = max(self.next_episode, episode or 0)
        return episode is not None

    def ready(self, stop: Callable[[], bool]) -> bool:
        """Wait for permission to step, and begin an episode if none is running; False: the end."""
        if self.driver.index == self.change.after:
            self.driver.env.alter(**self.change.changes())
        if not self.student.wait(self.driver.index + 1, self.next_episode, stop):
            return False
        if not self.driver.running:
            self.episodes.put(self.driver.begin(self.next_episode))
            self.next_episode += 1
            self.random = scripted("random", self.driver.robot, self.driver.rng)
        return True

    def propose(self) -> Array:
        """The exploring policy's action, at random during warm-up; standing still if it is no number."""
        driver, policy = self.driver, self.student.policy
        if policy is None or self.student.warmup:
            return self.practice.instead(driver, self.random(driver.observation, driver.info))
        action = policy.explore(driver.observation, driver.rng)
        if not np.isfinite(action).all():
            log.error("weights %d propose %s: standing still", policy.version, action)
            return np.zeros(driver.robot.action_dim)
        return self.practice.instead(driver, action)

    def act(self, proposal: Array, outcome: Outcome | None) -> pb.Step:
        if outcome is not None:
            self.exchanges.put(outcome.exchange(self.driver.info["time"]))
        version = 0 if self.student.policy is None else self.student.policy.version
        step = self.driver.execute(proposal, outcome, version)
        self.steps.put(step)
        return step


@dataclass
class Tally:
    steps: int = 0
    fallbacks: int = 0
    waits: int = 0
    round_trip_ms: float = 0.0  # sum
    collisions: int = 0


def cycle(riders: list[Rider], question: Ask | None, tally: Tally, stop: Callable[[], bool]) -> bool:
    """One period of all robots of the process; False: the end."""
    for rider in riders:
        if not rider.ready(stop):
            return False
    proposals = [rider.propose() for rider in riders]
    outcomes: list[Outcome | None] = [None] * len(riders)
    if question is not None:
        requests = [rider.driver.request(p) for rider, p in zip(riders, proposals, strict=True)]
        outcomes = list(consult(question, requests, riders[0].driver.robot))
    for rider, proposal, outcome in zip(riders, proposals, outcomes, strict=True):
        if outcome is not None:
            tally.round_trip_ms += outcome.round_trip_ms
            if rider.driver.may_wait(outcome):
                if not rider.waiting:
                    log.warning("standing and waiting for the safety service: %s", outcome.failure)
                rider.waiting = True
                tally.waits += 1
                time.sleep(PATIENCE)
                continue
            if outcome.answer is None:
                log.warning("no decision, braking along the committed plan: %s", outcome.failure)
            rider.waiting = False
        step = rider.act(proposal, outcome)
        tally.steps += 1
        tally.fallbacks += step.fallback
        tally.collisions += step.collision
    return True


def run(settings: ActorSettings, make: Make) -> bool:
    """Drive until the learner says the run is done (True), or SIGINT or SIGTERM.

    Raises:
        RefusedByLearner, Unreachable: with what to do.
    """
    tally = Tally()
    with Process(settings.bus, settings.name) as process:
        stop = process.stop.is_set
        riders = [Rider(process, settings, offset, make) for offset in range(settings.robots)]
        started = time.monotonic()

        def refresh() -> None:
            elapsed = max(time.monotonic() - started, 1e-9)
            process.figures.update(
                steps=tally.steps,
                steps_per_s=tally.steps / elapsed,
                fallbacks=tally.fallbacks,
                waits=tally.waits,
                collisions=tally.collisions,
                round_trip_ms=tally.round_trip_ms / max(tally.steps, 1),
            )

        process.refresh = refresh
        process.announce()
        question: Ask | None = None
        if settings.method != "none":
            question = lambda requests: ask(process.bus, requests, settings.deadline)  # noqa: E731
        if all(rider.join(stop) for rider in riders):
            while not stop() and cycle(riders, question, tally, stop):
                pass
        log.info("%s: %d steps, %d fallbacks, %d waits", settings.name, tally.steps, tally.fallbacks, tally.waits)
        return not stop()
