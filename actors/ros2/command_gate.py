"""Decide in each period which command goes to a ROS 2 robot's base, and keep the committed plan.

Time does not wait: while the input of one period is in force, the gate decides about the next one, with a model set of
the robot in real time. `begin` returns the input of the period that begins. `decide`, late in the period, asks about
the newest command, with the state that was measured at the period's beginning.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from brakeline.actors.decision_guard import Ask, DecisionOutcome, next_input, request_decisions
from brakeline.actors.ros2.ros_inputs import RawCommand
from brakeline.messaging.obstacle import BOX, Obstacle, Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import ADJUSTED, ALLOWED
from brakeline.safety.service.client import request_message
from brakeline.safety.service.wire import KIND_NUMBERS

SCAN_DIFFERENCE = 0.035  # m by which two scans of one obstacle may differ, about
MOST_SAMPLES = 10_000  # the latest delays and decision times that count
NO_ANSWER, LATE, BLIND = "no answer", "late", "blind"


def inflated(obstacle: Obstacle, margin: float) -> Obstacle:
    """Return a box or a disc that is larger by a margin [m] on every side."""
    growth = 2.0 * margin if obstacle.kind == BOX else margin
    return replace(obstacle, size=tuple(size + growth for size in obstacle.size))


@dataclass
class GateStats:
    """Statistics of the periods so far."""

    periods: int = 0
    kinds: Counter[str] = field(default_factory=Counter)  # periods by decision, or `no answer`, `late`, `blind`
    commands: int = 0  # about which the gate decided
    outside: int = 0  # measured states outside of the predicted set
    slips: int = 0  # periods that began late by a period or more
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))  # s, command to period
    decide_ms: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))

    def figures(self) -> dict[str, float]:
        """Return the figures for diagnostics and for the end of the run."""
        delays_ms, decide_ms = 1e3 * np.array([*self.delays] or [0.0]), np.array([*self.decide_ms] or [0.0])
        return {
            "periods": self.periods,
            **{kind: self.kinds[kind] for kind in (*KIND_NUMBERS, NO_ANSWER, LATE, BLIND)},
            "commands": self.commands,
            "left the predicted set": self.outside,
            "periods slipped": self.slips,
            "delay p50 ms": float(np.percentile(delays_ms, 50)),
            "delay p99 ms": float(np.percentile(delays_ms, 99)),
            "delay worst ms": float(delays_ms.max()),
            "decide p50 ms": float(np.percentile(decide_ms, 50)),
            "decide p99 ms": float(np.percentile(decide_ms, 99)),
        }


class CommandGate:
    """The committed plan of one robot, and the decision about its next input."""

    def __init__(self, robot: Robot, ask: Ask, name: str = "ros2", turn_aside: bool = False) -> None:
        """robot: in real time (`Robot.late`); name: of the robot, in the requests; turn_aside: see `Request`."""
        assert robot.late, "in real time a decision is about the next period"
        self.robot, self.backup_plan, self.stats = robot, BackupPlan(robot, turn_aside), GateStats()
        self.input = np.zeros(robot.action_dim)  # in force
        self.kind, self.reason = BLIND, "not begun"  # the decision about this input, and why it is not the command's
        self.outcome: DecisionOutcome | None = None  # of this period's query
        self._ask, self._name = ask, name
        self._command: RawCommand | None = None  # the one that the outcome is about
        self._counted = 0  # number of the last command whose delay has been counted

    def decide(
        self, state: Array, obstacles: Sequence[Obstacle], command: RawCommand | None, time: float, step: int
    ) -> None:
        """Ask about a command in the state (n,) at the beginning of the period.

        The gate first inflates the obstacles by `SCAN_DIFFERENCE`, since the next scan may show them that much nearer.
        Otherwise a robot that stops at the edge of this scan's free space could not even turn after the next scan. If
        nothing can be verified with that margin, the gate asks without it, but accepts no plan that ends nearer to an
        obstacle.

        Args:
            obstacles: all obstacles that a scan shows; all other space is free.
            command: the newest command; None: the robot should stand.
            time: s, of the state.
            step: number of the period.
        """
        proposal = np.zeros(self.robot.action_dim) if command is None else command.action
        number = step & 0xFFFFFFFF

        def ask(action: Array, around: Sequence[Obstacle]) -> DecisionOutcome:
            request = request_message(
                self.backup_plan, state, action, around, known_free=True, actor=self._name, step=number, time=time
            )
            return request_decisions(self._ask, [request], self.robot)[0]

        outcome = ask(proposal, [inflated(obstacle, SCAN_DIFFERENCE) for obstacle in obstacles])
        if _unverified(outcome) and obstacles:
            outcome = ask(proposal, obstacles)
            if not _unverified(outcome) and self._approaches(outcome, state, obstacles):
                outcome = ask(np.where(self.robot.translates, 0.0, proposal), obstacles)
        self.outcome, self._command = outcome, command

    def slip(self, periods: int) -> None:
        """Take in that a period begins late: pass over the committed plan's inputs for the periods that were missed.

        Meanwhile the base went on with the last input, or its own timeout stopped it. So the plan of a robot that does
        not stand no longer counts as verified. The inputs of missed periods could set a robot in motion again that
        already stands.
        """
        self.stats.slips += periods > 0
        if self.backup_plan.plan.any():
            self.backup_plan.distrust()
        for _ in range(min(periods, len(self.backup_plan.plan))):
            self.backup_plan.fallback()

    def begin(self, now: float, in_time: bool = True, why: str = "") -> Array:
        """Return the input (m,) of the period that begins now [s].

        Args:
            now: by the robot's clock.
            in_time: whether the answer arrived before the period began.
            why: the reason why there was no query, or why no answer counts; empty: there is none.
        """
        stats, outcome, command = self.stats, None if why else self.outcome, self._command
        self.outcome = self._command = None
        stats.periods += 1
        if outcome is not None and outcome.answer is not None and in_time:
            answer = outcome.answer
            stats.outside += answer.compared and not answer.contained
            stats.decide_ms.append(answer.time_ms)
            self.kind, self.reason = answer.kind, answer.reason
            self.input = next_input(self.backup_plan, outcome)
            if command is None:
                self.reason = self.reason or "no command"
            elif command.number != self._counted:
                self._counted = command.number
                stats.commands += 1
                stats.delays.append(now - command.at)
        else:
            if outcome is None:
                self.kind, self.reason = BLIND, why or "nothing was asked"
            elif outcome.answer is None:
                self.kind, self.reason = NO_ANSWER, outcome.failure
            else:
                self.kind, self.reason = LATE, "the answer came after its period had begun"
            self.input = self.backup_plan.fallback()
        stats.kinds[self.kind] += 1
        return self.input

    def _approaches(self, outcome: DecisionOutcome, state: Array, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether the answer's plan ends nearer to the obstacles than the robot is now."""
        assert outcome.answer is not None
        d = self.robot.position_dim
        positions = np.stack([state[:d], outcome.answer.tube_center[-1]])
        now, end = Shapes.at_present(obstacles, d).distance(positions).min(axis=0)
        return bool(end < now)


def _unverified(outcome: DecisionOutcome) -> bool:
    """Return whether there was an answer, but no verified plan."""
    return outcome.answer is not None and outcome.answer.kind not in (ALLOWED, ADJUSTED)
