"""`Filter.decide` for thousands of robots at once, on any device of an array namespace.

    batch = BatchFilter(Filter.load("ground"))
    answers = batch.decide(RequestArrays.of(requests))     # or arrays of your own; torch tensors may lie on a GPU

The batch decides the rows whose answer is the proposal or the input of a QP, among obstacles that stand still. It
leaves every other row to `Filter.decide`, the *single path*: a state or a proposal outside the recorded domain, a
proposal that is not finite, a robot that may turn in place and whose proposal is not allowed at once, most failsafes,
every recovery, and every comparison whose result rounding could change.
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any

import array_api_compat
import numpy as np

from brakeline.errors import BadRequest
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.batch.decision_arrays import KINDS, BlockingArrays, DecisionArrays
from brakeline.safety.filter.batch.lane_decisions import LaneDecisions
from brakeline.safety.filter.batch.obstacle_arrays import Array, on_host
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.request import Decision

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter
    from brakeline.safety.methods import Method


class BatchFilter:
    """Decides batches of requests with one filter. It stores nothing about a robot."""

    def __init__(self, safety: Filter) -> None:
        robot = safety.robot
        self.safety = safety  # the filter, which is also the single path
        # whether batches decide for this robot at all. For a robot in joint space, with limits or with a feedback, the
        # single path decides every request.
        self.covers = bool(robot.position_dim) and not robot.limits and not robot.feedback
        self._prepared: dict[tuple[str, str], LaneDecisions] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, without prepared arrays: they refer to a module, which nobody can copy."""
        return vars(self) | {"_prepared": {}}

    def decide(self, requests: RequestArrays) -> DecisionArrays:
        """Decide on a batch of requests: see `Filter.decide_batch`."""
        started = perf_counter_ns()
        xp, device = array_api_compat.array_namespace(requests.state), array_api_compat.device(requests.state)
        _check_arrays(self.safety.robot, requests, xp)
        answers = blank_answers(self.safety.robot, requests, xp, device)
        decided = xp.zeros(len(requests), dtype=xp.bool, device=device)
        if self.covers and len(requests):
            key = xp.__name__, str(device)
            if key not in self._prepared:
                self._prepared[key] = LaneDecisions(self.safety, xp, device)
            with np.errstate(all="ignore"):  # lanes that overflow are left to the single path
                decided = self._prepared[key].decide(requests, answers)
        safety = self.safety
        judges = safety.model.one_step is not None
        about = {"bound": safety.bound, "judges": judges, "outside_share": safety.outside_share}
        return completed(safety, requests, answers, ~on_host(decided), started, **about)


def completed(
    method: Method, requests: RequestArrays, answers: dict[str, Any], left: Array, started: int, **about: Any
) -> DecisionArrays:
    """Let a method decide the rows that are left (B,) one by one, and return all decisions.

    started [ns]: time of the requests; about: `bound`, `judges` and `outside_share` of `Decision`.
    """
    singly, rows = {}, np.flatnonzero(left).tolist()
    if rows:
        xp, device = array_api_compat.array_namespace(answers["plan"]), array_api_compat.device(answers["plan"])
        own = requests.rows(rows)
        written = blank_answers(method.robot, own, np, "cpu")
        for number, row in enumerate(rows):
            try:
                singly[row] = method.decide(own.row(number))
            except BadRequest as error:
                raise BadRequest(error.field, f"row {row}: {error}") from error
            write_decision(written, number, singly[row])
        to = xp.asarray(np.array(rows), device=device)
        del written["blocked"]  # `singly` holds it
        for name, array in written.items():
            answers[name][to] = xp.asarray(array, device=device)
    time_ms = (perf_counter_ns() - started) * 1e-6 / max(len(requests), 1)
    about |= {"model": method.version, "time_ms": time_ms}
    return DecisionArrays(**answers, singly=singly, obstacles=requests.obstacles, **about)


def _check_arrays(robot: Robot, requests: RequestArrays, xp: Any) -> None:
    """Check the shapes and types of all arrays. Raises BadRequest with the field's name."""
    B, K = len(requests), requests.obstacles.slots
    types = {"b": xp.bool, "f": xp.float64}
    for name, value, kind, shape in _expected(robot, requests):
        if tuple(value.shape) != (B, *shape):
            raise BadRequest(name, f"{name} has shape {tuple(value.shape)}, a batch of {B} requests has {(B, *shape)}")
        if kind in types and value.dtype != types[kind]:
            raise BadRequest(name, f"{name} has the type {value.dtype}, not {'float64' if kind == 'f' else 'bool'}")
    counts = on_host(requests.obstacles.count)
    if counts.dtype.kind != "i":
        raise BadRequest("obstacles.count", f"obstacles.count has the type {counts.dtype}: give signed integers")
    if counts.size and not (counts.min() >= 0 and counts.max() <= K):
        raise BadRequest("obstacles.count", f"obstacles.count holds integers from 0 to {K}, the number of slots")
    if not isinstance(requests.model, str) and len(requests.model) != B:
        raise BadRequest("model", f"model has {len(requests.model)} versions, a batch of {B} requests has {B}")


