"""Conversion between messages and the filter's requests and decisions.

This module or `Filter.decide` checks every field of a request before its use.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from brakeline.errors import BadRequest, BadScan, BadShape, SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.moving_obstacles import MovingObstacles, split_moving
from brakeline.messaging.obstacle import FARTHEST, Obstacle, Shapes
from brakeline.messaging.obstacle_messages import obstacle_of
from brakeline.messaging.robot import Robot
from brakeline.messaging.sensor_messages import RangeMeasurement, measurement_in
from brakeline.messaging.stated_share import valid_bound
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.blocking_constraint import BlockingConstraint
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, RECOVERING, Decision, Request
from brakeline.safety.filter.reservation import OtherReservations, Reservation
from brakeline.safety.filter.widening import PastWindow
from brakeline.safety.model.model_config import MOST_OUTSIDE

KIND_NUMBERS = {ALLOWED: pb.ALLOWED, ADJUSTED: pb.ADJUSTED, FAILSAFE: pb.FAILSAFE, RECOVERING: pb.RECOVERING}
KIND_NAMES = {number: name for name, number in KIND_NUMBERS.items()}
# Limits on the cost of a batch, which the service checks before it does the work.
MAX_BATCH_SIZE = 2**20  # bytes: about thirty requests with a range image each
MAX_REQUESTS = 64  # of a batch
MAX_OTHER_FIELDS = 16  # of a batch: its nonce, and fields of later versions
MAX_OBSTACLES = 1000  # of all requests of a batch
FIXED_64, LENGTH, FIXED_32 = 1, 2, 5  # wire types of protobuf; the others are one varint
DIGEST_SIZE = 16  # bytes
# Fields with the same name and value in a decision and in its message.
SAME_FIELDS = (
    *("margin", "at_least", "model", "reason", "verified", "contained", "compared"),
    *("time_ms", "solve_ms", "verify_ms", "solver", "iterations", "broken", "judges"),
)


def digest(batch: bytes) -> bytes:
    """Return a digest that names a batch of requests, nonce included, so that a reply can state its batch."""
    return hashlib.sha256(batch).digest()[:DIGEST_SIZE]


def batch_of(payload: bytes) -> pb.RequestBatch:
    """Return the batch in a payload. Raises BadRequest if it is not a batch, or too large."""
    if len(payload) > MAX_BATCH_SIZE:
        raise BadRequest("payload", f"{len(payload)} bytes; a request batch has at most {MAX_BATCH_SIZE}: send several")
    if _count_requests(payload, MAX_REQUESTS) > MAX_REQUESTS:
        raise BadRequest("requests", f"a batch has at most {MAX_REQUESTS} requests: send several")
    try:
        batch = pb.RequestBatch.FromString(payload)
    except DecodeError as error:
        raise BadRequest("payload", f"not a request batch: {error}") from error
    if not batch.requests:
        raise BadRequest("requests", "the batch holds no request")
    obstacles = sum(len(request.obstacles) for request in batch.requests)
    if obstacles > MAX_OBSTACLES:
        raise BadRequest(
            "obstacles", f"{obstacles} obstacles; a batch has at most {MAX_OBSTACLES}: send several, or near ones only"
        )
    return batch


def _count_requests(payload: bytes, most: int) -> int:
    """Return the number of requests of a batch on the wire, or `most + 1` if there are more, or too many other fields.

    The service counts before it decodes: to decode half a million empty requests takes longer than a robot can wait.
    """
    at = count = others = 0
    while at < len(payload) and count <= most:
        tag, at = _varint(payload, at)
        if tag >> 3 == pb.RequestBatch.REQUESTS_FIELD_NUMBER:
            count += 1
        else:
            others += 1
        wire_type = tag & 7
        if wire_type in (FIXED_64, FIXED_32):
            at += 8 if wire_type == FIXED_64 else 4
        else:
            value, at = _varint(payload, at)
            at += value if wire_type == LENGTH else 0
        if others > MAX_OTHER_FIELDS:
            return most + 1
    return count


def _varint(payload: bytes, at: int) -> tuple[int, int]:
    """Return the varint at a position, and the position after it. A truncated varint ends with the payload."""
    value = shift = 0
    while at < len(payload):
        byte = payload[at]
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128 or shift > 63:
            break
    return value, at


def request_of(
    message: pb.Request,
    robot: Robot,
    reservation: Reservation | None = None,
    other_reservations: OtherReservations | None = None,
) -> Request:
    """Return the request in a message.

    Args:
        message: a request about this robot.
        robot: the robot of the method that decides.
        reservation: the present reservation of this robot, if it is in a fleet.
        other_reservations: those of the fleet's other robots.

    Raises:
        BadRequest: an obstacle, a size or a value is wrong; `field` names it.
    """
    predicted = None
    if message.predicted_center or message.predicted_half_width:
        center, half = array_of(message.predicted_center), array_of(message.predicted_half_width)
        predicted = Prediction(center, half, message.predicted_heading)
    plan = array_of(message.plan)
    if plan.size != robot.horizon * robot.action_dim:
        size = f"{robot.horizon} x {robot.action_dim}"
        raise BadRequest("plan", f"plan has {plan.size} numbers; a plan of {robot.name} has {size}")
    obstacles, movers = surroundings_of(message.obstacles, robot.position_dim)
    return Request(
        state=array_of(message.state),
        action=array_of(message.action),
        input_in_force=array_of(message.input_in_force),
        plan=plan.reshape(robot.horizon, robot.action_dim),
        obstacles=obstacles,
        movers=movers,
        scan=measurement_of(message),
        model=message.model,
        predicted=predicted,
        reservation=reservation,
        other_reservations=other_reservations,
        observation=np.fromiter(message.observation, np.float32, len(message.observation)),
        known_free=message.known_free,
        turn_aside=message.turn_aside,
        widening=message.widening or 1.0,
        state_widening=message.state_widening or 1.0,
        past=_past_of(message, robot),
        acceleration_age=message.acceleration_age,
    )


def _past_of(message: pb.Request, robot: Robot) -> PastWindow | None:
    if not message.past_states and not message.past_inputs:
        return None
    states, inputs, N = array_of(message.past_states), array_of(message.past_inputs), robot.horizon
    if (states.size, inputs.size) != (N * robot.state_dim, (N + 1) * robot.action_dim):
        why = f"past must have {N} states and {N + 1} inputs of {robot.name}: send a whole window, or none"
        raise BadRequest("past", why)
    return PastWindow(states.reshape(N, -1), inputs.reshape(N + 1, -1), message.past_from_start)


def array_of(field: Collection[float]) -> NDArray[np.float64]:
    """Return a repeated field as an array. `np.array` would take five times as long."""
    return np.fromiter(field, np.float64, len(field))


def surroundings_of(messages: Sequence[pb.Obstacle], dim: int) -> tuple[Shapes, MovingObstacles | None]:
    """Return the standing and the moving obstacles in messages, as `split_moving`. Raises BadRequest.

    A cache holds the latest standing obstacles, because a robot sends the same ones in many requests.
    """
    if any(message.HasField("motion") for message in messages):
        return split_moving(obstacles_of(messages, dim), dim)
    return _standing(dim, *[message.SerializeToString() for message in messages]), None


@lru_cache(256)
def _standing(dim: int, *payloads: bytes) -> Shapes:
    return Shapes.of(obstacles_of([pb.Obstacle.FromString(payload) for payload in payloads], dim), dim)


def obstacles_of(messages: Sequence[pb.Obstacle], dim: int) -> list[Obstacle]:
    """Return the obstacles in messages. Raises BadRequest; `field` names the obstacle and its field."""
    obstacles = []
    for i, message in enumerate(messages):
        try:
            obstacles.append(obstacle_of(message, dim))
        except BadShape as error:
            raise BadRequest(f"obstacles[{i}].{error.field}", str(error)) from error
    return obstacles


def measurement_of(message: pb.Request) -> RangeMeasurement | None:
    """Return the scan or range image in a request. Raises BadRequest if it is not valid."""
    try:
        return measurement_in(message)
    except BadScan as error:
        raise BadRequest("scan" if message.HasField("scan") else "image", str(error)) from error


def reservation_of(m: pb.Reservation, robot: Robot) -> Reservation:
    """Return the reservation in a message. Raises BadRequest if it does not fit the robot."""
    shape = robot.horizon, robot.position_dim
    if {len(m.center), len(m.half_width)} != {shape[0] * shape[1]} or len(m.radius) != shape[0]:
        raise BadRequest("reservation", f"a reservation of {robot.name} has {shape[0]} boxes in {shape[1]} coordinates")
    center, half, radius = array_of(m.center), array_of(m.half_width), array_of(m.radius)
    within = all((np.abs(part) <= FARTHEST).all() for part in (center, half, radius))  # NaN fails too
    if not within or (half < 0.0).any() or (radius < 0.0).any():
        raise BadRequest("reservation", f"a reservation's numbers are {FARTHEST:g} at most, and its sizes not negative")
    return Reservation(center.reshape(shape), half.reshape(shape), radius)


def decision_reply(decision: Decision, queue_ms: float) -> pb.Reply:
    """Return the reply with a decision. queue_ms: time from the receipt of the request to the decision."""
    message = pb.Decision(
        kind=KIND_NUMBERS[decision.kind],
        plan=decision.plan.ravel().tolist(),
        tube_center=decision.tube_center.ravel().tolist(),
        tube_half_width=decision.tube_half_width.ravel().tolist(),
        predicted_center=decision.predicted.center.tolist(),
        predicted_half_width=decision.predicted.half_width.tolist(),
        predicted_heading=decision.predicted.heading,
        queue_ms=queue_ms,
        for_clearance=decision.for_clearance,
        bound=decision.bound,
        outside_share=decision.outside_share,
        score=decision.score,
        plan_score=decision.plan_score,
        **{name: getattr(decision, name) for name in SAME_FIELDS},
    )
    if (stopped := decision.blocked_by) is not None:
        message.stopped.by, message.stopped.room, message.stopped.after = stopped.by, stopped.room, stopped.after
        message.stopped.normal.extend(stopped.normal.tolist())
        message.stopped.at.extend(stopped.at.tolist())
    if decision.reservation is not None:
        message.reservation.CopyFrom(reservation_message(decision.reservation))
    return pb.Reply(decision=message)


def set_decision(step: pb.Step, decision: Decision) -> None:
    """Copy the kind of a decision, its time and its flags to a step."""
    step.decision, step.decide_ms, step.broken = KIND_NUMBERS[decision.kind], decision.time_ms, decision.broken
    if decision.for_clearance is not None:
        step.for_clearance = decision.for_clearance


def decision_of(m: pb.Decision, robot: Robot) -> Decision:
    """Return the decision in a message. The caller has checked the size of its plan.

    Raises:
        BadRequest: its kind, tube or reservation does not fit the robot; `field` names it.
    """
    if m.kind not in KIND_NAMES:
        raise BadRequest("kind", f"{m.kind} is no kind of decision: use the version of the service")
    d = robot.position_dim
    tube = array_of(m.tube_center), array_of(m.tube_half_width)
    if {part.size for part in tube} not in ({0}, {robot.horizon * d}):  # the rivals have none
        raise BadRequest("tube_center", f"a tube of {robot.name} has {robot.horizon} boxes in {d} coordinates, or none")
    if not all(np.isfinite(part).all() for part in tube) or (tube[1] < 0.0).any():
        raise BadRequest("tube_center", "a tube that holds NaN, infinity or a negative half-width")
    stopped = None
    if m.HasField("stopped"):
        where = array_of(m.stopped.normal), array_of(m.stopped.at)
        stopped = BlockingConstraint(m.stopped.by, m.stopped.room, m.stopped.after, *where)
    return Decision(
        kind=KIND_NAMES[m.kind],
        plan=array_of(m.plan).reshape(robot.horizon, robot.action_dim),
        tube_center=tube[0].reshape(-1 if d else 0, d),  # in joint space there are no boxes
        tube_half_width=tube[1].reshape(-1 if d else 0, d),
        predicted=Prediction(array_of(m.predicted_center), array_of(m.predicted_half_width), m.predicted_heading),
        **{name: getattr(m, name) for name in SAME_FIELDS},
        blocked_by=stopped,
        reservation=reservation_of(m.reservation, robot) if m.HasField("reservation") else None,
        for_clearance=m.for_clearance if m.HasField("for_clearance") else None,
        bound=valid_bound(m.bound) if m.HasField("bound") else None,
        # Any other share counts as 0: then no score is left out, and the largest one counts.
        outside_share=m.outside_share if 0.0 <= m.outside_share <= MOST_OUTSIDE else 0.0,
        score=max(m.score, 0.0) if m.HasField("score") else None,
        plan_score=max(m.plan_score, 0.0) if m.HasField("plan_score") else None,
    )


def reservation_message(reservation: Reservation) -> pb.Reservation:
    """Return the message of a reservation."""
    return pb.Reservation(
        center=reservation.center.ravel().tolist(),
        half_width=reservation.half_width.ravel().tolist(),
        radius=reservation.radius.tolist(),
    )


def error_reply(error: Exception) -> pb.Reply:
    """Return the reply with an error: its type, its field if it has one, and its message."""
    name = type(error).__name__
    return pb.Reply(error=pb.Error(type=name, field=str(getattr(error, "field", "")), message=str(error)))


def bad_reply(field: str, message: str) -> SafetyError:
    """Return the error that a client raises if a reply is not valid."""
    return SafetyError(pb.Error(type="BadReply", field=field, message=message))
