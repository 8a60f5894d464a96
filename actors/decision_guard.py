"""Asks for decisions with a deadline; without one the robot brakes along the plan that it committed to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter_ns

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusError
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import Array, BackupPlan
from brakeline.safety.service.client import SafetyError, read_reply
from brakeline.safety.service.filter_client import Answer, accept

Ask = Callable[[Sequence[pb.Request]], list[pb.Reply]]  # raises BusError when there is no answer


@dataclass(frozen=True)
class DecisionOutcome:
    """Of one question about one robot: an answer, or why there is none."""

    request: pb.Request
    reply: pb.Reply | None
    answer: Answer | None
    failure: str
    round_trip_ms: float

    def exchange(self, time: float) -> pb.Exchange:
        message = pb.Exchange(request=self.request, round_trip_ms=self.round_trip_ms, failure=self.failure)
        message.header.time = time
        if self.reply is not None:
            message.reply.CopyFrom(self.reply)
        return message


def request_decisions(ask: Ask, requests: Sequence[pb.Request], robot: Robot) -> list[DecisionOutcome]:
    """One question for all robots of a process. Whatever goes wrong, each has an outcome."""
    before = perf_counter_ns()
    replies: Sequence[pb.Reply | None]
    try:
        replies, failure = ask(requests), ""
    except BusError as error:
        replies, failure = [None] * len(requests), f"{type(error).__name__}: {error}"
    elapsed = (perf_counter_ns() - before) * 1e-6
    return [_outcome(request, reply, failure, elapsed, robot) for request, reply in zip(requests, replies, strict=True)]


def _outcome(
    request: pb.Request, reply: pb.Reply | None, failure: str, elapsed: float, robot: Robot
) -> DecisionOutcome:
    answer = None
    if reply is not None:
        try:
            answer = read_reply(reply, request, robot)
        except SafetyError as error:
            failure = str(error)
    return DecisionOutcome(request, reply, answer, failure, elapsed)


def next_input(backup_plan: BackupPlan, outcome: DecisionOutcome) -> Array:
    """The input to execute now: the answer's, else the committed plan's."""
    if outcome.answer is not None:
        return accept(backup_plan, outcome.answer)
    return backup_plan.fallback()


def at_rest(backup_plan: BackupPlan) -> bool:
    """Is the robot standing, and committed to that? Then it can wait for the service for as long as it takes."""
    robot = backup_plan.robot
    return bool(robot.is_stop_input(backup_plan.input_in_force) and robot.is_stop_input(backup_plan.plan).all())