def _expected(robot: Robot, requests: RequestArrays) -> Iterator[tuple[str, Array, str, tuple[int, ...]]]:
    """Yield the name of each array, the array, its type (f: float64, b: bool) and the shape of its rows."""
    n, m, N, d = robot.state_dim, robot.action_dim, robot.horizon, robot.position_dim
    obstacles = requests.obstacles
    yield "state", requests.state, "f", (n,)
    yield "action", requests.action, "f", (m,)
    yield "input_in_force", requests.input_in_force, "f", (m,)
    yield "plan", requests.plan, "f", (N, m)
    yield "known_free", requests.known_free, "b", ()
    if not isinstance(requests.turn_aside, bool):
        yield "turn_aside", requests.turn_aside, "b", ()
    for name, shape in obstacles.row_shapes(d).items():
        field = "obstacles" if name == "center" else f"obstacles.{name}"
        yield field, getattr(obstacles, name), "i" if name == "count" else "f", shape
    if requests.widening is not None:
        yield "widening", requests.widening, "f", ()
    if requests.state_widening is not None:
        yield "state_widening", requests.state_widening, "f", ()
    if (predicted := requests.predicted) is not None:
        yield "predicted_center", predicted.center, "f", (n,)
        yield "predicted_half_width", predicted.half_width, "f", (n,)
        yield "predicted_heading", predicted.heading, "f", ()
        yield "predicted", predicted.given, "b", ()
    if (past := requests.past) is not None:
        yield "past", past.states, "f", (N, n)
        yield "past.inputs", past.inputs, "f", (N + 1, m)
        yield "past.from_start", past.from_start, "b", ()
        yield "past.given", past.given, "b", ()


def blank_answers(robot: Robot, requests: RequestArrays, xp: Any, device: Any) -> dict[str, Any]:
    """Return the arrays of a `DecisionArrays` without answers."""
    B = len(requests)
    n, m, N, d = robot.state_dim, robot.action_dim, robot.horizon, robot.position_dim
    shapes = {
        "plan": (N, m),
        "tube_center": (N, d),
        "tube_half_width": (N, d),
        "predicted_center": (n,),
        "predicted_half_width": (n,),
        "predicted_heading": (),
        "margin": (),
        "score": (),
        "plan_score": (),
        "proposal_margin": (),
        "too_long_for": (),
    }
    arrays: dict[str, Any] = {
        name: xp.full((B, *shape), xp.nan, dtype=xp.float64, device=device) for name, shape in shapes.items()
    }
    for name in ("at_least", "verified", "contained", "compared", "for_clearance", "scored"):
        arrays[name] = xp.zeros(B, dtype=xp.bool, device=device)
    arrays["kind"] = xp.full(B, KINDS.index("failsafe"), dtype=xp.int64, device=device)
    for name in ("steps", "turned"):
        arrays[name] = xp.zeros(B, dtype=xp.int64, device=device)
    blank = {name: xp.full((B, d), xp.nan, dtype=xp.float64, device=device) for name in ("normal", "at")}
    alone = {name: xp.full(B, xp.nan, dtype=xp.float64, device=device) for name in ("room", "after")}
    arrays["blocked"] = BlockingArrays(xp.full(B, -1, dtype=xp.int64, device=device), **alone, **blank)
    return arrays


def write_decision(answers: dict[str, Any], row: int, decision: Decision) -> None:
    """Write a decision of the single path into its row. A method that verifies nothing has no tube."""
    predicted = decision.predicted
    values = {
        "plan": decision.plan,
        "tube_center": decision.tube_center,
        "tube_half_width": decision.tube_half_width,
        "predicted_center": predicted.center,
        "predicted_half_width": predicted.half_width,
        "predicted_heading": predicted.heading,
        "margin": decision.margin,
        "score": np.nan if decision.score is None else decision.score,
        "plan_score": np.nan if decision.plan_score is None else decision.plan_score,
    }
    for name, value in values.items():
        array = np.asarray(value, dtype=float)
        if array.size:
            answers[name][row] = array
    for name in ("at_least", "verified", "contained", "compared"):
        answers[name][row] = getattr(decision, name)
    answers["for_clearance"][row] = bool(decision.for_clearance)
    answers["scored"][row] = decision.score is not None
    answers["kind"][row] = KINDS.index(decision.kind)
    answers["steps"][row] = decision.iterations
