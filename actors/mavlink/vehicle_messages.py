"""Convert between the messages of an actor and its vehicle server (`messaging/brakeline.proto`) and our own types.

Every function `…_of` checks sizes and numbers before it returns, and raises BadMessage if they are not valid.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from brakeline.actors.actor_settings import FlightSettings
from brakeline.actors.mavlink.periodic_vehicle import ControlPeriod
from brakeline.actors.mavlink.telemetry import Array
from brakeline.errors import BadInput, BadLink, BadMessage, CommandLost, HandoverRefused, MavlinkError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import OLDEST
from brakeline.messaging.obstacle import FARTHEST, Obstacle
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.robot import Robot
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.service.wire import array_of, obstacles_of
from brakeline.sim.quadrotor import QUADROTOR, SAMPLES
from brakeline.sim.vehicle import Period

LONGEST_TEXT = 8000  # characters of a log line or an error
MOST_PORTS, MOST_SYSTEMS = 65535, 255

# The errors that keep their type on the way to the actor; another one arrives as a MavlinkError. Subclasses come first.
ERRORS: tuple[type[Exception], ...] = (
    *(CommandLost, HandoverRefused, MavlinkError),
    *(BadInput, BadLink, BadMessage, OSError),
)


@dataclass(frozen=True)
class FlightRequest:
    """The vehicle to fly. obstacles: the map, against which a ground truth over MAVLink is judged."""

    flight: FlightSettings
    robot: Robot
    obstacles: tuple[Obstacle, ...]


def request_message(request: FlightRequest) -> pb.FlightRequest:
    """Return the message of a flight request."""
    robot = request.robot
    return pb.FlightRequest(
        robot=json.dumps(robot.description),
        late=robot.late,
        obstacles=obstacle_messages(request.obstacles),
        **asdict(request.flight),
    )


def request_of(message: pb.FlightRequest) -> FlightRequest:
    """Return the flight request in a message."""
    try:
        robot = robot_from_description(parse_json(message.robot))
        robot = robot.in_real_time() if message.late else robot
        obstacles = tuple(obstacles_of(message.obstacles, robot.position_dim))
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"flight request: {error}") from error
    if (robot.state_dim, robot.action_dim) != (QUADROTOR.state_dim, QUADROTOR.action_dim):
        raise BadMessage(f"flight request: {robot.name} has another state or another input than a quadrotor")
    if not 1 <= message.system <= MOST_SYSTEMS or message.truth > MOST_PORTS:
        raise BadMessage(f"flight request: system {message.system}, truth port {message.truth}")
    origin = _vector("origin", message.origin, 3)
    if not 0.0 <= message.height <= FARTHEST or np.abs(origin).max() > FARTHEST:  # NaN fails too
        raise BadMessage(f"flight request: height {message.height} m, origin {origin.tolist()} m")
    if not 0.0 <= message.acceleration_age <= OLDEST:
        raise BadMessage(f"flight request: an acceleration of {message.acceleration_age} s ago")
    values: dict[str, Any] = {option.name: getattr(message, option.name) for option in fields(FlightSettings)}
    flight = FlightSettings(**values | {"origin": tuple(origin.tolist())})
    return FlightRequest(flight, robot, obstacles)


def plan_of(message: pb.PlanCommit, robot: Robot, current: int) -> Array:
    """Return the plan (K, inputs) of a commit, K at most the horizon. current: number of the current period.

    Its inputs may be infinite or NaN: `MavlinkVehicle.commit` refuses those.
    """
    rows, rest = divmod(len(message.plan), robot.action_dim)
    if rest or not 1 <= rows <= robot.horizon:
        most = f"1 to {robot.horizon} inputs of {robot.action_dim} numbers"
        raise BadMessage(f"a plan has {most}, not {len(message.plan)} numbers")
    if message.period > current + robot.horizon:
        raise BadMessage(f"a plan for period {message.period} in period {current}: too far ahead")
    return array_of(message.plan).reshape(rows, robot.action_dim)


def period_message(period: ControlPeriod) -> pb.ControlPeriod:
    """Return the message of a control period."""
    report = period.report
    return pb.ControlPeriod(
        number=period.number,
        input=period.input.tolist(),
        measured=report.measured.tolist(),
        true_state=report.true.tolist(),
        collision=report.collision,
        closest=report.closest,
        clearance=report.clearance,
        path=report.subsamples.ravel().tolist(),
        turned=report.turned,
        lost=text_of(period.lost),
    )


def period_of(message: pb.ControlPeriod, robot: Robot) -> ControlPeriod:
    """Return the control period in a message."""
    closest, clearance, turned = message.closest, message.clearance, message.turned
    if math.isnan(closest) or math.isnan(clearance) or not math.isfinite(turned):
        raise BadMessage(f"control period: closest {closest}, clearance {clearance}, turned {turned}")
    report = Period(
        measured=_vector("measured", message.measured, robot.state_dim),
        true=_vector("true_state", message.true_state, robot.state_dim),
        collision=message.collision,
        closest=closest,
        clearance=clearance,
        subsamples=_vector("path", message.path, SAMPLES * robot.position_dim).reshape(SAMPLES, robot.position_dim),
        turned=turned,
    )
    return ControlPeriod(message.number, _vector("input", message.input, robot.action_dim), report, message.lost)


def error_message(error: Exception) -> pb.Error:
    """Return the message of an error."""
    known = next((kind.__name__ for kind in ERRORS if isinstance(error, kind)), type(error).__name__)
    return pb.Error(type=known, message=text_of(str(error)))


def error_of(message: pb.Error) -> Exception:
    """Return the error in a message: of its own type if that is one of `ERRORS`, else a MavlinkError."""
    kind = next((kind for kind in ERRORS if kind.__name__ == message.type), None)
    return MavlinkError(f"{message.type}: {message.message}") if kind is None else kind(message.message)


def text_of(text: str) -> str:
    """Return a text that a protobuf field can hold: valid Unicode, and not too long."""
    return text[:LONGEST_TEXT].encode(errors="replace").decode()


def _vector(name: str, field: Collection[float], size: int) -> Array:
    """Return a repeated field as an array of finite numbers."""
    if len(field) != size:
        raise BadMessage(f"{name}: {len(field)} numbers, not {size}")
    vector = array_of(field)
    if not np.isfinite(vector).all():
        raise BadMessage(f"{name}: not finite: {vector.tolist()}")
    return vector
