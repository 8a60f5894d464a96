"""Ask for decisions with a deadline. Without an answer, the robot brakes along the plan that it committed to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter_ns

from brakeline.errors import BusError, SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import read_reply
from brakeline.safety.service.filter_client import Answer, accept

Ask = Callable[[Sequence[pb.Request]], list[pb.Reply]]  # sends requests; raises BusError if there is no reply


@dataclass(frozen=True)
class DecisionOutcome:
    """The outcome of one request."""

    request: pb.Request
    reply: pb.Reply | None  # None: none arrived
    answer: Answer | None  # None: there is no valid answer
    failure: str  # why there is no answer; empty: there is one
    round_trip_ms: float  # of the query

    def exchange(self, time: float) -> pb.Exchange:
        """Return the message for the log; time: s, of the request."""
        message = pb.Exchange(request=self.request, round_trip_ms=self.round_trip_ms, failure=self.failure)
        message.header.time = time
        if self.reply is not None:
            message.reply.CopyFrom(self.reply)
        return message


def request_decisions(ask: Ask, requests: Sequence[pb.Request], robot: Robot) -> list[DecisionOutcome]:
    """Send one query about several robots, and return the outcome of each request. It states what went wrong."""
    before = perf_counter_ns()
    replies: Sequence[pb.Reply | None]
    try:
        replies, failure = ask(requests), ""
    except BusError as error:
        replies, failure = [None] * len(requests), f"{type(error).__name__}: {error}"
    elapsed_ms = (perf_counter_ns() - before) * 1e-6
    outcomes = []
    for request, reply in zip(requests, replies, strict=True):
        answer, why = None, failure
        if reply is not None:
            try:
                answer = read_reply(reply, request, robot)
            except SafetyError as error:
                why = str(error)
        outcomes.append(DecisionOutcome(request, reply, answer, why, elapsed_ms))
    return outcomes


def next_input(backup_plan: BackupPlan, outcome: DecisionOutcome) -> Array:
    """Return the input (m,) to execute next: the answer's, or the committed plan's if there is no answer."""
    if outcome.answer is not None:
        return accept(backup_plan, outcome.answer)
    return backup_plan.fallback()


def at_rest(backup_plan: BackupPlan) -> bool:
    """Return whether the robot stands and its committed plan is to stand, so that it can wait for the service."""
    robot = backup_plan.robot
    return bool(robot.is_stop_input(backup_plan.input_in_force) and robot.is_stop_input(backup_plan.plan).all())
