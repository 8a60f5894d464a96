"""PROCESS: fly one quadrotor in real time over a MAVLink link, with the loop of every actor.

While the input of period k is in force, the actor observes, proposes and asks; the answer is for period k + 1. An
answer that comes too late does not count, and the vehicle server sends the committed plan's next input by itself. The
server is a process of its own (`brakeline.actors.mavlink.vehicle_server`), which brakes along that plan if this
process dies.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from queue import SimpleQueue
from threading import Thread

import numpy as np
from google.protobuf.message import Message

from brakeline.actors.actor_process import (
    STOP_PRACTICE,
    ActorGroup,
    ActorRunner,
    ActorSettings,
    ActorStats,
    EnvironmentFactory,
    run_period,
)
from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.decision_guard import Ask, DecisionOutcome, request_decisions
from brakeline.actors.mavlink.frame_log import FrameTap
from brakeline.actors.mavlink.frame_recorder import MessageSink
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.actors.mavlink.vehicle_client import VehicleClient
from brakeline.actors.mavlink.vehicle_messages import FlightRequest
from brakeline.actors.proposers import PolicyFactory, Stop
from brakeline.errors import BusError, Mismatch, TakeoffNotVerified
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import ADJUSTED, ALLOWED
from brakeline.safety.service.client import request_message
from brakeline.safety.service.service_query import query_service
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import goal_sequence
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.scripted_policies import Policy
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import Period

log = logging.getLogger("brakeline.flight")

GOALS = 12  # of a flight, which then come again: a policy prepares for each of them before the flight
RETRY_INTERVAL = 0.2  # s between two queries to a service that does not answer yet
DRAIN_TIMEOUT = 2.0  # s for the last messages of a flight


class BackgroundPublisher:
    """Publishes in a thread of its own, so that a receiver that does not read cannot delay the flight."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[tuple[MessageSink, Message] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    def wrap(self, publisher: MessageSink) -> MessageSink:
        return QueuedSink(publisher, self._queue)

    def close(self) -> None:
        """Wait until everything is published, for `DRAIN_TIMEOUT` at most."""
        self._queue.put(None)
        self._thread.join(DRAIN_TIMEOUT)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            publisher, message = item
            try:
                publisher.put(message)
            except BusError as error:
                log.error("not published: %s", error)


@dataclass(frozen=True)
class QueuedSink:
    """A publisher behind the queue of a `BackgroundPublisher`."""

    publisher: MessageSink
    queue: SimpleQueue[tuple[MessageSink, Message] | None]

    def put(self, message: Message) -> None:
        """Queue a message; never waits."""
        self.queue.put((self.publisher, message))


class RealTimeVehicle:
    """A flying vehicle as the environment sees it: `step` waits for the end of the period.

    The true state is unknown here. The estimate takes its place, also for the rays of a virtual scan.
    """

    def __init__(
        self,
        vehicle: VehicleClient,
        skip: Callable[[], object],
        executes: Callable[[Array], object],
        acceleration_age: float,
    ) -> None:
        """Follow a vehicle in flight.

        Args:
            skip: called for each period that passed without an observation.
            executes: called with the input in force (3,) [m/s] of each period that was observed.
            acceleration_age: see `FlightSettings`. The environment states it, and the runner's requests repeat it.
        """
        self.vehicle, self._skip, self._executes = vehicle, skip, executes
        self.acceleration_age = acceleration_age
        self.current_period: ControlPeriod = vehicle.current_period  # the latest that the environment observed
        self.skipped = 0  # periods that passed without an observation

    @property
    def true(self) -> Array:
        """The estimated state (9,)."""
        return self.current_period.report.measured

    measured = true

    @property
    def input(self) -> Array:
        """The input in force (3,) [m/s]."""
        return self.current_period.input

    def catch_up(self) -> None:
        """Continue with the next period, whatever the number of the last one."""
        self.current_period = self.vehicle.wait(self.vehicle.current_period.number + 1)

    def step(self, input: Array) -> Period:
        """Wait for the end of the current period; the vehicle flies the committed plan. Raises MavlinkError."""
        expected = self.current_period.number + 1
        self.current_period = self.vehicle.wait(expected)
        for _ in range(self.current_period.number - expected):
            self.skipped += 1
            self._skip()
        self._executes(self.current_period.input)
        return self.initial_period()

    def initial_period(self) -> Period:
        """Return the report about the last period that ended."""
        return replace(self.current_period.report, true=self.current_period.report.measured)

    def alter(self, **changes: float) -> None:
        """Raises ValueError: the physics of a vehicle behind a link cannot change from here."""
        raise ValueError(f"a vehicle behind a link cannot be altered: {', '.join(changes)}")


