"""One robot's committed plan between its raw commands and its base: what goes out in each period, and why.

The world does not wait: while a period's input is carried out the next one's is decided on, by a model set of the robot
in real time. `begin` gives the input of the period that begins; `decide`, late in it, asks about the command that is
the newest then, with the state that was measured at its beginning.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask, DecisionOutcome, next_input, request_decisions
from brakeline.actors.ros2.ros_inputs import RawCommand
from brakeline.messaging.obstacle import BOX, Obstacle, Shapes
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.request import ADJUSTED, ALLOWED
from brakeline.safety.service.client import request_message
from brakeline.safety.service.wire import KINDS

Array = NDArray[np.float64]

ROOM = 0.035  # m: by how much two scans of one thing may differ, roughly
KEPT = 10_000  # latest delays that are remembered
NO_ANSWER, LATE, BLIND = "no answer", "late", "blind"


def inflated(obstacle: Obstacle, room: float) -> Obstacle:
    """A box or a disc with that much [m] around it."""
    more = 2.0 * room if obstacle.kind == BOX else room
    return replace(obstacle, size=tuple(size + more for size in obstacle.size))


@dataclass
class GateStats:
    """What became of the periods so far."""

    periods: int = 0
    kinds: Counter[str] = field(default_factory=Counter)  # as decided; or no answer, late, blind
    commands: int = 0  # that were decided on
    compared: int = 0  # measured states with a prediction
    outside: int = 0  # of them: not in the predicted set
    slips: int = 0  # periods that began a period late or more
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))  # s from a command's coming to its going
    decide_ms: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))

    def figures(self) -> dict[str, float]:
        kinds = (*KINDS, NO_ANSWER, LATE, BLIND)
        delays, decide = 1e3 * np.array([*self.delays] or [0.0]), np.array([*self.decide_ms] or [0.0])
        return {
            "periods": self.periods,
            **{kind: self.kinds[kind] for kind in kinds},
            "commands": self.commands,
            "left the predicted set": self.outside,
            "periods slipped": self.slips,
            "delay p50 ms": float(np.percentile(delays, 50)),
            "delay p99 ms": float(np.percentile(delays, 99)),
            "delay worst ms": float(delays.max()),
            "decide p50 ms": float(np.percentile(decide, 50)),
            "decide p99 ms": float(np.percentile(decide, 99)),
        }


class CommandGate:
    """The committed plan, and who is asked about the next one."""

    def __init__(self, robot: Robot, ask: Ask, name: str = "ros2") -> None:
        """robot: in real time (`Robot.late`)."""
        assert robot.late, "in real time an answer counts from the next period on"
        self.robot, self.backup_plan, self.tally = robot, BackupPlan(robot), GateStats()
        self.input = np.zeros(robot.action_dim)  # of the running period
        self.reason = "not begun"  # why the next input is not the command; empty: it is
        self.kind = BLIND
        self.outcome: DecisionOutcome | None = None  # of this period's question
        self._ask, self._name = ask, name
        self._command: RawCommand | None = None  # that was asked about
        self._known = 0  # number of the last command whose delay is known

    def decide(
        self, state: Array, obstacles: Sequence[Obstacle], command: RawCommand | None, time: float, step: int
    ) -> None:
        """Ask about a command (None: to stand) in the state of the period's beginning. obstacles: all that a scan
        shows; space is known to be free where it shows nothing.

        First with `ROOM` around the obstacles: the next scan will show them somewhat nearer or farther, and who stopped
        where this one just allowed it could not even turn by the next. If nothing is verified there, then without; but
        then nothing that leads nearer.
        """
        proposal = np.zeros(self.robot.action_dim) if command is None else command.action

        def ask(action: Array, around: Sequence[Obstacle]) -> DecisionOutcome:
            request = request_message(
                self.backup_plan,
                state,
                action,
                around,
                known_free=True,
                actor=self._name,
                step=step & 0xFFFFFFFF,
                time=time,
            )
            return request_decisions(self._ask, [request], self.robot)[0]

        outcome = ask(proposal, [inflated(obstacle, ROOM) for obstacle in obstacles])
        if self._stuck(outcome) and obstacles:
            outcome = ask(proposal, obstacles)
            if not self._stuck(outcome) and self._nearer(outcome, state, obstacles):
                outcome = ask(np.where(self.robot.translates, 0.0, proposal), obstacles)
        self.outcome, self._command = outcome, command

    def begin(self, now: float, in_time: bool = True, why: str = "") -> Array:
        """The input (m,) of the period that begins now. in_time: False if the answer came after its beginning; why:
        there was no question, or no answer can count, and this is the reason."""
        tally, outcome, command = self.tally, None if why else self.outcome, self._command
        self.outcome = self._command = None
        tally.periods += 1
        if outcome is not None and outcome.answer is not None and in_time:
            answer = outcome.answer
            tally.compared += answer.compared
            tally.outside += answer.compared and not answer.contained
            tally.decide_ms.append(answer.time_ms)
            self.kind, self.reason = answer.kind, answer.reason
            self.input = next_input(self.backup_plan, outcome)
            if command is None:
                self.reason = self.reason or "no command"
            else:
                self._note(command, now)
        else:
            if outcome is None:
                self.kind, self.reason = BLIND, why or "nothing was asked"
            elif outcome.answer is None:
                self.kind, self.reason = NO_ANSWER, outcome.failure
            else:
                self.kind, self.reason = LATE, "the answer came after its period had begun"
            self.input = self.backup_plan.fallback()
        tally.kinds[self.kind] += 1
        return self.input

    def _stuck(self, outcome: DecisionOutcome) -> bool:
        """Was there an answer, and was nothing verified?"""
        return outcome.answer is not None and outcome.answer.kind not in (ALLOWED, ADJUSTED)

    def _nearer(self, outcome: DecisionOutcome, state: Array, obstacles: Sequence[Obstacle]) -> bool:
        """Does the answer's plan end nearer to what stands around than the robot is now?"""
        assert outcome.answer is not None
        d = self.robot.position_dim
        ends = np.stack([state[:d], outcome.answer.tube_center[-1]])
        here, there = Shapes.of(obstacles, d).distance(ends).min(axis=0)
        return bool(there < here)

    def _note(self, command: RawCommand, now: float) -> None:
        self.tally.commands += command.number != self._known
        if command.number != self._known:
            self._known = command.number
            self.tally.delays.append(now - command.at)
