"""PROCESS: flies one quadrotor in real time behind a MAVLink link; the loop is that of every actor.

Period k: its input goes out; then it is observed, proposed and asked, and what the answer says is for period k + 1. An
answer that comes too late is discarded for the committed plan's next input, which the vehicle's keeper sends by itself:
a process of its own, which brakes along that plan should this one die (`brakeline.actors.mavlink.vehicle_server`).
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
from google.protobuf.message import Message

from brakeline.actors.actor_process import (
    STOP_PRACTICE,
    ActorRunner,
    ActorSettings,
    ActorStats,
    EnvironmentFactory,
    cycle,
)
from brakeline.actors.actor_settings import FlightSettings as FlightSettings
from brakeline.actors.decision_guard import Ask, DecisionOutcome, request_decisions
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.frame_recorder import MessageSink
from brakeline.actors.mavlink.mavlink_vehicle import ControlPeriod
from brakeline.actors.mavlink.vehicle_client import VehicleClient
from brakeline.actors.mavlink.vehicle_messages import FlightRequest
from brakeline.actors.policies import PolicyFactory
from brakeline.messaging.bus import BusError
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.backup_plan import Array, BackupPlan
from brakeline.safety.service.client import query_service, request_message
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import goal_sequence
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import Period

log = logging.getLogger("brakeline.flight")

GOALS = 12  # after which they come again: what a policy works out about a goal it works out before the flight
PATIENCE = 0.2  # s between questions to a service that does not answer yet


class FilterRequired(ValueError):
    """In real time nobody flies without the filter: its plan is what is flown when nothing else comes."""


class TakeoffNotVerified(ValueError):
    """Not even hovering can be verified where the flight is to begin."""


class BackgroundPublisher:
    """Publishes in a thread of its own: a receiver that does not drain may block it, and not the flight."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[tuple[MessageSink, Message] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def at(self, publisher: MessageSink) -> Posting:
        """What publishes there."""
        return Posting(publisher, self._queue)

    def close(self, patience: float = 2.0) -> None:
        """Wait until all is published, but not for ever."""
        self._queue.put(None)
        self._thread.join(patience)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            publisher, message = item
            try:
                publisher.put(message)
            except BusError as error:
                log.error("not published: %s", error)


@dataclass(frozen=True)
class Posting:
    """A publisher behind an outbox."""

    publisher: MessageSink
    queue: SimpleQueue[tuple[MessageSink, Message] | None]

    def put(self, message: Message) -> None:
        """Never waits."""
        self.queue.put((self.publisher, message))


class RealTimeVehicle:
    """A live vehicle as the environment sees it: `step` ends with the period; what was committed is carried out.

    What is true is not known here: the estimate stands for it, also where rays are cast.
    """

    def __init__(self, vehicle: VehicleClient, skip: Callable[[], object]) -> None:
        """skip: is called for each period that went by unseen."""
        self.vehicle, self._skip = vehicle, skip
        self.current_period: ControlPeriod = vehicle.current_period
        self.skipped = 0

    @property
    def true(self) -> Array:
        """(9,) as estimated."""
        return self.current_period.report.measured

    measured = true

    @property
    def input(self) -> Array:
        """(3,) m/s, in force."""
        return self.current_period.input

    def catch_up(self) -> None:
        """Go on from the next period on, whatever the number of the last one."""
        self.current_period = self.vehicle.wait(self.vehicle.current_period.number + 1)

    def step(self, input: Array) -> Period:
        """The running period to its end. Raises MavlinkError."""
        expected = self.current_period.number + 1
        self.current_period = self.vehicle.wait(expected)
        for _ in range(self.current_period.number - expected):
            self.skipped += 1
            self._skip()
        return self.initial_period()

    def initial_period(self) -> Period:
        """The report about the period that ended last."""
        return replace(self.current_period.report, true=self.current_period.report.measured)

    def alter(self, **changes: float) -> None:
        """Raises ValueError: nobody can, from here."""
        raise ValueError(f"a vehicle behind a link cannot be altered: {', '.join(changes)}")