class FlightRunner(ActorRunner):
    """The robot of a flight: its world does not wait."""

    waits = False

    def __init__(
        self,
        process: Process,
        settings: ActorSettings,
        stages: Sequence[Arena],
        propose: PolicyFactory | None,
        publisher: BackgroundPublisher,
        conditions: Conditions,
        acceleration_age: float = 0.0,
    ) -> None:
        """Prepare the runner.

        Args:
            stages: the arenas of the flight's episodes, one after the other; they differ in the goal.
            acceleration_age: see `FlightSettings`.
        """
        self._stages, self._next_stages, self._acceleration_age = stages, cycle(stages), acceleration_age
        super().__init__(process, settings, 0, self._environment(conditions), propose, continuous=True)
        self._vehicle: RealTimeVehicle | None = None
        self._began_lost = False  # whether the state before the step did not count
        self.answers: Counter[str] = Counter()  # "in time", "late", "none", "lost" or "not needed"
        self.steps, self.episodes, self.exchanges = map(publisher.wrap, (self.steps, self.episodes, self.exchanges))
        self.frames.publisher = publisher.wrap(self.frames.publisher)

    @property
    def vehicle(self) -> RealTimeVehicle:
        """The vehicle, once `take` has been called."""
        assert self._vehicle is not None, "call `take` first"
        return self._vehicle

    def take(self, vehicle: VehicleClient) -> None:
        """Fly this vehicle, which hovers, from now on. This does everything once that is slow the first time."""
        self._vehicle = RealTimeVehicle(
            vehicle, self.runner.skip, self.runner.backup_plan.executes, self._acceleration_age
        )
        observation, info = self.runner.env.reset(options={"episode_seed": 0})
        self.proposer.begin(np.random.default_rng(0))
        self.proposer.propose(observation, info)
        self._next_stages = cycle(self._stages)
        self._vehicle.catch_up()

    def commit(self, outcome: DecisionOutcome) -> DecisionOutcome:
        """Commit the answer's plan. Return an outcome without an answer if the plan is late, or its state is lost.

        A lost vehicle may not follow its plan, so the plan no longer counts as verified.
        """
        period, answer = self.vehicle.current_period, outcome.answer
        self._began_lost = bool(period.lost)
        if period.lost:
            self.runner.backup_plan.distrust()
            result, outcome = "lost", replace(outcome, answer=None, failure=f"Lost: {period.lost}")
        elif outcome.failure == STOP_PRACTICE:
            result = "not needed"
        elif answer is None:
            result = "none"
        elif self.vehicle.vehicle.commit(answer.plan[self.runner.robot.committed_steps :], period.number + 1):
            result = "in time"
        else:
            result, outcome = "late", replace(outcome, answer=None, failure="Late: its period had begun")
        self.answers[result] += 1
        return outcome

    def publish(self, step: pb.Step) -> None:
        """Publish a step. Nothing may learn from it if the vehicle did not follow it, or a state of it is not known."""
        step.lost = self._began_lost or bool(self.vehicle.current_period.lost)
        super().publish(step)

    def brake(self) -> None:
        """Wait until the vehicle has flown its committed plan to the end, and hovers."""
        self.vehicle.vehicle.wait(self.vehicle.current_period.number + self.runner.robot.horizon)

    def figures(self) -> dict[str, float]:
        if self._vehicle is None:
            return {}
        needed = max(self.answers.total() - self.answers["not needed"], 1)
        counts = {f"answers {result}": self.answers[result] for result in ("in time", "late", "none", "lost")}
        shares = {"answers in time share": self.answers["in time"] / needed, "periods skipped": self._vehicle.skipped}
        return counts | shares | self._vehicle.vehicle.figures

    def _environment(self, conditions: Conditions) -> EnvironmentFactory:
        """Make the environment: obstacles are virtual, and a scan is computed from the estimated pose."""
        noise = conditions.lidar_noise(flies=True) if conditions.perception.kind == "scan" else 0.0

        def make(robot: RobotWithTask, arena: str, seed: int, *, tap: FrameTap | None = None) -> NavigationEnv:
            return NavigationEnv(
                robot,
                arena,
                lambda arena, rng: self.vehicle,
                conditions=conditions,
                lidar_noise=noise,
                seed_key=seed,
                draw=lambda *_: next(self._next_stages),
            )

        return make


def takeoff_verified(
    ask: Ask, robot: Robot, stage: Arena, filtered: bool, stop: Stop, acceleration_age: float = 0.0
) -> bool:
    """Wait until the safety service decides about hovering at the start. Return False after a stop.

    Args:
        robot: the robot in real time.
        stage: the first arena.
        filtered: whether our own filter decides; a rival method does not tell whether it can verify hovering.
        acceleration_age: see `FlightSettings`.

    Raises:
        TakeoffNotVerified: the filter cannot verify hovering there.
    """
    start = np.array(stage.start[: robot.position_dim])
    state = np.concatenate([start, np.zeros(robot.state_dim - len(start))])
    distances = stage.shapes.distance(start)
    place = f", {distances.min():.2f} m from the nearest obstacle," if len(distances) else ""
    near = [obstacle for obstacle, far in zip(stage.obstacles, distances, strict=True) if far <= robot.sight]
    logged = ""
    while not stop():
        backup_plan = BackupPlan(robot, acceleration_age=acceleration_age)
        request = request_message(backup_plan, state, np.zeros(robot.action_dim), near, known_free=True)
        outcome = request_decisions(ask, [request], robot)[0]
        if outcome.answer is not None:
            if filtered and outcome.answer.kind not in (ALLOWED, ADJUSTED):
                raise TakeoffNotVerified(
                    f"not taking off: hovering at the start{place} can't be verified ({outcome.answer.reason}). The "
                    "model set's error bound is too large for so little room: collect more data, or fly where there is "
                    "more room"
                )
            return True
        if outcome.failure != logged:
            log.info("on the ground, waiting for the safety service: %s", outcome.failure)
            logged = outcome.failure
        time.sleep(RETRY_INTERVAL)
    return False


def run(
    settings: ActorSettings,
    flight: FlightSettings,
    arena: Arena,
    propose: PolicyFactory | None = None,
    conditions: Conditions | None = None,
) -> bool:
    """Fly from goal to goal on the arena's map until the run is over (True), or until SIGINT or SIGTERM (False).

    The vehicle then brakes, and stays with its autopilot.

    Args:
        arena: the map.
        propose: makes the policy, which flies `settings.steps` steps; None: the robot learns until the learner ends
            the run.
        conditions: of these only perception counts.

    Raises:
        Mismatch, TakeoffNotVerified, RefusedByLearner, Unreachable, BadLink: with what to do.
        MavlinkError: there is no autopilot, it refuses something, or nobody flies the vehicle any more.
    """
    robot = robot_with_task(settings.robot)
    if settings.method == "none" or not robot.late:
        raise Mismatch("a real-time flight needs the filter, and a robot whose plans allow for the delay")
    stages = goal_sequence(arena, GOALS, np.random.default_rng(settings.seed), robot)
    if propose is not None:
        propose = _prepared(propose(settings.seed), stages)
    stats, publisher = ActorStats(), BackgroundPublisher()
    with Process(settings.bus, settings.name) as process:
        stop, started = process.stop.is_set, time.monotonic()
        age = flight.acceleration_age
        actor = FlightRunner(process, settings, stages, propose, publisher, conditions or Conditions(), age)
        process.refresh = lambda: process.figures.update(stats.figures(time.monotonic() - started) | actor.figures())
        process.announce()
        ask = partial(query_service, process.bus, deadline=settings.deadline)
        if not (actor.join(stop) and takeoff_verified(ask, robot, stages[0], settings.method == "ddpc", stop, age)):
            return False
        request = FlightRequest(flight, robot, arena.obstacles)
        vehicle = VehicleClient(request, actor.frames.add, process.bus.rejected, stop)
        try:
            actor.take(vehicle)
            group = ActorGroup([actor])
            while not stop() and run_period([group], ask, stats, stop):
                pass
            done = not stop()
            actor.brake()
            vehicle.close()
        except BaseException:
            vehicle.leave()
            raise
        finally:
            actor.frames.publish()
            publisher.close()
        log.info("%s: %d periods, %d without an answer in time", settings.name, stats.steps, stats.fallbacks)
        return done


def _prepared(policy: Policy, stages: Sequence[Arena]) -> PolicyFactory:
    """Return what gives this policy, after it has seen all stages: planning takes longer than a period."""
    for stage in stages if hasattr(policy, "prepare") else ():
        policy.prepare(stage)  # type: ignore[attr-defined]
    return lambda _: policy