class FlightRunner(ActorRunner):
    """A rider whose world does not wait."""

    waits = False

    def __init__(
        self,
        process: Process,
        settings: ActorSettings,
        stages: Sequence[Arena],
        propose: PolicyFactory | None,
        outbox: BackgroundPublisher,
        conditions: Conditions,
    ) -> None:
        super().__init__(process, settings, 0, self._environment(stages, conditions), propose, goes_on=True)
        self._flight: RealTimeVehicle | None = None
        self.answers: Counter[str] = Counter()  # in time | late | none | lost
        self.steps, self.episodes, self.exchanges = map(outbox.at, (self.steps, self.episodes, self.exchanges))
        self.tape.publisher = outbox.at(self.tape.publisher)

    @property
    def flight(self) -> RealTimeVehicle:
        """Once it has begun."""
        assert self._flight is not None, "begin the flight first"
        return self._flight

    def take(self, vehicle: VehicleClient) -> None:
        """From here on it flies this one, which hovers. What is slow the first time is done once before."""
        self._flight = RealTimeVehicle(vehicle, self.driver.skip)
        observation, info = self.driver.env.reset(options={"episode_seed": 0})
        self.proposer.begin(np.random.default_rng(0))
        self.proposer.propose(observation, info)
        self._stage = -1
        self._flight.catch_up()

    def settle(self, outcome: DecisionOutcome) -> DecisionOutcome:
        """Hand the plan over, if it comes in time and what it was made from counts; else there is no answer."""
        period, answer = self.flight.current_period, outcome.answer
        if period.lost:
            what, outcome = "lost", replace(outcome, answer=None, failure=f"Lost: {period.lost}")
        elif outcome.failure == STOP_PRACTICE:
            what = "not needed"
        elif answer is None:
            what = "none"
        elif self.flight.vehicle.commit(answer.plan[self.driver.robot.committed_steps :], period.number + 1):
            what = "in time"
        else:
            what, outcome = "late", replace(outcome, answer=None, failure="Late: its period had begun")
        self.answers[what] += 1
        return super().settle(outcome)

    def stop(self) -> None:
        """Along the committed plan to hovering."""
        period = self.flight.current_period
        self.flight.vehicle.wait(period.number + self.driver.robot.horizon)

    def figures(self) -> dict[str, float]:
        """For Health."""
        if self._flight is None:
            return {}
        asked = max(self.answers.total() - self.answers["not needed"], 1)
        return {
            **{f"answers {what}": self.answers[what] for what in ("in time", "late", "none", "lost")},
            "answers in time share": self.answers["in time"] / asked,
            "periods skipped": self._flight.skipped,
            **self._flight.vehicle.figures(),
        }

    def _environment(self, stages: Sequence[Arena], conditions: Conditions) -> EnvironmentFactory:
        """Obstacles are virtual: what a scan shows is cast from the estimated pose."""
        seeing = conditions.perception.kind == "scan"
        noise = conditions.lidar_noise(flies=True) if seeing else 0.0

        def draw(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
            self._stage += 1
            return stages[self._stage % len(stages)]

        self._stage = -1

        def make(robot: RobotWithTask, arena: str, seed: int, *, tap: FrameTap | None = None) -> NavigationEnv:
            vehicle = lambda arena, rng: self.flight  # noqa: E731
            return NavigationEnv(robot, arena, vehicle, noise, seed, draw=draw, perception=conditions.perception)

        return make


def prepared(propose: PolicyFactory, stages: Sequence[Arena], seed: int) -> Any:
    """The policy, with what it must know of the map worked out."""
    policy = propose(seed)
    if hasattr(policy, "prepare"):
        for stage in stages:
            policy.prepare(stage)
    return policy


def answered(question: Ask, robot: Robot, stage: Arena, filtered: bool, stop: Callable[[], bool]) -> bool:
    """Wait until the safety service answers about a robot that hovers at the start; False: told to stop.

    filtered: by our own filter, which knows whether it could.

    Raises:
        TakeoffNotVerified: hovering there can't be verified, let alone a flight from there.
    """
    start = np.array(stage.start[: robot.position_dim])
    state = np.concatenate([start, np.zeros(robot.state_dim - len(start))])
    away = stage.shapes.distance(start)
    seen = [obstacle for obstacle, far in zip(stage.obstacles, away, strict=True) if far <= robot.sight]
    said = ""
    while not stop():
        request = request_message(BackupPlan(robot), state, np.zeros(robot.action_dim), seen, known_free=True)
        outcome = request_decisions(question, [request], robot)[0]
        if outcome.answer is not None:
            if filtered and outcome.answer.kind not in ("allowed", "adjusted"):
                raise TakeoffNotVerified(
                    f"not taking off: hovering at the start, {away.min():.2f} m from the nearest obstacle, can't be "
                    f"verified ({outcome.answer.reason}). Where this vehicle drifts to is known too badly for "
                    "that much room: collect more data, or fly where there is more"
                )
            return True
        if outcome.failure != said:
            log.info("on the ground, waiting for the safety service: %s", outcome.failure)
            said = outcome.failure
        time.sleep(PATIENCE)
    return False


def run(
    settings: ActorSettings,
    flight: FlightSettings,
    arena: Arena,
    propose: PolicyFactory | None = None,
    conditions: Conditions | None = None,
) -> bool:
    """Fly from goal to goal on the arena's map until the learner's run is done or the policy's steps are taken (True),
    or SIGINT or SIGTERM; then brake, and leave the vehicle to its autopilot. Of the conditions, perception counts.

    Raises:
        FilterRequired, TakeoffNotVerified, RefusedByLearner, Unreachable, BadLink: with what to do.
        MavlinkError: no autopilot, it refuses something, or nobody flies it any more.
    """
    robot = robot_with_task(settings.robot)
    if settings.method == "none" or not robot.late:
        raise FilterRequired("in real time a robot flies behind the filter, with plans that reckon with the delay")
    stages = goal_sequence(arena, GOALS, np.random.default_rng(settings.seed), robot)
    if propose is not None:
        policy = prepared(propose, stages, settings.seed)
        propose = lambda _: policy  # noqa: E731
    tally, outbox = ActorStats(), BackgroundPublisher()
    with Process(settings.bus, settings.name) as process:
        stop, started = process.stop.is_set, time.monotonic()
        rider = FlightRunner(process, settings, stages, propose, outbox, conditions or Conditions())
        process.refresh = lambda: process.figures.update(tally.figures(time.monotonic() - started) | rider.figures())
        process.announce()
        question = partial(query_service, process.bus, deadline=settings.deadline)
        if not (rider.join(stop) and answered(question, robot, stages[0], settings.method == "ddpc", stop)):
            return False
        request = FlightRequest(flight, robot, arena.obstacles)
        vehicle = VehicleClient(request, rider.tape.keep, process.bus.rejected, stop)
        try:
            rider.take(vehicle)
            while not stop() and cycle([rider], question, tally, stop):
                pass
            done = not stop()
            rider.stop()
            vehicle.close()
        except BaseException:
            vehicle.leave()
            raise
        finally:
            rider.tape.publish()
            outbox.close()
        log.info("%s: %d periods, %d without an answer in time", settings.name, tally.steps, tally.fallbacks)
        return done
